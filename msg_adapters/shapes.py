"""The backbone to messages, and a Path to points.

Everything is in the reference frame, in metres; `new` is a factory (see messages).
"""

from __future__ import annotations

import struct
import sys
from typing import Any

import numpy as np

from fluoro_shape_ros.data import Shape

from .messages import New, header

MAX_POSES = 100_000
CLOUD_FIELDS = ('x', 'y', 'z', 's', 'sigma', 'residual_a_px', 'residual_b_px', 'confidence')
UNKNOWN_VARIANCE = 1e6              # m^2: PoseWithCovariance has no mark for "unknown", and NaN or -1 upsets filters
ANY_ANGLE_VARIANCE = np.pi**2 / 3   # rad^2, of an angle about which nothing is known: uniform on the circle
TIP_CHORD = 0.01                    # m, the end piece over which the tip's direction is judged to be known
_FLOAT32 = 7                        # sensor_msgs/PointField


class BadPath(ValueError):
    """A Path that can't be a backbone; the message tells why."""


def shape_to_path(shape: Shape, stamp_ns: int, frame_id: str, new: New) -> Any:
    """nav_msgs/Path, base to tip; each orientation turns +x into the tangent towards the tip, with rotation-minimising
    roll."""
    head = header(new, stamp_ns, frame_id)
    poses = [new('geometry_msgs/msg/PoseStamped', header=head, pose=_pose(p, q, new))
             for p, q in zip(shape.points.tolist(), orientations(shape).tolist(), strict=True)]
    return new('nav_msgs/msg/Path', header=head, poses=poses)


def shape_to_path_cdr(shape: Shape, stamp_ns: int, frame_id: str) -> bytes:
    """What `shape_to_path` makes as ROS 2 serialises it (XCDR version 1, little endian; OMG DDS-XTypes 7.4), for a
    publisher that takes it as it is.

    A hundred poses as Python objects cost several ms to make and to serialise, this a tenth of one.
    """
    name = frame_id.encode() + b'\0'
    head = struct.pack('<iII', *divmod(int(stamp_ns), 10**9), len(name)) + name
    start = head + bytes(-len(head) % 4) + struct.pack('<I', len(shape.points)) + head      # up to the first pose
    start += bytes(-len(start) % 8)
    head += bytes(-len(head) % 8)       # of the others: after a pose everything is aligned
    rows = np.empty((len(shape.points), len(head) + 7 * 8), np.uint8)
    rows[:, :len(head)] = np.frombuffer(head, np.uint8)
    rows[:, len(head):] = np.ascontiguousarray(np.c_[shape.points, orientations(shape)], '<f8').view(np.uint8)
    return b'\0\1\0\0' + start + rows.tobytes()[len(head):]


def shape_to_tip(shape: Shape, stamp_ns: int, frame_id: str, new: New) -> Any:
    """geometry_msgs/PointStamped of the last backbone point."""
    return new('geometry_msgs/msg/PointStamped', header=header(new, stamp_ns, frame_id),
               point=_point(shape.tip.tolist(), new))


def shape_to_tip_pose(shape: Shape, stamp_ns: int, frame_id: str, new: New) -> Any:
    """geometry_msgs/PoseWithCovarianceStamped: the last pose of the path, with `tip_covariance`."""
    pose = _pose(shape.tip.tolist(), orientations(shape)[-1].tolist(), new)
    return new('geometry_msgs/msg/PoseWithCovarianceStamped', header=header(new, stamp_ns, frame_id),
               pose=new('geometry_msgs/msg/PoseWithCovariance', pose=pose, covariance=tip_covariance(shape)))


def shape_to_cloud(shape: Shape, confidence: float, stamp_ns: int, frame_id: str, new: New) -> Any:
    """sensor_msgs/PointCloud2 with the float32 fields x, y, z, s, sigma (m, in the worst direction), residual_a_px,
    residual_b_px, confidence; NaN: not known.

    The confidence is the probability that the shape is right, the same in every point.
    """
    rows = np.c_[shape.points, shape.s, _worst_sigma(shape.covariance), shape.residuals_px,
                 np.full(len(shape.points), confidence)].astype(np.float32)
    fields = [new('sensor_msgs/msg/PointField', name=name, offset=4 * k, datatype=_FLOAT32, count=1)
              for k, name in enumerate(CLOUD_FIELDS)]
    return new('sensor_msgs/msg/PointCloud2', header=header(new, stamp_ns, frame_id), height=1, width=len(rows),
               fields=fields, is_bigendian=sys.byteorder == 'big', point_step=rows.strides[0], row_step=rows.nbytes,
               data=rows.view(np.uint8), is_dense=bool(np.isfinite(rows).all()))


def path_to_points(msg: Any) -> np.ndarray:
    """(N, 3) positions of a nav_msgs/Path. Raises BadPath for fewer than 2 or more than MAX_POSES poses, and positions
    that are not finite."""
    if not 2 <= len(msg.poses) <= MAX_POSES:
        raise BadPath(f'a backbone of {len(msg.poses)} poses: it needs 2 to {MAX_POSES}')
    positions = (pose.pose.position for pose in msg.poses)
    points = np.array([(p.x, p.y, p.z) for p in positions], float)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise BadPath(f'{bad.size} of {len(points)} positions are not finite, the first is pose {bad[0]}')
    return points


def tangents(shape: Shape) -> np.ndarray:
    """(N, 3) unit tangents towards the tip; +x for a single point."""
    if len(shape.points) < 2:
        return np.tile([1.0, 0.0, 0.0], (len(shape.points), 1))
    t = np.gradient(shape.points, shape.s, axis=0, edge_order=2 if len(shape.points) > 2 else 1)
    return t / np.linalg.norm(t, axis=1, keepdims=True)


def orientations(shape: Shape) -> np.ndarray:
    """(N, 4) quaternions x, y, z, w that turn +x into the tangents; from one to the next by the smallest rotation that
    carries tangent to tangent.

    That is parallel transport: the frame never turns about the backbone (Bishop 1975, There is more than one way to
    frame a curve).
    """
    t = tangents(shape)
    turns = _smallest_rotations(np.vstack([[1.0, 0.0, 0.0], t[:-1]]), t)
    # q_i = r_i r_(i-1) ... r_0: all prefix products in log2(N) rounds, each doubling how many factors are in
    step = 1
    while step < len(t):
        turns[step:] = _product(turns[step:], turns[:-step])
        step *= 2
    return turns / np.linalg.norm(turns, axis=1, keepdims=True)


def _smallest_rotations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions of the rotations by the smallest angle that turn the unit vectors a (N, 3) into b
    (N, 3)."""
    w = 1.0 + np.sum(a * b, axis=1)
    axis = np.cross(a, b)
    opposite = w < 1e-12    # half a turn about any axis across will do
    axis[opposite] = np.cross(a[opposite], np.eye(3)[np.abs(a[opposite]).argmin(axis=1)])
    q = np.c_[axis, np.where(opposite, 0.0, w)]
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def _product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(N, 4) Hamilton products p q of quaternions x, y, z, w; scipy's Rotation, written for more than this, takes six
    times as long."""
    (px, py, pz, pw), (qx, qy, qz, qw) = p.T, q.T
    return np.stack([pw * qx + px * qw + py * qz - pz * qy, pw * qy - px * qz + py * qw + pz * qx,
                     pw * qz + px * qy - py * qx + pz * qw, pw * qw - px * qx - py * qy - pz * qz], axis=1)


def tip_covariance(shape: Shape) -> np.ndarray:
    """(6, 6) covariance of the tip's position (m) and rotation about the fixed axes x, y, z (rad).

    The direction's comes from the chord over the last TIP_CHORD: only the points' own covariances are known, and
    cov(a - b) <= 2 cov(a) + 2 cov(b) whatever their correlation. Nothing is known of the roll about a centreline.
    """
    out = np.zeros((6, 6))
    tip, base = shape.covariance[-1], np.searchsorted(shape.s, shape.s[-1] - TIP_CHORD)
    chord = shape.s[-1] - shape.s[base]
    known = np.isfinite(tip).all()
    out[:3, :3] = tip if known else UNKNOWN_VARIANCE * np.eye(3)
    if not known or not np.isfinite(shape.covariance[base]).all() or chord == 0:
        out[3:, 3:] = ANY_ANGLE_VARIANCE * np.eye(3)
        return out
    t = tangents(shape)[-1]
    across = np.cross(np.eye(3), t)     # a change d of the direction is a rotation by t x d = across @ d
    out[3:, 3:] = (across @ (2 * (tip + shape.covariance[base]) / chord**2) @ across.T
                   + ANY_ANGLE_VARIANCE * np.outer(t, t))
    return out


def _worst_sigma(covariance: np.ndarray) -> np.ndarray:
    """(N,) standard deviation in the worst direction of (N, 3, 3) covariances; NaN where they are."""
    known = np.isfinite(covariance).all(axis=(1, 2))
    largest = np.linalg.eigvalsh(np.where(known[:, None, None], covariance, 0.0))[:, -1]
    return np.where(known, np.sqrt(np.maximum(largest, 0.0)), np.nan)


def _point(p: list[float], new: New) -> Any:
    return new('geometry_msgs/msg/Point', x=p[0], y=p[1], z=p[2])


def _pose(p: list[float], q: list[float], new: New) -> Any:
    return new('geometry_msgs/msg/Pose', position=_point(p, new),
               orientation=new('geometry_msgs/msg/Quaternion', x=q[0], y=q[1], z=q[2], w=q[3]))
