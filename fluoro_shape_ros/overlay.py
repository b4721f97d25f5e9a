"""What was seen, drawn on the image it was seen in; pure, and fast enough to go along with a stream.

Everything is drawn in pixels of the image as received: what the geometry says of undistorted pixels is distorted first.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import chdtri

from .data import Outcome, Reconstruction, Shape, View
from .geometry.cameras import depth, distort, epipolar_lines, fundamental, project, projection_jacobian, undistort
from .geometry.curve import arc_length, at_arc_length

SEEN, FOUND, TIP, EPIPOLAR = '#ffb347', '#2ad4ff', '#ff5a5f', '#c58bff'
GOOD, REJECTED, WORDS = '#5ee07a', '#ff7ac6', '#ffffff'
CONFIDENCE = 0.95       # of the tip's ellipse
END_PX = 15.0           # an end of a centreline this near to the reprojected tip is where its plane sees the tip
INSET = 0.25            # side of the magnified surroundings of the tip, share of the image's shorter side
INSET_HALF = 8          # line widths from the tip to the inset's border
NOISE_SPAN = 8          # from black to white, in median differences of neighbours: noise must not fill the range
RING = 7                # line widths, the radius of the ring that shows where the tip is
DASH = 6                # line widths, and as much to the next
SHIFT = 4               # fractional bits of OpenCV's coordinates
_TURN = np.linspace(0, 2 * np.pi, 65)
_CIRCLE = np.c_[np.cos(_TURN), np.sin(_TURN)]


@dataclass(frozen=True)
class Stroke:
    """A curve to be drawn."""

    name: str               # for the legend
    points_px: np.ndarray   # (N, 2) u, v in the image as received
    colour: str             # #rrggbb
    dashed: bool = False    # so that what lies under it shows


def overlay(image: np.ndarray, plane: int, result: Reconstruction,
            views: tuple[View, View] | None = None) -> np.ndarray:
    """(H, W, 3) uint8 BGR: the (H, W) image of plane 0 (A) or 1 (B) with what was seen in it and what became of the
    pair, in words.

    Without `views`, of a pair that has none, only image and words.
    """
    canvas = cv2.cvtColor(stretched(image), cv2.COLOR_GRAY2BGR)
    unit = max(1, round(min(image.shape) / 512))
    strokes = [] if views is None else evidence(plane, result, views)
    inset = None
    if result.shape is not None and strokes:
        tip = distort(views[plane], project(views[plane].P, result.shape.points[-1:]))[0]
        if (np.abs(tip / (image.shape[1], image.shape[0]) - 0.5) < 0.5).all():      # in the image; NaN is not
            inset = magnified(canvas, strokes, tip, unit)
            strokes.insert(0, Stroke('tip ring', tip + RING * unit * _CIRCLE, TIP))      # under the others
    draw(canvas, strokes, unit)
    title, *rest = words(result)
    colour = GOOD if result.outcome is Outcome.OK else REJECTED
    top = write(canvas, [(f'plane {"AB"[plane]}: {title}', colour), *((line, WORDS) for line in rest)])
    bottom = caption(canvas, {s.name: s.colour for s in strokes if s.name != 'tip ring'})
    if inset is not None:
        _place(canvas[top:bottom], inset,
               np.vstack([s.points_px for s in strokes if s.name in ('seen', 'backbone')]) - (0, top))
    return canvas


def words(result: Reconstruction) -> list[str]:
    """Outcome and reason for people, a line each, the most important first; ASCII."""
    name = result.outcome.value.replace('_', ' ')
    shape = result.shape
    sure = '' if np.isnan(result.confidence) else f'confidence {result.confidence:.3f}'
    if shape is None:
        reason = ': '.join(dict.fromkeys((name, result.detail or name))).encode('ascii', 'replace').decode()
        return ['no result', reason, *([f'the best curve has {sure}'] if sure else [])]
    sigma = tip_sigma(shape)
    size = f'{shape.length * 1e3:.1f} mm long' + ('' if np.isnan(sigma) else f', tip +-{sigma * 1e3:.2f} mm')
    return [', '.join(filter(None, (name, sure, size))), *(warning.replace('_', ' ') for warning in result.warnings)]


def tip_sigma(shape: Shape) -> float:
    """Standard deviation of the tip in its worst direction, m; NaN where the method does not know it."""
    covariance = shape.covariance[-1]
    return (float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
            if np.isfinite(covariance).all() else float('nan'))


# ---- what there is to see


def evidence(plane: int, result: Reconstruction, views: tuple[View, View]) -> list[Stroke]:
    """What the pair shows of plane 0 (A) or 1 (B), in the order of drawing."""
    view, other, shape = views[plane], views[1 - plane], result.shape
    strokes = [Stroke('epipolar line of the tip' if shape else 'epipolar lines of the ends', line, EPIPOLAR)
               for line in tip_lines(view, other, result.centerlines[1 - plane], shape)]
    if shape is not None:
        strokes.append(Stroke('backbone', distort(view, project(view.P, shape.points)), FOUND))
    if result.centerlines[plane] is not None:
        strokes.append(Stroke('seen', result.centerlines[plane].points_px, SEEN, dashed=True))
    if shape is not None:
        tip = distort(view, project(view.P, shape.points[-1:]))
        ellipse = tip_ellipse(view, shape)
        strokes.append(Stroke('tip' if ellipse is None else f'tip, {CONFIDENCE:.0%}',
                              tip if ellipse is None else ellipse, TIP))
    return strokes


def tip_ellipse(view: View, shape: Shape) -> np.ndarray | None:
    """(65, 2) px, the closed contour within which the tip lies with CONFIDENCE; None where the method does not know
    it."""
    if not np.isfinite(shape.covariance[-1]).all() or depth(view.P, shape.tip) <= 0:
        return None
    J = projection_jacobian(view.P, shape.tip[None])[0]
    variance, axes = np.linalg.eigh(J @ shape.covariance[-1] @ J.T)
    radii = np.sqrt(np.maximum(variance, 0.0) * chdtri(2, 1 - CONFIDENCE))
    return distort(view, project(view.P, shape.tip) + (_CIRCLE * radii) @ axes.T)


def tip_lines(view: View, other: View, seen, shape: Shape | None) -> list[np.ndarray]:
    """The curves (N, 2) in `view` on which the tip must lie by what `other` saw of it: where they miss it, the
    calibration is off.

    `seen` is the Centerline of the other plane or None. Without a shape nobody knows which end is the tip: a curve for
    each.
    """
    ends = np.empty((0, 2)) if seen is None else seen.points_px[[0, -1]]
    if shape is not None:
        tip = distort(other, project(other.P, shape.points[-1:]))
        distance = np.linalg.norm(ends - tip, axis=1)
        ends = ends[[distance.argmin()]] if distance.min(initial=np.inf) < END_PX else tip
    if not len(ends):
        return []
    lines = epipolar_lines(fundamental(other.P, view.P), undistort(other, ends))
    return [distort(view, across(line, view.width, view.height)) for line in lines]


def across(line: np.ndarray, width: int, height: int) -> np.ndarray:
    """(N, 2) px, points of the (3,) normalised line in and around an image; none where it misses that."""
    center = np.array([width - 1, height - 1]) / 2
    foot = center - (line[:2] @ center + line[2]) * line[:2]
    points = foot + np.linspace(-1, 1, 65)[:, None] * np.hypot(width, height) * np.array([-line[1], line[0]])
    # farther out a distortion model says nothing
    return points[(np.abs(points - center) < 0.55 * np.array([width, height])).all(axis=1)]


# ---- how it is drawn


def grey_levels(image: np.ndarray) -> tuple[float, float]:
    """The levels of an (H, W) image of any range that are to be black and white: neither noise nor the unexposed border
    sets them."""
    h, w = image.shape
    small = cv2.resize(image, (-(-w // 4), -(-h // 4)), interpolation=cv2.INTER_AREA)
    exposed = small > 0.12 * np.percentile(small[::4, ::4], 95)
    exposed = small[cv2.erode(exposed.astype(np.uint8), np.ones((5, 5))) > 0][::2]  # without the field's blurred rim
    low, high = np.percentile(exposed if exposed.size else small, (0.1, 99.9))
    noise = np.median(np.abs(np.diff(image[::32].astype(np.float32)))) if w > 1 else 0.0
    middle, half = (low + high) / 2, max(high - low, NOISE_SPAN * noise, 0.01 * abs(high), 1e-6) / 2
    return float(middle - half), float(middle + half)


def stretched(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8, the image between its `grey_levels`."""
    low, high = grey_levels(image)
    scale = 255 / (high - low)
    if image.dtype == np.uint8:
        return cv2.LUT(image, np.clip((np.arange(256) - low) * scale, 0, 255).astype(np.uint8))
    black = image.dtype.type(low if image.dtype.kind == 'f' else max(np.ceil(low), 0))
    return cv2.convertScaleAbs(np.maximum(image, black), alpha=scale, beta=-scale * low)


def draw(canvas: np.ndarray, strokes: list[Stroke], unit: int) -> None:
    """Draw strokes on a BGR image, with lines `unit` px wide."""
    for stroke in strokes:
        points = stroke.points_px[np.isfinite(stroke.points_px).all(axis=1)].clip(-1e5, 1e5)
        pieces = dashes(points, DASH * unit) if stroke.dashed else points[None]
        cv2.polylines(canvas, list(np.round(pieces * 2**SHIFT).astype(np.int32)), False, bgr(stroke.colour), unit,
                      cv2.LINE_AA, SHIFT)


def dashes(points: np.ndarray, length_px: int) -> np.ndarray:
    """(M, length_px + 1, 2) pieces of an (N, 2) curve, `length_px` long and as far from each other, the first at its
    begin."""
    if len(points) < 2:
        return np.empty((0, length_px + 1, 2))
    s = np.arange(0.0, arc_length(points)[-1], 2.0 * length_px)[:, None] + np.arange(length_px + 1)
    return at_arc_length(points, s.ravel()).reshape(*s.shape, 2)


def magnified(image: np.ndarray, strokes: list[Stroke], center: np.ndarray, unit: int) -> np.ndarray:
    """The surroundings of `center` (2,) px of a BGR image, with the strokes drawn at the larger scale."""
    side = round(INSET * min(image.shape[:2]))
    half = INSET_HALF * unit
    zoom = side / (2 * half)
    patch = cv2.getRectSubPix(image, (2 * half, 2 * half), tuple(map(float, center)))
    out = cv2.resize(patch, (side, side), interpolation=cv2.INTER_CUBIC)
    draw(out, [replace(s, points_px=zoom * (s.points_px - center) + (side - 1) / 2) for s in strokes], unit)
    cv2.rectangle(out, (0, 0), (side - 1, side - 1), bgr(TIP), unit)
    return out


def _place(canvas: np.ndarray, inset: np.ndarray, avoid: np.ndarray) -> None:
    """Put an inset into the corner of the canvas that holds fewest of the (N, 2) points."""
    (h, w), side = canvas.shape[:2], len(inset)
    if h < side:
        return
    right, below = free_corner(avoid / (w, h), side / min(w, h))
    u, v = right * (w - side), below * (h - side)
    canvas[v:v + side, u:u + side] = inset


def free_corner(points: np.ndarray, side: float, corners=((0, 1), (1, 1), (0, 0), (1, 0))) -> tuple[int, int]:
    """The one of `corners` (right, below: 0 or 1) whose square of `side` holds fewest of (N, 2) points in the unit
    square, v down."""
    return min(corners, key=lambda c: np.count_nonzero((np.abs(points - np.array(c)) < side + 0.03).all(axis=1)))


def write(canvas: np.ndarray, lines: list[tuple[str, str]]) -> int:
    """Write (text, colour) lines on a darkened strip at the top, broken where they are too long;
    the strip's height in px."""
    font = _font(canvas)
    room = canvas.shape[1] - 3 * font['height']
    broken = [(part, colour) for text, colour in lines
              for part in textwrap.wrap(text, max(8, int(len(text) * room / max(_length(text, font), 1))))]
    step = round(1.5 * font['height'])
    strip = step * len(broken) + font['height'] // 2
    _darken(canvas[:strip])
    for k, (text, colour) in enumerate(broken):
        _put(canvas, text, (font['height'], step * (k + 1) - font['height'] // 4), colour, font)
    return strip


def caption(canvas: np.ndarray, names: dict[str, str]) -> int:
    """Write names in their colours on a darkened strip at the bottom; the row at which it begins."""
    if not names:
        return len(canvas)
    font, u = _font(canvas), 0
    strip = max(len(canvas) - 2 * font['height'], 0)
    _darken(canvas[strip:])
    for name, colour in names.items():
        u += font['height']
        _put(canvas, name, (u, len(canvas) - round(0.6 * font['height'])), colour, font)
        u += _length(name, font)
    return strip


def _font(canvas: np.ndarray) -> dict:
    """Letters that can be read where the image is shown 512 px wide."""
    height = max(9, round(min(canvas.shape[:2]) / 46))
    thickness = max(1, height // 12)
    return dict(height=height, scale=cv2.getFontScaleFromHeight(cv2.FONT_HERSHEY_SIMPLEX, height, thickness),
                thickness=thickness)


def _length(text: str, font: dict) -> int:
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, font['scale'], font['thickness'])[0][0]


def _put(canvas: np.ndarray, text: str, at: tuple[int, int], colour: str, font: dict) -> None:
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, font['scale'], bgr(colour), font['thickness'], cv2.LINE_AA)


def _darken(region: np.ndarray) -> None:
    region[:] = cv2.convertScaleAbs(region, alpha=0.3)


def bgr(colour: str) -> tuple[int, int, int]:
    """OpenCV's colour for #rrggbb."""
    red, green, blue = bytes.fromhex(colour[1:])
    return blue, green, red
