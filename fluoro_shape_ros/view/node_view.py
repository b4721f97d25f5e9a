"""What one node says, message by message, made visible at the stamps of its images; the same for topics and bags."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import rerun as rr

from msg_adapters.cameras import BadCameraInfo, camera_info_to_view
from msg_adapters.diagnostics import STALE
from msg_adapters.images import BadImage, compressed_to_array, image_to_array
from msg_adapters.messages import stamp_ns
from msg_adapters.shapes import BadPath, path_to_points

from ..data import Outcome, View
from ..geometry.cameras import GeometryError, check_pair
from ..metrics import compare
from ..overlay import stretched
from . import scene
from .messages import cloud_to_rows, coloured, received_shape

PLANES = 'a', 'b'
RECONSTRUCTION, LATENCY = 'reconstruction', 'latency median (ms)'     # of diagnostics: a status and one of its keys
KEPT = 64               # stamps whose backbone or truth is waited for by the other
TIMELINE = 'stamp'
NUMBERS = re.compile(r'[0-9.]+')
MOST_S = 10.0           # a latency above it is none: the stamps are of another clock
# topic -> type, in the order in which they are looked at where several have come
TOPICS = {
    **{f'plane_{p}/camera_info': 'sensor_msgs/msg/CameraInfo' for p in PLANES},
    'ground_truth/backbone': 'nav_msgs/msg/Path',
    'backbone_points': 'sensor_msgs/msg/PointCloud2',
    'tip_pose': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    **{f'plane_{p}/overlay': 'sensor_msgs/msg/Image' for p in PLANES},
}
DIAGNOSTICS = '/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray'


# takes a stamp in ns (None: for all times), and archetypes by entity path
Log = Callable[[int | None, scene.Scene], None]


def into(recording: rr.RecordingStream) -> Log:
    """A Log that fills a recording of Rerun."""
    def log(stamp: int | None, things: scene.Scene) -> None:
        if stamp is not None:
            recording.set_time(TIMELINE, timestamp=np.datetime64(stamp, 'ns'))
        for path, archetypes in things.items():
            recording.log(path, *(archetypes if isinstance(archetypes, list) else [archetypes]), static=stamp is None)
    return log


class NodeView:
    """Takes the messages of a node in an absolute `namespace` and logs what they show, below the entity
    `root_of(namespace)`."""

    def __init__(self, log: Log, namespace: str):
        self.heard = False      # anything of the node itself
        self._namespace, self._root, self._log_all = namespace, root_of(namespace), log
        self._views: dict[str, View] = {}
        self._moved = False     # cameras that are not drawn yet
        self._upright = False
        self._found: dict[int, np.ndarray] = {}     # backbones by stamp
        self._truths: dict[int, np.ndarray] = {}
        self._newest: int | None = None             # stamp of the last pair seen
        self._overlaid: int | None = None           # of which an overlay came
        self._counts: dict[str, int] = {}
        self._said = ''
        self._strokes = False       # where there is no overlay: backbone and tip are drawn on the images here
        self._log(None, scene.styles())

    def take(self, topic: str, msg, arrived_ns: int) -> None:
        """A message of a topic in TOPICS, `plane_a/image_raw`, or DIAGNOSTICS, that came at `arrived_ns`. What makes no
        sense is left out."""
        try:
            self._handler(topic)(topic, msg, arrived_ns)
        except (BadImage, BadCameraInfo, BadPath):      # the node names them in its diagnostics
            return

    def _handler(self, topic: str) -> Callable:
        name = topic.rpartition('/')[2]
        return {'camera_info': self._on_camera, 'backbone': self._on_path, 'backbone_points': self._on_points,
                'tip_pose': self._on_tip, 'overlay': self._on_overlay,
                'image_raw': self._on_image, 'diagnostics': self._on_diagnostics}[name]

    # ---- images and cameras

    def _on_camera(self, topic: str, msg, _) -> None:
        plane, before = topic[len('plane_')], self._views.get(topic[len('plane_')])
        view = self._views[plane] = camera_info_to_view(msg, plane, received_shape(msg))
        self._moved |= (before is None or not np.array_equal(before.P, view.P)
                        or (before.width, before.height) != (view.width, view.height))

    def _on_overlay(self, topic: str, msg, _) -> None:
        self.heard, stamp = True, stamp_ns(msg)
        # its backbone would have come before: the pair has no result
        if stamp != self._overlaid and stamp not in self._found:
            self._log(stamp, scene.nothing())
        self._overlaid = stamp
        self._picture(topic[len('plane_')], coloured(msg), stamp)

    def _on_image(self, topic: str, msg, _) -> None:
        self._strokes = True
        image = image_to_array(msg) if hasattr(msg, 'encoding') else compressed_to_array(msg)
        self._picture(topic[len('plane_')], stretched(image), stamp_ns(msg))

    def _picture(self, plane: str, image: np.ndarray, stamp: int) -> None:
        self._pair(stamp)
        self._log(stamp, scene.picture(plane, image))

    def _pair(self, stamp: int) -> None:
        """A pair with this stamp is there: time goes on, and the cameras that hold for it are drawn where they have
        moved."""
        self._newest = stamp
        if not self._moved or len(self._views) < 2:
            return
        self._moved, views = False, tuple(self._views[p] for p in PLANES)
        try:
            check_pair(views)
        except GeometryError:       # as where poses come from tf: P has none
            return
        if not self._upright:
            self._upright = True
            self._log(None, scene.upright(views[0]))
        self._log(stamp, scene.cameras(views))

    # ---- results

    def _on_points(self, _, msg, arrived_ns: int) -> None:
        rows = cloud_to_rows(msg)
        self._backbone(stamp_ns(msg), rows['points'], arrived_ns)
        known = rows['sigma'][np.isfinite(rows['sigma'])]
        self._log(stamp_ns(msg),
                  scene.values(confidence__published=rows['confidence'][-1],
                               millimetres__tip_sigma=1e3 * rows['sigma'][-1],
                               millimetres__sigma=1e3 * float(np.median(known)) if known.size else np.nan))

    def _on_path(self, topic: str, msg, arrived_ns: int) -> None:
        points = path_to_points(msg)
        if topic.startswith('ground_truth'):
            self._truth(stamp_ns(msg), points)
        else:
            self._backbone(stamp_ns(msg), points, arrived_ns)

    def _backbone(self, stamp: int, points: np.ndarray, arrived_ns: int) -> None:
        self.heard = True
        self._pair(stamp)
        self._log(stamp, scene.backbone(points))
        late = (arrived_ns - stamp) * 1e-9
        if 0 < late < MOST_S:
            self._log(stamp, scene.values(milliseconds__here=1e3 * late))
        if self._strokes:
            for view in self._views.values():
                self._log(stamp, scene.drawn(view, points))
        _keep(self._found, stamp, points)
        self._compare(stamp)

    def _truth(self, stamp: int, points: np.ndarray) -> None:
        _keep(self._truths, stamp, points)
        self._log(stamp, scene.truth(points, None))
        self._compare(stamp)

    def _compare(self, stamp: int) -> None:
        if stamp in self._found and stamp in self._truths:
            errors = compare(self._found[stamp], self._truths[stamp])
            self._log(stamp, scene.truth(self._truths[stamp], self._found[stamp][-1]))
            self._log(stamp, scene.values(millimetres__tip_error=1e3 * errors.tip,
                                          millimetres__error=1e3 * errors.mean))

    def _on_tip(self, _, msg, __) -> None:
        p = msg.pose.pose.position
        tip, covariance = np.array([p.x, p.y, p.z]), np.array(msg.pose.covariance, float).reshape(6, 6)[:3, :3]
        if not np.isfinite(tip).all():
            raise BadPath('a tip that is not finite')
        self._log(stamp_ns(msg), scene.ellipsoid(tip, covariance))
        if self._strokes:
            for view in self._views.values():
                self._log(stamp_ns(msg), scene.drawn_tip(view, tip, covariance))

    # ---- what the node says of itself

    def _on_diagnostics(self, _, msg, __) -> None:
        for status in msg.status:
            node, _, name = status.name.rpartition(': ')
            if name == RECONSTRUCTION and (node.rpartition('/')[0] or '/') == self._namespace:
                self.heard = True
                self._status(status, stamp_ns(msg))

    def _status(self, status, stamp: int) -> None:
        said = {item.key: item.value for item in status.values}
        outcome, level = (said.get('last outcome', 'none'),
                          status.level[0] if isinstance(status.level, bytes) else status.level)
        one_pair = 'mask' not in said       # a replay tells of every pair, a node sums up once a second
        if one_pair:
            self._counts[outcome] = self._counts.get(outcome, 0) + 1
        else:
            self._counts = {key.removeprefix('count '): int(value)
                            for key, value in said.items() if key.startswith('count ') and value.isdecimal()}
            # the images have another clock, as those of a bag that is played
            if self._newest is not None and abs(stamp - self._newest) > MOST_S * 1e9:
                stamp = self._newest + 1
        things = scene.counts(self._counts) | scene.values(milliseconds__node=_number(said.get(LATENCY)))
        if outcome not in ('none', Outcome.OK.value):
            things |= scene.values(confidence__refused=_number(said.get('confidence')))
            if one_pair or self._overlaid is None:      # else that of the pair itself tells
                self._log(stamp, scene.nothing())
        if level == STALE:
            self._log(stamp, scene.nothing())
        good = outcome == Outcome.OK.value and level != STALE
        text = ': '.join(filter(None, [outcome, said.get('warnings')])) if good else status.message
        said_without_numbers = NUMBERS.sub('', text)
        if said_without_numbers != self._said:
            self._said = said_without_numbers
            things |= scene.words(text, good)
        self._log(stamp, things)

    def _log(self, stamp: int | None, things: scene.Scene) -> None:
        self._log_all(stamp, {f'{self._root}/{path}'.rstrip('/'): archetypes for path, archetypes in things.items()})


def root_of(namespace: str) -> str:
    """The entity of a node."""
    return namespace.strip('/') or 'fluoro_shape'


def _keep(kept: dict[int, np.ndarray], stamp: int, points: np.ndarray) -> None:
    kept[stamp] = points
    while len(kept) > KEPT:
        del kept[next(iter(kept))]


def _number(text: str | None) -> float:
    """NaN for what is not known."""
    with suppress(TypeError, ValueError):
        return float(text)
    return np.nan
