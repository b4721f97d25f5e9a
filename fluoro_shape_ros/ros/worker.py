"""One pair at a time, the newest one: the thread that does the work, what it remembers, and messages into a Frame.
Nothing here imports ROS."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from msg_adapters.cameras import BadCameraInfo, camera_info_to_view, check_lengths
from msg_adapters.diagnostics import Tally
from msg_adapters.images import BadImage, compressed_to_array, image_to_array
from msg_adapters.messages import stamp_ns

from ..config import Config
from ..data import Frame, Outcome, Prior, Reconstruction, Shape, View
from ..method.prediction import staleness
from .message_sizes import Oversized
from .pairing import PLANES

LOOK_S = 0.5            # between two looks at whether all is ready for a job


class NoTransform(LookupError):
    """A pose that tf does not know; the message names the frames."""


@dataclass(frozen=True)
class Camera:
    """A CameraInfo; two of them are equal when they are the same camera, whatever their stamps."""

    content: tuple
    msg: Any = field(compare=False)

    @property
    def window(self) -> tuple:
        """Which part of the detector the image shows, and how finely."""
        roi = self.msg.roi
        return roi.x_offset, roi.y_offset, roi.width, roi.height, self.msg.binning_x, self.msg.binning_y


def camera(msg, plane: str = '') -> Camera:
    """The camera of a plane's sensor_msgs/CameraInfo, unchecked but for its lengths. Raises BadCameraInfo where these
    are absurd."""
    check_lengths(msg, plane)
    content = (msg.header.frame_id, msg.height, msg.width, msg.distortion_model,
               *map(tuple, (msg.d, msg.k, msg.r, msg.p)))
    roi = msg.roi
    return Camera((*content, msg.binning_x, msg.binning_y, roi.x_offset, roi.y_offset, roi.width, roi.height), msg)


def checked_camera(msg, config: Config, plane: str = '') -> Camera:
    """The camera of a plane's CameraInfo that may serve once an image of its size comes. Raises BadCameraInfo."""
    region = [(r or full) // max(b, 1) for r, full, b in zip((msg.roi.height, msg.roi.width), (msg.height, msg.width),
                                                             (msg.binning_y, msg.binning_x))]
    pose = (np.eye(3), np.zeros(3)) if config.input.geometry == 'tf' else None
    camera_info_to_view(msg, plane, tuple(region), rectified=config.input.rectified, pose=pose)
    return camera(msg, plane)


@dataclass(frozen=True)
class Prediction:
    """A kinematic model's guess of the shape."""

    points: np.ndarray      # (N, 3) m, base to tip
    frame_id: str
    stamp_ns: int = 0


@dataclass(frozen=True)
class Job:
    """A pair of messages and everything that holds for it."""

    stamp_ns: int                           # of plane A's image
    images: tuple[Any, Any]                 # sensor_msgs/Image or CompressedImage
    cameras: tuple[Camera | None, Camera | None]
    config: Config
    generation: int                         # of the memory when the pair came
    arrived: float                          # time.monotonic() when the second image came
    prediction: Prediction | None = None

    @property
    def frame_id(self) -> str:
        """The reference frame; empty where it is to be plane A's and that is not known."""
        first = self.cameras[0]
        return self.config.input.reference_frame or ('' if first is None else first.msg.header.frame_id)


ViewOf = Callable[..., View]        # (camera, plane, image_shape, rectified, pose) -> View
# (reference frame, camera frame, stamp_ns) -> camera_from_reference, raises NoTransform
Lookup = Callable[[str, str, int], tuple]


def view_of(camera: Camera, plane: str, image_shape: tuple[int, int], rectified: bool, pose=None) -> View:
    """The View of a camera; `pose` is R, t of camera_from_reference as nested tuples. All arguments are hashable: worth
    a cache."""
    pose = None if pose is None else tuple(map(np.array, pose))
    return camera_info_to_view(camera.msg, plane, image_shape, rectified=rectified, pose=pose)


def decode(msg) -> np.ndarray:
    """(H, W) uint8, uint16 or float32 of a sensor_msgs/Image or CompressedImage, or of what was decoded before. Raises
    BadImage."""
    if isinstance(msg, np.ndarray):
        return msg
    if isinstance(msg, Oversized):
        raise BadImage(msg.reason)
    return image_to_array(msg) if hasattr(msg, 'encoding') else compressed_to_array(msg)


def adapt(job: Job, view_of: ViewOf, lookup: Lookup, tally: Tally) -> Frame | Reconstruction:
    """The Frame of a pair of messages, or the rejection that says why it can't be one."""
    images, faults = [], []
    for plane, msg in zip(PLANES, job.images):
        try:
            images.append(decode(msg))
            tally.accepted(f'image {plane}')
        except BadImage as error:
            faults.append(f'plane {plane}: {error}')
            tally.refused(f'image {plane}', str(error))
    if faults:
        return Reconstruction(Outcome.BAD_IMAGE, '; '.join(faults))
    missing = [f'plane {plane}' for plane, c in zip(PLANES, job.cameras) if c is None]
    if missing:
        return Reconstruction(Outcome.NO_CAMERA_INFO, f'{" and ".join(missing)}: no valid camera info yet')
    given = job.config.input
    try:
        poses = [lookup(job.frame_id, c.msg.header.frame_id, stamp_ns(image)) if given.geometry == 'tf' else None
                 for c, image in zip(job.cameras, job.images)]
        views = tuple(view_of(c, plane, image.shape, given.rectified, pose)
                      for c, plane, image, pose in zip(job.cameras, PLANES, images, poses))
    except NoTransform as error:
        return Reconstruction(Outcome.NO_TRANSFORM, str(error))
    except BadCameraInfo as error:
        return Reconstruction(Outcome.BAD_CAMERA_INFO, str(error))
    return Frame(job.stamp_ns, job.frame_id, tuple(images), views)


class Memory:
    """What outlives a pair: the last shape and the mask images. Used by the worker and by the services."""

    def __init__(self):
        self._lock = threading.Lock()
        self._last: deque[tuple[Shape, int, str]] = deque(maxlen=2)     # shape, stamp, frame
        self._search = None     # one of whole images that was cut short
        self._searched = None   # what the last one found, as long as that suffices ...
        # ... and the last pair's config and masks: with others it would find something else
        self._looked_with: tuple[Config | None, tuple | None] = None, None
        self._sums, self._taken, self._wanted = None, 0, 0
        self._masks, self._window = None, None      # what was captured, and the images it fits
        self.generation = 0     # a result that was begun in an earlier one is out of date
        self.note = ''          # what became of the mask against the user's will

    def reset(self) -> None:
        """Forget the last shape; results under way are out of date."""
        with self._lock:
            self.generation += 1
            self._last.clear()
            self._search = self._searched = None

    def capture_mask(self, pairs: int) -> None:
        """The next `pairs` pairs become the mask."""
        with self._lock:
            self._sums, self._taken, self._wanted, self.note = None, 0, pairs, ''

    def clear_mask(self) -> None:
        with self._lock:
            self._masks, self._sums, self._wanted, self.note = None, None, 0, ''

    @property
    def capturing(self) -> bool:
        return self._wanted > 0

    @property
    def mask(self) -> str:
        """What there is of a mask, in words."""
        if self._wanted:
            return f'capturing, {self._taken} of {self._wanted} pairs'
        return 'none' if self._masks is None else f'in use, mean of {self._taken} pairs'

    def take_for_mask(self, frame: Frame, window: tuple) -> bool:
        """Whether a mask is being captured and this frame went into it."""
        with self._lock:
            if not self._wanted:
                return False
            if self._sums is None or window != self._window:
                self._sums, self._taken, self._window = [np.zeros(image.shape) for image in frame.images], 0, window
            for total, image in zip(self._sums, frame.images):
                total += image
            self._taken += 1
            if self._taken == self._wanted:
                self._finish_mask()
            return True

    def finish_mask(self) -> int:
        """Let what was captured so far be the mask, if anything was; the number of its pairs."""
        with self._lock:
            if self._wanted and self._taken:
                self._finish_mask()
            self._wanted = 0
            return self._taken

    def _finish_mask(self) -> None:
        self._masks = tuple((total / self._taken).astype(np.float32) for total in self._sums)
        self._sums, self._wanted = None, 0

    def prior(self, job: Job, frame: Frame, window: tuple) -> Prior:
        """What is known before `frame` is looked at. A mask that no longer fits the images is dropped."""
        with self._lock:
            if self._masks is not None and window != self._window:
                self._masks, self.note = None, 'mask cleared: the size or region of the images changed'
            known = [(shape, stamp_ns) for shape, stamp_ns, frame_id in self._last
                     if job.config.curve.tracking and frame_id == frame.frame_id]
            before, previous = [(None, None)] * (2 - len(known)) + known
            points, fault = _predicted(job, frame)
            if self._looked_with[0] != job.config or self._looked_with[1] is not self._masks:
                self._searched = None
            self._looked_with = job.config, self._masks
            return Prior(previous[0], previous[1], before[0], before[1], self._masks, points, fault, self._search,
                         self._searched if known else None)

    def remember(self, job: Job, frame: Frame, result: Reconstruction) -> bool:
        """Keep the shape of a result for the next pair; False where the result is out of date and must not be
        published."""
        with self._lock:
            if job.generation != self.generation:
                return False
            self._search, self._searched = result.search, result.searched
            if result.shape is not None:
                self._last.append((result.shape, frame.stamp_ns, frame.frame_id))
            return True


def image_window(job: Job, frame: Frame) -> tuple:
    """What two pairs must have in common for one to be subtracted from the other."""
    return tuple((image.shape, image.dtype, c.window) for image, c in zip(frame.images, job.cameras))


def _predicted(job: Job, frame: Frame) -> tuple[np.ndarray | None, str]:
    """(N, 3) m, the prediction for a pair, or None and why it does not count."""
    given = job.prediction
    if given is None:
        return None, ''
    fault = staleness(given.stamp_ns, frame.stamp_ns, job.config.curve.prior_max_age)
    if given.frame_id not in ('', frame.frame_id):
        fault = f'it is in frame "{given.frame_id}", not in "{frame.frame_id}"'
    return (None if fault else given.points), fault


class Worker:
    """A thread that works on the newest job offered; a job that nobody got to is overtaken by the next.

    An exception of `work(job)` goes to `failed(job, error)` and the next job goes on. `get_ready(waits)` is called
    before each, and every LOOK_S while none waits.
    """

    def __init__(self, work: Callable[[Job], None], failed: Callable[[Job, Exception], None],
                 get_ready: Callable[[bool], None] = lambda waits: None):
        self._work, self._failed, self._get_ready = work, failed, get_ready
        self._changed = threading.Condition()
        self._job: Job | None = None
        self._began: float | None = None
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name='reconstruction', daemon=True)
        self._thread.start()

    def offer(self, job: Job) -> bool:
        """Make `job` the next one; whether another one had been waiting and was dropped."""
        with self._changed:
            dropped, self._job = self._job is not None, job
            self._changed.notify()
        return dropped

    def clear(self) -> None:
        """Forget the job that waits, if any."""
        with self._changed:
            self._job = None

    @property
    def busy_s(self) -> float:
        """How long the job at work has taken so far; 0 where there is none."""
        began = self._began
        return 0.0 if began is None else time.monotonic() - began

    def stop(self, timeout_s: float) -> bool:
        """Take no more jobs and wait for the one at work; whether it ended in time."""
        with self._changed:
            self._job, self._stopped = None, True
            self._changed.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            self._get_ready(self._job is not None)
            with self._changed:
                self._changed.wait_for(lambda: self._job is not None or self._stopped, LOOK_S)
                if self._stopped:
                    return
                job, self._job = self._job, None
            if job is None:
                continue
            self._began = time.monotonic()
            try:
                self._work(job)
            except Exception as error:  # the last line of defence: a pair must not take the node with it
                self._failed(job, error)
            self._began = None
