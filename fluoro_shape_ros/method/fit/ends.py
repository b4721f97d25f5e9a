"""Where along the curve the device is, and exactly where it ends: an edge along the axis, solved in both planes at
once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import ndtr

OUTWARD = np.array([-1, 1])     # from the first end, from the last
PRESENT = 0.5           # of the darkness near an end: there it ends
BRIDGED_PX = 70         # a stretch that not both planes show does not end the device
SMOOTH_PX = 9           # along which darkness is averaged, where a device is clearly seen ...
CLEARLY, LONGEST_PX = 5.0, 63   # ... by so many standard deviations; else, up to so many px, along what makes it so
LOCAL_PX = 27           # at an end, that tell how dark the device is there
PALEST = 0.03           # of the usual darkness: a paler device is not told from a background that is no parabola
EDGE_PX, SHORTEST_PX = 1.5, 4.0     # from an end on that its edge is over, and the least there that may be a part of
                                    # its own
VARIES = 0.1            # share that a device's darkness varies by along it
ALIKE = 0.75            # of a band's darkness: what lies behind it is paler, or it is none
BAND, SOFT_TIP = 2e-3, 2e-3     # m: longest marker band (electrodes are longer), and farthest that a device goes on
                                # past one at its end
SURE, ABSENT = 10.0, 1.5        # nats: what SMOOTH_PX px can say at most for the device, and against it where nothing
                                # is seen, since it may be pale
ANOTHER = 5.0           # nats against another line that goes on just where the device ends
GOES_ON = 3.0           # nats past an end that make one look farther, and by which a part at an end is one of its own
REACH_PX = 20.0         # the edge is looked for this far around the first guess
COARSE_PX, FINE_PX = 0.8, 0.2  # steps of the search
BLURS_PX = (0.8, 1.2, 1.9)     # of an edge; the middle one is enough for a first guess
RAMP = 0.3              # of the length over which an end fades in a plane, that its model is worth there: tips are flat
                        # or round
DISAGREE = 3.0          # standard deviations by which the planes' ends may differ
FLOOR_PX = 0.18         # what the model of the edge itself is worth in a plane
ALONG_PX, NOISELESS = np.full(2, SMOOTH_PX), np.zeros(2)


def windows(clear: np.ndarray) -> np.ndarray:
    """(2,) px along which darkness is averaged, where a device stands out by (2,) `clear` standard deviations over
    SMOOTH_PX in the planes."""
    longer = (CLEARLY / np.maximum(np.nan_to_num(clear), 1e-3))**2
    return SMOOTH_PX * np.rint(np.clip(longer, 1, LONGEST_PX / SMOOTH_PX)).astype(int)


def evidence(presence: np.ndarray, clutter: np.ndarray, step_px: int = 1,
             along_px: np.ndarray = ALONG_PX) -> np.ndarray:
    """(N,) nats by which each strip of (2, N) presence (NaN: outside the field) speaks for a device that both planes
    show, about `step_px` apart.

    clutter: (2, N) or (2, 1) how dark places beside the device happen to look over (2,) `along_px`. What a single plane
    shows may be another line: the other counts.
    """
    return nats(_both_show(presence / np.maximum(clutter, PALEST), along_px // step_px), step_px, int(max(along_px)))


def nats(z: np.ndarray, step_px: int, along_px: int = SMOOTH_PX) -> np.ndarray:
    """What strips say for a device that stands out by `z` standard deviations over `along_px`."""
    return (np.minimum(0.5 * np.maximum(z, 0.0)**2, SURE) - ABSENT) * (step_px / along_px)


def goes_on(z: np.ndarray, clear: np.ndarray, px: np.ndarray, tried: float) -> np.ndarray:
    """(..., N) nats by which both planes show a device as far as each of N places on a line.

    z: (2, ..., N) standard deviations over SMOOTH_PX by which each place is dark, clear: (2, ..., 1) those by which a
    device is, px: (2, ..., N) from place to place. tried: the best of so many lines (in space) may show noise. In each
    plane the likelihood ratio of a device to nothing, as dark as is usual or of any darkness; of both together, but of
    one alone no more than what it takes to be another line's.
    """
    usual = np.minimum(z * clear - 0.5 * clear**2, SURE) / SMOOTH_PX
    each = np.cumsum(np.maximum(usual, nats(z, 1)) * px, axis=-1)
    return np.minimum(each.sum(axis=0) - np.log(tried), each.min(axis=0) + ANOTHER - 0.5 * np.log(tried))


def supported(presence: np.ndarray, clutter: np.ndarray, step_px: int = 1, gap_px: float = BRIDGED_PX,
              along_px: np.ndarray = ALONG_PX) -> tuple[int, int] | None:
    """First and last index of the device's stretch of (N, 2) presence, the one that most `evidence` speaks for, to
    where it is PRESENT of as dark as near that end; None where there is none. Bands beyond a pale stretch no longer
    than `gap_px` belong to it, if they are clear enough."""
    nats = evidence(presence.T, clutter, step_px, along_px)
    seen = np.nonzero(nats > 0)[0]
    for k in np.nonzero(np.diff(seen) * step_px > gap_px)[0]:
        nats[seen[k] + 1:seen[k + 1]] = -np.inf
    total = np.concatenate([[0.0], np.cumsum(np.maximum(nats.astype(float), -1e6))])
    gain = total - np.minimum.accumulate(total)        # of the best stretch that stops there (Kadane 1977)
    stop = int(gain.argmax())
    if gain[stop] <= SURE / 2:
        return None
    start = int(total[:stop].argmin())
    if (stop - start) * step_px < 5:
        return None
    dark = _both_show(presence.T, along_px // step_px)[start:stop]
    near = max(LOCAL_PX, *along_px) // step_px
    first, last = (int((d > PRESENT * max(d[:near].max(), 1e-9)).argmax()) for d in (dark, dark[::-1]))
    return (start + first, stop - 1 - last) if (stop - 1 - last - start - first) * step_px >= 5 else None


def level(presence: np.ndarray, inward: np.ndarray, px: float, sigma: np.ndarray = NOISELESS,
          fade: np.ndarray = NOISELESS) -> tuple[np.ndarray, float]:
    """(2,) darkness of the device at an end in each plane, and how far inside that it surely stays so, in the units of
    `inward`: a band, a pale tip, or what lies in a disk's shadow, may be short.

    presence: (2, N), sigma: (2,) its noise over a px; inward: (N,) how far inside the end each strip lies; px: a pixel
    in these units; fade: (2,) over which the end itself fades in each plane.
    The end's part is that up to the change of darkness that explains most in both planes, if that is by GOES_ON nats.
    """
    longer = windows(np.sqrt(SMOOTH_PX) / np.maximum(sigma, 1e-9)) / SMOOTH_PX
    order = np.nonzero((inward > -0.5 * px) & (inward < max(longer) * LOCAL_PX * px))[0]
    order = order[np.argsort(inward[order])]
    if len(order) < 3:
        return np.ones(2), np.inf
    x, y = inward[order], _known(presence[:, order])
    step = max((x[-1] - x[0]) / (len(x) - 1) / px, 1e-3)
    full = x > (EDGE_PX * px + fade)[:, None]
    count, total = np.cumsum(full, axis=1), np.cumsum(y * full, axis=1)
    rest: np.ndarray = count[:, -1:] - count
    apart = total / np.maximum(count, 1) - (total[:, -1:] - total) / np.maximum(rest, 1)
    enough = np.minimum(count, rest) * step >= SHORTEST_PX * longer[:, None]
    variance = (1 / np.maximum(count, 1) + 1 / np.maximum(rest, 1)) * np.maximum(sigma, VARIES)[:, None]**2 / step
    tried = max(np.count_nonzero(enough.any(axis=0)), 1)
    nats = np.where(enough, 0.5 * apart**2 / variance, 0.0).sum(axis=0) - np.log(tried)
    changes = int(nats.argmax())
    until = changes + 1 if nats[changes] > GOES_ON else len(x)
    height = [np.mean(v[:until][f[:until]] if f[:until].any() else v[:until]) for v, f in zip(y, full)]
    return np.maximum(height, PALEST), float(x[until]) if until < len(x) else np.inf


def past_band(presence: np.ndarray, inward: np.ndarray, inner: float, clutter: np.ndarray, rim: np.ndarray,
              px: float) -> tuple[float, float]:
    """m by which the device goes on past a dark band that seems to be its end, and the standard deviation of that: a
    pale tip is often hardly seen.

    presence: (2, N) at (N,) m inside the band's outer edge; inner: m, the band's length; clutter: (2,) see `evidence`;
    rim: (2,) m from that edge on that the band's own end, seen at an angle, may darken in each plane.
    Posterior mean over lengths up to SOFT_TIP, half of the prior on none, of a tip as dark as the device is behind the
    band. (0, 0) where there is no band.
    """
    inside, past = (inward > 0) & (inward < inner), inward < -px
    behind = [(inward > inner + 2 * px) & (inward < inner + n * px) for n in (SMOOTH_PX + 2, LOCAL_PX)]
    if inner > BAND + 2 * EDGE_PX * px or not inside.any() or behind[0].sum() < 6 or past.sum() < 6:
        return 0.0, 0.0
    y = np.nan_to_num(presence)
    band, *pale = (np.median(y[:, m], axis=1) for m in (inside, *behind))
    pale = np.minimum(*pale)        # a braid or coil may begin not far behind the band
    if (pale > ALIKE * band).any():
        return 0.0, 0.0
    pale, out = np.maximum(pale, PALEST), -inward[past]
    step = np.ptp(out) / (len(out) - 1)
    lengths = np.linspace(0, SOFT_TIP, 21)
    rest = (y[:, past] - pale[:, None] * (out < lengths[:, None, None])) * (out > rim[:, None] + px)
    misfit = (rest * rest).sum(axis=2) @ (step / (SMOOTH_PX * px) / np.maximum(clutter, PALEST)**2)
    p = np.exp(-0.5 * (misfit - misfit.min())) * np.where(lengths > 0, 1 / (len(lengths) - 1), 1.0)
    p /= p.sum()
    mean = float(p @ lengths)
    return mean, float(np.sqrt(p @ (lengths - mean)**2))


def _both_show(presence: np.ndarray, strips: int | np.ndarray) -> np.ndarray:
    """(N,) darkness that both planes show at least, of (2, N) presence averaged over so many strips: what only one
    shows is another line."""
    return _averaged(presence, strips).min(axis=0)


def _averaged(presence: np.ndarray, strips: int | np.ndarray) -> np.ndarray:
    """(2, N) presence averaged over so many strips."""
    return np.stack([cv2.blur(row[None], (max(int(n), 1), 1), borderType=cv2.BORDER_REPLICATE)[0]
                     for row, n in zip(_known(presence), np.broadcast_to(strips, 2))])


def _known(presence: np.ndarray) -> np.ndarray:
    """(2, N) float32, nothing where it is not known."""
    return np.where(np.isfinite(presence), np.clip(presence, -99, 99), 0).astype(np.float32)


@dataclass(frozen=True)
class End:
    """Where a device ends along a curve."""

    at: float               # m, by both planes
    sigma: float            # m, if the planes agree
    seen_at: np.ndarray     # (2,) m, by each plane alone; NaN where it does not show the end
    seen_sigma: np.ndarray  # (2,) m

    @property
    def apart(self) -> float:
        """m by which the planes differ; 0 where only one shows the end."""
        return float(np.fmax(abs(self.seen_at[0] - self.seen_at[1]), 0.0))

    @property
    def disagreed(self) -> bool:
        """Whether the planes differ by more than they may."""
        return self.apart > DISAGREE * float(np.hypot(*self.seen_sigma))

    @property
    def honest_sigma(self) -> float:
        """sigma in m; where the planes disagree, the truth lies somewhere between."""
        return float(np.hypot(self.sigma, self.apart / 2)) if self.disagreed else self.sigma


def locate(s: np.ndarray, presence: np.ndarray, sigma: np.ndarray, speed: np.ndarray, guess: np.ndarray,
           outward: np.ndarray, beyond: np.ndarray, ramp: np.ndarray, density: float = 1.0, reach_px: float = REACH_PX,
           blurs_px: Sequence[float] = BLURS_PX, inner: np.ndarray | None = None) -> list[End]:
    """Where the device ends, for E ends at once.

    s: (E, N) m. presence: (E, 2, N), sigma: (E, 2) its noise, speed: (E, 2, N) px per m. guess: (E,) m. outward: (E,)
    +1 for an end at large s, -1 at small. beyond: (E, 2) m, see `bulge`. ramp: (E, 2) m over which the end fades in
    each plane; its model is worth RAMP of that.
    density: strips a px, so many of which are one observation. reach_px: how far from the guess it is looked for.
    inner: (E,) m, how far inside the guess the device is as dark as at its end (`level`); as far as is looked by
    default.
    Model: the blurred step a Phi((end + beyond - s) speed / blur), a and blur free in each plane; least squares over
    both planes, residuals clipped at 3.5 sigma. Each plane counts by what its edge is worth, noise and model together.
    """
    e = np.arange(len(s))
    px_per_m = speed[e, :, np.abs(s - guess[:, None]).argmin(axis=1)].mean(axis=1)
    near = np.abs(s - guess[:, None]) * px_per_m[:, None] < reach_px + 12
    if inner is not None:
        near &= (guess[:, None] - s) * outward[:, None] < inner[:, None]
    at = np.minimum(near.argmax(axis=1)[:, None] + np.arange(near.sum(axis=1).max()), s.shape[1] - 1)
    y, speed, s, near = (presence[e[:, None], :, at].transpose(0, 2, 1), speed[e[:, None], :, at].transpose(0, 2, 1),
                         s[e[:, None], at], near[e[:, None], at])
    counted = near[:, None] & np.isfinite(y) & np.isfinite(sigma)[..., None]
    counted &= counted.sum(axis=2, keepdims=True) >= 12
    y = np.where(counted, y, 0.0)
    weight = np.where(counted.any(axis=2),
                      1 / (density * np.maximum(np.where(np.isfinite(sigma), sigma, 0.0), 0.02) ** 2), 0.0)     # (E, 2)

    def edges(ends: np.ndarray, blur: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of edges at (E, C) `ends` with blurs (..., E, 2): (..., E, 2, C) cost and height, and (E, 2, C, n) px that
        each strip lies inside the device."""
        z = (((outward[:, None, None] * (ends[:, :, None] - s[:, None]))[:, None] + beyond[..., None, None])
             * speed[:, :, None])
        m = ndtr(z / blur[..., None, None]) * counted[:, :, None]
        a = np.clip((m @ y[..., None])[..., 0] / np.maximum(np.einsum('...n,...n->...', m, m), 1e-9), 0.5, 1.8)
        rest = y[:, :, None] - a[..., None] * m
        return np.einsum('...n->...', np.minimum(rest * rest * (weight * density)[..., None, None], 12)) / density, a, z

    def information(z: np.ndarray, a: np.ndarray, blur: np.ndarray) -> np.ndarray:
        """(E, 2) 1/m^2 that an edge tells: z (E, 2, n) px inside the device, its height and blur (E, 2)."""
        slope = ((a / (blur * np.sqrt(2 * np.pi)))[..., None] * np.exp(-0.5 * (z / blur[..., None]) ** 2)
                 * speed * counted)
        return (slope * slope).sum(axis=2) * weight

    both = e[:, None], np.arange(2)
    model = (FLOOR_PX / px_per_m[:, None]) ** 2 + (0.2 * beyond) ** 2 + (RAMP * ramp) ** 2
    wide = guess[:, None] + np.arange(-reach_px, reach_px + 0.01, COARSE_PX) / px_per_m[:, None]
    cost, a, z = edges(wide, np.broadcast_to(np.reshape(blurs_px, (-1, 1, 1)), (len(blurs_px), len(s), 2)))
    best = cost.min(axis=3).argmin(axis=0)
    cost, a, blur = cost[best, *both], a[best, *both], np.array(blurs_px)[best]
    lowest = cost.argmin(axis=2)
    noise = 1 / (information(z[*both, lowest], a[*both, lowest], blur) + 1e-12)
    # in noise the edge may be one of several
    alone = _spread(wide[:, None], cost)
    seen_sigma = np.sqrt(np.maximum(noise, np.where(alone * px_per_m[:, None] > COARSE_PX, alone, 0.0)**2) + model)
    counts = (noise / (noise + model))[:, :, None]      # the more foreshortened a plane sees the end, the less
    fine = (wide[e, (cost * counts).sum(axis=1).argmin(axis=1)][:, None]
            + np.arange(-1.0, 1.01, FINE_PX) / px_per_m[:, None])
    fine_cost, a, z = edges(fine, blur)
    fine_cost = (fine_cost * counts).sum(axis=1)
    k = fine_cost.argmin(axis=1)
    sigma = (1 / (1 / (information(z[e, :, k], a[e, :, k], blur) + 1e-12) + model)).sum(axis=1) ** -0.5
    at = np.array([_lowest(f, c) for f, c in zip(fine, fine_cost)])
    spread = _spread(wide, cost.sum(axis=1))
    sigma = np.where(spread * px_per_m > COARSE_PX, np.maximum(sigma, spread), sigma)
    ends = []
    for i in e:
        seen = weight[i] > 0
        if seen.any():
            seen_at = np.array([_lowest(wide[i], c) for c in cost[i]])
            end = End(float(at[i]), float(sigma[i]), np.where(seen, seen_at, np.nan),
                      np.where(seen, seen_sigma[i], np.nan))
            if end.apart > np.hypot(*seen_sigma[i]) and not end.disagreed:
                # of two edges the joint one is the sharper, not the better known
                end = replace(end, at=float(seen_sigma[i]**-2 @ seen_at / (seen_sigma[i]**-2).sum()))
            ends.append(end)
        else:
            ends.append(End(float(guess[i]), float('inf'), np.full(2, np.nan), np.full(2, np.nan)))
    return ends


def _spread(x: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """(...) m that (..., C) places x with such costs lie from the best one, root mean square."""
    posterior = np.exp(-0.5 * (cost - cost.min(axis=-1, keepdims=True)))
    best = np.take_along_axis(np.broadcast_to(x, cost.shape), cost.argmin(axis=-1)[..., None], axis=-1)
    return np.sqrt((posterior * (x - best)**2).sum(axis=-1) / posterior.sum(axis=-1))


def _lowest(x: np.ndarray, y: np.ndarray) -> float:
    """Where the parabola through the lowest of (N,) values at even x and its neighbours is lowest."""
    k = min(max(int(np.argmin(y)), 1), len(y) - 2)
    left, middle, right = y[k - 1:k + 2]
    bow = left - 2 * middle + right
    return float(x[k] + (min(max(0.5 * (left - right) / bow, -1.0), 1.0) * (x[1] - x[0]) if bow > 0 else 0.0))
