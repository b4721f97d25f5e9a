"""How a plane takes an image and shows it: scatter, blur, quantum noise of a dose, and what the display makes of it.

A sharp beam I (H, W), the share of the X-rays that pass without being scattered, becomes

    D = G(blur) I + share / (1 - share) G(scatter) I                detected, in units of its median over the field
                                                                    without a device
    N = D + sqrt(D / photons) n                                     n: unit normal, correlated over `noise_px`
    V = (c(N) - black) / (white - black)                            c: the display's curve, linear, a power, or a
                                                                    logarithm
    V + sharpening (V - G(sharpening_px) V), in 2^bits - 1 steps    an unsharp mask

G(s) is convolution with a Gaussian of s px. Exposure and window belong to a run: they are set once, by what a plane
shows without a device.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import cv2
import numpy as np

DISPLAYS = ('linear', 'gamma', 'logarithmic')
COARSE = 8                              # scatter is smooth enough to be spread at an eighth of the size
FAINTEST = 1e-3                         # of the median: what a logarithm is taken of at least
DARKEST, BRIGHTEST = 0.4, 1.25          # of the median: the window holds at least these


def _q(default, text: str, unit: str, low: float, high: float, log: bool = False):
    """A quantity with its unit and the range that it is drawn from, evenly, or evenly in its logarithm."""
    return field(default=default, metadata=dict(text=text, unit=unit, low=low, high=high, log=log))


@dataclass(frozen=True)
class Imaging:
    """One plane. Raises ValueError for what can't be."""

    energy_kev: float = _q(65.0, 'effective energy', 'keV', 50, 90)
    photons: float = _q(600.0, 'detected at the median of the field', '1/pixel', 60, 4000, log=True)
    scatter: float = _q(0.3, 'share of what is detected that was scattered', '', 0.05, 0.6)
    scatter_px: float = _q(90.0, 'how far scatter spreads, sigma', 'px', 40, 200)
    blur_px: float = _q(0.9, 'focal spot and detector, sigma', 'px', 0.4, 2.0)
    noise_px: float = _q(0.4, 'kernel that noise is correlated by, sigma; 0.3 to 0.6 make it 1 to 2 px wide',
                         'px', 0.0, 0.7)
    gamma: float = _q(1.0, 'power of the display gamma', '', 0.45, 2.2, log=True)
    black: float = _q(0.0, 'of the window beyond the darkest 1 %, in widths of the field\'s range; '
                           'above 0 it is cut off', '', -0.8, 0.02)
    white: float = _q(0.0, 'the same beyond the brightest 1 %', '', -0.02, 0.5)
    sharpening: float = _q(0.0, 'strength of the unsharp mask', '', 0.0, 1.2)
    sharpening_px: float = _q(2.5, 'its sigma', 'px', 1.5, 6.0)
    lag: float = _q(0.0, 'share of the image before in recursive averaging of a run', '', 0.0, 0.5)
    display: str = 'linear'             # one of DISPLAYS
    bits: int = 8                       # above 8 the image is uint16

    def __post_init__(self):
        if self.display not in DISPLAYS:
            raise ValueError(f'no display is called {self.display!r}: there are {", ".join(DISPLAYS)}')
        if not (1 <= self.bits <= 16 and self.photons > 0 and 0 <= self.scatter < 1 and 0 <= self.lag < 1
                and self.gamma > 0 and self.white - self.black > -0.9
                and min(self.blur_px, self.noise_px, self.scatter_px, self.sharpening, self.sharpening_px) >= 0):
            raise ValueError(f'no imaging: {self}')


@dataclass(frozen=True)
class Levels:
    """What a run's exposure and window are set by; in units of the sharp beam."""

    median: float       # detected, of the field without a device
    low: float          # the window's darkest ...
    high: float         # ... and brightest level, before `black` and `white`, as shares of the median


SETTINGS = {
    'fluoroscopy': Imaging(energy_kev=68, photons=250, scatter=0.35, blur_px=0.9, noise_px=0.45, display='logarithmic',
                           black=-0.2, white=0.1, sharpening=0.4, lag=0.3),
    'cine': Imaging(energy_kev=75, photons=2000, scatter=0.3, blur_px=0.7, noise_px=0.3, display='gamma', gamma=0.7,
                    black=-0.1, white=0.05, sharpening=0.6, sharpening_px=2.0, bits=10),
    'intensifier': Imaging(energy_kev=60, photons=400, scatter=0.4, scatter_px=140, blur_px=1.6, noise_px=0.5,
                           display='linear', black=-0.4, white=0.2, lag=0.2),
}
CIRCULAR = ('intensifier',)     # settings whose field is a circle


def draw(rng: np.random.Generator) -> Imaging:
    """An imaging chain with every quantity drawn from its range; a third of the displays sharpen nothing, a third
    average nothing."""
    values = {}
    for f in dataclasses.fields(Imaging):
        if f.metadata:
            low, high = f.metadata['low'], f.metadata['high']
            values[f.name] = float(np.exp(rng.uniform(np.log(low), np.log(high)))
                                   if f.metadata['log'] else rng.uniform(low, high))
    for name in ('sharpening', 'lag'):
        values[name] *= bool(rng.random() > 1 / 3)
    return Imaging(**values, display=str(rng.choice(DISPLAYS)), bits=int(rng.choice([8, 10, 12, 16])))


def levels(bare: np.ndarray, imaging: Imaging, aperture: np.ndarray | None = None) -> Levels:
    """Exposure and window for the (H, W) sharp beam without a device, by the middle half of the image as automatic
    exposure has it, where the `aperture` of blades or intensifier, the (H, W) share of the beam that it lets through,
    is open."""
    h, w = bare.shape
    middle = slice(h // 4, h - h // 4), slice(w // 4, w - w // 4)
    detected = spread(bare, imaging)[middle]
    if aperture is not None and (aperture[middle] > 0.5).any():
        detected = detected[aperture[middle] > 0.5]
    median = float(np.median(detected))
    low, high = np.percentile(detected, [1, 99]) / median
    return Levels(median, float(min(low, DARKEST)), float(max(high, BRIGHTEST)))


def spread(beam: np.ndarray, imaging: Imaging) -> np.ndarray:
    """(H, W) float32: the beam as it is detected, blurred and with scatter, without noise. It is linear in the beam."""
    size = beam.shape[1] // COARSE + 1, beam.shape[0] // COARSE + 1
    coarse = cv2.GaussianBlur(cv2.resize(beam, size, interpolation=cv2.INTER_AREA), (0, 0),
                              max(imaging.scatter_px / COARSE, 0.5))
    scattered = (cv2.resize(coarse, beam.shape[::-1], interpolation=cv2.INTER_CUBIC)
                 * np.float32(imaging.scatter / (1 - imaging.scatter)))
    return (cv2.GaussianBlur(beam, (0, 0), imaging.blur_px) if imaging.blur_px > 0 else beam) + scattered


def detect(beam: np.ndarray, imaging: Imaging, exposure: Levels, rng: np.random.Generator | None) -> np.ndarray:
    """(H, W) float32: what is detected of a sharp (H, W) beam, 1 at the field's median; with quantum noise, or without
    for rng None."""
    detected = np.maximum(spread(beam, imaging), 0) / np.float32(exposure.median)
    if rng is None:
        return detected
    return detected + np.sqrt(detected / np.float32(imaging.photons)) * _noise(rng, beam.shape, imaging.noise_px)


def show(detected: np.ndarray, imaging: Imaging, exposure: Levels) -> np.ndarray:
    """(H, W) uint8 or uint16: the image that the display makes of what is detected."""
    low, high = _curve(np.array([exposure.low, exposure.high], np.float32), imaging)
    black, white = low + imaging.black * (high - low), high + imaging.white * (high - low)
    shown = (_curve(detected, imaging) - black) / (white - black)
    if imaging.sharpening > 0:
        shown += np.float32(imaging.sharpening) * (shown - cv2.GaussianBlur(shown, (0, 0), imaging.sharpening_px))
    full = 2**imaging.bits - 1
    return np.rint(np.clip(shown, 0, 1) * np.float32(full)).astype(np.uint8 if imaging.bits <= 8 else np.uint16)


def _curve(detected: np.ndarray, imaging: Imaging) -> np.ndarray:
    """The display's curve, monotone; float32."""
    if imaging.display == 'linear':
        return detected
    positive = np.maximum(detected, np.float32(FAINTEST))
    return np.log(positive) if imaging.display == 'logarithmic' else positive**np.float32(imaging.gamma)


def _noise(rng: np.random.Generator, shape: tuple[int, ...], sigma_px: float) -> np.ndarray:
    """(H, W) float32 normal noise of unit variance, correlated by a Gaussian kernel."""
    white = rng.standard_normal(shape, dtype=np.float32)
    if sigma_px < 0.1:
        return white
    kernel = cv2.getGaussianKernel(2 * int(np.ceil(4 * sigma_px)) + 1, sigma_px, cv2.CV_32F)
    return cv2.sepFilter2D(white, -1, kernel, kernel) / np.float32((kernel**2).sum())
