"""From one plane's line to the device in space: on the rays of its points, the smooth path that the other plane shows
as a device.

Where a chain of ridges in one plane is half device and half lead, that in the other plane mostly is whole. So it alone
says where the device is looked for in the first, not along ridges but as the most probable sequence of depths
(Viterbi 1967). The state is depth and slope: at a crossing the path goes on as it came, and its direction in space says
how dark a device is in either plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter, uniform_filter1d

from ...data import View
from ...geometry.cameras import depth, distort, isocenter, pixels_per_metre, plane_angle, source
from ...imaging.ridges import ridge_scale, shrinking

# of the image made smaller by `shrinking`: between points along the line, and between depths as the other plane shows
# them
STEP_PX, DEPTH_PX = 3, 1
SLOPES = 9              # depths by which the path may move from point to point: three times as far as along the line
BEND_COST = 0.3         # of a slope that changes by one depth a point; it never changes by more
FAINT, DARK = 0.5, 0.9  # logarithm of the ratio to the darkness expected by which a fainter and a darker point speaks
                        # neither for nor against the path ...
FAINTER, DARKER = -1.0, 0.5     # ... and what they count at least: where it is too dark, something lies in front
OVER = 9                # points over which a line's darkness is a median: what crosses it does not count
STEEPEST = 0.25         # sine of the angle between axis and ray
NEAREST = 0.1           # of the isocenter's depth
SHORTEST = 8            # points
BEGINS = 2              # instead of a bend: the path begins here


@dataclass(frozen=True)
class Path:
    """A line of one plane with depths, by what the other plane shows."""

    points: np.ndarray      # (M, 3) m
    score: float            # gain of its points, each at most 1 ...
    share: float            # ... and as a share of the line's


def darkness(image: np.ndarray, field: np.ndarray, half_width_px: float) -> np.ndarray:
    """(h, w) float32: how dark lines of this half width are in an (H, W) image, whatever its brightness; smaller by
    `shrinking`, 0 outside the field."""
    k = shrinking(half_width_px)
    size = image.shape[1] // k, image.shape[0] // k
    image, field = (cv2.resize(a[:size[1] * k, :size[0] * k], size, interpolation=i)
                    for a, i in ((image, cv2.INTER_AREA), (field, cv2.INTER_NEAREST)))
    sigma = ridge_scale(half_width_px) / k
    smooth = cv2.GaussianBlur(cv2.log(cv2.max(image, 1e-3 * float(image.max()) + 1e-9)), (0, 0), sigma)
    uu, vv, uv = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (0, 2), (1, 1)))
    out = cv2.add(cv2.add(uu, vv), cv2.magnitude(cv2.subtract(uu, vv), 2 * uv))
    margin = int(np.ceil(3 * sigma))
    inside = cv2.erode(field, np.ones((2 * margin + 1,) * 2, np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return cv2.dilate(np.where(inside > 0, np.maximum(out, 0), 0), np.ones((3, 3), np.uint8))


def _sample(dark: np.ndarray, view: View, points_px: np.ndarray) -> np.ndarray:
    """(...) `darkness` at (..., 2) undistorted pixels of a view; 0 outside the image."""
    k = view.width // dark.shape[1]
    at = ((distort(view, points_px.reshape(-1, 2)) - (k - 1) / 2) / k).reshape(points_px.shape).astype(np.float32)
    at = at.reshape(len(at), -1, 2)
    return cv2.remap(dark, at[..., 0], at[..., 1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT,
                     borderValue=0).reshape(points_px.shape[:-1])


def sweep(line_px: np.ndarray, views: tuple[View, View], dark: tuple[np.ndarray, np.ndarray]) -> Path | None:
    """The best path on the rays of an (N, 2) undistorted line of views[0], about a pixel apart, along what views[1]
    shows as dark.

    dark: `darkness` of both.
    """
    (view, other), k = views, views[0].width // dark[0].shape[1]
    u = uniform_filter1d(line_px, 9, axis=0, mode='nearest')[::STEP_PX * k]
    if len(u) < SHORTEST:
        return None
    own = _sample(dark[0], view, u[None])[0]
    own = np.maximum(median_filter(own, OVER, mode='nearest'), 0.3 * np.median(own) + 1e-6)
    rays = np.c_[u, np.ones(len(u))] @ np.linalg.inv(view.P[:, :3]).T           # X = source + depth ray
    sources, center = [source(v.P) for v in views], isocenter(views)[None]
    step = DEPTH_PX * k / (pixels_per_metre(other.P, center) * max(np.sin(plane_angle(views)), 0.2))
    reach = int(0.6 * max(other.width, other.height) / (DEPTH_PX * k))
    middle = depth(view.P, center)[0]
    depths = middle + step * np.arange(-reach, reach + 1)
    depths = depths[depths > NEAREST * middle]
    x = (sources[0] + depths[:, None] * rays[:, None]) @ other.P[:, :3].T + other.P[:, 3]       # (n, K, 3)
    behind = x[..., 2] <= 0
    seen = np.where(behind, 0, _sample(dark[1], other, x[..., :2] / np.where(behind, 1, x[..., 2])[..., None]))
    ratio = np.log(np.maximum(seen, 1e-6) / own[:, None]).astype(np.float32)
    expected = _expected(rays, middle + step * np.arange(-SLOPES, SLOPES + 1), *sources).astype(np.float32)
    gain = ratio[:, None] - expected[..., None]     # (n, V, K)
    np.clip(gain, -FAINT * np.sqrt(1 - FAINTER), DARK * np.sqrt(1 - DARKER), out=gain)
    gain /= np.where(gain < 0, np.float32(FAINT), np.float32(DARK))
    np.subtract(1, np.square(gain, out=gain), out=gain)
    columns, first, score = most_probable(gain)
    if len(columns) < SHORTEST:
        return None
    along = gaussian_filter1d(depths[columns], 1.5, mode='nearest')
    return Path(sources[0] + along[:, None] * rays[first:first + len(columns)], score, score / len(u))


def _expected(rays: np.ndarray, depths: np.ndarray, *sources: np.ndarray) -> np.ndarray:
    """(n, V) natural logarithm of how many times as dark the second plane shows a device as the first, by the slope it
    comes with: the more its axis points to a source, the more of it a ray there goes through.

    rays: (n, 3) of the first plane. depths: (V,) m of a point where that before it has the middle one. sources: (3,) m,
    of both.
    """
    before = sources[0] + depths[len(depths) // 2] * rays[:-1]
    along = sources[0] + depths[:, None] * rays[1:, None] - before[:, None]                     # (n - 1, V, 3)
    sine = []
    for s in sources:
        across = np.linalg.norm(np.cross(along, (before - s)[:, None]), axis=2)
        sine.append(np.maximum(across / (np.linalg.norm(along, axis=2) * np.linalg.norm(before - s, axis=1)[:, None]),
                               STEEPEST))
    ratio = np.log(sine[0] / sine[1])
    return np.concatenate([ratio[:1], ratio])


def most_probable(gain: np.ndarray) -> tuple[np.ndarray, int, float]:
    """The smooth path of the highest sum through (n, V, K) gains, which begins and ends at any row: (m,) columns, the
    first row, and the sum.

    A path that moves from row to row by v columns (-V // 2 ... V // 2) takes the gains of that v.
    """
    n, _, count = gain.shape
    slopes = np.arange(gain.shape[1])[:, None] - gain.shape[1] // 2
    came_from = np.arange(count) - slopes                                       # (V, K)
    outside = (came_from < 0) | (came_from >= count)
    came_from = came_from.clip(0, count - 1) + count * np.arange(len(slopes))[:, None]
    total = gain[0]
    came = np.full((n, *total.shape), BEGINS, np.int8)
    best, end = np.empty(n), np.empty(n, int)
    end[0], best[0] = total.argmax(), total.max()
    for row in range(1, n):
        before, bend = total.copy(), np.zeros(total.shape, np.int8)
        for step in (1, -1):
            to, by = (slice(None, -1), slice(1, None))[::step], total - BEND_COST
            better = by[to[1]] > before[to[0]]
            np.copyto(before[to[0]], by[to[1]], where=better)
            np.copyto(bend[to[0]], np.int8(step), where=better)
        before = before.ravel()[came_from]
        goes_on = (before > 0) & ~outside
        total = np.where(goes_on, before, 0) + gain[row]
        came[row] = np.where(goes_on, bend.ravel()[came_from], BEGINS)
        end[row] = total.argmax()
        best[row] = total.ravel()[end[row]]
    row, score = int(best.argmax()), float(best.max())
    v, k = np.unravel_index(end[row], total.shape)
    path = [k]
    while came[row, v, k] != BEGINS:
        v, k, row = v + came[row, v, k], k - slopes[v, 0], row - 1
        path.append(k)
    return np.array(path[::-1]), row, score
