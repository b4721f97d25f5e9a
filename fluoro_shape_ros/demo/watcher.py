"""The demo's ROS side: listens to results, ground truth and diagnostics, and at the end to one pair of images."""

from __future__ import annotations

import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path
from sensor_msgs.msg import CameraInfo, Image

from msg_adapters.cameras import camera_info_to_view
from msg_adapters.diagnostics import OK
from msg_adapters.images import image_to_array
from msg_adapters.messages import stamp_ns
from msg_adapters.shapes import path_to_points

from ..data import Outcome
from ..files.pictures import Snapshot
from .own_node import OwnNode
from .score import Score

KEPT = 40   # stamps of which parts of a snapshot are kept


class Watcher(OwnNode):
    """A context manager with a ROS context of its own; `score` and what the node says of itself fill while it spins."""

    NAME = 'fluoro_shape_demo'

    def __init__(self):
        self.score = Score()
        self.reason = ''                            # why the last pair got no answer
        self.not_answered: dict[str, int] = {}      # pairs by reason
        self.snapshot: Snapshot | None = None
        self._parts: dict[int, dict] | None = None  # of snapshots, by stamp

    def _connect(self) -> None:
        self._node.create_subscription(Path, 'ground_truth/backbone', self._on_truth, 10)
        self._node.create_subscription(Path, 'backbone', self._on_backbone, 10)
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def watch_images(self) -> None:
        """From now on take a snapshot of the first pair whose images, cameras, truth and result have all come."""
        self._parts = {}
        for plane in 'ab':
            self._node.create_subscription(Image, f'plane_{plane}/image_raw',
                                           lambda msg, key=f'image {plane}': self._part(key, msg, msg), 5)
            self._node.create_subscription(CameraInfo, f'plane_{plane}/camera_info',
                                           lambda msg, key=f'camera {plane}': self._part(key, msg, msg), 5)

    def _on_truth(self, msg: Path) -> None:
        points = path_to_points(msg)
        self.score.truth(stamp_ns(msg), points)
        self._part('truth', msg, points)

    def _on_backbone(self, msg: Path) -> None:
        points = path_to_points(msg)
        self.score.result(stamp_ns(msg), points, time.time_ns())
        self._part('found', msg, points)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            values = {item.key: item.value for item in status.values}
            if status.name.endswith(': reconstruction'):
                level = status.level[0] if isinstance(status.level, bytes) else status.level
                self.reason = '' if level == OK or values.get('last outcome') == Outcome.OK.value else status.message
                counts = {key.removeprefix('count '): int(value) for key, value in values.items()
                          if key.startswith('count ')}
                self.not_answered |= {name: count for name, count in counts.items() if name != Outcome.OK.value}
            elif status.name.endswith(': pairing') and values.get('dropped', '0') != '0':
                self.not_answered['overtaken by a newer pair'] = int(values['dropped'])

    def _part(self, key: str, msg, value) -> None:
        if self._parts is None or self.snapshot is not None:
            return
        parts = self._parts.setdefault(stamp_ns(msg), {})
        parts[key] = value
        if len(parts) == 6:
            images = tuple(image_to_array(parts[f'image {plane}']) for plane in 'ab')
            views = (camera_info_to_view(parts[f'camera {plane}'], plane, image.shape)
                     for plane, image in zip('ab', images))
            self.snapshot = Snapshot(images, tuple(view.P for view in views), parts['found'],
                                     np.asarray(parts['truth']))
        while len(self._parts) > KEPT:
            del self._parts[min(self._parts)]
