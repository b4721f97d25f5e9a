"""The ROS side of the house: subscribe, pair, hand over to the worker, publish."""

from __future__ import annotations

import gc
import re
import time
from collections import deque
from functools import lru_cache

import cv2
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import SetBool, Trigger

from msg_adapters.cameras import BadCameraInfo
from msg_adapters.diagnostics import (
    Tally,
    diagnostic_array,
    pairing_status,
    plane_status,
    reconstruction_status,
    trouble,
)
from msg_adapters.messages import ros_message, stamp_ns
from msg_adapters.shapes import BadPath, path_to_points

from ..config import Config, ConfigError
from ..data import Frame, Outcome, Reconstruction
from ..method.prediction import newest
from . import parameters as params
from .calibration_watch import CalibrationWatch
from .frame_names import doubts
from .message_sizes import bounded
from .outputs import Outputs
from .pairing import PLANES, Pairer
from .reconstruction_process import Bug, BugThere
from .reconstructor import Reconstructor
from .subscriptions import Inputs, path_of, surviving
from .transforms import TfMissing, TfPoses, import_tf
from .waiting import CameraBook, Pair, WaitingRoom
from .worker import Job, Memory, Prediction, Worker, adapt, camera, checked_camera, image_window, view_of

PREDICTIONS = 256       # that are kept: a model may tell them faster than images come
OVERDUE_S = 5.0         # a pair takes a fraction of a second; one that takes longer is told
PERSISTENT_S = 2.5      # what keeps results from coming is worth a line in the log once it has lasted that long ...
WARN_S = 30.0           # ... and another one after that


class FluoroShapeNode(Node):
    """Two image streams in, backbone and tip out. Callbacks only pair; one worker thread has the newest pair
    reconstructed and publishes.

    Raises ConfigError where a parameter given at the start can't work, and TfMissing where it asks for tf and there is
    none.
    """

    _levels: list[int] | None
    _doubts: tuple[str, ...]
    _lookup: TfPoses | None
    _threads: int | None
    _left: tuple[Job, Frame | None, Reconstruction, float] | None
    _inputs: Inputs | None

    def __init__(self, reconstructor: Reconstructor):
        super().__init__('fluoro_shape')
        self._config = params.declare(self)
        self._enabled, self._overdue, self._levels, self._room = True, False, None, WaitingRoom()
        self._trouble, self._namesakes, self._has_result = ('', 0.0), '', False     # which, since when
        self._predictions, self._doubts = deque(maxlen=PREDICTIONS), ()
        self._pairer, self._books = Pairer(self._slop_ns), {plane: CameraBook() for plane in PLANES}
        self._tally, self._memory, self._watch = Tally(), Memory(), CalibrationWatch()
        self._view_of, self._lookup, self._threads = lru_cache(maxsize=8)(view_of), None, None
        self._reconstructor, self._restarted = reconstructor, ''      # why it was lately
        self._left = None       # of the pair answered last: it, and what is to be told of it
        reconstructor.told = self._on_restart

        overridable = QoSOverridingOptions.with_default_policies()
        self._outputs = Outputs(self)
        self._diagnostics_out = self.create_publisher(DiagnosticArray, '/diagnostics', QoSProfile(depth=10),
                                                      qos_overriding_options=overridable)
        self._answered = self.create_guard_condition(self._report_changes)
        self._worker = Worker(self._work, self._failed, self._get_ready)
        self._inputs = None
        self._listen()
        self.create_subscription(Path, 'predicted_backbone', surviving(self._on_prediction, self._bug),
                                 QoSProfile(depth=1), qos_overriding_options=overridable, raw=True)
        for name, kind, callback in (('reset', Trigger, self._on_reset), ('enable', SetBool, self._on_enable),
                                     ('capture_mask', Trigger, self._on_capture_mask),
                                     ('clear_mask', Trigger, self._on_clear_mask)):
            self.create_service(kind, f'~/{name}', callback)
        self.add_pre_set_parameters_callback(params.as_declared)
        self.add_on_set_parameters_callback(self._on_check_parameters)
        self.add_post_set_parameters_callback(self._on_parameters)
        # also while /clock stands still
        self.create_timer(1.0, self._on_second, clock=Clock(clock_type=ClockType.STEADY_TIME))
        unknown = params.unknown(self)
        if unknown:
            self.get_logger().warning(unknown)
        self._introduce()

    def stop(self, timeout_s: float) -> bool:
        """End the worker, which is given that long for the pair at work, if there is one; False where it can't be
        ended."""
        if not self._worker.stop(timeout_s if self._worker.busy_s else 0.0):
            self._reconstructor.end()
        return self._worker.stop(timeout_s)

    @property
    def _slop_ns(self) -> int:
        return round(self._config.input.sync_slop * 1e9)

    # ---- what comes in

    def _listen(self) -> None:
        """(Re)make the subscriptions to images and camera infos."""
        if self._inputs is not None:
            self._inputs.destroy()
        given = self._config.input
        if given.geometry == 'tf' and self._lookup is None:
            self._lookup = TfPoses(self)
        self._inputs = Inputs(self, given.image_transport, given.image_reliability,
                              *(surviving(callback, self._bug) for callback in (self._on_image, self._on_camera_info)))

    def _on_image(self, plane: str, msg) -> None:
        self._tally.event(f'image {plane}')
        if not self._enabled:
            return
        stamp, arrived, counts = stamp_ns(msg), time.monotonic(), self._pairer.counts
        jumps, unstamped, unpaired = counts.jumps, counts.unstamped, counts.unpaired
        pair = self._pairer.add(plane, stamp, bounded(msg))
        for _ in range(counts.unpaired - unpaired):
            self._tally.event('unpaired')
        if counts.unstamped > unstamped:
            self._tally.event('unstamped')
        if counts.jumps > jumps:
            self._tally.event('jump')
            self.get_logger().warning(f'plane {plane}: stamps jumped back: starting anew')
            self._forget()
            for book in self._books.values():
                book.rewind(stamp)
            if self._lookup is not None:
                self._lookup.forget()
        if pair is not None:
            self._tally.event('pair')
            stamp_a, image_a, image_b = pair
            self._drop(self._room.add(Pair((stamp_a, stamp_ns(image_b)), (image_a, image_b), arrived)))
            self._hand_over()
        self._report_changes()

    def _on_camera_info(self, plane: str, msg) -> None:
        book = self._books[plane]
        try:
            known = camera(msg, plane)
            if known != book.newest:
                known = checked_camera(msg, self._config, plane)
        except BadCameraInfo as error:
            self._tally.refused(f'camera info {plane}', str(error))
            self._report_changes()
            if book.newest is None:
                return
            known = book.newest     # the one before holds, and no image need wait for this one
        else:
            self._tally.accepted(f'camera info {plane}')
        book.add(stamp_ns(msg), known)
        self._hand_over()

    def _on_prediction(self, data: bytes) -> None:
        try:
            msg = path_of(data)
            self._predictions.append(Prediction(path_to_points(msg), msg.header.frame_id, stamp_ns(msg)))
            self._tally.accepted('prediction')
        except BadPath as error:
            self._tally.refused('prediction', str(error))
        self._report_changes()

    def _hand_over(self) -> None:
        """Give the newest pair whose cameras are known to the worker."""
        pair, lost = self._room.take(tuple(self._books.values()), time.monotonic(), self._inputs.infos_may_be_lost)
        if pair is not None:
            cameras = tuple(self._books[plane].at(stamp) for plane, stamp in zip(PLANES, pair.stamps))
            self._doubts = doubts(self._config, tuple(image.header.frame_id for image in pair.items), cameras)
            if self._doubts:
                self.get_logger().warning('; '.join(self._doubts), throttle_duration_sec=WARN_S)
            prediction = newest(self._predictions, pair.stamps[0])
            lost += self._worker.offer(Job(pair.stamps[0], pair.items, cameras, self._config, self._memory.generation,
                                           pair.arrived, prediction))
        self._drop(lost)

    def _drop(self, pairs: int) -> None:
        for _ in range(pairs):
            self._tally.event('dropped')

    def _forget(self) -> None:
        """Nothing of what came before counts any more, but the cameras and the mask."""
        self._room.clear()
        self._predictions.clear()
        self._worker.clear()
        self._memory.reset()

    # ---- services and parameters

    def _on_reset(self, request, response):
        self._pairer.reset()
        self._forget()
        self._watch.reset()
        response.success, response.message = True, 'tracking state and buffered frames forgotten'
        return response

    def _on_enable(self, request, response):
        self._enabled = request.data
        self._pairer.reset()
        self._forget()
        self._report_changes()
        response.success, response.message = True, 'processing' if request.data else 'paused'
        return response

    def _on_capture_mask(self, request, response):
        pairs = self._config.input.mask_frames
        self._memory.capture_mask(pairs)
        self._report_changes()
        response.success, response.message = (True, f'the next {pairs} pairs become the mask: '
                                                    'keep the device out of the field')
        return response

    def _on_clear_mask(self, request, response):
        self._memory.clear_mask()
        self._report_changes()
        response.success, response.message = True, 'no mask'
        return response

    def _on_check_parameters(self, parameters) -> SetParametersResult:
        try:
            if params.changed(self._config, parameters).input.geometry == 'tf':
                import_tf()
        except (ConfigError, TfMissing) as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _on_parameters(self, parameters) -> None:
        try:
            old, self._config = self._config, params.changed(self._config, parameters)
        except ConfigError as error:    # the device's file is another one than when it was checked
            self.get_logger().error(str(error))
            return
        if any(p.name in ('device', 'robot_radius') for p in parameters):
            self.get_logger().info(_radius(self._config))
        self._pairer.slop_ns = self._slop_ns
        subscribed = ('geometry', 'image_transport', 'image_reliability')
        if any(getattr(old.input, name) != getattr(self._config.input, name) for name in subscribed):
            self._listen()

    # ---- what goes out

    def _get_ready(self, waited_for: bool) -> None:
        """In the worker's thread, before each pair and now and then while there is none."""
        # else that is done while the next one is reconstructed over there
        if not waited_for or self._reconstructor.here:
            self._finish()
        self._reconstructor.get_ready()

    def _work(self, job: Job) -> None:
        """A pair from messages to messages, in the worker's thread; all but the answer itself is left for `_finish`."""
        budget = job.config.input.time_budget
        until = time.monotonic() + budget if budget else None
        if job.config.input.threads != self._threads:
            self._threads = job.config.input.threads
            cv2.setNumThreads(self._threads or -1)      # 0 would mean none for OpenCV
        adapted = adapt(job, self._view_of, self._lookup, self._tally)
        frame, result = ((None, adapted) if isinstance(adapted, Reconstruction)
                         else (adapted, self._reconstruct(job, adapted, until)))
        latency_s = time.monotonic() - job.arrived
        self._finish()
        if result is None:
            self._answered.trigger()
        else:
            self._left = job, frame, result, latency_s

    def _finish(self) -> None:
        """Count, watch and explain what was answered last, if that was not done yet."""
        if self._left is None:
            return
        (job, frame, result, latency_s), self._left = self._left, None
        self._tally.result(result, latency_s)
        try:
            self._answered.trigger()
            if frame is not None:
                self._watch.take(result, frame.views, job.cameras)
            self._outputs.explain(job, frame, result)
        except Exception as error:  # it belongs to this pair, and not to the one that may be under way
            self._bug(error, latency_s)

    def _reconstruct(self, job: Job, frame: Frame, until: float | None) -> Reconstruction | None:
        """The published answer to a frame; None where it went into the mask or was overtaken by a reset."""
        window = image_window(job, frame)
        if self._memory.take_for_mask(frame, window):
            return None
        result = self._reconstructor(frame, job.config, self._memory.prior(job, frame, window), until, self._finish)
        if not self._memory.remember(job, frame, result):
            return None
        self._outputs.answer(frame, result)
        if result.shape is not None and not self._has_result:
            self._has_result = True
            self.get_logger().info(f'first result, {1e3 * (time.monotonic() - job.arrived):.0f} ms after its images: '
                                   f'{1e3 * result.shape.length:.1f} mm long, in frame "{frame.frame_id}"')
        return result

    def _failed(self, job: Job, error: Exception) -> None:
        self._bug(error, time.monotonic() - job.arrived)

    def _bug(self, error: Exception, latency_s: float = 0.0) -> None:
        """An exception that nobody foresaw, in either thread or in the process that reconstructs: said once, counted
        always."""
        if not self.context.ok():   # what fails while the node goes down is no news
            return
        bug = error.bug if isinstance(error, BugThere) else Bug.of(error)
        if not self._tally.count(bug.kind):
            self.get_logger().error(bug.trace)
        self._tally.event(bug.kind)
        self._tally.result(Reconstruction(Outcome.INTERNAL_ERROR, bug.words), latency_s)
        self._answered.trigger()

    def _on_restart(self, reason: str) -> None:
        """The process that reconstructs was lost; in the worker's thread."""
        if not self.context.ok():
            return
        self._restarted = f'reconstruction restarted: {reason}'
        self._tally.event('restart')
        self.get_logger().error(self._restarted)
        self._answered.trigger()

    def _summaries(self) -> tuple:
        """Of the planes, of the pairing and of the reconstruction."""
        gap = self._pairer.gap_ns
        planes = [self._tally.plane(plane, has_camera=self._books[plane].newest is not None,
                                    **self._inputs.known(plane)) for plane in PLANES]
        pairing = self._tally.pairing(self._pairer.counts, slop_s=self._config.input.sync_slop,
                                      gap_s=None if gap is None else gap / 1e9,
                                      lossy=any(plane.reliability == 'best_effort' for plane in planes))
        fault = self._tally.reason('prediction')
        still = ('use_sim_time is set, but there is no /clock'
                 if self.get_clock().ros_time_is_active and not self.get_clock().now().nanoseconds else '')
        restarted = self._restarted if self._tally.lately('restart') else ''
        watch = self._watch.finding
        notes = tuple(filter(None, (restarted, self._memory.note, fault and f'predicted_backbone: {fault}', still,
                                    self._namesakes, *self._doubts, str(watch) if watch.noticed else '')))
        results = self._tally.reconstruction(enabled=self._enabled, mask=self._memory.mask,
                                             capturing=self._memory.capturing, notes=notes, calibration=str(watch),
                                             overdue_s=self._overdue_s(), here=self._reconstructor.here,
                                             restarts=self._tally.count('restart'))
        return planes, pairing, results

    def _statuses(self) -> list:
        planes, pairing, results = self._summaries()
        return [*map(plane_status, planes), pairing_status(pairing), reconstruction_status(results)]

    def _overdue_s(self) -> float:
        """For how long the pair at work has been if that is too long, else 0; every such pair is counted once."""
        busy = self._worker.busy_s
        late = busy > OVERDUE_S
        if late and not self._overdue:
            self.get_logger().error(f'the pair at work takes more than {OVERDUE_S:g} s')
            self._tally.event('overdue')
        self._overdue = late
        return busy if late else 0.0

    def _report(self, statuses) -> None:
        self._levels = _key(statuses)
        self._diagnostics_out.publish(diagnostic_array(statuses, self.get_clock().now().nanoseconds,
                                                       self.get_fully_qualified_name(), ros_message))

    def _report_changes(self) -> None:
        statuses = self._statuses()
        if _key(statuses) != self._levels:
            self._report(statuses)

    def _on_second(self) -> None:
        # cheap after node.main's freeze; Python keeps thousands of freed tuples for later,
        # and only this gives them back
        gc.collect()
        self._inputs.count()
        self._hand_over()
        self._warn()
        self._report(self._statuses())

    def _introduce(self) -> None:
        """The log's first line."""
        given, named = self._config, self.resolve_topic_name
        suffix = '/compressed' if given.input.image_transport == 'compressed' else ''
        images, infos = (' and '.join(named(f'plane_{plane}/{topic}') + more for plane in PLANES)
                         for topic, more in (('image_raw', suffix), ('camera_info', '')))
        frame = (f'frame "{given.input.reference_frame}"' if given.input.reference_frame
                 else 'the frame of plane A\'s camera info')
        self.get_logger().info(f'images on {images}, cameras on {infos} (geometry {given.input.geometry}); '
                               f'results on {named("backbone")} and '
                               f'{named("tip")} in {frame}; method {given.curve.method}, {_radius(given)}')
        if self._reconstructor.here:
            self.get_logger().info('reconstructing in a thread of the node, not in a process of its own: '
                                   f'{self._reconstructor.here}')

    def _warn(self) -> None:
        """A line in the log now and then, while no results come or another node has the same name."""
        me = self.get_name(), self.get_namespace()
        count = self.get_node_names_and_namespaces().count(me)
        self._namesakes = (f'{count} nodes are named {self.get_fully_qualified_name()}: end all but one, '
                           'or give them other names' if count > 1 else '')
        if self._namesakes:
            self.get_logger().warning(self._namesakes, throttle_duration_sec=WARN_S)
        if self._watch.finding.noticed:
            self.get_logger().warning(str(self._watch.finding), throttle_duration_sec=WARN_S)
        words, now = trouble(*self._summaries()), time.monotonic()
        kind = re.sub(r'[\d.]+|, most often.*', '', words)
        if kind != self._trouble[0]:
            self._trouble = kind, now
        if words and now > self._trouble[1] + PERSISTENT_S:
            self.get_logger().warning(f'no results: {words}', throttle_duration_sec=WARN_S)


def _radius(config: Config) -> str:
    """What is looked for, and who says so."""
    return f'robot_radius {1e3 * config.radius:g} mm' + (f', that of device {config.detection.device}'
                                                         if config.described else '')


def _key(statuses) -> list:
    """What is worth telling at once."""
    return [(s.level, s.values.get('last outcome'), s.values.get('mask')) for s in statuses]
