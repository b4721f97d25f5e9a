"""Where a robot stands in the C-arm's reference frame, from points that its tip was led to: their places by the joints,
and as `tip` showed them."""

from __future__ import annotations

import numpy as np

from .beads import FOLDS, CalibrationError, read_points

MIN_POINTS = 4          # three tell a pose, one more whether it is right
MIN_SPREAD = 0.05       # of the second extent of the points against the first: on a line they leave a turn about it
                        # open
MAX_SCALE = 1.1         # of one frame's distances against the other's: more is another unit, or another robot
MAX_RMS = 0.01          # m; no registration that is worse is of use


def read_touched(path: str) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) m in the robot's frame and in the reference frame: columns robot_x_mm, ... and x_mm, ... (or _m). Raises
    CalibrationError and OSError."""
    points, _ = read_points(path, ['robot_', ''], [])
    return tuple(points)


def fit_pose(robot: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3), t (3,) with seen = R robot + t, the least squares of (N, 3) points (Kabsch 1976). Raises
    CalibrationError where they do not tell."""
    if len(robot) < MIN_POINTS:
        raise CalibrationError(f'{len(robot)} points: at least {MIN_POINTS} are needed')
    if not (np.isfinite(robot).all() and np.isfinite(seen).all()):
        raise CalibrationError('not all points are finite')
    A, B = robot - robot.mean(axis=0), seen - seen.mean(axis=0)
    extents = np.linalg.svd(A, compute_uv=False)
    if extents[1] < MIN_SPREAD * extents[0]:
        raise CalibrationError('the points lie (nearly) on a line, which leaves a turn about it open')
    scale = np.sqrt(np.sum(B**2) / np.sum(A**2))
    if not 1 / MAX_SCALE < scale < MAX_SCALE:
        raise CalibrationError(f'distances in the reference frame are {scale:.3g} times those in the robot\'s: '
                               'another unit, or points that do not belong together')
    U, _, V = np.linalg.svd(A.T @ B)
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V).T
    t = seen.mean(axis=0) - R @ robot.mean(axis=0)
    mirrored = (U @ np.diag([1.0, 1.0, -np.linalg.det(U @ V)]) @ V).T
    rms = [np.sqrt(np.mean(np.sum((A @ M.T - B)**2, axis=1))) for M in (R, mirrored)]
    if rms[0] > MAX_RMS:
        better = (': mirrored they would fit, so that one of the frames is left-handed'
                  if rms[1] < rms[0] / 3 else ': they do not belong together, in this order')
        raise CalibrationError(f'the best pose misses the points by {1e3 * rms[0]:.1f} mm rms{better}')
    return R, t


def errors(robot: np.ndarray, seen: np.ndarray, pose: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    """(N,) m by which a pose misses the points; without one, that of the other FOLDS - 1 parts, NaN where these do not
    tell one."""
    if pose is not None:
        return np.linalg.norm(robot @ pose[0].T + pose[1] - seen, axis=1)
    found, fold = np.full(len(robot), np.nan), np.arange(len(robot)) % FOLDS
    for part in range(min(FOLDS, len(robot))):
        out = fold == part
        try:
            found[out] = errors(robot[out], seen[out], fit_pose(robot[~out], seen[~out]))
        except CalibrationError:
            pass
    return found


def report(robot: np.ndarray, seen: np.ndarray, pose: tuple[np.ndarray, np.ndarray]) -> str:
    """How well the pose fits, for people."""
    missed, left_out = errors(robot, seen, pose), errors(robot, seen)
    rms = 1e3 * np.sqrt(np.sum(missed**2) / (3 * len(missed) - 6) * 3)
    more = (f'; {1e3 * np.sqrt(np.mean(left_out**2)):.3f} mm rms where they are left out of the fit in turn'
            if not np.isnan(left_out).any() else '')
    return (f'{len(missed)} points, missed by {rms:.3f} mm rms (6 unknowns counted), '
            f'{1e3 * missed.max():.3f} mm at worst (point {missed.argmax() + 1}){more}')
