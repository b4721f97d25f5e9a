"""Poses from the tf messages of a bag, as tf2 would have told them with all of the recording at hand: a small tree of
frames, interpolated in time."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from msg_adapters.messages import short, stamp_ns

from ..ros.worker import NoTransform

TF_TYPE = 'tf2_msgs/msg/TFMessage'
NAMES = ('tf', 'tf_static')     # relative names of their topics


@dataclass
class Edge:
    """A frame's pose in its parent, by stamp in ns; where it is static, the last one whatever the stamp."""

    parent: str
    static: bool
    poses: dict[int, tuple] = field(default_factory=dict)       # x, y, z and the quaternion x, y, z, w
    stamps: list[int] = field(default_factory=list)             # of the poses, ascending, once all are there

    def at(self, stamp: int, child: str) -> tuple[np.ndarray, np.ndarray]:
        """R, t of parent_from_child. Raises NoTransform before the first and after the last pose."""
        if self.static:
            return _pose(self.poses[self.stamps[-1]])
        after = bisect_left(self.stamps, stamp)
        if after < len(self.stamps) and self.stamps[after] == stamp:
            return _pose(self.poses[stamp])
        if not 0 < after < len(self.stamps):
            raise NoTransform(f'{short(child)} in {short(self.parent)} was recorded from {self.stamps[0] / 1e9:.3f} to '
                              f'{self.stamps[-1] / 1e9:.3f} s, not at {stamp / 1e9:.3f} s')
        early, late = self.stamps[after - 1:after + 1]
        first, second = self.poses[early], self.poses[late]
        share = (stamp - early) / (late - early)
        turn = Slerp([0.0, 1.0], Rotation.from_quat([first[3:], second[3:]]))(share)
        return turn.as_matrix(), (1 - share) * np.array(first[:3]) + share * np.array(second[:3])


def _pose(values: tuple) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.from_quat(values[3:]).as_matrix(), np.array(values[:3])


class RecordedPoses:
    """A Lookup (see worker): (reference frame, camera frame, stamp_ns) -> camera_from_reference as R, t in nested
    tuples. Raises NoTransform."""

    def __init__(self):
        self._edges: dict[str, Edge] = {}

    def take(self, message, static: bool) -> None:
        """The transforms of a tf2_msgs/TFMessage; those that are none are left out. `done` comes after the last one."""
        for transform in message.transforms:
            t, q = transform.transform.translation, transform.transform.rotation
            values = tuple(map(float, (t.x, t.y, t.z, q.x, q.y, q.z, q.w)))
            child, parent = (name.lstrip('/') for name in (transform.child_frame_id, transform.header.frame_id))
            if not np.isfinite(values).all() or not any(values[3:]) or child == parent:
                continue
            edge = self._edges.get(child)
            if edge is None or (edge.parent, edge.static) != (parent, static):
                edge = self._edges[child] = Edge(parent, static)
            if static:
                edge.poses.clear()
            edge.poses[stamp_ns(transform)] = values

    def done(self) -> None:
        """All messages were taken."""
        for edge in self._edges.values():
            edge.stamps = sorted(edge.poses)

    def __call__(self, reference: str, camera: str, stamp: int) -> tuple:
        if not camera:
            raise NoTransform('CameraInfo has no frame_id to look up')
        up, down = (self._chain(name.lstrip('/')) for name in (reference, camera))
        if up[-1] != down[-1]:
            raise NoTransform(f'the bag\'s tf has nothing between {short(camera)} and {short(reference)}')
        while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:     # what both have above them cancels
            up.pop()
            down.pop()
        (R_reference, t_reference), (R_camera, t_camera) = (self._in_root(chain, stamp) for chain in (up, down))
        R = R_camera.T @ R_reference
        t = R_camera.T @ (t_reference - t_camera)
        return tuple(map(tuple, R.tolist())), tuple(t.tolist())

    def _chain(self, frame: str) -> list[str]:
        """The frame and all above it. Raises NoTransform for a circle."""
        chain = [frame]
        while chain[-1] in self._edges:
            chain.append(self._edges[chain[-1]].parent)
            if chain[-1] in chain[:-1]:
                raise NoTransform(f'the bag\'s tf goes in a circle at {short(chain[-1])}')
        return chain

    def _in_root(self, chain: list[str], stamp: int) -> tuple[np.ndarray, np.ndarray]:
        """R, t from the first to the last frame of a chain."""
        R, t = np.eye(3), np.zeros(3)
        for child in chain[:-1]:
            R_up, t_up = self._edges[child].at(stamp, child)
            R, t = R_up @ R, R_up @ t + t_up
        return R, t


def read_poses(bag, topics: dict[str, str], copy=None) -> RecordedPoses:
    """The poses of a bag (of open_bag) whose tf topics are `topics`, name -> one of NAMES; `copy` gets every message
    (a Recorded) and its log time."""
    poses = RecordedPoses()
    for recorded in bag.messages([topic for topic in topics if topic in bag.types()]):
        if copy:
            copy(recorded, recorded.log_ns)
        poses.take(recorded.message, topics[recorded.topic] == 'tf_static')
    poses.done()
    return poses
