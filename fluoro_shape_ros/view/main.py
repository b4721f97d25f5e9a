"""fluoro_shape_view: images, backbone and figures over time in Rerun, without RViz; live from nodes, or from a bag."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from .. import cli
from .page import LOOPBACK, PORT, address, serve
from .viewer import free_port, viewer

PROG = 'fluoro_shape_view'
ROS_PACKAGES = 'rclpy', 'sensor_msgs', 'nav_msgs', 'geometry_msgs', 'diagnostic_msgs'


def main(argv=None) -> int:
    """The command line; Ctrl-C ends it."""
    parser = make_parser()
    return cli.run(lambda args: _run(args, parser), parser, argv)


def make_parser() -> argparse.ArgumentParser:
    """What the command line may have."""
    parser = argparse.ArgumentParser(
        PROG, description='See both planes with overlays, the backbone with its tip ellipsoid between sources and '
                          'detectors, ground truth where a simulator publishes it, and confidence, sigma, '
                          'latency and outcomes over time: live from nodes, or from a bag. Ends with Ctrl-C.')
    add = parser.add_argument
    add('namespaces', nargs='*', type=namespace, metavar='NAMESPACE',
        help='of the nodes to watch (default: /; of a bag: all that have results in it)')
    add('--bag', metavar='BAG', help='a bag with results instead, of fluoro_shape_replay '
                                     '(with --with-images it shows them too) or of ros2 bag record')
    to = parser.add_mutually_exclusive_group()
    to.add_argument('--web', action='store_true', help='a page for any browser, instead of a window of Rerun\'s own')
    to.add_argument('--save', type=Path, metavar='FILE.rrd', help='a new file instead, which `rerun FILE.rrd` shows')
    add('--bind', default=LOOPBACK, metavar='ADDRESS',
        help='of the page (default: %(default)s, for browsers on this machine alone); there is no password')
    add('--port', type=port, default=PORT, metavar='N', help='of the page (default: %(default)s)')
    add('--no-images', action='store_true', help='leave the images out: a node draws overlays only for those who look')
    add('--wait', type=cli.positive, default=20.0, metavar='S',
        help='give up where no node was heard within S seconds (default: %(default)g)')
    add('--seconds', type=cli.positive, metavar='S', help='end after S seconds (default: with Ctrl-C)')
    add('-r', '--remap', action='append', default=[], metavar='FROM:=TO',
        help='another name for a topic, as for the node; may be repeated')
    add('--ros-args', action='store_true', help=argparse.SUPPRESS)      # so that -r can be given as to the node
    return parser


def namespace(text: str) -> str:
    """A ROS namespace, absolute."""
    if not re.fullmatch(r'/?([A-Za-z_]\w*(/[A-Za-z_]\w*)*/?)?', text, re.ASCII):
        raise argparse.ArgumentTypeError(f'"{text}" is no namespace: its parts are letters, digits and _, between /')
    return '/' + text.strip('/')


def port(text: str) -> int:
    """The number of a port."""
    if not 1 <= (number := int(text)) < 65536:
        raise argparse.ArgumentTypeError(f'{text} is no port from 1 to 65535')
    return number


def _run(args, parser: argparse.ArgumentParser) -> int:
    rerun = cli.need('rerun', 'view')
    for rule in args.remap:
        if not all(rule.partition(':=')):
            parser.error(f'-r {rule}: needs the form FROM:=TO')
    if args.bag is None:
        for package in ROS_PACKAGES:
            cli.need(package, 'ros')
        from ..sim.publisher import use_large_image_profile
        use_large_image_profile()
    else:
        for module in ('rosbags.highlevel', 'mcap.stream_reader'):
            cli.need(module, 'bags')
    told = _told_to_stop(args.seconds)
    return _live(args, rerun, told, parser) if args.bag is None else _recorded(args, rerun, told)


def _live(args, rerun, told: threading.Event, parser: argparse.ArgumentParser) -> int:
    from .live import watch
    from .node_view import NodeView, into
    names = list(dict.fromkeys(args.namespaces or ['/']))
    with _shown(args, rerun, names) as (recording, closed):
        try:
            watch({name: NodeView(into(recording), name) for name in names},
                  ros_arguments=['--ros-args', *(word for rule in args.remap for word in ('-r', rule))],
                  images=not args.no_images, wait_s=args.wait, stop=lambda: told.is_set() or closed())
        except ValueError as error:
            parser.error(' '.join(str(error).split()))
    return 0


def _recorded(args, rerun, told: threading.Event) -> int:
    from msg_adapters.bags import BadBag, open_bag

    from .node_view import NodeView, into
    from .recorded import RESULTS, has_latency, namespaces, play, topics_of
    try:
        with open_bag(args.bag) as bag:
            known, others = namespaces(bag.types()), dict(rule.split(':=', 1) for rule in args.remap)
            names = list(dict.fromkeys(args.namespaces or known or ['/']))
            topics = {name: topics_of(name, bag.types(), others, not args.no_images) for name in names}
            if without := [name for name in names if not RESULTS & set(topics[name].values())]:
                raise cli.ToolError(f'{args.bag}: there are no results ({" or ".join(sorted(RESULTS))}) in '
                                    f'{", ".join(without)}; '
                                    + (f'those in it are in {", ".join(known)}'
                                       if known else 'fluoro_shape_replay makes a bag that has them'))
            with _shown(args, rerun, names, has_latency(bag)) as (recording, closed):
                def stop() -> bool:
                    return told.is_set() or closed()
                play(bag, [(NodeView(into(recording), name), topics[name]) for name in names], stop)
                while args.save is None and not stop():     # for who looks later
                    told.wait(0.2)
            damage = bag.damage
    except BadBag as error:
        raise cli.ToolError(str(error)) from error
    if damage:
        raise cli.ToolError(damage)
    return 0


@contextlib.contextmanager
def _shown(args, rerun, names: list[str], latency: bool = True) -> Iterator[tuple[object, Callable[[], bool]]]:
    """A recording that goes where the arguments say, and whether nobody looks any more."""
    from .node_view import root_of
    from .scene import layout
    recording = rerun.RecordingStream(PROG)
    with contextlib.ExitStack() as stack:
        if args.save is not None:
            _save(recording, args.save)
            closed = lambda: False      # noqa: E731
        else:
            if not args.web and sys.platform == 'linux' and not (os.environ.get('DISPLAY')
                                                                 or os.environ.get('WAYLAND_DISPLAY')):
                raise cli.ToolError('there is no display for a window here; take --web or --save FILE.rrd')
            data_port, page_port = free_port(), free_port() if args.web else None
            if page_port is not None:       # first, since it tells at once where the port is taken
                stack.enter_context(serve(args.bind, args.port, page_port, data_port))
            process = stack.enter_context(viewer(data_port, page_port))
            recording.connect_grpc(f'rerun+http://{LOOPBACK}:{data_port}/proxy')
            closed = lambda: process.poll() is not None     # noqa: E731
            if page_port is not None:
                print(f'{PROG}: to be seen at {address(args.bind, args.port)}', flush=True)
        recording.send_blueprint(layout([root_of(name) for name in names], latency))
        try:
            yield recording, closed
        except (cli.ToolError, SystemExit):
            recording.disconnect()
            if args.save is not None:
                args.save.unlink(missing_ok=True)
            raise
        if args.web and closed():
            raise cli.ToolError('Rerun\'s viewer ended by itself')
        recording.disconnect()


def _save(recording, path: Path) -> None:
    if path.exists():
        raise cli.ToolError(f'{path} exists already and is not overwritten')
    try:
        recording.save(path)
    except RuntimeError as error:
        raise cli.ToolError(f'{path}: {error}') from error


def _told_to_stop(seconds: float | None) -> threading.Event:
    """Set by the first Ctrl-C or SIGTERM, or after `seconds`; the second one raises KeyboardInterrupt."""
    told = threading.Event()

    def handler(*_):
        if told.is_set():
            raise KeyboardInterrupt
        told.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)
    if seconds is not None:
        timer = threading.Timer(seconds, told.set)
        timer.daemon = True
        timer.start()
    return told


if __name__ == '__main__':
    sys.exit(main())
