"""What a device's description says of how dark it is along it, compared with what both images show along a curve: which
end is the tip, and is it that device.

Darkness d is taken through the middle of the curve, less that of both its sides. From the description it is known but
for what differs in every plane, the energy of the X-rays, scatter and the display: a gain a, and k, by which what is
dark saturates,

    d = a (1 - exp(-k t / sin)) / k,

where t is the path length through the middle, straight on, times attenuation at REFERENCE_KEV, and sin that of the
angle between ray and curve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ..device import REFERENCE_KEV, REST, Device, attenuation
from ..geometry.cameras import pixels_per_metre
from ..geometry.curve import arc_length, middle
from ..imaging.strips import Sheet, cut
from .fit.result import Fit

STEP = 1e-4             # m, between the places where it is known what a device looks like
SHIFTS = np.arange(-3e-3, 3.1e-3, 5e-4)     # m, by which a curve's end may be off
SATURATION = 0.25, 0.5, 1.0, 2.0            # k
# sigma of an image, and of what strips are averaged by along the curve; px between these
BLUR_PX, SMOOTH_PX, APART_PX = 1.2, 2.0, 2.0
FLANK_PX = 4            # wide at least is what is looked at beside the widest part, and 2 px from it
DARKEST = 0.02          # of what lies beside it, below which an image is black
FEWEST = 20             # strips that tell anything
PALEST = 0.05           # of the darkest part: what is paler tells nothing of the gain
OFF, MOST = 0.1, 3.0    # of the darkness: what a description is worth at best; scatters, more by which a strip is off
                        # says no more: something hides it
TOGETHER_PX = 15.0      # along which a background errs the same way
SURE = 3.0              # nats, by which one end is the tip rather than the other
LENGTH, SHARE = 3e-3, 0.03      # m, and share of it: standard deviation of a known length
FOR, AGAINST = 1.0, -5.0        # nats: most that a description says for a curve, and against it
CONTRADICTS = -1.0      # nats, from which on it says so in words


@dataclass(frozen=True)
class Likeness:
    """Log-likelihood, nats, of what both images show along a curve."""

    first: float            # if its first end is the tip
    last: float             # if its last end is
    neither: float          # if it is the same all along

    @property
    def last_is_tip(self) -> float:
        """Nats by which the last end is the tip rather than the first; 0 where it surely is no such device either way,
        or only a part of one."""
        return self.last - self.first if max(self.first, self.last) > self.neither - SURE else 0.0


ALIKE = Likeness(0.0, 0.0, 0.0)         # nothing is known


def likeness(device: Device, points: np.ndarray, sheet: Sheet, radius: float) -> Likeness:
    """What the images say of a curve, (N, 3) points in m, if it is this device; the same of each case where they say
    nothing. radius: see Config.radius."""
    length, scale = float(arc_length(points)[-1]), [pixels_per_metre(v.P, points) for v in sheet.views]
    count = int(length * max(scale) / APART_PX)
    if count < FEWEST:
        return ALIKE
    s = np.linspace(0, length, count)
    found = np.zeros(2 * len(SHIFTS) + 1)
    for plane in _darkness(device, points, s, sheet, radius, scale):
        found += _log_likelihoods(device, s, *plane)
    return Likeness(float(found[1:len(SHIFTS) + 1].max()), float(found[len(SHIFTS) + 1:].max()), float(found[0]))


def verdict(device: Device | None, alike: Callable[[], Likeness], f: Fit, last_is_tip: bool,
            name: str = '') -> tuple[float, str]:
    """Log odds, from AGAINST to FOR, that a fit is a device of known length, and what of it speaks against that, in
    words; 0 where its length is not known."""
    if device is None or device.length == REST:
        return 0.0, ''
    # of a device that leaves the field more may be there
    seen, whole, length = alike(), not f.open_end.any(), f.stop - f.start
    off = (length - device.length) / np.sqrt(LENGTH**2 + (SHARE * device.length)**2 + (f.end_sigma**2).sum())
    profile, stretch = ((seen.last if last_is_tip else seen.first) - seen.neither,
                        -0.5 * off**2 if whole or off > 0 else 0.0)
    words = (f'it is {1e3 * length:.0f} mm long, and {name} {1e3 * device.length:.0f} mm'
             if stretch < profile else f'it does not look like {name} along it')
    return float(np.clip(profile + stretch + FOR * whole, AGAINST, FOR)), words


def expected(device: Device, length: float, half: float) -> np.ndarray:
    """(N,) optical depth at REFERENCE_KEV, straight on, in steps of STEP from the tip to `length` m: the mean up to
    `half` m to either side of the middle.

    A shorter device goes on as it is at its base: how long it is, is judged apart.
    """
    return _expected(device, round(float(np.ceil(length / 0.05)) * 0.05, 2),
                     float(f'{half:.2g}'))[:int(np.ceil(length / STEP))]


@lru_cache(64)
def _expected(device: Device, length: float, half: float) -> np.ndarray:
    changes = []        # of the depth, and where
    for p in device.pieces(length):
        depth = attenuation(p.material, REFERENCE_KEV) * (_chord(p.radius, half) - _chord(p.lumen, half))
        changes += [(p.start, depth), (p.stop, -depth)]
    at, change = np.array(sorted(changes)).T
    total = np.concatenate([[0.0], np.cumsum(np.cumsum(change)[:-1] * np.diff(at))])      # integral from the tip
    return np.diff(np.interp(STEP * np.arange(round(length / STEP) + 1), at, total)) / STEP


def _chord(radius: float, half: float) -> float:
    """m: the mean length of a circle's chords up to `half` m to either side of its middle."""
    h = min(radius, half)
    return float((h * np.sqrt(radius**2 - h**2) + radius**2 * np.arcsin(h / radius)) / half) if radius > 0 else 0.0


def _darkness(device: Device, points: np.ndarray, s: np.ndarray, sheet: Sheet, radius: float,
              scale: list[float]) -> list[tuple]:
    """Of each plane, at (N,) arc lengths of a curve: (N,) darkness, (N,) bool whether it is known, (N,) sine of the
    angle between ray and curve; px a m; and how far to either side of the middle, m, that darkness is taken."""
    along = arc_length(points)
    at = np.stack([np.interp(s, along, c) for c in points.T], axis=1)
    tangents = gaussian_filter1d(np.gradient(at, s, axis=0), SMOOTH_PX / APART_PX, axis=0, mode='nearest')
    wide, flank = [device.widest * k + 2 for k in scale], [max(FLANK_PX, radius * k) for k in scale]
    strips = cut(sheet, at, tangents, float(np.ceil(max(np.add(wide, flank)))), rough=True)
    x, found = np.abs(strips.offsets_px), []
    for profiles, inside, speed, px_per_m, w, f in zip(strips.profiles, strips.inside, strips.speed, scale,
                                                       wide, flank):
        inner = max(int(radius * px_per_m / 2), 1)
        beside = profiles[:, (x > w) & (x <= np.ceil(w + f))].mean(axis=1)
        share = profiles[:, x <= inner].mean(axis=1) / np.maximum(beside, 1e-6)
        dark = -2 * np.log(np.clip(share, DARKEST, 1 / DARKEST))         # of square roots of counts
        # a box of the same variance stands for the mean over samples and the image's blur
        half = np.sqrt((inner + 0.5)**2 + 3 * BLUR_PX**2) / px_per_m
        found.append((gaussian_filter1d(dark, SMOOTH_PX / APART_PX), inside & (beside > 0),
                      np.clip(speed / px_per_m, 0.2, 1.0), px_per_m, half))
    return found


def _log_likelihoods(device: Device, s: np.ndarray, dark: np.ndarray, known: np.ndarray, sine: np.ndarray,
                     px_per_m: float, half: float) -> np.ndarray:
    """(2 S + 1,) of what a plane shows: if it is the same all along, and with the tip at its first and at its last end,
    shifted by SHIFTS."""
    if known.sum() < FEWEST:
        return np.zeros(2 * len(SHIFTS) + 1)
    depth = expected(device, s[-1] - SHIFTS[0], half)
    depth = gaussian_filter1d(depth, np.hypot(BLUR_PX, SMOOTH_PX) / (px_per_m * middle(sine) * STEP), mode='nearest')
    from_tip = np.concatenate([s + SHIFTS[:, None], s[-1] - s + SHIFTS[:, None]])
    t = np.interp(from_tip, STEP * (np.arange(len(depth)) + 0.5), depth, left=0.0) / sine
    even = np.full(len(s), middle(depth)) / sine
    y = dark[known]
    shapes = np.stack([np.concatenate([even[None], t])[:, known] * k for k in SATURATION])
    shapes = 1 - np.exp(-shapes)
    gains = middle(y / np.maximum(shapes, PALEST * shapes.max(axis=2, keepdims=True)))[..., None]
    off = np.abs(y - np.maximum(gains, 0) * shapes)
    scatter = max(1.4826 * float(middle(off).min()), OFF * abs(float(middle(y))), 1e-6)
    return (-0.5 * (np.minimum(off / scatter, MOST)**2).sum(axis=2).max(axis=0) / TOGETHER_PX
            * (px_per_m * s[-1] / len(s)))
