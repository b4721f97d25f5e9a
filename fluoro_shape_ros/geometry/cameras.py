"""Two-view geometry: projection, epipolar lines, triangulation, distortion of points.

HZ is Hartley & Zisserman, Multiple View Geometry in Computer Vision, 2nd edition. Pixel centres lie at integer
coordinates, u to the right, v down. Nothing here looks at an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import rq

from ..data import Distortion, View

MIN_PLANE_ANGLE = np.deg2rad(5.0)   # below it depth is a guess: triangulation errors grow as 1 / sin(angle)
PARALLEL = np.deg2rad(1.0)          # central rays below it are meant not to meet
STEREO_SHIFT = 0.25                 # of their width: how far apart the images of a stereo pair show what it looks at
POINT = 0.02                        # share that counts of what the place of a single point in both planes tells


class GeometryError(ValueError):
    """Numbers that can't be a camera, or a pair of cameras that can't see depth; the message says which."""


def make_view(name: str, P: ArrayLike, width: int, height: int, distortion: Distortion | None = None) -> View:
    """A View of plane `name` from a (3, 4) projection in metres to pixels, scaled so that w is the depth in m.

    Raises GeometryError where P can't be a camera.
    """
    P = np.asarray(P, float)
    if P.shape != (3, 4) or not np.isfinite(P).all():
        raise GeometryError(f'plane {name}: the projection matrix is not 3x4 and finite')
    scale = np.linalg.norm(P[2, :3])
    if scale == 0 or abs(np.linalg.det(P[:, :3] / np.abs(P[:, :3]).max())) < 1e-12:
        raise GeometryError(f'plane {name}: the projection matrix is zero or singular')
    view = View(name, P / scale, int(width), int(height), distortion)
    K, _, _ = decompose(view.P)
    if min(abs(K[0, 0]), abs(K[1, 1])) < 1.0:
        raise GeometryError(f'plane {name}: a focal length of {min(abs(K[0, 0]), abs(K[1, 1])):.3g} px is no camera')
    return view


def crop(view: View, rows: slice, columns: slice) -> View:
    """The view of these rows and columns of the image alone."""
    shift = np.array([[1, 0, -columns.start], [0, 1, -rows.start], [0, 0, 1]], float)
    d = view.distortion
    return replace(view, P=shift @ view.P, width=columns.stop - columns.start, height=rows.stop - rows.start,
                   distortion=d and replace(d, K=shift @ d.K))


def decompose(P: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K (3, 3), R (3, 3) and t (3,) of P = K [R | t] (HZ 6.2.4); K[2, 2] = 1, det R = 1, K[1, 1] > 0; a mirrored image
    has K[0, 0] < 0."""
    K, R = rq(P[:, :3])
    signs = np.where(np.diag(K) < 0, -1.0, 1.0)
    K, R = K * signs, signs[:, None] * R
    if np.linalg.det(R) < 0:
        K[:, 0], R[0] = -K[:, 0], -R[0]
    return K / K[2, 2], R, np.linalg.solve(K, P[:, 3])


def source(P: np.ndarray) -> np.ndarray:
    """(3,) position of the X-ray source in the reference frame, m: the null vector of P (HZ 6.2.4)."""
    return -np.linalg.solve(P[:, :3], P[:, 3])


def plane_angle(views: tuple[View, View]) -> float:
    """Angle between the two viewing directions, rad, in [0, pi/2]: 0 where they are parallel or opposite."""
    a, b = (v.P[2, :3] for v in views)     # unit: see View.P
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


@lru_cache(16)
def check(views: tuple[View, View], radius: float) -> None:
    """Raises GeometryError where a device of `radius` (m) can't be reconstructed with these views. What has passed is
    known."""
    check_pair(views)
    check_scale(views, radius)


def check_pair(views: tuple[View, View]) -> None:
    """Raises GeometryError where two views can't see depth: sources that coincide, or planes that are (nearly) parallel
    without a baseline across."""
    sources = [source(v.P) for v in views]
    apart = sources[1] - sources[0]
    baseline, far = np.linalg.norm(apart), max(np.linalg.norm(s) for s in sources) + 1e-3
    if baseline < 1e-3:
        raise GeometryError(f'the sources of planes a and b coincide ({baseline * 1000:.2g} mm apart): '
                            'no depth can be seen')
    # A rectified stereo pair has parallel axes but sees depth through its baseline; biplane sees it through the angle.
    if plane_angle(views) < MIN_PLANE_ANGLE and np.linalg.norm(np.cross(apart, views[0].P[2, :3])) < 0.02 * far:
        raise GeometryError(f'planes a and b are parallel ({np.rad2deg(plane_angle(views)):.2g} degrees): '
                            'no depth can be seen')


def project(P: np.ndarray, X: np.ndarray) -> np.ndarray:
    """(..., 2) undistorted pixels of (..., 3) points in m; NaN or inf where a point lies in the source's plane."""
    x = X @ P[:, :3].T + P[:, 3]
    with np.errstate(divide='ignore', invalid='ignore'):
        return x[..., :2] / x[..., 2:]


def depth(P: np.ndarray, X: np.ndarray) -> np.ndarray:
    """(...) distance in m of (..., 3) points from the source along the viewing axis; negative behind it."""
    return X @ P[2, :3] + P[2, 3]


def projection_jacobian(P: np.ndarray, X: np.ndarray) -> np.ndarray:
    """(..., 2, 3) derivative of `project`, px per m."""
    x = X @ P[:, :3].T + P[:, 3]
    return (P[:2, :3] - (x[..., :2] / x[..., 2:])[..., None] * P[2, :3]) / x[..., 2, None, None]


def calibration_covariance(views: Sequence[View], X: np.ndarray, T: np.ndarray,
                           sigma_px: float | np.ndarray) -> np.ndarray:
    """(N, 3, 3) m^2 of (N, 3) points of a curve with (N, 3) tangents that planes displaced by `sigma_px`, one for all
    or (N,), along u and v cause.

    Each plane v shifts the curve by d_v = J_v dX across its projection, and both on average along it:
    n_v J_v dX = n_v d_v, sum_v t_v (J_v dX - d_v) / |J_v T| = 0, with n_v and t_v across and along the projection.
    Where the curve runs along epipolar lines that leaves its depth open; there what a point would tell counts a little
    (POINT).
    """
    J = np.stack([projection_jacobian(v.P, X) for v in views])                              # (2, N, 2, 3)
    step = (J @ T[:, :, None])[..., 0]
    speed = np.linalg.norm(step, axis=2, keepdims=True) + 1e-9
    along = step / speed
    across = np.stack([-along[..., 1], along[..., 0]], axis=2)
    normal = np.einsum('vnk,vnki->nvi', across, J)                                          # (N, 2, 3)
    tangential = np.einsum('vnk,vnki->ni', along / speed, J) / np.sqrt((1 / speed**2).sum(axis=0))
    A = np.concatenate([normal, tangential[:, None]], axis=1)
    information = A.transpose(0, 2, 1) @ A + POINT * (J.transpose(0, 1, 3, 2) @ J).sum(axis=0)
    # nothing is known less well than to sigma_px metres
    return np.linalg.inv(information + np.eye(3)) * np.square(sigma_px)[..., None, None]


def pixels_per_metre(P: np.ndarray, X: np.ndarray) -> float:
    """Magnification at the mean of (N, 3) points: image px per m across the viewing ray."""
    # det K R = f_u f_v, since |P[2, :3]| = 1
    return float(np.sqrt(abs(np.linalg.det(P[:, :3]))) / abs(np.mean(depth(P, X))))


def slant(P: np.ndarray, X: np.ndarray, T: np.ndarray) -> np.ndarray:
    """(N,) sine of the angle at which rays meet (N, 3) tangents T at (N, 3) points."""
    ray = X - source(P)
    return (np.linalg.norm(np.cross(ray, T), axis=1)
            / np.maximum(np.linalg.norm(ray, axis=1) * np.linalg.norm(T, axis=1), 1e-12))


def isocenter(views: Sequence[View]) -> np.ndarray:
    """(3,) m, where two planes look: for a biplane system the point nearest to both central rays (through the image
    centres).

    Those of a rectified stereo pair are parallel: it looks at the distance where its images are STEREO_SHIFT apart.
    """
    sources = np.stack([source(v.P) for v in views])
    rays = np.stack([np.linalg.solve(v.P[:, :3], [(v.width - 1) / 2, (v.height - 1) / 2, 1.0]) for v in views])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if np.linalg.norm(np.cross(*rays)) < np.sin(PARALLEL):
        baseline = np.linalg.norm(np.cross(sources[1] - sources[0], rays[0]))
        focal_px = np.sqrt(abs(np.linalg.det(views[0].P[:, :3])))
        return sources.mean(axis=0) + rays[0] * focal_px * baseline / (STEREO_SHIFT * views[0].width)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.solve(across.sum(axis=0), np.einsum('vij,vj->i', across, sources))


def check_scale(views: tuple[View, View], radius: float) -> None:
    """Raises GeometryError where a device of `radius` (m) would be a quarter as wide as an image, or wider, at the
    `isocenter`, or less than a tenth of a pixel: no C-arm is made so; P may not be in metres."""
    center = isocenter(views)[None]
    for v in views:
        with np.errstate(divide='ignore'):
            half_width_px = radius * pixels_per_metre(v.P, center)
        if not 0.05 <= half_width_px < min(v.width, v.height) / 8:
            raise GeometryError(f'plane {v.name}: a device of radius {radius * 1e3:g} mm would be '
                                f'{2 * half_width_px:.3g} px wide where the planes look: is P in metres?')


def fundamental(Pa: np.ndarray, Pb: np.ndarray) -> np.ndarray:
    """(3, 3) F with x_b^T F x_a = 0, unit norm: F = [e_b]x P_b P_a^+ (HZ eq. 9.1)."""
    e = Pb @ np.append(source(Pa), 1.0)
    F = np.cross(np.eye(3), e).T @ Pb @ np.linalg.pinv(Pa)
    return F / np.linalg.norm(F)


def epipolar_lines(F: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """(N, 3) lines l = F x, one a point of (N, 2); normalised, so that l . (u, v, 1) is the signed distance in px."""
    lines = points_px @ F[:, :2].T + F[:, 2]
    return lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)


def triangulate(Pa: np.ndarray, Pb: np.ndarray, a_px: np.ndarray, b_px: np.ndarray, iterations: int = 10) -> np.ndarray:
    """(N, 3) points in m that minimise the squared reprojection error of (N, 2) undistorted pixels.

    Starts at the linear solution (HZ 12.2) and takes Newton steps on the reprojection error (Gauss-Newton Hessian),
    all points at once. NaN where a point can't be triangulated.
    """
    # farther away nothing can be told, and squares overflow
    a_px, b_px = (np.where(np.abs(px) < 1e9, px, np.nan) for px in (a_px, b_px))
    A = np.stack([a_px[:, 0, None] * Pa[2] - Pa[0], a_px[:, 1, None] * Pa[2] - Pa[1],
                  b_px[:, 0, None] * Pb[2] - Pb[0], b_px[:, 1, None] * Pb[2] - Pb[1]], axis=1)
    bad = ~np.isfinite(A).all(axis=(1, 2))
    A[bad] = 0.0
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        H = np.einsum('nij,nik->njk', A[:, :, :3], A[:, :, :3])
        g = np.einsum('nij,ni->nj', A[:, :, :3], A[:, :, 3])
        bad |= _singular(H)
        H[bad] = np.eye(3)
        X = -np.linalg.solve(H, g[..., None])[..., 0]
        for _ in range(iterations):
            r = np.concatenate([project(Pa, X) - a_px, project(Pb, X) - b_px], axis=1)
            J = np.concatenate([projection_jacobian(Pa, X), projection_jacobian(Pb, X)], axis=1)
            H = np.einsum('nij,nik->njk', J, J)
            g = np.einsum('nij,ni->nj', J, r)
            bad |= _singular(H) | ~np.isfinite(g).all(axis=1)
            H[bad], g[bad] = np.eye(3), 0.0
            step = np.linalg.solve(H, g[..., None])[..., 0]
            X = X - step
            if np.abs(step).max(initial=0.0) < 1e-9:
                break
    return np.where(bad[:, None], np.nan, X)


def _singular(H: np.ndarray) -> np.ndarray:
    """(N,) whether (N, 3, 3) positive semidefinite matrices have no inverse worth the name, or are not finite."""
    return ~(np.linalg.det(H / (np.trace(H, axis1=1, axis2=2)[:, None, None] + 1e-300)) >= 1e-15)


def undistort(view: View, points_px: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of the ideal pinhole P for (N, 2) pixels of the image as received."""
    d = view.distortion
    if d is None or len(points_px) == 0:
        return np.asarray(points_px, float)
    K, _, _ = decompose(view.P)
    p = np.ascontiguousarray(points_px, float)[:, None]
    if d.model == 'equidistant':
        return cv2.fisheye.undistortPoints(p, d.K, d.D, R=d.R, P=K)[:, 0]
    ideal = cv2.undistortPoints(p, d.K, d.D, R=d.R, P=K)[:, 0]
    for _ in range(10):     # OpenCV stops after five fixed-point steps; go on in the same way to sub-pixel agreement
        ideal = ideal - (distort(view, ideal) - p[:, 0])
    return ideal


def distort(view: View, points_px: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of the image as received for (N, 2) pixels of the ideal pinhole P: the inverse of `undistort`."""
    d = view.distortion
    if d is None or len(points_px) == 0:
        return np.asarray(points_px, float)
    K, _, _ = decompose(view.P)
    rays = np.c_[points_px, np.ones(len(points_px))] @ (d.R.T @ np.linalg.inv(K)).T
    if d.model == 'equidistant':
        return cv2.fisheye.distortPoints(np.ascontiguousarray(rays[:, None, :2] / rays[:, None, 2:]), d.K, d.D)[:, 0]
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), d.K, d.D)[0][:, 0]
