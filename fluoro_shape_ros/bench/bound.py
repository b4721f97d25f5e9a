"""The Cramer-Rao bound: what no unbiased estimator of a smooth backbone can do better than, in the scene at hand.

The backbone is the true curve X(s), s in [0, L], moved by a small smooth displacement

    d(s) = sum_j B_j(s) (a_j n1(s) + b_j n2(s)),      T(s) the tangent, n1, n2 across it,

B_j cubic B-splines with knots KNOT_SPACING apart, while its two ends slide along the axis by c0 (base) and c1 (tip).
Displacement along the axis between the ends changes no image, so these 2 n + 2 parameters theta are all that there is
to know of a curve this smooth.

Moving the device by d moves its shadow in the noise-free image I by J d px, J the Jacobian of the projection at the
nearest axis point. Before blur that makes dI/dtheta = -grad I . J dd/dtheta, which is then blurred as the image is. The
gradient is measured: the scene's own renderer draws the shadow shifted by +-STEP_PX along u and v. What little more the
device's apparent width and darkness say of its depth and slant is left out.

Pixels carry independent noise of known variance v, so the Fisher information is F = sum_pixels
(dI/dtheta)(dI/dtheta)^T / v over both images, and no unbiased estimate has a covariance below C = F^-1 (Kay, Estimation
Theory, 1993, ch. 3). From C follow, to first order,

    E |d(s)| averaged over s: the mean closest-point distance. With l1 >= l2 the variances along the principal axes of
    the displacement across the curve, E |d| = sqrt(2 l1 / pi) E(1 - l2 / l1), E the complete elliptic integral of the
    second kind;
    the rms error of the tip, across and along the axis;
    the rms error of the length, dL = c1 - c0 - integral of kappa . d ds, kappa = dT/ds the curvature vector.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree
from scipy.special import ellipe

from ..geometry.cameras import project, projection_jacobian
from ..geometry.curve import arc_length, frames
from ..sim.scenes import Run

KNOT_SPACING = 0.010    # m
STEP_PX = 0.25          # of the shadow, to each side
END = 0.0025            # m: so far an end carries along what is next to it when it slides;
                        # over as much again it lets go
MARGIN_PX = 12          # around the axis, for shadow and blur


@dataclass(frozen=True)
class Bound:
    """All in metres."""

    mean: float     # expected mean closest-point distance
    tip: float      # rms
    length: float   # rms


def bound(run: Run, knot_spacing: float = KNOT_SPACING) -> Bound:
    """The bound of the pair at the start of a run. Raises ValueError where the device does not stand in both images
    with both ends."""
    curve = run.backbone()
    if min(f.room(curve).min() for f in run.fields) < 0:
        raise ValueError('the bound is that of a device with both ends in both images')
    s = arc_length(curve)
    tangent, first = frames(curve)
    normals = np.stack([first, np.cross(tangent, first)], axis=2)
    basis = spline_basis(s, knot_spacing)
    covariance = np.linalg.inv(sum(information(run, i, curve, tangent, normals, basis) for i in (0, 1)))
    n = basis.shape[1]
    # (N, 2, 2) m^2
    across = np.einsum('sj,jakb,sk->sab', basis, covariance[:-2, :-2].reshape(n, 2, n, 2), basis, optimize=True)
    step = np.gradient(s)
    of_length = length_change(s, tangent, normals, basis)
    return Bound(float(np.average(mean_norm(across), weights=step)),
                 float(np.sqrt(np.trace(across[-1]) + covariance[-1, -1])),
                 float(np.sqrt(of_length @ covariance @ of_length)))


def information(run: Run, i: int, curve: np.ndarray, tangent: np.ndarray, normals: np.ndarray,
                basis: np.ndarray) -> np.ndarray:
    """(2 n + 2, 2 n + 2) 1/m^2: what plane `i` tells of the parameters a_0, b_0, a_1, b_1 ..., c0, c1.

    `curve` and `tangent` are (N, 3), `normals` (N, 3, 2), `basis` (N, n): the axis, its frame and the splines at the
    same points.
    """
    view, s = run.fields[i].view, arc_length(curve)
    uv = project(view.P, curve)
    low = np.maximum(np.floor(uv.min(axis=0) - MARGIN_PX), 0).astype(int)
    box = tuple(slice(lo, int(hi)) for lo, hi in zip(low[::-1], np.ceil(uv.max(axis=0) + MARGIN_PX)[::-1]))
    slope = np.stack([_slope(run, curve, i, axis)[box] for axis in np.eye(2)], axis=-1)
    shadow = np.argwhere(np.any(slope != 0, axis=-1))
    at = cKDTree(uv - low).query(shadow[:, ::-1])[1]
    # (P, 3) the change of each pixel by a displacement of its axis point
    change = np.einsum('pi,pij->pj', slope[tuple(shadow.T)], projection_jacobian(view.P, curve)[at])
    ends = np.clip(2 - np.stack([s, s[-1] - s], axis=1) / END, 0, 1)
    sideways = np.einsum('pj,pa->pja', basis[at], np.einsum('pi,pia->pa', change, normals[at]))
    along = ends[at] * np.einsum('pi,pi->p', change, tangent[at])[:, None]
    noise = np.sqrt(run.noise_variance(run.blurred(run.sharp(curve, i), i), i)[box])
    rows = []
    for of_parameter in np.concatenate([sideways.reshape(len(at), -1), along], axis=1).T:
        image = np.zeros(noise.shape, np.float32)
        image[tuple(shadow.T)] = of_parameter
        rows.append((run.blurred(image, i) / noise).ravel())
    whole = np.array(rows, float)
    return whole @ whole.T


def length_change(s: np.ndarray, tangent: np.ndarray, normals: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """(2 n + 2,) derivative of the length by each of the parameters of `information`."""
    kappa = np.einsum('si,sia->sa', np.gradient(tangent, s, axis=0), normals)
    return np.append(-np.einsum('sj,sa,s->ja', basis, kappa, np.gradient(s)), [-1.0, 1.0])


def spline_basis(s: np.ndarray, spacing: float) -> np.ndarray:
    """(N, n) cubic B-splines at (N,) arc lengths, with knots about `spacing` m apart from the first to the last."""
    pieces = max(1, round(s[-1] / spacing))
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, s[-1], pieces + 1), np.full(3, s[-1])])
    return BSpline(knots, np.eye(pieces + 3), 3)(s)


def mean_norm(covariance: np.ndarray) -> np.ndarray:
    """(N,) E |x| of normal x in the plane with (N, 2, 2) covariances."""
    low, high = np.linalg.eigvalsh(covariance).T
    return np.sqrt(2 * high / np.pi) * ellipe(1 - np.clip(low / high, 0, 1))


def _slope(run: Run, curve: np.ndarray, i: int, axis: np.ndarray) -> np.ndarray:
    """(H, W) change of plane `i` before blur, a px of shift of the shadow along the (2,) unit vector."""
    ahead, behind = (run.sharp(curve, i, tuple(sign * STEP_PX * axis)) for sign in (1, -1))
    return (ahead - behind) / (2 * STEP_PX)
