"""How opaque a device is, and how far the shadow of its end reaches past it therefore.

A ray that meets a device at an angle passes through more of it. How much darker its shadow is there tells what the
device takes of the beam and what the display makes of it, both at once and without knowing either.
"""

from __future__ import annotations

import numpy as np

from ...geometry.curve import middle

USUAL, VARIES = 0.9, 0.5    # exponent of most devices, and its standard deviation among them
BLOCK = 12              # strips, that are looked at together
REWEIGHTED = 8          # times
RIM = 0.6               # share of its length by which the ellipse of an opaque end counts as an edge (measured)

STEEPEST = 0.1          # sine of the angle between curve and ray: at a smaller one the ray leaves where the curve bends

# Beer-Lambert: depths x of half the attenuation, the exponents x / (exp(x) - 1) that belong to them, and how far the
# middle of the fading shadow of a slanted end lies past it: at the share of the path that is half as dark
_DEPTHS = np.linspace(1e-3, 40.0, 4000)
_EXPONENTS = _DEPTHS / np.expm1(_DEPTHS)
_REACHES = 1 + 2 * np.log(0.5 * (1 + np.exp(-_DEPTHS))) / _DEPTHS


def exponent(darkness: np.ndarray, sine: np.ndarray, good: np.ndarray) -> float:
    """By which power of the rays' path through it the device's darkness grows: 1 where it lets most of them through,
    0 where it is opaque.

    darkness, sine: (V, N) of the strips of each plane, and of the angle between the curve and the rays there; good:
    (V, N) bool. Robust slope of their logarithms (Tukey's biweight) and what is USUAL, each by what it is worth.
    """
    paths: list[np.ndarray] = []
    darks: list[np.ndarray] = []
    for dark, slanted, g in zip(darkness, sine, good):
        at = np.nonzero(g)[0]
        at = at[:len(at) // BLOCK * BLOCK].reshape(-1, BLOCK)
        dark, path = dark[at].mean(axis=1), -np.log(np.clip(slanted[at], STEEPEST, 1.0)).mean(axis=1)
        seen = dark > 0
        if seen.any():
            paths.append(path[seen] - middle(path[seen]))
            darks.append(np.log(dark[seen]) - middle(np.log(dark[seen])))
    x, y = np.concatenate([np.zeros(0), *paths]), np.concatenate([np.zeros(0), *darks])
    if len(x) < 3:
        return USUAL
    slope, w = USUAL, np.ones(len(x))
    for _ in range(REWEIGHTED):
        rest = y - slope * x
        spread = 1.4826 * float(middle(np.abs(rest))) + 1e-3
        w = np.maximum(1 - (rest / (5 * spread))**2, 0)**2 / spread**2
        slope = (float(w @ (x * y)) + USUAL / VARIES**2) / (float(w @ (x * x)) + 1 / VARIES**2)
    return min(max(slope, 0.0), 1.0)


def of_part(power: float, share: np.ndarray) -> np.ndarray:
    """(...) exponent of parts of a device that are (...) `share` times as dark as those whose exponent is `power`:
    Beer-Lambert, 1 - exp(-x)."""
    depth = np.interp(min(power, USUAL), _EXPONENTS[::-1], _DEPTHS[::-1])
    return np.interp(-np.log1p(-np.minimum(share * -np.expm1(-depth), 1 - 1e-9)), _DEPTHS, _EXPONENTS)


def bulge(radius: float, sine: np.ndarray, power: np.ndarray) -> np.ndarray:
    """(...) m by which the shadow of a flat end reaches beyond the axis' end, seen at angles of this (...) sine; power:
    (...) see `exponent`.

    The end's rim is an ellipse, r cos / sin of the angle between ray and axis long. An opaque device shows all of it; a
    translucent one fades from that far before the end to that far after it, and is half as dark in between.
    """
    return RIM * np.interp(power, _EXPONENTS[::-1], _REACHES[::-1]) * rim(radius, sine)


def rim(radius: float, sine: np.ndarray) -> np.ndarray:
    """(...) m along the axis from its end to that of the ellipse of the rim."""
    sine = np.clip(sine, STEEPEST, 1.0)
    return radius * np.sqrt(1 - sine**2) / sine
