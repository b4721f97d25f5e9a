"""A pair of images walks straight through: prepare, find and fit the device, decide the tip, doubt, answer."""

from __future__ import annotations

import time
from dataclasses import replace

import cv2
import numpy as np

from . import paper
from ..config import Config
from ..geometry.curve import arc_length, distance_to, even_steps, middle, resample
from ..data import Centerline, Frame, Outcome, Prior, Reconstruction, Shape
from .detect import Detection, detect, found_near, track
from .tip import tip_is_last
from ..imaging.field import border_distance, field_of_view
from .fit.fit import Fit
from .propose.follow import reach_px
from ..geometry.cameras import GeometryError, calibration_covariance, check, crop, distort, pixels_per_metre, project, undistort
from ..imaging.mask import subtract
from .propose.motion import going_on
from .plausibility import check_curvature, check_length, check_reprojection, check_tip, curvature_limit
from ..imaging.parallel import both
from .prediction import Guess, borne_out, informed, judged, look
from ..imaging.strips import Sheet

REGION_PX = 80          # a tracked device moves and grows less than this from one pair to the next ...
EDGE_PX = 30            # ... and where it ends this near to the region's edge, it may go on
BORDER_PX = 12.0        # an end this near to the field's border runs out of it
CALIBRATION_PX = 0.25   # what the best calibration of a plane is worth
SOME = 12               # points of a backbone at which that is worked out ...
AROUND = 12             # ... with so many strips around each, that tell whether the device lies beside the curve there
WHOLE = slice(None), slice(None)    # rows and columns of an image


def reconstruct(frame: Frame, config: Config, prior: Prior = Prior()) -> Reconstruction:
    """The backbone seen in a pair of images, or the reason why there is none. Pure: the same pair gives the same answer."""
    clock = _Stopwatch()
    try:
        check(frame.views, config.detection.robot_radius)
    except GeometryError as error:
        return Reconstruction(Outcome.BAD_GEOMETRY, str(error))
    images = frame.images if prior.masks is None else tuple(subtract(i, m) for i, m in zip(frame.images, prior.masks))
    fields = both(field_of_view, frame.images, pixels=sum(image.size for image in frame.images) // 4)     # it halves them first
    clock.lap('prepare')
    by = _by_paper if config.curve.method == 'paper' else _by_spline
    guess, why = look(prior, frame.views, config.curve.prior_sigma)
    return judged(by(frame, images, fields, config, prior, guess, clock), guess, why)


def _by_spline(frame: Frame, images, fields, config: Config, prior: Prior, guess: Guess | None, clock: _Stopwatch) -> Reconstruction:
    """method:=spline: both images are fitted at once, from where the device was or is predicted to be, or from a search of the whole images."""
    radius, polarity = config.detection.robot_radius, config.detection.polarity
    near = []       # what is found near where it was, or should be
    if config.curve.tracking and prior.previous is not None:
        expected = going_on(prior, frame.stamp_ns)
        for points, coarse in ((expected, None), (prior.previous.points, 1)):
            if points is not None and not near:
                around = [region_around(v, points) for v in frame.views]
                near += _near(around, track, images, fields, frame.views, polarity, radius, config.detection.min_length_px, points, coarse, guess)
        clock.lap('track')
    if guess is not None and not any(d.sure and borne_out(d.fit.curve(100), guess) for d in near):
        around = [region_around(v, guess.points, reach_px(guess, v)) for v in frame.views]
        near += _near(around, found_near, images, fields, frame.views, polarity, radius, config.detection.min_length_px, guess)
        clock.lap('follow')
    found = next((d for d in reversed(near) if d.sure), None)
    if found is None:
        found = detect(_sheet(images, fields, frame.views, polarity), radius, config.detection.min_length_px, guess, [d.fit for d in near])
        clock.lap('detect')
    seen = tuple(None if px is None else Centerline(px) for px in found.seen_px)
    if found.fit is None:
        return Reconstruction(found.outcome, found.detail, centerlines=seen, stage_seconds=clock.laps)

    f = found.fit
    if guess is not None and borne_out(f.curve(100), guess):
        f = informed(f, guess)
    ends = f.spline(np.array([f.start, f.stop]))
    known = _known_order(f.curve(100), prior, guess)
    forward, guessed = _tip_rule(ends, tuple(f.open_end), frame.views, fields, config, known)
    shape = backbone(f, frame.views, forward, config.curve.backbone_spacing)
    clock.lap('backbone')
    metres_per_px = 1 / np.mean([pixels_per_metre(v.P, shape.points) for v in frame.views])
    doubt = (found.doubt or check_curvature([shape.points[::4]], curvature_limit(config, metres_per_px)) or check_length(shape.length, config)
             or check_reprojection(shape.residuals_px, config) or check_tip(shape.covariance[-1], config))
    clock.lap('plausibility')
    if doubt:
        return Reconstruction(*doubt, centerlines=seen, stage_seconds=clock.laps)
    return Reconstruction(Outcome.OK, 'ok', shape, ('tip_ambiguous',) if guessed else (), seen, clock.laps)


def _by_paper(frame: Frame, images, fields, config: Config, prior: Prior, guess: Guess | None, clock: _Stopwatch) -> Reconstruction:
    """method:=paper: segment each image, correspond, triangulate, and believe eq. 3."""
    images = [dark_device(image, config.detection.polarity) for image in images]
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
    forward, guessed = _tip_rule(best[[0, -1]], _at_border(best[[0, -1]], frame.views, seen), frame.views, fields, config,
                                 _known_order(best, prior, guess))
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


def backbone(f: Fit, views, forward: bool, step: float) -> Shape:
    """The fitted spline at equal arc-length steps from base to tip, with the covariance of each point.

    Across the curve it comes from the normal equations. Along it only the ends mean anything, and there it is that of the end. What the calibration is
    worth adds to both: the images can't tell that they lie a little beside where it says. Where the strips around a point agree that the device lies beside
    the curve, as along the edge of a bone, that counts as much as if the calibration were off by it.
    """
    u = np.linspace(f.start, f.stop, max(int((f.stop - f.start) / 5e-4), 50))
    if not forward:
        u = u[::-1]
    along = arc_length(f.spline(u))
    s = even_steps(along[-1], step)
    at = np.interp(s, along, u)
    basis, slope = f.spline.bases(at, 0, 1)
    points, tangents = basis @ f.spline.control, slope @ f.spline.control
    n = len(f.spline.control)
    half = (basis @ f.covariance.reshape(n, -1)).reshape(len(at), 3, n, 3)
    near, weights = f.spline.weights(at, 0)
    covariance = np.einsum('mk,mkab->mab', weights, half[np.arange(len(at))[:, None], :, near]) + _displaced(f, views, points, tangents, at)
    tangent = tangents[[0, -1]] / np.linalg.norm(tangents[[0, -1]], axis=1, keepdims=True)
    sigma = f.end_sigma if forward else f.end_sigma[::-1]
    covariance[[0, -1]] += sigma[:, None, None] ** 2 * tangent[:, :, None] * tangent[:, None, :]
    known = [np.isfinite(o) for o in f.offset_px.T]
    residuals = np.stack([np.interp(at, f.s[k], np.abs(o[k]), left=np.nan, right=np.nan) if k.any() else np.full(len(at), np.nan)
                          for o, k in zip(f.offset_px.T, known)], axis=1)
    return Shape(points, s, covariance, residuals)


def _displaced(f: Fit, views, points: np.ndarray, tangents: np.ndarray, s: np.ndarray) -> np.ndarray:
    """(N, 3, 3) m^2 that planes displaced by the calibration's errors, or by what the fit leaves over, add to (N, 3) points at (N,) arc lengths.

    Between SOME of them it changes evenly.
    """
    k = np.linspace(0, len(points) - 1, SOME).round().astype(int)
    first = np.searchsorted(f.s, np.clip(s[k], f.start, f.stop)) - AROUND // 2
    lowest, highest = np.searchsorted(f.s, [f.start, f.stop]) + [0, -AROUND]
    first = np.clip(first, lowest, max(highest, lowest))
    around = f.offset_px[np.minimum(first[:, None] + np.arange(AROUND), len(f.s) - 1)]       # (SOME, AROUND, 2)
    left = np.abs(middle(np.where(np.isfinite(around), around, 0.0), axis=1)).max(axis=1)
    some = calibration_covariance(views, points[k], tangents[k], np.hypot(CALIBRATION_PX, left))
    at = np.interp(np.arange(len(points)), k, np.arange(SOME))
    return (np.maximum(1 - np.abs(at[:, None] - np.arange(SOME)), 0) @ some.reshape(SOME, 9)).reshape(-1, 3, 3)


def dark_device(image: np.ndarray, polarity: str) -> np.ndarray:
    """The (H, W) image as float32, not negative, with a device that is darker than its surroundings; polarity is settled here and nowhere else."""
    full = float(np.iinfo(image.dtype).max) if image.dtype.kind == 'u' else None
    image = image.astype(np.float32)
    if full is None:
        low, high = float(image.min()), float(image.max())
        image, full = image - min(low, 0.0), high - min(low, 0.0)
    if polarity == 'auto':
        # a thin device is a rare deviation from the local level: the longer tail tells its sign
        detail = image - cv2.blur(image, (31, 31))
        polarity = 'bright' if np.mean(detail**3) > 0 else 'dark'
    return full - image if polarity == 'bright' else image


def stable_noise(image: np.ndarray, polarity: str, region: tuple[slice, slice], out: np.ndarray) -> None:
    """Write the square root of the `region` of a dark device's (H, W) image to `out`, float32: quantum noise gets the same variance everywhere (Anscombe)."""
    if image.dtype.kind == 'u' and polarity == 'dark':
        np.sqrt(image[region], out=out, dtype=np.float32)
    elif image.dtype.kind == 'u' and polarity != 'auto':
        np.sqrt(dark_device(image[region], polarity), out=out)
    else:       # needs the whole image's statistics
        np.sqrt(dark_device(image, polarity)[region], out=out)


def _sheet(images, fields, views, polarity: str, regions=(WHOLE, WHOLE)) -> Sheet:
    """Both planes' images, or a region of each, as the method wants them."""
    parts = [crop(v, *r) for v, r in zip(views, regions)] if regions != (WHOLE, WHOLE) else views
    return Sheet.of(list(zip(images, regions)), [f[r] for f, r in zip(fields, regions)], parts, lambda i, out: stable_noise(i[0], polarity, i[1], out))


def _near(regions, look, images, fields, views, polarity: str, *known) -> list[Detection]:
    """What `look` finds in these regions of both planes; nothing where it may go on beyond them."""
    found = look(_sheet(images, fields, views, polarity, regions), *known)
    if found is None:
        return []
    seen = []
    for (rows, columns), view, line in zip(regions, views, found.seen_px):
        last = np.array([columns.stop - columns.start, rows.stop - rows.start])
        cut_off = np.array([columns.start, rows.start]) > 0, np.array([columns.stop, rows.stop]) < [view.width, view.height]
        ends = line[[0, -1]]
        if ((ends < EDGE_PX) & cut_off[0] | (ends > last - EDGE_PX) & cut_off[1]).any():
            return []
        seen.append(line + [columns.start, rows.start])
    return [replace(found, seen_px=tuple(seen))]


def region_around(view, points: np.ndarray, margin_px: float = REGION_PX) -> tuple[slice, slice]:
    """Rows and columns of the image within `margin_px` of the projections of (N, 3) points."""
    uv = distort(view, project(view.P, points))
    low = np.clip(np.floor(uv.min(axis=0)) - margin_px, 0, [view.width - 1, view.height - 1]).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + margin_px, 1, [view.width, view.height]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def residuals_px(points: np.ndarray, views, centerlines) -> np.ndarray:
    """(N, 2) distance in px of the reprojected (N, 3) points to the centreline seen in each plane."""
    return np.stack([distance_to(project(v.P, points), undistort(v, line.points_px)) for v, line in zip(views, centerlines)], axis=1)


def _centerline(points_px: np.ndarray, field: np.ndarray, half_width_px: float) -> Centerline | None:
    if len(points_px) < 2:
        return None
    first, last = border_distance(field, points_px[[0, -1]]) < BORDER_PX
    return Centerline(points_px, 2 * half_width_px, (bool(first), bool(last)))


def _at_border(ends: np.ndarray, views, seen) -> tuple[bool, bool]:
    """Whether each of a backbone's two ends belongs to a centreline's end at the field's border, in either plane."""
    at_border = np.zeros(2, bool)
    for line, view in zip(seen, views):
        for k, end in enumerate(distort(view, project(view.P, ends))):
            at_border[k] |= line.at_border[np.linalg.norm(line.points_px[[0, -1]] - end, axis=1).argmin()]
    return bool(at_border[0]), bool(at_border[1])


def _known_order(points: np.ndarray, prior: Prior, guess: Guess | None) -> np.ndarray | None:
    """(N, 3) a curve known to run from base to tip, m: the previous result, else the prediction if the (N, 3) points found bear it out."""
    if prior.previous is not None:
        return prior.previous.points
    return guess.points if guess is not None and borne_out(points, guess) else None


def _tip_rule(ends: np.ndarray, at_border: tuple[bool, bool], views, fields, config: Config, known: np.ndarray | None) -> tuple[bool, bool]:
    """The contract's rule on a backbone's two ends (2, 3): whether the last is the tip, and whether that is a guess."""
    def border_px() -> np.ndarray:
        return np.stack([border_distance(f, distort(v, project(v.P, ends))) for f, v in zip(fields, views)], axis=1)
    return tip_is_last(ends, at_border, border_px, config.curve.base_position, known)


class _Stopwatch:
    """Wall time of each stage, s."""

    def __init__(self):
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
