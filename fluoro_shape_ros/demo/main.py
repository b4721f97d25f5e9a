"""fluoro_shape_demo: a simulated biplane system and the node, two processes on real topics, and how well the one sees
the other."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from .. import cli
from ..config import fields
from ..device import load_device, presets
from ..files import pictures
from ..view.page import LOOPBACK, PORT, address
from .score import Score, headline, live_line, summary

FRAME = 'isocenter'
RENDERED = 20           # pairs, played forth and back
STARTUP_S = 60.0        # for the simulator to render and everybody to find each other
SNAPSHOT_S = 10.0       # to catch one answered pair with its images at the end
STOP_S = 5.0            # for a child to end by itself


def main(argv=None) -> int:
    """The command line; Ctrl-C ends it early, with the summary."""
    return cli.run(_run, _parser(), argv)


def _parser() -> argparse.ArgumentParser:
    method = next(f for f in fields() if f.name == 'method')
    parser = argparse.ArgumentParser(
        'fluoro_shape_demo', formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Watch a moving continuum device being reconstructed from two simulated X-ray streams, live on ROS '
                    '2 topics: starts fluoro_shape_sim and fluoro_shape_node, compares results with ground truth, '
                    'ends with a summary and pictures.')
    add = parser.add_argument
    add('--seconds', type=cli.positive, default=20.0, metavar='S', help='how long')
    add('--rate', type=cli.positive, default=5.0, metavar='HZ', help='pairs a second')
    add('--seed', type=int, default=9, help='another seed is another device')
    add('--method', choices=method.metadata['choices'], default=method.default, help='parameter of the node')
    add('--renderer', choices=('xray', 'vtk'), default='xray',
        help='X-ray attenuation, or the VTK tube with blur and white noise of Burgner et al. 2011')
    add('--device', metavar='NAME|FILE', type=cli.device,
        help=f'what it looks like, under fluoroscopy: a file, or {", ".join(presets())} (xray only)')
    add('--no-anatomy', action='store_true', help='an even background instead of ribs and spine (xray only); '
                                                  'the method `paper` needs it')
    add('--out', type=Path, default=Path('fluoro_shape_demo'), metavar='FOLDER', help='pictures and logs go there')
    add('--view', action='store_true', help='see it in a browser too: starts fluoro_shape_view --web beside')
    add('--domain', type=int, default=47, metavar='ID',
        help='ROS_DOMAIN_ID, so that nothing else on this machine is disturbed')
    return parser


def _run(args) -> int:
    for module, extra in (('rclpy', 'ros'), ('nav_msgs', 'ros'), ('matplotlib', 'plot')):
        cli.need(module, extra)
    if args.view:
        cli.need('rerun', 'view')
    pictures.clear(args.out)
    os.environ.update(ROS_DOMAIN_ID=str(args.domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
    from ..sim.publisher import use_large_image_profile
    from .watcher import Watcher
    use_large_image_profile()
    told = _told_to_stop()
    with contextlib.ExitStack() as stack:
        children = {name: stack.enter_context(child(arguments, args.out / f'{name}.log'))
                    for name, arguments in commands(args).items()}
        watcher = stack.enter_context(Watcher())

        def spin(until: Callable[[], bool], seconds: float) -> None:
            deadline = time.monotonic() + seconds
            while time.monotonic() < deadline and not until():
                watcher.spin(0.05)
                check_alive(children, args.out)

        if args.view:
            print(f'fluoro_shape_demo: to be seen at {address(LOOPBACK, PORT)}', flush=True)
        print('fluoro_shape_demo: rendering and connecting ...', flush=True)
        spin(lambda: told.is_set() or watcher.score.start_ns is not None, STARTUP_S)
        if watcher.score.start_ns is None and not told.is_set():
            raise cli.ToolError(f'no image came within {STARTUP_S:.0f} s, see {args.out / "sim.log"}')
        end = time.monotonic() + args.seconds
        while time.monotonic() < end and not told.is_set():
            spin(told.is_set, min(1.0, end - time.monotonic()))
            print(live_line(watcher.score, time.time_ns(), watcher.reason), flush=True)
        now_ns, measured, not_answered = time.time_ns(), watcher.score, dict(watcher.not_answered)
        watcher.score = Score()     # what comes while images are watched too does not count
        if measured.answers:
            watcher.watch_images()
            spin(lambda: watcher.snapshot is not None, SNAPSHOT_S)
    return _report(args, measured, now_ns, not_answered, watcher.snapshot)


def commands(args) -> dict[str, list[str]]:
    """The arguments of Python for each child."""
    # an active cannula whose shaft comes in through the border, so that the free end is known to be the tip; 0.3 mm a
    # pixel at the isocentre
    device = ['--shape', 'cannula', '--length', '0.14', '0.188', '--moving', '--entering', '--pixel-size', '0.00044']
    sim = ['--seed', str(args.seed), '--rate', str(args.rate), '--renderer', args.renderer, '--prerender',
           str(RENDERED), '--wait', str(STARTUP_S)]
    if args.no_anatomy:
        sim.append('--no-anatomy')
    radius = []
    if args.device:
        sim += ['--device', args.device]
        radius = ['-p', f'robot_radius:={load_device(args.device).radius}']
    view = {'view': ['-m', 'fluoro_shape_ros.view.main', '--web', '--wait', str(STARTUP_S)]} if args.view else {}
    return view | {'node': ['-m', 'fluoro_shape_ros.node', '--ros-args', '-p', f'method:={args.method}', '-p',
                            f'reference_frame:={FRAME}', *radius],
            'sim': ['-m', 'fluoro_shape_ros.sim.main', *sim, *device, '--reference-frame', FRAME]}


@contextlib.contextmanager
def child(arguments: list[str], log: Path) -> Iterator[subprocess.Popen]:
    """A Python process that writes into `log` and is ended when the block is left."""
    with log.open('w') as output:
        # in a process group of its own: Ctrl-C in the terminal is for the demo, which still wants a last picture from
        # its children
        process = subprocess.Popen([sys.executable, *arguments], stdin=subprocess.DEVNULL, stdout=output,
                                   stderr=subprocess.STDOUT, process_group=0)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _told_to_stop() -> threading.Event:
    """Set by the first Ctrl-C, SIGTERM or hang-up; the second one raises KeyboardInterrupt."""
    told = threading.Event()

    def handler(*_):
        if told.is_set():
            raise KeyboardInterrupt
        told.set()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, handler)
    return told


def check_alive(children: dict[str, subprocess.Popen], out: Path) -> None:
    """Raises ToolError, with the child's own words, where one has ended."""
    for name, process in children.items():
        if process.poll() is not None:
            log = out / f'{name}.log'
            words = log.read_text(errors='replace').strip().splitlines()
            raise cli.ToolError(f'the {name} ended with exit code {process.returncode}, see {log}: '
                                f'{words[-1] if words else "it said nothing"}')


def _report(args, measured: Score, now_ns: int, not_answered: dict[str, int],
            snapshot: pictures.Snapshot | None) -> int:
    print('\n' + '\n'.join(summary(measured, now_ns, not_answered)), flush=True)
    if not measured.answers:
        print('pictures    none without a result', flush=True)
        return 0
    answers, start = measured.answers, measured.start_ns
    history = pictures.History(t=np.array([a.stamp_ns - start for a in answers]) * 1e-9,
                               mean=np.array([a.errors.mean for a in answers]),
                               tip=np.array([a.errors.tip for a in answers]),
                               unanswered=np.array([s - start for s in measured.unanswered(now_ns)]) * 1e-9)
    saved = pictures.save(args.out, snapshot, history,
                          f'fluoro_shape_ros, method {args.method}: {headline(measured, now_ns)}')
    print(f'pictures    {", ".join(str(path) for path in saved)}', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
