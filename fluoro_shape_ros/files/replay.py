"""fluoro_shape_replay: a recorded bag in, a bag with results out; offline, without DDS, and the same output every time.

Every result is logged at the stamp of plane A's image. The images and camera infos are not copied unless --with-images
says so: they are most of a bag.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

from msg_adapters import shapes
from msg_adapters.diagnostics import ERROR, FAULTS, OK, WARN, Status, diagnostic_array, probability

from ..cli import ToolError, count, need, positive, run
from ..config import Config, ConfigError
from ..data import Outcome
from ..ros.frame_names import doubts
from ..ros.pairing import PLANES
from .exports import Arrays, Table, writing
from .offline import NO_FRAMES, Answer, Offline, Topics
from .parameter_files import NODE, read_parameters
from .recorded_tf import NAMES as TF
from .recorded_tf import TF_TYPE
from .summary import as_json, report

IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
DIAGNOSTICS = '/diagnostics'
RESULTS = {     # topic -> type
    'backbone': 'nav_msgs/msg/Path',
    'tip': 'geometry_msgs/msg/PointStamped',
    'tip_pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'backbone_points': 'sensor_msgs/msg/PointCloud2',
}
INPUTS = tuple(f'plane_{plane}/{what}' for plane in PLANES for what in ('image_raw', 'camera_info'))


def main(argv=None) -> int:
    """The command line."""
    parser = make_parser()
    parser.set_defaults(command=command_line(parser.prog, sys.argv[1:] if argv is None else argv))
    return run(lambda args: replay(args, parser), parser, argv)


def command_line(program: str, argv: list[str]) -> str:
    """What was typed, for the page; without the name of who did."""
    return shlex.join((program, *argv)).replace(f'{os.path.expanduser("~")}/', '~/')


def make_parser() -> argparse.ArgumentParser:
    """What the command line may have."""
    parser = argparse.ArgumentParser(prog='fluoro_shape_replay',
                                     description='Reconstruct backbone and tip from recorded bags '
                                                 '(rosbag2: MCAP or sqlite3, compressed or not).')
    parser.add_argument('bags', nargs='+', metavar='BAG', help='the recorded bag; of several each one by itself')
    parser.add_argument('--out', required=True, metavar='BAG',
                        help='the bag to make, a new folder; for several bags the folder for their results')
    workers = parser.add_mutually_exclusive_group()
    workers.add_argument('--jobs', type=count, default=1, metavar='N',
                         help='of several bags so many at a time (default: 1)')
    workers.add_argument('--scheduler', metavar='ADDRESS', help='instead: HOST:PORT of a Dask scheduler, whose workers '
                                                                '(dask worker --nthreads 1) see the same folders')
    parser.add_argument('--storage', choices=('mcap', 'sqlite3'),
                        help='default: sqlite3 if the new bag ends in .db3, else mcap')
    parser.add_argument('--with-images', action='store_true',
                        help='copy the images and camera infos too, logged at their stamps')
    parser.add_argument('--report', metavar='HTML', help='make a page to look at: what became of the pairs, '
                                                         'the tip\'s track, overlays, the backbone in 3-D over time')
    parser.add_argument('--csv', metavar='FILE', help='write a table: a row a backbone point')
    parser.add_argument('--npz', metavar='FILE', help='write NumPy arrays of all backbone points')
    parser.add_argument('--bundle', metavar='ZIP', help='pack what a report of a fault needs: a part of the bag, '
                                                        'parameters, versions, page and outcomes')
    parser.add_argument('--bundle-seconds', type=positive, default=3.0, metavar='S',
                        help='so much of the bag, around the first refused or else the worst pair '
                             '(default: %(default)g)')
    parser.add_argument('--start', type=_seconds, default=0.0, metavar='S', help='skip the first S seconds')
    parser.add_argument('--duration', type=_seconds, default=math.inf, metavar='S', help='stop after S seconds')
    parser.add_argument('--mask', type=_seconds, default=0.0, metavar='S',
                        help='the first S seconds of the bag show no device: their mean is the mask image, '
                             'subtracted from all later images')
    parser.add_argument('-p', '--param', action='append', default=[], metavar='NAME=VALUE',
                        help='a parameter of fluoro_shape_node; may be repeated')
    parser.add_argument('--params', metavar='YAML', help='a ROS parameter file with the parameters of fluoro_shape')
    parser.add_argument('-r', '--remap', action='append', default=[], metavar='FROM:=TO',
                        help=f'another name for a topic, read ({", ".join((*INPUTS, *TF))}) or written '
                             f'({", ".join(RESULTS)}); may be repeated')
    # so that -p and -r can be given as to the node
    parser.add_argument('--ros-args', action='store_true', help=argparse.SUPPRESS)
    for plane in PLANES:
        parser.add_argument(f'--image-{plane}', metavar='TOPIC', help=f'the same as -r plane_{plane}/image_raw:=TOPIC')
        parser.add_argument(f'--info-{plane}', metavar='TOPIC', help=f'the same as -r plane_{plane}/camera_info:=TOPIC')
    parser.add_argument('--json', metavar='FILE', help='write how many pairs came to what')
    return parser


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 <= value < 1e9:
        raise argparse.ArgumentTypeError(f'must be a time in seconds, not {text}')
    return value


def replay(args, parser: argparse.ArgumentParser) -> int:
    """What the arguments ask for; the exit code."""
    for module in ('rosbags.highlevel', 'mcap.stream_reader', 'yaml'):
        need(module, 'bags')
    if args.report or args.bundle:
        need('plotly.offline', 'report')
    from msg_adapters.bags import BadBag

    try:
        config = Config.from_values(**read_parameters(args.params, args.param,
                                                      lambda words: print(f'{parser.prog}: {words}', file=sys.stderr)))
        names = topic_names(args)
    except ValueError as error:
        parser.error(str(error))
    suffix = '/compressed' if config.input.image_transport == 'compressed' else ''
    topics = Topics({names[f'plane_{p}/image_raw'].removesuffix(suffix) + suffix: p for p in PLANES},
                    {names[f'plane_{p}/camera_info']: p for p in PLANES},
                    {names[name]: name for name in TF} if config.input.geometry == 'tf' else {})
    if len(topics.images) < 2 or len(topics.infos) < 2:
        parser.error('both planes have the same topic')
    if args.start + args.duration <= args.mask:
        parser.error('--mask: nothing is left to reconstruct before the end of --duration')
    if len(args.bags) > 1:
        if args.bundle:
            parser.error('--bundle: of one bag at a time')
        from .many_bags import replay_all
        return replay_all(args)
    for path in filter(None, (args.report, args.csv, args.npz, args.json, args.bundle)):
        if Path(path).exists():
            raise ToolError(f'{path} exists already and is not overwritten')
        if not Path(path).parent.is_dir():
            raise ToolError(f'{path}: there is no folder {Path(path).parent}')
    try:
        return _replay(args, config, topics, names, parser)
    except BadBag as error:
        raise ToolError(str(error)) from error


def topic_names(args) -> dict[str, str]:
    """The absolute name of each topic of the node, as remapped. Raises ConfigError for what is no rule."""
    from msg_adapters.bags import absolute

    names = {name: absolute(name) for name in (*INPUTS, *TF, *RESULTS)}
    given = [(f'plane_{p}/{topic}', getattr(args, f'{what}_{p}')) for p in PLANES
             for what, topic in (('image', 'image_raw'), ('info', 'camera_info'))]
    for text in args.remap:
        name, rule, other = text.partition(':=')
        name = name.strip('/').removesuffix('/compressed')
        if not rule or not other.strip('/'):
            raise ConfigError(f'-r {text}: needs the form FROM:=TO')
        if name not in names:
            raise ConfigError(f'-r {text}: there is no topic {name}; those are {", ".join(names)}')
        given.append((name, other))
    names |= {name: absolute(other) for name, other in given if other is not None}
    written = [names[name] for name in RESULTS]
    if len({*written, DIAGNOSTICS}) <= len(RESULTS):
        raise ConfigError(f'-r: two results have the same topic ({", ".join(sorted(written))})')
    return names


def _replay(args, config: Config, topics: Topics, names: dict[str, str], parser: argparse.ArgumentParser) -> int:
    """The work; the exit code. What was computed is kept when it is interrupted or something fails on the way."""
    from msg_adapters.bags import create_bag, open_bag

    failures, interrupted, packed = [], False, ''
    with open_bag(args.bags[0]) as bag, _damage_told(bag):
        check_topics(bag.types(), topics)
        if topics.tf and not bag.types().keys() & topics.tf.keys():
            parser.error(f'geometry: tf needs {" and ".join(topics.tf)}, of which none is in the bag; '
                         'record them with the images' + (bag.damage and f'; {bag.damage}'))
        with create_bag(args.out, args.storage) as out:
            history = None
            sinks: list = [Results(out, names),
                           *(kind(path) for kind, path in ((Table, args.csv), (Arrays, args.npz)) if path)]
            if args.report or args.bundle:
                from .history import History
                history = History()
                sinks.append(history)
            offline = Offline(bag, config, topics, (args.start, args.duration), args.mask,
                              copier(bag, out, topics) if args.with_images else None)
            try:
                feed(offline.answers(), sinks, failures)
            except KeyboardInterrupt:
                if not offline.summary.outcomes:
                    raise
                interrupted = True
        if args.report:
            from .report import write_report
            with _kept(failures):
                write_report(args.report, history, offline, args.bags[0], args.command)
        if args.bundle and not interrupted:
            from .bundle import write_bundle
            with _kept(failures):
                packed = write_bundle(args.bundle, args.bundle_seconds, bag, config, topics,
                                      (args.start, args.duration), args.mask, history)
        damage = bag.damage
    summary = offline.summary
    print('\n'.join(filter(None, (report(summary, args.out), packed))))
    if args.json:
        with _kept(failures), writing(args.json), Path(args.json).open('x', encoding='utf-8') as file:
            json.dump(as_json(summary), file)
    if summary.bug:
        failures.append(f'{summary.outcomes[Outcome.INTERNAL_ERROR.value]} pairs ended in an error of the program, '
                        f'the first: {summary.bug}')
    failures += filter(None, [damage])
    if failures:
        raise ToolError('; '.join(failures))
    return 130 if interrupted else 0


def feed(answers: Iterable[Answer], sinks: list, failures: list[str]) -> None:
    """Give every answer to every sink, and close them; a sink that fails is left out from there on."""
    try:
        for answer in answers:
            for sink in sinks[:]:
                with _kept(failures, lambda sink=sink: sinks.remove(sink)):
                    sink.take(answer)
    finally:
        for sink in sinks:
            with _kept(failures):
                sink.close()


@contextlib.contextmanager
def _damage_told(bag):
    """What is damaged in the bag, or missing, may be why something fails."""
    try:
        yield
    except ToolError as error:
        raise ToolError('; '.join(filter(None, (str(error), bag.damage, bag.missing)))) from error


@contextlib.contextmanager
def _kept(failures: list[str], then=lambda: None):
    """A failure of one output is for the end: the others go on."""
    try:
        yield
    except ToolError as error:
        failures.append(str(error))
        then()


def check_topics(types: dict[str, str], topics: Topics) -> None:
    """Raises ToolError where a topic is not in the bag, or is something else; it tells what could be meant."""
    for topic in topics.tf:
        if types.get(topic, TF_TYPE) != TF_TYPE:
            raise ToolError(f'{topic} is a {types[topic]}; name another with -r {topics.tf[topic]}:=TOPIC')
    for named, fitting, what in ((topics.images, IMAGE_TYPES, 'image'),
                                 (topics.infos, ('sensor_msgs/msg/CameraInfo',), 'info')):
        known = ', '.join(sorted(t for t, kind in types.items() if kind in fitting)) or 'none'
        for topic, plane in named.items():
            if topic not in types:
                raise ToolError(f'{topic} is not in the bag; name another with --{what}-{plane} '
                                f'(such topics in it: {known})')
            if types[topic] not in fitting:
                raise ToolError(f'{topic} is a {types[topic]}; name another with --{what}-{plane} '
                                f'(fitting topics in the bag: {known})')


def copier(bag, out, topics: Topics):
    """A function that copies messages of `bag` into `out` as they are; declares their topics."""
    for topic in (*topics.infos, *topics.images, *(topic for topic in topics.tf if topic in bag.types())):
        out.declare(topic, bag.types()[topic])
    return lambda recorded, stamp: out.write_raw(recorded.topic, recorded.raw, stamp)


class Results:
    """The bag with the results (of create_bag): one diagnostics message a pair, and the shape where there is one."""

    def __init__(self, out, names: dict[str, str]):
        self._out, self._names = out, names
        for name, kind in RESULTS.items():
            out.declare(names[name], kind)
        out.declare(DIAGNOSTICS, 'diagnostic_msgs/msg/DiagnosticArray')

    def take(self, answer: Answer) -> None:
        """Write the result of a pair."""
        out, names, result, stamp, frame_id = (self._out, self._names, answer.result, answer.job.stamp_ns,
                                               answer.job.frame_id)
        notes = (*result.warnings, *doubts(answer.job.config, NO_FRAMES, answer.job.cameras))
        level = ERROR if result.outcome in FAULTS else WARN if result.outcome is not Outcome.OK or notes else OK
        reason = ': '.join(filter(None, (result.outcome.value, result.detail)))
        status = Status('reconstruction', level, '; '.join((reason, *notes)), {
            'last outcome': result.outcome.value, 'last detail': result.detail,
            'confidence': probability(result.confidence), 'warnings': ', '.join(result.warnings)})
        out.write(DIAGNOSTICS, diagnostic_array([status], stamp, f'/{NODE}', out.new), stamp)
        if result.shape is not None:
            out.write_raw(names['backbone'], shapes.shape_to_path_cdr(result.shape, stamp, frame_id), stamp)
            out.write(names['tip'], shapes.shape_to_tip(result.shape, stamp, frame_id, out.new), stamp)
            out.write(names['tip_pose'], shapes.shape_to_tip_pose(result.shape, stamp, frame_id, out.new), stamp)
            out.write(names['backbone_points'],
                      shapes.shape_to_cloud(result.shape, result.confidence, stamp, frame_id, out.new), stamp)

    def close(self) -> None:
        """Nothing is left to do: the bag is closed by who made it."""


if __name__ == '__main__':
    sys.exit(main())
