"""From a predicted curve to the device near it: in strips across its projections, the darkest smooth path, and from both paths a curve in space.

The path in each plane is the most probable one (Viterbi 1967) where the response of each strip speaks for a shift and the prediction's standard
deviation against it. Shifts in the two planes are the two directions across the curve, so each plane can be asked alone.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from .config import Config
from .curve import resample
from .detect import Detection, track
from .fit import Fit
from .geometry import distort, fundamental, pixels_per_metre, project, undistort
from .matching import align
from .plausibility import check_fit
from .prior import Guess, borne_out, whole
from .start import first_curve
from .strips import shadow

STEP_PX, SHIFT_PX = 3.0, 1.5    # between strips, and along them: a path may turn by 27 degrees from the prediction
WITHIN = 2.0            # standard deviations to either side that a strip reaches
BEYOND_PX = 30.0        # the path goes on straight past both ends: the device may be longer
STRONGEST = 6.0         # noise deviations: a darker strip speaks no louder, it may be something else
BEND_COST = 1.0         # of a shift that changes by a pixel from a strip to the next ...
TRUST = 0.15            # ... and what the prediction counts in each strip: its error is the same in many
CLEAR = 2.0             # noise deviations: darker strips speak for the device, others against it
SHORTEST = 0.6          # share of the strips ...
SEEN = 0.93             # ... and how many of these must be clear, for a path that is worth a try
SHARP = 0.35e-3         # m: an end less certain than this may be another one


def found_near(images, fields, views, config: Config, guess: Guess) -> Detection | None:
    """The device near a guess; None where the images show none there that leaves no doubt, so that all of them must be searched.

    images, fields: (H, W) float32 (dark device, even noise; needed only within reach_px) and uint8, a pair each.
    """
    start = follow(images, fields, views, guess, config.detection.robot_radius)
    if start is None or not borne_out(start, guess):
        return None
    found = track(images, fields, views, config.detection.robot_radius, start)
    if found is None:
        return None
    f = found.fit
    points = curve(f)
    sharp = (f.open_end | (f.end_sigma < SHARP)).all()
    believed = sharp and whole(f.stop - f.start, guess, views) and borne_out(points, guess) and not check_fit(f, config)
    return found if believed else None


def curve(f: Fit) -> np.ndarray:
    """(100, 3) m along the fitted device."""
    return f.spline(np.linspace(f.start, f.stop, 100))


def reach_px(guess: Guess, view) -> float:
    """How far from the projected guess the image is looked at."""
    return WITHIN * float(guess.sigma.max()) * pixels_per_metre(view.P, guess.points) + BEYOND_PX + 50


def follow(images, fields, views, guess: Guess, radius: float) -> np.ndarray | None:
    """(M, 3) points in m along what looks most like the device of `radius` m near `guess`, base to tip; None where nothing does.

    images, fields: (H, W) float32 (dark device, even noise) and uint8, a pair each.
    """
    paths = [_path(*plane, guess, radius) for plane in zip(images, fields, views)]
    if any(path is None for path in paths):
        return None
    found = align([paths[0]], [paths[1]], [np.ones(1), np.ones(1)], fundamental(views[0].P, views[1].P), best=1)
    return first_curve(views, *paths, found[0]) if found and not found[0].flipped else None


def _path(image: np.ndarray, field: np.ndarray, view, guess: Guess, radius: float) -> np.ndarray | None:
    """(N, 2) undistorted pixels along the device in one plane."""
    scale = pixels_per_metre(view.P, guess.points)
    centers, normals, sigma_px = _strips(view, guess, scale)
    reach = int(np.ceil(WITHIN * sigma_px.max() / SHIFT_PX))
    shifts = SHIFT_PX * np.arange(-reach, reach + 1)
    at = (centers[:, None] + shifts[None, :, None] * normals[:, None]).astype(np.float32)
    strength = _response(image, field, at, radius * scale)
    score = strength - TRUST * (shifts / sigma_px[:, None]) ** 2 / 2
    score[np.abs(shifts) > WITHIN * sigma_px[:, None]] = -np.inf
    best = _most_probable(score)
    gain = strength[np.arange(len(best)), best] - CLEAR
    start, stop = _darkest_stretch(gain)
    if stop - start < SHORTEST * len(best) or (gain[start:stop] > 0).mean() < SEEN:
        return None
    shift = gaussian_filter1d(shifts[best[start:stop]], 3.0, mode='nearest')
    return undistort(view, centers[start:stop] + shift[:, None] * normals[start:stop])


def _strips(view, guess: Guess, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 2) centres and (N, 2) unit normals in pixels of the image as received, (N,) standard deviation in px; those in or near the image."""
    step = STEP_PX / scale
    points, s = resample(guess.points, step)
    out = np.arange(1, BEYOND_PX / STEP_PX + 1)[:, None] * step
    first, last = (d / np.linalg.norm(d) for d in (points[0] - points[1], points[-2] - points[-3]))
    points = np.concatenate([points[0] + out[::-1] * first, points, points[-1] + out * last])
    sigma = np.interp(np.r_[np.zeros(len(out)), s, np.full(len(out), s[-1])], np.linspace(0, s[-1], len(guess.sigma)), guess.sigma) * scale
    uv = distort(view, project(view.P, points))
    tangent = np.gradient(uv, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-9
    near = ((uv > -WITHIN * sigma[:, None]) & (uv < [view.width, view.height] + WITHIN * sigma[:, None])).all(axis=1)
    return uv[near], np.c_[-tangent[:, 1], tangent[:, 0]][near], sigma[near]


def _response(image: np.ndarray, field: np.ndarray, at: np.ndarray, half_width_px: float) -> np.ndarray:
    """(N, W) how much darker than beside it each of (N, W, 2) pixels is, over the device's width, in noise deviations; 0 outside the field."""
    profiles = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    lit = cv2.remap(field, at[..., 0], at[..., 1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0
    half = int(np.ceil((1.6 * half_width_px + 3) / SHIFT_PX))
    template = shadow(half_width_px, SHIFT_PX * np.arange(-half, half + 1))
    response = -cv2.filter2D(profiles, cv2.CV_32F, (template - template.mean())[None].astype(np.float32), borderType=cv2.BORDER_REPLICATE)
    lit = cv2.erode(lit.astype(np.uint8), np.ones((1, 2 * half + 1), np.uint8), borderValue=1) > 0
    noise = 1.4826 * float(np.median(np.abs(response[lit]))) + 1e-6 if lit.any() else 1.0
    return np.where(lit, np.clip(response / noise, -1.0, STRONGEST), 0.0).astype(np.float32)


def _darkest_stretch(gain: np.ndarray) -> tuple[int, int]:
    """First and past-the-last index of the successive (N,) numbers with the largest sum (Kadane 1984)."""
    total = np.concatenate([[0.0], np.cumsum(gain)])
    lowest = np.minimum.accumulate(total)
    stop = int((total - lowest).argmax())
    return int(total[:stop + 1].argmin()), stop


def _most_probable(score: np.ndarray) -> np.ndarray:
    """(N,) column a row of the (N, W) scores: the path of the highest sum that moves by at most a column a row, each move at BEND_COST."""
    n, width = score.shape
    total, came = score[0], np.zeros((n, width), np.int8)
    options = np.empty((3, width), np.float32)
    for row in range(1, n):
        options[0] = total
        options[1, 1:], options[1, 0] = total[:-1] - BEND_COST, -np.inf
        options[2, :-1], options[2, -1] = total[1:] - BEND_COST, -np.inf
        choice = options.argmax(axis=0)
        total = options.max(axis=0) + score[row]
        came[row] = choice
    column = int(total.argmax())
    columns = [column]
    for row in range(n - 1, 0, -1):
        column += (0, -1, 1)[came[row, column]]
        columns.append(column)
    return np.array(columns[::-1])
