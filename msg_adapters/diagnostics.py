"""How the node is doing: counts, their summary in words, and diagnostic_msgs/DiagnosticArray.

`Tally` counts; the `*_status` functions judge a summary; `diagnostic_array` makes the message.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fluoro_shape_ros.data import Outcome, Reconstruction
from fluoro_shape_ros.ros.pairing import Counts

from .messages import New, header

OK, WARN, ERROR, STALE = range(4)   # diagnostic_msgs/DiagnosticStatus
WINDOW_S = 3.0      # over which rates and latencies are taken, and after which a silent stream is stale
MISSING = 0.1       # share of the images without a partner from which on that is told where they may get lost
LOST = ('best-effort images get lost on their way; over UDP the receive buffers must hold one '
        '(net.core.rmem_max, see docs/connect.md)')
# what no better image would mend: something is not connected or configured as it must be
FAULTS = {Outcome.BAD_IMAGE, Outcome.BAD_CAMERA_INFO, Outcome.NO_CAMERA_INFO, Outcome.NO_TRANSFORM,
          Outcome.BAD_GEOMETRY, Outcome.INTERNAL_ERROR}


@dataclass(frozen=True)
class Status:
    """One line of diagnostics."""

    name: str
    level: int
    message: str                # the reason first
    values: dict[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class PlaneSummary:
    plane: str                      # 'a' or 'b'
    images: int = 0
    rate_hz: float = 0.0
    silent_s: float | None = None   # since the last image; None: there was none yet
    bad_images: int = 0
    image_fault: str = ''           # why the last image was refused; empty: it was not
    has_camera: bool = False
    bad_camera_infos: int = 0
    camera_fault: str = ''          # the same for the last camera info
    reliability: str = 'reliable'   # in use
    fell_back: bool = False         # best-effort only because that is all a publisher offers
    unheard: Callable[[], str] = str    # names those of its topics that nobody publishes; asked only where it matters
    publishers: int = 0             # of its images


@dataclass(frozen=True)
class PairingSummary:
    counts: Counts
    slop_s: float
    rate_hz: float = 0.0
    dropped: int = 0                # complete pairs overtaken by a newer one before their turn
    dropped_hz: float = 0.0
    silent_s: float | None = None   # since the last pair; None: there was none yet
    gap_s: float | None = None      # newest stamp of plane B less that of plane A
    both_alive: bool = False        # images come in both planes
    unstamped: bool = False         # images without a stamp came lately
    jumped: bool = False            # stamps jumped back lately
    unpaired_hz: float = 0.0        # images given up
    lossy: bool = False             # images are taken best-effort


@dataclass(frozen=True)
class ReconstructionSummary:
    enabled: bool = True
    mask: str = 'none'
    capturing: bool = False
    outcome: Outcome | None = None  # of the last pair; None: there was none yet
    detail: str = ''
    warnings: tuple[str, ...] = ()  # of the last pair
    confidence: float = float('nan')    # of the last pair; NaN: not known
    prediction: str = ''            # what became of it for the last pair
    calibration: str = ''           # what the run says of the calibrations
    notes: tuple[str, ...] = ()     # what else went wrong lately
    silent_s: float | None = None   # since the last pair
    overdue_s: float = 0.0          # for how long the pair at work has been, where that is too long
    overdue: int = 0                # pairs that took too long
    here: str = ''                  # why pairs are reconstructed in the node itself; empty where that is done in a
                                    # process of its own ...
    restarts: int = 0               # ... and how often that was begun anew
    rate_hz: float = 0.0            # of results
    latency_s: tuple[float, ...] = ()       # of the last results: second image's arrival to publication
    outcomes: dict[str, int] = field(default_factory=dict)
    out_of_time: float = 0.0        # share of the pairs lately
    refused: str = ''               # why most pairs were refused lately, in words; empty where any gave a result, or
                                    # there was none


def plane_status(s: PlaneSummary) -> Status:
    """What is to be said of one plane's images and camera."""
    if s.image_fault:
        level, message = ERROR, f'bad image: {s.image_fault}'
    elif s.camera_fault:
        level, holds = (WARN, ', the one before holds') if s.has_camera else (ERROR, '')
        message = f'camera info refused{holds}: {s.camera_fault}'
    elif s.silent_s is None:
        level, message = STALE, f'no image yet{_nobody(s)}'
    elif s.silent_s > WINDOW_S:
        level, message = STALE, f'no image for {s.silent_s:.0f} s{_nobody(s)}'
    elif not s.has_camera:
        level, message = ERROR, f'no camera info yet{_nobody(s)}'
    elif s.fell_back:
        level, message = WARN, 'best-effort is all the publisher offers: images may get lost'
    elif s.publishers > 1:
        level, message = WARN, f'{s.publishers} publishers on one image topic'
    else:
        level, message = OK, f'{s.rate_hz:.1f} images/s'
    return Status(f'plane {s.plane}', level, message, {
        'images': s.images, 'rate (1/s)': f'{s.rate_hz:.1f}', 'bad images': s.bad_images,
        'bad camera infos': s.bad_camera_infos,
        'camera info': 'known' if s.has_camera else 'none', 'reliability': s.reliability, 'publishers': s.publishers})


def _nobody(s: PlaneSummary) -> str:
    topics = s.unheard()
    if topics:
        return f': nobody publishes {topics}'
    return f': {LOST}' if s.publishers and s.reliability == 'best_effort' else ''


def pairing_status(s: PairingSummary) -> Status:
    """What is to be said of the pairing of the two streams."""
    c = s.counts
    quiet = s.silent_s is None or s.silent_s > WINDOW_S
    missing = s.unpaired_hz / max(s.unpaired_hz + 2 * s.rate_hz, 1e-9) if s.lossy else 0.0
    if s.unstamped:
        level, message = ERROR, 'images without a stamp (zero) can\'t be paired'
    elif s.jumped:
        level, message = WARN, 'stamps jumped back: everything before was forgotten'
    elif quiet and s.both_alive and s.gap_s is not None:
        level, message = (WARN, f'nothing pairs: the newest stamps differ by {abs(s.gap_s) * 1e3:.1f} ms, '
                                f'sync_slop is {s.slop_s * 1e3:.1f} ms')
        message += f'; or {LOST}' if missing > MISSING else ''
    elif quiet:
        level, message = STALE, 'no pair yet' if s.silent_s is None else f'no pair for {s.silent_s:.0f} s'
    elif missing > MISSING:
        level, message = WARN, f'{100 * missing:.0f} % of the images have no partner: {LOST}'
    else:
        level, message = OK, f'{s.rate_hz:.1f} pairs/s' + (f', {s.dropped_hz:.1f} of them dropped: they come faster '
                                                           'than they are processed' if s.dropped_hz else '')
    return Status('pairing', level, message, {
        'pairs': c.pairs, 'rate (1/s)': f'{s.rate_hz:.1f}', 'dropped': s.dropped, 'unpaired': c.unpaired,
        'out of order': c.out_of_order, 'duplicates': c.duplicates, 'unstamped': c.unstamped, 'jumps back': c.jumps})


def reconstruction_status(s: ReconstructionSummary) -> Status:
    """What is to be said of the results."""
    last = 'none' if s.outcome is None else s.outcome.value
    reason = last if s.detail in ('', last) else f'{last}: {s.detail}'
    notes = (*s.warnings, *s.notes)
    ms = [1e3 * x for x in s.latency_s]
    if not s.enabled:
        level, message = WARN, 'paused by ~/enable'
    elif s.overdue_s:
        level, message = ERROR, f'the pair at work takes {s.overdue_s:.0f} s already'
    elif s.capturing:
        level, message = OK, f'mask: {s.mask}'
    elif s.outcome is None:
        level, message = (WARN, '; '.join(s.notes)) if s.notes else (STALE, 'no pair yet')
    elif s.silent_s is not None and s.silent_s > WINDOW_S:
        level, message = STALE, '; '.join((f'no pair for {s.silent_s:.0f} s; the last one: {reason}', *s.notes))
    elif s.outcome is not Outcome.OK:
        level, message = ERROR if s.outcome in FAULTS else WARN, '; '.join((reason, *notes))
    elif notes:
        level, message = WARN, '; '.join(notes)
    else:
        level, message = OK, f'{s.rate_hz:.1f} results/s' + (f', {statistics.median(ms):.0f} ms after their images'
                                                             if ms else '')
        message += f', {100 * s.out_of_time:.0f} % of the pairs out of time' if s.out_of_time else ''
    values = {'last outcome': last, 'last detail': s.detail, 'confidence': probability(s.confidence),
              'warnings': ', '.join(s.warnings),
              'rate (1/s)': f'{s.rate_hz:.1f}', 'mask': s.mask, 'prediction': s.prediction, 'overdue pairs': s.overdue,
              'out of time (%)': f'{100 * s.out_of_time:.0f}', 'calibration_watch': s.calibration,
              'process': f'the node itself: {s.here}' if s.here else 'its own', 'reconstruction restarted': s.restarts,
              'latency median (ms)': f'{statistics.median(ms):.1f}' if ms else '',
              'latency max (ms)': f'{max(ms):.1f}' if ms else ''}
    return Status('reconstruction', level, message,
                  {**values, **{f'count {name}': n for name, n in sorted(s.outcomes.items())}})


def trouble(planes: list[PlaneSummary], pairing: PairingSummary, results: ReconstructionSummary) -> str:
    """What keeps results from coming, in words; empty where they come, or are not to come."""
    if not results.enabled or results.capturing or results.rate_hz:
        return ''
    missing, pairs = [s for s in map(plane_status, planes) if s.level in (STALE, ERROR)], pairing_status(pairing)
    return ('; '.join(f'{s.name}: {s.message}' for s in missing) or results.refused
            or (pairs.message if pairs.level in (WARN, ERROR) else ''))


def probability(value: float) -> str:
    """Three decimals; empty where it is not known (NaN)."""
    return '' if value != value else f'{value:.3f}'


def diagnostic_array(statuses: list[Status], stamp_ns: int, node_name: str, new: New) -> Any:
    """A diagnostic_msgs/DiagnosticArray; `new` is a factory (see messages)."""
    return new('diagnostic_msgs/msg/DiagnosticArray', header=header(new, stamp_ns, ''), status=[
        new('diagnostic_msgs/msg/DiagnosticStatus', level=s.level, name=f'{node_name}: {s.name}', message=s.message,
            hardware_id=node_name,
            values=[new('diagnostic_msgs/msg/KeyValue', key=k, value=str(v)) for k, v in s.values.items()])
        for s in statuses])


class Tally:
    """Counts what happens; may be asked and told from any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock, self._lock = clock, threading.Lock()
        self._start = clock()
        self._counts: Counter[str] = Counter()
        self._events: dict[str, deque[tuple[float, float]]] = {}     # name -> times (and values) of the last WINDOW_S
        self._last: dict[str, float] = {}       # name -> time of the last one
        self._reasons: dict[str, str] = {}      # name -> why the last one was refused
        self._result: Reconstruction | None = None

    def event(self, name: str, value: float = 0.0) -> None:
        """Something happened, with a number that may belong to it."""
        with self._lock:
            now = self._clock()
            self._counts[name] += 1
            self._last[name] = now
            self._recent(name, now).append((now, value))

    def refused(self, name: str, reason: str) -> None:
        """Something was refused; it counts as `bad {name}`."""
        self.event(f'bad {name}')
        with self._lock:
            self._reasons[name] = reason

    def accepted(self, name: str) -> None:
        """The last one of `name` was not refused."""
        with self._lock:
            self._reasons.pop(name, None)

    def result(self, result: Reconstruction, latency_s: float) -> None:
        """A pair came to an end."""
        self.event(f'outcome {result.outcome.value}', latency_s)
        self.event('answer')
        self._result = result
        with self._lock:
            self._reasons[f'outcome {result.outcome.value}'] = result.detail

    def reason(self, name: str) -> str:
        """Why the last one of `name` was refused; empty where it was not."""
        return self._reasons.get(name, '')

    def count(self, name: str) -> int:
        return self._counts[name]

    def rate_hz(self, name: str) -> float:
        with self._lock:
            now = self._clock()
            return len(self._recent(name, now)) / max(min(WINDOW_S, now - self._start), 1.0)

    def silent_s(self, name: str) -> float | None:
        """Time since the last event, None where there was none."""
        with self._lock:
            return self._clock() - self._last[name] if name in self._last else None

    def lately(self, name: str) -> bool:
        with self._lock:
            return bool(self._recent(name, self._clock()))

    def plane(self, plane: str, **known: Any) -> PlaneSummary:
        """The summary of a plane; `known` are the fields that nobody counts."""
        image, camera = f'image {plane}', f'camera info {plane}'
        return PlaneSummary(plane, self.count(image), self.rate_hz(image), self.silent_s(image),
                            bad_images=self.count(f'bad {image}'), image_fault=self.reason(image),
                            bad_camera_infos=self.count(f'bad {camera}'), camera_fault=self.reason(camera), **known)

    def pairing(self, counts: Counts, **known: Any) -> PairingSummary:
        return PairingSummary(counts, rate_hz=self.rate_hz('pair'), dropped=self.count('dropped'),
                              dropped_hz=self.rate_hz('dropped'), silent_s=self.silent_s('pair'),
                              both_alive=self.lately('image a') and self.lately('image b'),
                              unstamped=self.lately('unstamped'),
                              jumped=self.lately('jump'), unpaired_hz=self.rate_hz('unpaired'), **known)

    def reconstruction(self, **known: Any) -> ReconstructionSummary:
        done, good = self._result, f'outcome {Outcome.OK.value}'
        with self._lock:
            latency = tuple(value for _, value in self._recent(good, self._clock()))
            outcomes = {name.removeprefix('outcome '): n for name, n in self._counts.items()
                        if name.startswith('outcome ')}
            lately = {name: len(self._recent(f'outcome {name}', self._clock())) for name in outcomes}
        seen: dict[str, Any] = {} if done is None else dict(outcome=done.outcome, detail=done.detail,
                                                            warnings=done.warnings, confidence=done.confidence,
                                                            prediction=done.prediction)
        return ReconstructionSummary(silent_s=self.silent_s('answer'), rate_hz=self.rate_hz(good), latency_s=latency,
                                     outcomes=outcomes,
                                     overdue=self.count('overdue'), out_of_time=lately.get(Outcome.OUT_OF_TIME.value, 0)
                                                                                / max(sum(lately.values()), 1),
                                     refused=self._refused(lately), **seen, **known)

    def _refused(self, lately: dict[str, int]) -> str:
        """Why most pairs were refused, of the number of each outcome."""
        if not any(lately.values()) or lately.get(Outcome.OK.value):
            return ''
        usual = max(lately, key=lambda name: lately[name])
        reason = ': '.join(filter(None, (usual, self.reason(f'outcome {usual}'))))
        return f'none of the last {sum(lately.values())} pairs gave a result, most often for {reason}'

    def _recent(self, name: str, now: float) -> deque:
        events = self._events.setdefault(name, deque(maxlen=1000))
        while events and events[0][0] < now - WINDOW_S:
            events.popleft()
        return events
