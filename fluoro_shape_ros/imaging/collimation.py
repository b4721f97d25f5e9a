"""Where the exposed field ends: blades in straight edges, an intensifier in a circle.

An image's edges (Canny 1986) beyond which it stays darker are what blades and intensifiers make, and dense anatomy.
Lines (Hough) and a circle through them are the field's if they are seen along nearly all of their length, nothing goes
on beyond them, and hardly anything is to be seen there. All px here are those of an image of SMALLEST_PX to twice as
many.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..geometry.curve import middle as middle_of

STEEP = 3.0             # median gradients, that an edge has at least
SHORTEST = 0.25         # of an image's smaller side, that the edge of a blade is long;
                        # twice that where no other is parallel or at right angles
ALIGNED = 0.9           # cosine of the angle between an edge and where it should run
MAYBE, SEEN = 0.5, 0.7  # share of an outline that must be an edge, where one could be seen: at all, and where the
                        # others leave it exposed
BESIDE_PX = np.arange(2, 6)     # before an edge, where it is as bright as it gets there, and as far beyond it
WIDE_PX = 14            # what is dark for so far beyond an edge is no device
EVERY_PX = 5            # that is looked at farther on
SAME_PX = 4             # within which an edge may belong to another outline
ALIKE = 0.985           # cosine of the angle between two lines along one edge
CANDIDATES = 16         # straight edges that are looked at
SQUARE = 0.06           # rad: blades are parallel or at right angles within this angle
CENTRAL = 0.25          # of the way from an image's middle to its border, which each blade leaves open
BLOCK_PX = 8            # a side: what is not exposed has edges in at most ...
QUIET = 0.15            # ... this share of its blocks, or of twice as many as what is exposed
CANNY, FAINTEST = 100, 300      # OpenCV wants integers: the threshold, and at most how many times as steep an edge gets
ENOUGH = 500            # edges, to find a circle by
STEPS = 10              # of a circle's adjustment, half of them coarse: ...
POINTS = 0.9, 0.98      # ... cosines of the angle between a gradient and the middle
RIM = 0.06              # of its radius, within which a circle's edge lies


@dataclass(frozen=True, eq=False)
class Outline:
    """A blade's edge or an intensifier's rim."""

    points: np.ndarray      # (N, 2) in the image, a px apart
    seen: np.ndarray        # (N,) bool: it is an edge there
    hidden: np.ndarray      # (N,) bool: nobody could see one there, it is black or white on both sides
    line: np.ndarray        # (3,) a, b, c: exposed is where a u + b v > c; or u, v, r of a circle
    round: bool = False

    def draw(self, field: np.ndarray, scale: tuple[float, float]) -> None:
        """Make an (H, W) uint8 field 0 beyond the outline; scale: field px per px, along u and v."""
        far = 2.0 * sum(field.shape)
        at = lambda uv: np.round(((uv + 0.5) * scale - 0.5) * 16).astype(np.int32)      # noqa: E731
        if self.round:
            turn = np.linspace(0, 2 * np.pi, 360)
            inside = np.zeros_like(field)
            cv2.fillConvexPoly(inside, at(self.line[:2] + self.line[2] * np.stack([np.cos(turn), np.sin(turn)],
                                                                                  axis=1)), 255, cv2.LINE_8, 4)
            cv2.min(field, inside, field)
        else:
            n, foot = self.line[:2], self.line[2] * self.line[:2]
            along = far * np.array([-n[1], n[0]])
            cv2.fillConvexPoly(field, at(np.array([foot - along, foot + along, foot + along - far * n,
                                                   foot - along - far * n])), 0, cv2.LINE_8, 4)

    def inside_by(self, uv: np.ndarray) -> np.ndarray:
        """(...) px by which (..., 2) points lie on its exposed side."""
        if self.round:
            return self.line[2] - np.hypot(uv[..., 0] - self.line[0], uv[..., 1] - self.line[1])
        return uv @ self.line[:2] - self.line[2]


def outlines(image: np.ndarray) -> list[Outline]:
    """Of the exposed field in an (h, w) float32 image; none where it is exposed everywhere."""
    if min(image.shape) < 2 * WIDE_PX:
        return []       # too small to tell a blade from a device
    edges, shortest = Edges.of(image), SHORTEST * min(image.shape)
    found: list[Outline] = []
    candidates = [o for o in (*_straight(edges, shortest), *_round(edges, shortest))
                  if _share(o, (), shortest) >= MAYBE and edges.end_at(o)]
    for o in sorted(candidates, key=lambda o: -np.count_nonzero(o.seen)):
        its_own = np.all([o.seen, *(np.abs(f.inside_by(o.points)) > SAME_PX for f in found)], axis=0)
        if np.count_nonzero(its_own) >= shortest:
            found.append(o)
    while found:
        shares = [_share(o, [f for f in found if f is not o], shortest) for o in found]
        worst = int(np.argmin(shares))
        if shares[worst] >= SEEN:
            break
        del found[worst]
    sure = [o for o in found if o.round or np.count_nonzero(o.seen) >= 2 * shortest]
    return [edges.refined(o) for o in found if any(o is s or _square(o, s) for s in sure)]


def _share(outline: Outline, others: Sequence[Outline], shortest: float) -> float:
    """The share of an outline that is seen, of what the others leave exposed of it;
    0 where another one goes on beyond it."""
    if any(np.count_nonzero(o.seen & (outline.inside_by(o.points) < -SAME_PX)) > shortest / 2 for o in others):
        return 0.0
    exposed = np.all([~outline.hidden, *(o.inside_by(outline.points) > 0 for o in others)], axis=0)
    seen = np.count_nonzero(outline.seen & exposed)
    return seen / np.count_nonzero(exposed) if seen >= shortest else 0.0


def _square(a: Outline, b: Outline) -> bool:
    """Whether two straight edges are parallel, or at right angles."""
    cosine = float(a.line[:2] @ b.line[:2])
    return not (a.round or b.round) and abs(cosine) * np.sqrt(max(1 - cosine**2, 0.0)) < SQUARE


@dataclass(frozen=True, eq=False)
class Edges:
    """Those edges in an (h, w) image beyond which it stays darker."""

    image: np.ndarray       # (h, w) without what is finer than an edge
    places: np.ndarray      # (M, 2) u, v
    near: np.ndarray        # (h, w) bool: within a px of one
    thin: np.ndarray        # (h, w) uint8, 0 where there is none
    bright: np.ndarray      # (h, w, 2) unit vectors to the brighter side
    middles: np.ndarray     # (K, 2) of blocks ...
    busy: np.ndarray        # (K,) bool: ... in which there is an edge of any kind

    @classmethod
    def of(cls, image: np.ndarray) -> Edges:
        smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
        gradient = [cv2.Sobel(smooth, cv2.CV_32F, *d, ksize=3, borderType=cv2.BORDER_REPLICATE)
                    for d in ((1, 0), (0, 1))]
        steep = cv2.magnitude(*gradient)
        least = max(STEEP * float(middle_of(steep[::2, ::2].ravel())), float(steep.max()) / FAINTEST, 1e-12)
        thin = cv2.Canny(*((g * (CANNY / least)).astype(np.int16) for g in gradient), CANNY, 2 * CANNY, L2gradient=True)
        bright = cv2.merge(gradient) / (steep + 1e-12)[..., None]
        blocks = cv2.resize(thin, None, fx=1 / BLOCK_PX, fy=1 / BLOCK_PX, interpolation=cv2.INTER_AREA) > 0
        middles = BLOCK_PX * (np.stack(np.meshgrid(*map(np.arange, blocks.shape[::-1])), axis=-1).reshape(-1, 2) + 0.5)
        v, u = np.nonzero(thin)
        places = np.stack([u, v], axis=1)
        half = 0.5 * sum(_sampled(smooth, places, bright[v, u], side * BESIDE_PX).mean(axis=1) for side in (-1, 1))
        darker = (_sampled(smooth, places, bright[v, u], -np.arange(BESIDE_PX[-1] + 1, max(image.shape), EVERY_PX))
                  < half[:, None])
        stays = darker[:, :(WIDE_PX - BESIDE_PX[-1]) // EVERY_PX + 1].all(axis=1) & (darker.mean(axis=1) > 0.5)
        thin[v[~stays], u[~stays]] = 0
        return cls(smooth, places[stays], cv2.dilate(thin, np.ones((3, 3), np.uint8)) > 0, thin, bright, middles,
                   blocks.ravel())

    def outline(self, points: np.ndarray, inward: np.ndarray, line: np.ndarray, shortest: float,
                round: bool = False) -> Iterator[Outline]:
        """An outline through (N, 2) points, with its exposed side where `inward` (N, 2) points, if `shortest` px of it
        are seen."""
        u, v = np.round(points).astype(int).T
        seen = self.near[v, u]
        seen[seen] = np.einsum('nk,nk->n', self.bright[v[seen], u[seen]], inward[seen]) > ALIGNED
        if np.count_nonzero(seen) >= shortest:
            before, beyond = (_sampled(self.image, points, inward, side * BESIDE_PX).mean(axis=1) for side in (1, -1))
            black, white = np.sort(beyond[seen])[int(0.9 * np.count_nonzero(seen))], 0.99 * self.image.max()
            yield Outline(points, seen, ~seen & ((before <= black) | (beyond >= white)), line, round)

    def end_at(self, outline: Outline) -> bool:
        """Whether there is next to nothing to be seen beyond an outline."""
        at = outline.inside_by(self.middles)
        before, beyond = self.busy[at > BLOCK_PX], self.busy[at < -BLOCK_PX]
        return not len(before) or not len(beyond) or bool(beyond.mean() <= QUIET * max(1.0, 2 * before.mean()))

    def refined(self, outline: Outline) -> Outline:
        """The same outline, through the middle of its edge."""
        if outline.round:
            return outline
        du, dv, u, v = cv2.fitLine(self.places[np.abs(outline.inside_by(self.places)) <= 1.5].astype(np.float32),
                                   cv2.DIST_HUBER, 0, 0.01, 0.01).ravel()
        normal = np.array([-dv, du]) * np.sign(outline.line[:2] @ [-dv, du])
        return replace(outline, line=np.append(normal, normal @ [u, v]))


def _straight(edges: Edges, shortest: float) -> Iterator[Outline]:
    """What may be blades."""
    h, w = edges.thin.shape
    lines = cv2.HoughLines(edges.thin, 1, np.pi / 180, int(0.7 * shortest))
    if lines is None:
        return
    rho, theta = lines.reshape(-1, 2).T.astype(float)
    normals, middle = np.stack([np.cos(theta), np.sin(theta)], axis=1), np.array([w - 1, h - 1]) / 2
    feet = (rho - normals @ middle)[:, None] * normals
    along, left = np.arange(-np.hypot(h, w), np.hypot(h, w)), np.arange(len(rho))
    for _ in range(CANDIDATES):
        if not len(left):
            break
        k = left[0]
        left = left[(np.abs(normals[left] @ normals[k]) < ALIKE) | (np.hypot(*(feet[left] - feet[k]).T) > 2 * SAME_PX)]
        points = rho[k] * normals[k] + along[:, None] * np.array([-normals[k, 1], normals[k, 0]])
        points = points[_within(points, h, w)]
        u, v = np.round(points).astype(int).T
        side = 1 if (edges.bright[v, u] @ normals[k])[edges.near[v, u]].sum() > 0 else -1
        inward, c = side * normals[k], side * rho[k]
        if inward @ middle - c > CENTRAL * np.abs(inward) @ middle:
            yield from edges.outline(points, np.broadcast_to(inward, points.shape), np.append(inward, c), shortest)


def _round(edges: Edges, shortest: float) -> Iterator[Outline]:
    """What may be an intensifier's rim: its middle is where most gradients point to."""
    h, w = edges.thin.shape
    some = edges.places[::1 + len(edges.places) // ENOUGH]
    p, n = some.astype(float), edges.bright[some[:, 1], some[:, 0]]
    across = np.stack([-n[:, 1], n[:, 0]], axis=1)
    centre = np.array([w - 1, h - 1]) / 2
    middle = centre
    for k in range(STEPS):
        to = middle - p
        r = np.hypot(*to.T)
        coarse = k < STEPS // 2
        rim = ((to * n).sum(axis=1) > POINTS[not coarse] * r) & (r > shortest / 2)
        if not coarse and rim.any():
            usual = middle_of(r[rim])
            rim &= np.abs(r - usual) < RIM * usual
        if np.count_nonzero(rim) < 3:
            return
        # least squares: the lines through the edges along their gradients meet there
        a = across[rim]
        middle = np.linalg.solve(a.T @ a + 1e-9 * np.eye(2), a.T @ (a * p[rim]).sum(axis=1))
    # least squares: u^2 + v^2 = 2 u a + 2 v b + c
    a, b, c = np.linalg.lstsq(np.c_[2 * p[rim], np.ones(np.count_nonzero(rim))], (p[rim]**2).sum(axis=1), rcond=None)[0]
    middle, radius = np.array([a, b]), float(np.sqrt(max(c + a * a + b * b, 0.0)))
    if radius - np.hypot(*(middle - centre)) < CENTRAL * min(centre):
        return
    turn = np.arange(0, 2 * np.pi, 1 / max(radius, 1.0))
    out = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    within = _within(middle + radius * out, h, w)
    yield from edges.outline((middle + radius * out)[within], -out[within], np.append(middle, radius), shortest,
                             round=True)


def _within(points: np.ndarray, h: int, w: int) -> np.ndarray:
    """(N,) whether (N, 2) points lie in an (h, w) image."""
    return ((points >= 0) & (points <= [w - 1, h - 1])).all(axis=1)


def _sampled(image: np.ndarray, points: np.ndarray, direction: np.ndarray, px: np.ndarray) -> np.ndarray:
    """(N, M) of the image at (N, 2) points, and (M,) px from each along its (N, 2) direction."""
    if not len(points):
        return np.zeros((0, len(px)), np.float32)
    at = points[:, None] + px[:, None] * direction[:, None]
    return cv2.remap(image, at.astype(np.float32), None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
