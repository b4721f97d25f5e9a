"""fluoro_shape_servo_demo: a simulated continuum robot whose controller sees nothing but `tip_pose`, on real topics."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from pathlib import Path

import numpy as np

from .. import cli
from ..device import presets
from ..sim import ct, imaging
from ..sim.plant import MODEL_ERROR, ROBOTS

TOLERANCE = 0.3e-3      # m, in which the true tip has to end


def main(argv=None) -> int:
    """The command line; exit code 1 where a run ends farther than TOLERANCE from a target."""
    return cli.run(_run, _parser(), argv)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        'fluoro_shape_servo_demo', formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        description='Close the loop: a robot that bends otherwise than its model and is pushed by tissue, '
                    'two X-ray streams, the node, and a controller that sees only `tip_pose` drive the tip along a '
                    'square and to targets, four processes on real topics. A mask is captured before the '
                    'robot comes into the field. Prints the errors of the true tip, the delay of the loop, '
                    'and by how much the robot misses the targets without it.')
    add = parser.add_argument
    add('--robot', choices=tuple(ROBOTS), default='two_tubes', help='concentric tubes, or a segment bent by tendons')
    add('--runs', type=cli.count, default=1, metavar='N', help='each with a robot, a load and targets of its own')
    add('--seed', type=int, default=0, help='of the first run; they count up')
    add('--targets', type=cli.count, default=3, metavar='N', help='of each run')
    add('--square', type=float, default=0.012, metavar='M', help='side of the square, m; 0: none')
    add('--blackout', action='store_true', help='halfway along the square, plane B does not show the device for 1 s')
    add('--rate', type=_rate, default=15.0, metavar='HZ', help='pairs a second')
    add('--size', type=cli.count, default=512, metavar='PX', help='of the images, which always show 154 mm')
    add('--device', metavar='NAME|FILE', type=cli.device,
        help=f'what the robot looks like, instead of a rod: a file, or {", ".join(presets())}')
    add('--imaging', choices=[name for name in imaging.SETTINGS if name not in imaging.CIRCULAR], default='fluoroscopy',
        help='physics and display, with --device or --ct')
    add('--ct', metavar='FILE', type=_ct,
        help='a CT instead of ribs and spine, and the robot a rod of metal: a .npz file with hu and spacing_m, '
             'or a folder with a DICOM series')
    add('--no-anatomy', action='store_true', help='an even background instead of ribs and spine')
    add('--no-mask', action='store_true', help='no mask is captured before the robot comes into the field')
    add('--out', type=Path, default=Path('fluoro_shape_servo_demo'), metavar='FOLDER',
        help='the picture and logs go there')
    add('--domain', type=int, default=48, metavar='ID',
        help='ROS_DOMAIN_ID, so that nothing else on this machine is disturbed')
    return parser


def _rate(text: str) -> float:
    value = float(text)
    if not 0 < value < 1e3:
        raise argparse.ArgumentTypeError(f'{text} is no rate')
    return value


def _ct(text: str) -> str:
    """The file or folder of a CT, as it is given, once it is known to be one."""
    try:
        ct.load_ct(text)
    except ct.CtError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


def _run(args) -> int:
    for module, extra in (('rclpy', 'ros'), ('nav_msgs', 'ros'), ('matplotlib', 'plot')):
        cli.need(module, extra)
    from ..sim.publisher import use_large_image_profile
    signal.signal(signal.SIGTERM, signal.default_int_handler)      # no child may outlive the demo
    args.out.mkdir(parents=True, exist_ok=True)
    os.environ.update(ROS_DOMAIN_ID=str(args.domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
    use_large_image_profile()
    from .servo_plot import draw
    from .servo_robot import shown
    from .servo_run import run
    print(f'{args.robot}, bends by {100 * MODEL_ERROR:.0f} % otherwise than its model; its tip is pushed aside; '
          f'{args.rate:g} pairs/s\n{HEADING}', flush=True)
    runs = []
    for k in range(args.runs):
        runs.append(run(args, args.seed + k))
        print(line(runs[-1], args.rate), flush=True)
    print(f'picture     {draw(runs[0], args.out / "servo.png", shown(args, args.seed))}', flush=True)
    missed = sum(r.final.max() > TOLERANCE for r in runs)
    if missed:
        raise cli.ToolError(f'{missed} of {len(runs)} runs ended farther than {TOLERANCE * 1e3:g} mm from a target')
    print(f'all {len(runs)} runs ended within {TOLERANCE * 1e3:g} mm of every target; '
          f'without the loop the same robots miss by {1e3 * min(min(r.open_loop) for r in runs):.1f} to '
          f'{1e3 * max(max(r.open_loop) for r in runs):.1f} mm', flush=True)
    return 0


HEADING = (f'{"seed":>4s} {"final error mm":>22s} {"open loop mm":>18s} {"square rms mm":>13s} {"delay ms":>8s} '
           f'{"pairs":>5s} {"answered":>8s} {"robot s":>7s} {"wall s":>6s}')


def line(r, rate: float) -> str:
    """A row of the table: errors at the end of the square (if any) and at each target; what the same robot misses the
    targets by without the loop."""
    begun = min(r.record.target)
    pairs = [t for t in r.record.true if t >= begun]
    delay = f'{1e3 * np.median(r.record.delays):8.0f}' if r.record.delays else f'{"-":>8s}'
    text = (f'{r.seed:4d} {_mm(r.final, 2):>22s} {_mm(r.open_loop, 1):>18s} {1e3 * r.tracking:13.2f} {delay} '
            f'{len(pairs):5d} {sum(t in r.record.measured for t in pairs):8d} {r.robot_seconds:7.1f} {r.seconds:6.1f}')
    if found := r.blackout(1 / rate):
        text += (f'\n     blackout of plane b: the tip moved {1e3 * found[0]:.2f} mm while the controller held, '
                 f'and was measured again {found[1]} pairs after it')
    return text


def _mm(errors, digits: int) -> str:
    return ' '.join(f'{1e3 * e:.{digits}f}' for e in errors)


if __name__ == '__main__':
    sys.exit(main())
