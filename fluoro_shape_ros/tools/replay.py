"""fluoro_shape_replay: a recorded bag in, a bag with results out; offline, without DDS, and the same output every time.

Every result is logged at the stamp of plane A's image. The images and camera infos are not copied unless --with-images says so: they
are most of a bag, and `ros2 bag play` plays two bags at once.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from operator import itemgetter

import cv2
from tqdm import tqdm

from msg_adapters import shapes
from msg_adapters.cameras import BadCameraInfo
from msg_adapters.diagnostics import ERROR, FAULTS, OK, WARN, Status, Tally, diagnostic_array
from msg_adapters.messages import stamp_ns

from ..config import Config, ConfigError
from ..data import Frame, Outcome, Reconstruction
from ..pairing import PLANES, Counts, Pairer
from ..pipeline import reconstruct
from ..worker import Camera, Job, Memory, adapt, camera, checked_camera, image_window, view_of
from .cli import ToolError, need, run
from .parameters import NODE, read_parameters

IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
RESULTS = {     # topic -> type, adapter
    '/backbone': ('nav_msgs/msg/Path', shapes.shape_to_path),
    '/tip': ('geometry_msgs/msg/PointStamped', shapes.shape_to_tip),
    '/tip_pose': ('geometry_msgs/msg/PoseWithCovarianceStamped', shapes.shape_to_tip_pose),
    '/backbone_points': ('sensor_msgs/msg/PointCloud2', shapes.shape_to_cloud),
}


@dataclass
class Summary:
    """What became of a bag."""

    counts: Counts = field(default_factory=Counts)
    images: Counter = field(default_factory=Counter)        # by plane
    outcomes: Counter = field(default_factory=Counter)      # by name
    warnings: Counter = field(default_factory=Counter)
    refused: dict[str, str] = field(default_factory=dict)   # plane -> why its last refused camera info was
    masked: int = 0                                         # pairs that made the mask
    bug: str = ''                                           # what went wrong in the first pair that ended in internal_error

    def count(self, stamp: int, result: Reconstruction) -> None:
        """One more pair came to an end."""
        self.outcomes[result.outcome.value] += 1
        self.warnings.update(result.warnings)
        if result.outcome is Outcome.INTERNAL_ERROR:
            self.bug = self.bug or f'{result.detail} (stamp {stamp / 1e9:.3f} s)'


def main(argv=None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog='fluoro_shape_replay', description='Reconstruct backbone and tip from a recorded bag (rosbag2: MCAP or sqlite3, compressed or not).')
    parser.add_argument('bag', metavar='BAG', help='the recorded bag')
    parser.add_argument('--out', required=True, metavar='BAG', help='the bag to make, a new folder')
    parser.add_argument('--storage', choices=('mcap', 'sqlite3'), help='default: sqlite3 if the new bag ends in .db3, else mcap')
    parser.add_argument('--with-images', action='store_true', help='copy the images and camera infos too, logged at their stamps')
    parser.add_argument('--start', type=_seconds, default=0.0, metavar='S', help='skip the first S seconds')
    parser.add_argument('--duration', type=_seconds, default=math.inf, metavar='S', help='stop after S seconds')
    parser.add_argument('--mask', type=_seconds, default=0.0, metavar='S',
                        help='the first S seconds of the bag show no device: their mean is the mask image, subtracted from all later images')
    parser.add_argument('-p', '--param', action='append', default=[], metavar='NAME=VALUE', help='a parameter of fluoro_shape_node; may be repeated')
    parser.add_argument('--params', metavar='YAML', help='a ROS parameter file with the parameters of fluoro_shape')
    for plane in PLANES:
        parser.add_argument(f'--image-{plane}', default=f'plane_{plane}/image_raw', metavar='TOPIC', help='images (default: %(default)s)')
        parser.add_argument(f'--info-{plane}', default=f'plane_{plane}/camera_info', metavar='TOPIC', help='camera infos (default: %(default)s)')
    return run(lambda args: _body(args, parser), parser, argv)


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 <= value < 1e9:
        raise argparse.ArgumentTypeError(f'must be a time in seconds, not {text}')
    return value


def _body(args, parser: argparse.ArgumentParser) -> None:
    need('rosbags.highlevel', 'bags')
    need('yaml', 'bags')
    from msg_adapters.bags import BadBag, absolute, create_bag, open_bag

    try:
        config = Config.from_values(**read_parameters(args.params, args.param))
    except ConfigError as error:
        parser.error(str(error))
    if config.input.geometry == 'tf':
        parser.error('geometry: a replay takes the poses from CameraInfo alone (camera_info), not from tf')
    suffix = '/compressed' if config.input.image_transport == 'compressed' else ''
    images = {absolute(getattr(args, f'image_{p}') + suffix): p for p in PLANES}
    infos = {absolute(getattr(args, f'info_{p}')): p for p in PLANES}
    if len(images) < 2 or len(infos) < 2:
        parser.error('both planes have the same topic')
    if args.start + args.duration <= args.mask:
        parser.error('--mask: nothing is left to reconstruct before the end of --duration')
    try:
        with open_bag(args.bag) as bag:
            _check_topics(bag.types(), images, infos)
            with create_bag(args.out, args.storage) as out:
                summary = replay(bag, out, config, images, infos, (args.start, args.duration), args.with_images, args.mask)
    except BadBag as error:
        raise ToolError(str(error)) from error
    print(report(summary, args.out))
    if summary.bug:
        raise ToolError(f'{summary.outcomes[Outcome.INTERNAL_ERROR.value]} pairs ended in an error of the program, the first: {summary.bug}')


def _check_topics(types: dict[str, str], images: dict[str, str], infos: dict[str, str]) -> None:
    """Raises ToolError where a topic is not in the bag, or is something else; it tells what could be meant."""
    for topics, fitting, what in ((images, IMAGE_TYPES, 'image'), (infos, ('sensor_msgs/msg/CameraInfo',), 'info')):
        known = ', '.join(sorted(t for t, kind in types.items() if kind in fitting)) or 'none'
        for topic, plane in topics.items():
            if topic not in types:
                raise ToolError(f'{topic} is not in the bag; name another with --{what}-{plane} (such topics in it: {known})')
            if types[topic] not in fitting:
                raise ToolError(f'{topic} is a {types[topic]}; name another with --{what}-{plane} (fitting topics in the bag: {known})')


def replay(bag, out, config: Config, images: dict[str, str], infos: dict[str, str], window: tuple[float, float] = (0.0, math.inf),
           with_images: bool = False, mask_s: float = 0.0) -> Summary:
    """Reconstruct every pair of `bag` (of open_bag) and write the results to `out` (of create_bag).

    `images` and `infos` map topics to planes; `window` is the start and the duration in s. The pairs of the first `mask_s` of the bag
    are not reconstructed: they make the mask of the others. Raises ToolError where no images pair, BadBag where the bag is damaged.
    """
    cv2.setNumThreads(config.input.threads or -1)   # 0 would mean none for OpenCV
    for topic, (kind, _) in RESULTS.items():
        out.declare(topic, kind)
    out.declare('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray')
    span = _span_ns(bag, window)
    total = bag.count(images) if window == (0.0, math.inf) else None
    if with_images:
        _copy(bag, out, images, infos, span)

    summary = Summary()
    cameras = read_cameras(bag, config, infos, summary)
    pairer, memory, views = Pairer(round(config.input.sync_slop * 1e9)), Memory(), lru_cache(maxsize=8)(view_of)

    def jobs(what, total, start_ns, stop_ns):
        stream = tqdm(bag.messages(images, start_ns, stop_ns), what, total, unit='image', disable=None)
        for stamp_a, *pair in _pairs(stream, images, pairer, memory, summary):
            held = tuple(camera_at(cameras[plane], stamp_ns(message)) for plane, message in zip(PLANES, pair))
            yield Job(stamp_a, tuple(pair), held, config, memory.generation, 0.0)

    if mask_s:
        until_ns = bag.start_ns + round(mask_s * 1e9)
        span, total = (max(span[0] or 0, until_ns), span[1]), None
        summary.masked = take_mask(jobs('mask', None, None, until_ns), memory, views)
        if not summary.masked:
            raise ToolError(f'--mask {mask_s:g}: there is no usable pair in the first {mask_s:g} s of the bag')
    for job in jobs('replaying', total, *span):
        _, result = answer(job, memory, views)
        write_result(out, job, result)
        summary.count(job.stamp_ns, result)
    summary.counts = dataclasses.replace(pairer.counts, unpaired=pairer.counts.unpaired + pairer.waiting)
    if not summary.outcomes:
        if summary.masked:
            raise ToolError(f'--mask {mask_s:g}: no pair comes after the {summary.masked} that made the mask')
        raise ToolError(f'no images pair: there are {summary.images["a"]} of plane A and {summary.images["b"]} of plane B, '
                        f'{summary.counts.unstamped} without a stamp; sync_slop is {config.input.sync_slop * 1e3:g} ms')
    return summary


def _span_ns(bag, window: tuple[float, float]) -> tuple[int | None, int | None]:
    """The log times from and before which to read; None: no limit."""
    start, duration = window
    start_ns = bag.start_ns + round(start * 1e9) if start else None
    return start_ns, None if math.isinf(duration) else (start_ns or bag.start_ns) + round(duration * 1e9)


def _copy(bag, out, images: dict[str, str], infos: dict[str, str], span: tuple[int | None, int | None]) -> None:
    """Copy the images of the span, and all camera infos: an earlier one may hold."""
    for topic in (*infos, *images):
        out.declare(topic, bag.types()[topic])
    for topics, limits in ((infos, (None, None)), (images, span)):
        for recorded in tqdm(bag.messages(topics, *limits), 'copying', unit='message', disable=None):
            out.write(recorded.topic, recorded.message, stamp_ns(recorded.message))


def read_cameras(bag, config: Config, infos: dict[str, str], summary: Summary) -> dict[str, list[tuple[int, Camera]]]:
    """Plane to the valid cameras of the whole bag with their stamps, ascending; the others are noted in `summary`."""
    known = {plane: [] for plane in PLANES}
    for recorded in bag.messages(infos):
        plane, entry = infos[recorded.topic], camera(recorded.message)
        try:
            if not known[plane] or known[plane][-1][1] != entry:
                checked_camera(recorded.message, config, plane)
            known[plane].append((stamp_ns(recorded.message), entry))
        except BadCameraInfo as error:
            summary.refused[plane] = str(error)
    return {plane: sorted(entries, key=itemgetter(0)) for plane, entries in known.items()}


def camera_at(known: list[tuple[int, Camera]], stamp: int) -> Camera | None:
    """The newest camera stamped at or before an image; the oldest one for an image before them all."""
    return known[max(bisect_right(known, stamp, key=itemgetter(0)) - 1, 0)][1] if known else None


def _pairs(stream, images: dict[str, str], pairer: Pairer, memory: Memory, summary: Summary) -> Iterator[tuple]:
    """The pairs of a stream of recorded images: stamp of plane A in ns, message of plane A, of plane B."""
    for recorded in stream:
        plane, jumps = images[recorded.topic], pairer.counts.jumps
        summary.images[plane] += 1
        pair = pairer.add(plane, stamp_ns(recorded.message), recorded.message)
        if pairer.counts.jumps > jumps:
            memory.reset()
        if pair is not None:
            yield pair


def take_mask(jobs: Iterator[Job], memory: Memory, views) -> int:
    """Make the mean of pairs of messages the mask; how many these were. Bad ones are left out."""
    memory.capture_mask(sys.maxsize)
    for job in jobs:
        frame = adapt(job, views, None, Tally())
        if isinstance(frame, Frame):
            memory.take_for_mask(frame, image_window(job, frame))
    return memory.finish_mask()


def answer(job: Job, memory: Memory, views) -> tuple[Frame | None, Reconstruction]:
    """The frame of a pair of messages, None where they can't be one, and the answer."""
    tally = Tally()
    frame = adapt(job, views, None, tally)
    if isinstance(frame, Reconstruction):
        return None, frame
    try:
        result = reconstruct(frame, job.config, memory.prior(job, frame, image_window(job, frame)))
    except Exception as error:  # the last line of defence: a pair must not take the other thousands with it; the tool ends with 1
        return frame, Reconstruction(Outcome.INTERNAL_ERROR, f'{type(error).__name__}: {error}')
    memory.remember(job, frame, result)
    return frame, result


def write_result(out, job: Job, result: Reconstruction) -> None:
    """One diagnostics message a pair, and the shape where there is one."""
    stamp = job.stamp_ns
    level = ERROR if result.outcome in FAULTS else WARN if result.outcome is not Outcome.OK or result.warnings else OK
    reason = ': '.join(filter(None, (result.outcome.value, result.detail)))
    status = Status('reconstruction', level, '; '.join((reason, *result.warnings)),
                    {'last outcome': result.outcome.value, 'last detail': result.detail, 'warnings': ', '.join(result.warnings)})
    out.write('/diagnostics', diagnostic_array([status], stamp, NODE, out.new), stamp)
    if result.shape is not None:
        for topic, (_, adapter) in RESULTS.items():
            out.write(topic, adapter(result.shape, stamp, job.frame_id, out.new), stamp)


def report(summary: Summary, out: str) -> str:
    """The summary for people."""
    c = summary.counts
    lines = [f'{c.pairs} pairs of {summary.images["a"]} images of plane A and {summary.images["b"]} of plane B; results in {out}']
    if summary.masked:
        lines.append(f'{summary.masked:7d}  made the mask')
    lines += [f'{n:7d}  {name}' for name, n in (*summary.outcomes.most_common(), *summary.warnings.most_common())]
    lost = {'unpaired': c.unpaired, 'duplicate': c.duplicates, 'out of order': c.out_of_order, 'without a stamp': c.unstamped}
    if any(lost.values()):
        lines.append('images ' + ', '.join(f'{what}: {n}' for what, n in lost.items() if n))
    if c.jumps:
        lines.append(f'stamps jumped back: {c.jumps} times')
    lines += [f'camera infos refused: {reason}' for _, reason in sorted(summary.refused.items())]
    return '\n'.join(lines)


if __name__ == '__main__':
    sys.exit(main())
