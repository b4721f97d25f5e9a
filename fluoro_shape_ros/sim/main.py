"""fluoro_shape_sim: a simulated biplane system on real topics, without a launch file."""

from __future__ import annotations

import argparse
import itertools
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from .. import cli
from ..device import load_device, presets
from ..geometry.cameras import check_pair
from ..node import own_arguments
from . import carm, ct, imaging, scenes, variety, xray
from .placement import KINDS

STILL_FRAMES, MOVING_FRAMES = 8, 32     # rendered beforehand


def main(argv=None) -> int:
    """Publish simulated pairs until told to stop; the exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    parser = _parser()
    # until publishing begins, SIGTERM ends the program as Ctrl-C does
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    code = cli.run(lambda args: _run(args, parser, argv), parser, own_arguments(argv))
    return 0 if code == 130 else code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        'fluoro_shape_sim', usage='fluoro_shape_sim [-h] [options] [--ros-args -r TOPIC:=OTHER ...]',
        description='Publish simulated biplane fluoroscopy with ground truth: plane_a/image_raw, plane_a/camera_info, '
                    'plane_b/image_raw, '
                    'plane_b/camera_info, ground_truth/backbone, ground_truth/tip. Ends with Ctrl-C.')
    for title, options in (('stream', _STREAM), ('device', _DEVICE), ('images', _IMAGES), ('geometry', _GEOMETRY)):
        group = parser.add_argument_group(title)
        for name, text, kind in options:
            shown = ' (default %(default)s)' if kind.get('default') is not None and 'nargs' not in kind else ''
            group.add_argument(name, help=text + shown, **kind)
    return parser


# name, help, and what argparse needs to know
_STREAM = (
    ('--rate', 'pairs a second', dict(type=cli.positive, default=15.0, metavar='HZ')),
    ('--frames', 'end after N pairs (default: never)', dict(type=cli.natural, metavar='N')),
    ('--wait', 'publish only once somebody listens to all images and camera infos; give up after S seconds',
     dict(type=cli.positive, metavar='S')),
    ('--prerender', 'render N pairs first, play them forth and back; '
                    f'0: render while publishing (default: {STILL_FRAMES}, moving {MOVING_FRAMES})',
     dict(type=cli.natural, metavar='N')),
    ('--reliability', 'of images and camera infos', dict(choices=('reliable', 'best_effort'), default='reliable')),
    ('--reference-frame', 'frame of the ground truth; give the node\'s reference_frame the same name',
     dict(default=scenes.FRAME_ID, metavar='NAME')),
)
_DEVICE = (
    ('--seed', 'the same seed and options give the same images', dict(type=cli.natural, default=0)),
    ('--shape', 'random smooth spline, or two-tube active cannula', dict(choices=tuple(KINDS), default='spline')),
    ('--moving', 'the device slides and bends', dict(action='store_true')),
    ('--length', 'range of its length, m (default 0.067 0.188)',
     dict(type=cli.positive, nargs=2, default=scenes.LENGTHS, metavar=('MIN', 'MAX'))),
    ('--radius', 'm', dict(type=cli.positive, default=scenes.RADIUS, metavar='M')),
    ('--device', 'what it is made of, instead of a rod of --radius and --contrast: '
                 f'a file, or {", ".join(presets())}; xray only',
     dict(type=cli.device, metavar='NAME|FILE')),
    ('--entering', 'the shaft comes in through the border of both images', dict(action='store_true')),
)
_IMAGES = (
    ('--renderer', 'X-ray attenuation, or the VTK tube with blur and white noise of Burgner et al. 2011',
     dict(choices=scenes.RENDERERS, default='xray')),
    ('--depth', 'bits a pixel; above 8 the images are mono16; xray only',
     dict(type=int, choices=(8, 10, 12, 14, 16), default=8)),
    ('--photons', 'detected a pixel in the open beam: the fewer, the noisier; xray only',
     dict(type=cli.positive, default=1500.0)),
    ('--contrast', 'share of the beam that the device takes away; xray only', dict(type=cli.positive, default=0.25)),
    ('--imaging', 'physics and display of both planes, with --device fluoroscopy by default; '
                  'random: each plane drawn anew; --photons and --depth do '
     'not count then; xray only', dict(choices=(*imaging.SETTINGS, 'random'))),
    ('--ct', 'a CT behind the device, from anywhere: a .npz file with hu and spacing_m, '
             'or a folder with a DICOM series; xray only', dict(type=Path, metavar='FILE')),
    ('--no-anatomy', 'an even background; xray only', dict(action='store_true')),
    ('--clutter', 'what else is in the field; xray only', dict(nargs='+', choices=scenes.CLUTTER, default=())),
)
_GEOMETRY = (
    ('--angle-a', 'of plane A, degrees, LAO and cranial are positive (default 0 0)',
     dict(type=float, nargs=2, default=(0.0, 0.0), metavar=('PRIMARY', 'SECONDARY'))),
    ('--angle-b', 'of plane B, degrees (default 90 0)',
     dict(type=float, nargs=2, default=(90.0, 0.0), metavar=('PRIMARY', 'SECONDARY'))),
    ('--sid', 'source to detector, m', dict(type=cli.positive, default=1.195, metavar='M')),
    ('--sod', 'source to isocentre, m', dict(type=cli.positive, default=0.81, metavar='M')),
    ('--pixel-size', 'at the detector, m (default: what is 0.3 mm at the isocentre for xray, 0.523 mm for vtk)',
     dict(type=cli.positive, metavar='M')),
    ('--size', 'of the images, px (default 1024 1024)',
     dict(type=cli.natural, nargs=2, default=(1024, 1024), metavar=('WIDTH', 'HEIGHT'))),
)


def _run(args, parser: argparse.ArgumentParser, argv: list[str]) -> int:
    for package in ('rclpy', 'sensor_msgs', 'nav_msgs', 'geometry_msgs'):
        cli.need(package, 'ros')
    if args.renderer == 'vtk':
        cli.need('vtkmodules.vtkRenderingOpenGL2', 'vtk')
    from .publisher import FluoroSim, RosArgumentsError, use_large_image_profile
    use_large_image_profile()
    try:
        run = make_run(args)
    except ValueError as error:
        parser.error(str(error))
    try:
        with FluoroSim(reliability=args.reliability, reference_frame=args.reference_frame, ros_arguments=argv) as sim:
            return _publish(sim, run, args)
    except RosArgumentsError as error:
        parser.error(str(error))


def make_run(args) -> scenes.Run:
    """The run that parsed arguments describe. Raises ValueError where there is none."""
    iso = ({'xray': 0.3e-3, 'vtk': 0.523e-3}[args.renderer]
           if args.pixel_size is None else args.pixel_size * args.sod / args.sid)
    views = carm.biplane(np.deg2rad(args.angle_a), np.deg2rad(args.angle_b),
                         carm.CArm(args.sid, args.sod, iso, *args.size))
    check_pair(views)
    device = {'views': views, 'kind': args.shape, 'lengths': tuple(args.length), 'radius': args.radius,
              'entering': args.entering}
    if args.renderer == 'vtk':
        if args.device or args.imaging or args.ct:
            raise ValueError('--device, --imaging and --ct need --renderer xray')
        return scenes.protocol_p_run(args.seed, **device)
    if args.device:
        device['device'] = load_device(args.device)
    if args.imaging:
        rng = np.random.default_rng([args.seed, 10])
        device['chains'] = tuple(imaging.draw(rng) if args.imaging == 'random' else imaging.SETTINGS[args.imaging]
                                 for _ in views)
    if args.ct:
        device['background'] = variety.in_ct(ct.load_ct(args.ct), np.random.default_rng([args.seed, 8]))
    exposure = xray.Exposure(photons=args.photons, contrast=args.contrast, depth=args.depth)
    return scenes.xray_run(args.seed, exposure=exposure, anatomy=not args.no_anatomy,
                           clutter=tuple(args.clutter), **device)


def rendered(run: scenes.Run, args) -> Iterator[scenes.Scene]:
    """Scenes without end: some, rendered now, forth and back, or each rendered when it is due."""
    count = args.prerender
    if count is None:
        count = MOVING_FRAMES if args.moving else STILL_FRAMES
    if args.frames is not None:
        count = min(count, args.frames)
    if count == 0:
        return scenes.moving(run, args.rate) if args.moving else scenes.still(run)
    source = scenes.moving(run, args.rate, count) if args.moving else scenes.still(run, count)
    return scenes.ping_pong(list(tqdm(source, 'rendering', count, unit='pair', disable=None, leave=False)))


def _publish(sim, run: scenes.Run, args) -> int:
    pairs = itertools.islice(rendered(run, args), args.frames)
    if args.wait and not sim.wait_for_subscribers(args.wait):
        raise cli.ToolError(f'nobody listens to all images and camera infos after {args.wait:g} s')
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sim.stop())
    print(f'publishing {run.name} (seed {args.seed}) at {args.rate:g} pairs/s, '
          f'ground truth in frame {args.reference_frame}', flush=True)
    start = time.monotonic()
    sim.stream(pairs, args.rate)
    print(f'published {sim.published} pairs in {time.monotonic() - start:.1f} s', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
