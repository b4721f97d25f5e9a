"""A recorded bag through the pipeline: images into pairs, the cameras that hold for them, the mask, and one answer a
pair.

The order is that of the bag and nothing depends on timing, so the same bag gives the same answers. Reading and decoding
go on in a second thread, ahead of the reconstruction.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import re
import sys
import time
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import lru_cache
from operator import itemgetter
from typing import Any

import cv2
from tqdm import tqdm

from msg_adapters.cameras import BadCameraInfo
from msg_adapters.diagnostics import Tally
from msg_adapters.images import BadImage
from msg_adapters.messages import stamp_ns

from ..cli import ToolError
from ..config import Config
from ..data import Frame, Outcome, Reconstruction
from ..method.pipeline import reconstruct
from ..ros.calibration_watch import CalibrationWatch, Finding
from ..ros.frame_names import doubts
from ..ros.pairing import PLANES, Counts, Pairer
from ..ros.worker import Camera, Job, Lookup, Memory, adapt, camera, checked_camera, decode, image_window, view_of
from .recorded_tf import RecordedPoses, read_poses

MAX_NS = 2**63 - 1
LATE_NS = 10**9         # a camera info is not recorded later than this after the image for which it holds
AHEAD = 8               # images read before they are asked for
BAR = '{l_bar}{bar}| {n:.1f}/{total:.1f} s [{elapsed}<{remaining}]'
NO_FRAMES = '', ''      # those of the images are compared in `_jobs`
NUMBERS = re.compile(r'-?\d+(\.\d+)?(e[-+]?\d+)?')
Copy = Callable[[object, int], None]    # takes a Recorded and its stamp in ns


@dataclass(frozen=True)
class Topics:
    """Where the images and camera infos of a bag are: absolute topic -> plane; and its tf messages, -> tf or
    tf_static."""

    images: dict[str, str]
    infos: dict[str, str]
    tf: dict[str, str] = field(default_factory=dict)


@dataclass
class Summary:
    """What became of a bag."""

    counts: Counts = field(default_factory=Counts)
    images: Counter = field(default_factory=Counter)        # by plane
    outcomes: Counter = field(default_factory=Counter)      # by name
    reasons: Counter = field(default_factory=Counter)       # by name of the outcome and why, of pairs without a result;
                                                            # numbers left out
    warnings: Counter = field(default_factory=Counter)
    refused: dict[str, str] = field(default_factory=dict)   # plane -> why its last refused camera info was
    frames: dict[str, tuple[str, str]] = field(default_factory=dict)    # plane -> frame_id of an image, and another one
                                                                        # of the camera info that held for it
    masked: int = 0                                         # pairs that made the mask
    calibration: Finding = Finding()                        # what the run says of the calibrations
    bug: str = ''                                           # what went wrong in the first pair that ended in
                                                            # internal_error

    def count(self, stamp: int, result: Reconstruction) -> None:
        """One more pair came to an end."""
        self.outcomes[result.outcome.value] += 1
        if result.shape is None and result.detail:
            self.reasons[result.outcome.value, NUMBERS.sub('...', ' '.join(result.detail.split()))] += 1
        self.warnings.update(result.warnings)
        if result.outcome is Outcome.INTERNAL_ERROR:
            self.bug = self.bug or f'{result.detail} (stamp {stamp / 1e9:.3f} s)'


@dataclass(frozen=True)
class Picture:
    """An image of a bag."""

    plane: str
    stamp_ns: int
    log_ns: int
    pixels: object      # (H, W) array, or the message where it can't be one
    recorded: Any       # of msg_adapters.bags


@dataclass(frozen=True)
class Answer:
    """What became of a pair."""

    job: Job                        # its images are arrays, or the messages where they can't be
    frame: Frame | None             # None where the images or cameras are none
    result: Reconstruction
    seconds: float                  # it took to find the answer
    log_ns: tuple[int, int] = (0, 0)    # log times of the images


class Offline:
    """A bag (of open_bag) being replayed; `summary` is complete once all `answers` were taken.

    `window` is the start and the duration in s. The pairs of the first `mask_s` of the bag are not answered: they make
    the mask of the others. `copy` gets every image of the window and every camera info as it is read.
    """

    def __init__(self, bag, config: Config, topics: Topics, window: tuple[float, float] = (0.0, math.inf),
                 mask_s: float = 0.0, copy: Copy | None = None):
        self.summary = Summary()
        self._bag, self._config, self._topics, self._mask_s, self._copy = bag, config, topics, mask_s, copy
        self._span = span_ns(bag, window)
        self._pairer, self._memory, self._watch = (Pairer(round(config.input.sync_slop * 1e9)), Memory(),
                                                   CalibrationWatch())
        self._views = lru_cache(maxsize=8)(view_of)
        self._cameras: dict[str, list[tuple[int, Camera]]] = {}
        self._poses: RecordedPoses | None = None    # with geometry: tf

    def answers(self) -> Iterator[Answer]:
        """One answer a pair, in the order of the bag. Raises ToolError where no images pair."""
        cv2.setNumThreads(self._config.input.threads or -1)     # 0 would mean none for OpenCV
        self._cameras = read_cameras(self._bag, self._config, self._topics.infos, self.summary, self._span[1],
                                     self._copy)
        if self._config.input.geometry == 'tf':
            self._poses = read_poses(self._bag, self._topics.tf, self._copy)
        span, summary = self._span, self.summary
        if self._mask_s:
            until_ns = self._bag.start_ns + round(self._mask_s * 1e9)
            span = max(span[0], until_ns), span[1]
            summary.masked = take_mask((job for job, _ in self._jobs('mask', (self._bag.start_ns, until_ns))),
                                       self._memory, self._views, self._poses)
            if not summary.masked:
                raise ToolError(f'--mask {self._mask_s:g}: there is no usable pair in the first {self._mask_s:g} '
                                's of the bag')
        for job, log_ns in self._jobs('replaying', span):
            begin = time.perf_counter()
            frame, result = answer(job, self._memory, self._views, self._poses)
            summary.count(job.stamp_ns, result)
            if frame is not None:
                self._watch.take(result, frame.views, job.cameras)
                summary.calibration = self._watch.finding
            summary.warnings.update(doubts(job.config, NO_FRAMES, job.cameras))
            summary.counts = dataclasses.replace(self._pairer.counts)   # as far as it got, should it be interrupted
            yield Answer(job, frame, result, time.perf_counter() - begin, log_ns)
        summary.counts = dataclasses.replace(self._pairer.counts,
                                             unpaired=self._pairer.counts.unpaired + self._pairer.waiting)
        if not summary.outcomes:
            raise ToolError(self._nothing())

    def frame_of(self, given: Answer) -> Frame | None:
        """The frame of an answer whose images were let go, read again."""
        pictures = []
        for plane, log_ns in zip(PLANES, given.log_ns):
            topics = {t: p for t, p in self._topics.images.items() if p == plane}
            pictures += itertools.islice(map(self._picture, self._bag.messages(topics, log_ns, log_ns + 1)), 1)
        if len(pictures) < 2:
            return None
        frame = adapt(dataclasses.replace(given.job, images=tuple(p.pixels for p in pictures)), self._views,
                      self._poses, Tally())
        return frame if isinstance(frame, Frame) else None

    def _jobs(self, what: str, span: tuple[int, int]) -> Iterator[tuple[Job, tuple[int, int]]]:
        """The pairs of a span of log times with all that holds for them, and their log times."""
        for stamp_a, *pair in self._pairs(what, span):
            held = tuple(camera_at(self._cameras[p.plane], p.stamp_ns) for p in pair)
            for p, known in zip(pair, held):
                frame_ids = p.recorded.message.header.frame_id, known.msg.header.frame_id if known else ''
                if all(frame_ids) and frame_ids[0] != frame_ids[1]:
                    self.summary.frames[p.plane] = frame_ids
            job = Job(stamp_a, tuple(p.pixels for p in pair), held, self._config, self._memory.generation, 0.0)
            yield job, tuple(p.log_ns for p in pair)

    def _pairs(self, what: str, span: tuple[int, int]) -> Iterator[tuple[int, Picture, Picture]]:
        """Stamp of plane A in ns and the pictures of the pairs in a span of log times."""
        pairer = self._pairer
        for picture in _with_progress(ahead(map(self._picture, self._bag.messages(self._topics.images, *span))), what,
                                      self._shown(span)):
            if self._copy and self._span[0] <= picture.log_ns < self._span[1]:
                self._copy(picture.recorded, picture.stamp_ns)
            self.summary.images[picture.plane] += 1
            jumps = pairer.counts.jumps
            pair = pairer.add(picture.plane, picture.stamp_ns, picture)
            if pairer.counts.jumps > jumps:
                self._memory.reset()
            if pair is not None:
                yield pair

    def _shown(self, span: tuple[int, int]) -> tuple[int, int]:
        """The part of a span that the bag has."""
        return max(span[0], self._bag.start_ns), min(span[1], self._bag.end_ns)

    def _picture(self, recorded) -> Picture:
        pixels = recorded.message
        if self._poses is None:     # whose stamps are asked for with the poses
            with contextlib.suppress(BadImage):     # is named when its turn comes
                pixels = decode(recorded.message)
        return Picture(self._topics.images[recorded.topic], stamp_ns(recorded.message), recorded.log_ns,
                       pixels, recorded)

    def _nothing(self) -> str:
        """Why there is no answer at all."""
        s = self.summary
        if s.masked:
            return f'--mask {self._mask_s:g}: no pair comes after the {s.masked} that made the mask'
        return (f'no images pair: there are {s.images["a"]} of plane A and {s.images["b"]} of plane B, '
                f'{s.counts.unstamped} without a stamp; sync_slop is {self._config.input.sync_slop * 1e3:g} ms')


def span_ns(bag, window: tuple[float, float]) -> tuple[int, int]:
    """The log times from and before which to read, of a start and a duration in s."""
    start, duration = window
    start_ns = bag.start_ns + round(start * 1e9) if start else 0
    return start_ns, MAX_NS if math.isinf(duration) else max(start_ns, bag.start_ns) + round(duration * 1e9)


def ahead(items: Iterable, depth: int = AHEAD) -> Iterator:
    """The items of an iterator, taken by a second thread up to `depth` ahead; what it raises is raised here, in its
    turn."""
    items, end = iter(items), object()
    pool = ThreadPoolExecutor(1, 'reading')
    try:
        coming = deque(pool.submit(next, items, end) for _ in range(depth))
        while (item := coming.popleft().result()) is not end:
            coming.append(pool.submit(next, items, end))
            yield item
    finally:
        pool.shutdown(cancel_futures=True)


def _with_progress(pictures: Iterable[Picture], what: str, span: tuple[int, int]) -> Iterator[Picture]:
    """The pictures, with a bar over the seconds of the recording and the time left."""
    total = max(span[1] - span[0], 0) / 1e9
    with tqdm(desc=what, total=total, bar_format=BAR, disable=None) as bar:
        for picture in pictures:
            yield picture
            bar.update(min(max((picture.log_ns - span[0]) / 1e9, bar.n), total) - bar.n)


def read_cameras(bag, config: Config, infos: dict[str, str], summary: Summary, stop_ns: int = MAX_NS,
                 copy: Copy | None = None
                 ) -> dict[str, list[tuple[int, Camera]]]:
    """Plane to the valid cameras of the bag up to a log time with their stamps, ascending; the others are noted in
    `summary`."""
    known = {plane: [] for plane in PLANES}
    for recorded in bag.messages(infos, None, min(stop_ns + LATE_NS, MAX_NS)):
        plane, stamp = infos[recorded.topic], stamp_ns(recorded.message)
        if copy:
            copy(recorded, stamp)
        try:
            entry = camera(recorded.message, plane)
            if known[plane] and known[plane][-1][1] == entry:
                entry = known[plane][-1][1]     # one object a camera, however often it was sent
            else:
                checked_camera(recorded.message, config, plane)
            known[plane].append((stamp, entry))
        except BadCameraInfo as error:
            summary.refused[plane] = str(error)
    return {plane: sorted(entries, key=itemgetter(0)) for plane, entries in known.items()}


def camera_at(known: list[tuple[int, Camera]], stamp: int) -> Camera | None:
    """The newest camera stamped at or before an image; the oldest one for an image before them all."""
    return known[max(bisect_right(known, stamp, key=itemgetter(0)) - 1, 0)][1] if known else None


def take_mask(jobs: Iterable[Job], memory: Memory, views, lookup: Lookup | None = None) -> int:
    """Make the mean of pairs of messages the mask; how many these were. Bad ones are left out."""
    memory.capture_mask(sys.maxsize)
    for job in jobs:
        frame = adapt(job, views, lookup, Tally())
        if isinstance(frame, Frame):
            memory.take_for_mask(frame, image_window(job, frame))
    return memory.finish_mask()


def answer(job: Job, memory: Memory, views, lookup: Lookup | None = None) -> tuple[Frame | None, Reconstruction]:
    """The frame of a pair of images, None where they can't be one, and the answer."""
    frame = adapt(job, views, lookup, Tally())
    if isinstance(frame, Reconstruction):
        return None, frame
    try:
        result = reconstruct(frame, job.config, memory.prior(job, frame, image_window(job, frame)))
    except Exception as error:
        # the last line of defence: a pair must not take the other thousands with it; the tool ends with 1
        return frame, Reconstruction(Outcome.INTERNAL_ERROR, f'{type(error).__name__}: {error}')
    memory.remember(job, frame, result)
    return frame, result
