"""A pair of images walks straight through: segment both, correspond, triangulate, decide the tip, doubt, answer."""

from __future__ import annotations

import time

import cv2
import numpy as np
from scipy.spatial import cKDTree

from . import paper
from .config import Config
from .curve import arc_length, resample
from .data import Centerline, Frame, Outcome, Prior, Reconstruction, Shape
from .ends import tip_is_last
from .field import border_distance, field_of_view
from .geometry import GeometryError, check_pair, distort, pixels_per_metre, project, undistort
from .plausibility import check_curvature, check_length, check_reprojection, curvature_limit

BORDER_PX = 12.0        # an end this near to the field's border runs out of it


def reconstruct(frame: Frame, config: Config, prior: Prior = Prior()) -> Reconstruction:
    """The backbone seen in a pair of images, or the reason why there is none. Pure: the same pair gives the same answer."""
    clock = _Stopwatch()
    try:
        check_pair(frame.views)
    except GeometryError as error:
        return Reconstruction(Outcome.BAD_GEOMETRY, str(error))

    images = [dark_device(image, config.detection.polarity) for image in frame.images]
    fields = [field_of_view(image) for image in frame.images]
    clock.lap('prepare')

    widths = paper.half_width_px(frame.views, config)
    seen = tuple(_centerline(paper.segment(image, width, config.detection.min_length_px), field, width)
                 for image, field, width in zip(images, fields, widths))
    clock.lap('segment')
    for line, outcome in zip(seen, (Outcome.NO_DEVICE_A, Outcome.NO_DEVICE_B)):
        if line is None:
            return Reconstruction(outcome, f'no curve of at least {config.detection.min_length_px:g} px', centerlines=seen, stage_seconds=clock.laps)

    curves = paper.reconstruct_curves(frame.views, tuple(line.points_px for line in seen), config.detection.spacing_px)
    clock.lap('triangulate')
    if min(map(len, curves)) < 3:
        return Reconstruction(Outcome.NO_CORRESPONDENCE, f'{len(curves[0])} and {len(curves[1])} corresponding points', centerlines=seen, stage_seconds=clock.laps)

    best = max(curves, key=lambda c: arc_length(c)[-1])
    metres_per_px = 1 / np.mean([pixels_per_metre(v.P, best) for v in frame.views])
    forward, guessed = _tip_is_last(best, frame, fields, seen, config, prior)
    points, s = resample(best if forward else best[::-1], config.curve.backbone_spacing)
    residuals = residuals_px(points, frame.views, seen)
    clock.lap('curve')

    doubt = (check_curvature(curves, curvature_limit(config, metres_per_px)) or check_length(s[-1], config)
             or check_reprojection(residuals, config))
    clock.lap('plausibility')
    if doubt:
        return Reconstruction(*doubt, centerlines=seen, stage_seconds=clock.laps)
    shape = Shape(points, s, np.full((len(points), 3, 3), np.nan), residuals)   # the published method knows no covariance
    return Reconstruction(Outcome.OK, 'ok', shape, ('tip_ambiguous',) if guessed else (), seen, clock.laps)


def dark_device(image: np.ndarray, polarity: str) -> np.ndarray:
    """The (H, W) image as float32 with a device that is darker than its surroundings; polarity is settled here and nowhere else."""
    image = image.astype(np.float32)
    if polarity == 'auto':
        # a thin device is a rare deviation from the local level: the longer tail tells its sign
        detail = image - cv2.blur(image, (31, 31))
        polarity = 'bright' if np.mean(detail**3) > 0 else 'dark'
    return float(image.max()) - image if polarity == 'bright' else image


def residuals_px(points: np.ndarray, views, centerlines) -> np.ndarray:
    """(N, 2) distance in px of the reprojected (N, 3) points to the centreline seen in each plane."""
    return np.stack([_distance_to_polyline(project(v.P, points), undistort(v, line.points_px)) for v, line in zip(views, centerlines)], axis=1)


def _distance_to_polyline(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """(N,) distance of (N, 2) points to the nearest segment of the (M, 2) polyline."""
    a, d = line[:-1], np.diff(line, axis=0)
    near = np.clip(cKDTree(line).query(points)[1][:, None] + [-1, 0], 0, len(a) - 1)     # the two segments at the nearest vertex
    rel = points[:, None] - a[near]
    t = np.clip((rel * d[near]).sum(-1) / np.maximum((d[near] ** 2).sum(-1), 1e-30), 0, 1)
    return np.linalg.norm(rel - t[..., None] * d[near], axis=-1).min(axis=1)


def _centerline(points_px: np.ndarray, field: np.ndarray, half_width_px: float) -> Centerline | None:
    if len(points_px) < 2:
        return None
    first, last = border_distance(field, points_px[[0, -1]]) < BORDER_PX
    return Centerline(points_px, 2 * half_width_px, (bool(first), bool(last)))


def _tip_is_last(points: np.ndarray, frame: Frame, fields, seen, config: Config, prior: Prior) -> tuple[bool, bool]:
    """The tip rule on a backbone candidate (N, 3): its ends as each plane sees them."""
    ends_px = [distort(v, project(v.P, points[[0, -1]])) for v in frame.views]
    border_px = np.stack([border_distance(f, e) for f, e in zip(fields, ends_px)], axis=1)
    at_border = np.zeros(2, bool)
    for line, ends in zip(seen, ends_px):       # an end of the backbone belongs to the nearer end of each centreline
        for k, end in enumerate(ends):
            nearest = np.linalg.norm(line.points_px[[0, -1]] - end, axis=1).argmin()
            at_border[k] |= line.at_border[nearest]
    previous = prior.previous.points if prior.previous is not None else None
    return tip_is_last(points[[0, -1]], tuple(at_border), border_px, config.curve.base_position, previous)


class _Stopwatch:
    """Wall time of each stage, s."""

    def __init__(self):
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
