"""How fast a pair is answered: per stage and in total, in ms and in yardsticks timed in between, on scenes whose truth
is known.

Images of all sizes show the same field at the same dose, as one detector read out at several resolutions does: the
finer the pixels, the more of them the device covers, and the fewer photons each counts.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest

import cv2
import numpy as np
from skimage.filters import frangi
from tqdm import tqdm

from ..config import Config
from ..data import Prior, Reconstruction
from ..method.pipeline import reconstruct
from ..metrics import compare
from ..sim.carm import CArm, biplane
from ..sim.scenes import Scene, xray_run
from ..sim.xray import Exposure
from .score import WITHIN_MEAN, WITHIN_TIP

FIELD = 0.3e-3 * 1024               # m at the isocentre, whatever the number of pixels
PHOTONS = 1500.0 * 1024**2          # of the whole field
MOMENT, STEP = 1.0, 1 / 30          # s: when the moving device is seen, and how long before that the pair before was
                                    # taken, and the one before that
STEP_NS = round(STEP * 1e9)
COMPARED = 2                        # scenes for what takes seconds
SPLINE, TRACKED, PAPER, FRANGI = 'spline, full', 'spline, tracked', 'paper', 'skimage frangi'


@dataclass
class Laps:
    """What one way of working takes; each repeat sees another scene than the one before."""

    size: int                       # px, of the square images
    way: str
    scenes: int = 0
    right: int = 0                  # of these: answered, and within the truth's tolerance
    seconds: list[float] = field(default_factory=list)              # a pair
    yardsticks: list[float] = field(default_factory=list)           # s, just before each
    cpu: list[float] = field(default_factory=list)                  # s of all threads; other work on the machine hardly
                                                                    # shows in it
    stages: dict[str, list[float]] = field(default_factory=dict)    # s

    def add(self, work: Callable[[], Reconstruction | None], blank: np.ndarray) -> None:
        """Time `work` once, after a yardstick."""
        self.yardsticks.append(yardstick(blank))
        start, busy = time.perf_counter(), time.process_time()
        result = work()
        self.seconds.append(time.perf_counter() - start)
        self.cpu.append(time.process_time() - busy)
        for name, lap in ({} if result is None else result.stage_seconds).items():
            self.stages.setdefault(name, []).append(lap)

    @property
    def unit(self) -> float:
        """The yardstick Y in s."""
        return median(self.yardsticks)

    @property
    def ns_per_pixel(self) -> float:
        return median(self.seconds) * 1e9 / (2 * self.size**2)

    @property
    def y_per_pixel(self) -> float:
        return median(self.seconds) / self.unit / (2 * self.size**2)


def median(values: list[float]) -> float:
    """NaN of nothing."""
    return float(np.median(values)) if values else float('nan')


def yardstick(blank: np.ndarray) -> float:
    """Y in s: one `cv2.GaussianBlur(float32 1024x1024, sigma 2)` on both images of a pair."""
    start = time.perf_counter()
    for _ in range(2):
        cv2.GaussianBlur(blank, (0, 0), 2)
    return time.perf_counter() - start


def config_of(scene: Scene, method: str = 'spline') -> Config:
    """What a user knows of a scene."""
    return Config.from_values(method=method, robot_radius=scene.radius, base_position=scene.base_position.tolist())


def is_right(result: Reconstruction, scene: Scene) -> bool:
    """Whether there is an answer, as near to the truth as the accuracy table asks for."""
    if result.shape is None:
        return False
    errors = compare(result.shape.points, scene.truth)
    return errors.mean <= WITHIN_MEAN and errors.tip <= WITHIN_TIP


def sequences(size: int, count: int, seed: int) -> list[tuple[Scene, Scene, Scene]]:
    """Three successive moments of `count` devices that move in front of anatomies, `size` x `size` px each."""
    views = biplane(arm=CArm(pixel_size_iso=FIELD / size, width=size, height=size))
    exposure = Exposure(photons=PHOTONS / size**2)
    runs = (xray_run(seed + k, views=views, exposure=exposure) for k in range(count))
    return [tuple(run.scene(MOMENT - k * STEP, 2 - k) for k in (2, 1, 0))
            for run in tqdm(runs, f'{size} px, rendering', count, unit='scene', disable=None, leave=False)]


def measure(size: int, count: int, rounds: int, seed: int, compared: int = COMPARED) -> list[Laps]:
    """Laps of each way of working on scenes of one size; `compared` of them are given to what takes seconds.

    A scene is timed where its answer is right, since a wrong answer's time means nothing; the others are counted. What
    the literal method answers is checked too, but it is timed in any case: in front of anatomy it finds a rib.
    """
    cv2.setNumThreads(Config().input.threads)
    blank = np.random.default_rng(0).random((1024, 1024), np.float32)
    moments = sequences(size, count, seed)
    full, tracked = Laps(size, SPLINE, count), Laps(size, TRACKED, count)
    given: dict[str, list] = {way: [(now, config_of(now), Prior()) for *_, now in moments] for way in (SPLINE, TRACKED)}
    for k, (*earlier, now) in enumerate(moments):
        before, last = (reconstruct(scene.frame, config_of(scene)).shape for scene in earlier)
        given[TRACKED][k] = now, config_of(now), Prior(last, now.frame.stamp_ns - STEP_NS, before,
                                                       now.frame.stamp_ns - 2 * STEP_NS)
    for laps in (full, tracked):
        given[laps.way] = [(now.frame, config, prior) for now, config, prior in given[laps.way]
                           if (laps is full or prior.previous is not None)
                           and is_right(reconstruct(now.frame, config, prior), now)]
        laps.right = len(given[laps.way])
    for _ in tqdm(range(rounds), f'{size} px, timing', unit='round', disable=None, leave=False):
        for both in zip_longest(given[SPLINE], given[TRACKED]):
            for laps, arguments in zip((full, tracked), both):
                if arguments is not None:
                    laps.add(partial(reconstruct, *arguments), blank)
    return [full, tracked, *_compared([now for *_, now in moments[:compared]], blank)]


def _compared(scenes: list[Scene], blank: np.ndarray) -> list[Laps]:
    """The published method, and the filter that others begin with, at its defaults."""
    found = []
    for scene in scenes:
        size = scene.frame.views[0].width
        literal, filtered = found = found or [Laps(size, PAPER, len(scenes)), Laps(size, FRANGI)]
        config = config_of(scene, 'paper')
        literal.right += is_right(reconstruct(scene.frame, config), scene)
        literal.add(partial(reconstruct, scene.frame, config), blank)
        filtered.add(partial(_frangi, scene.frame.images), blank)
    return found


def _frangi(images: tuple[np.ndarray, np.ndarray]) -> None:
    for image in images:
        frangi(image)


def table(found: list[Laps]) -> str:
    """A line a size and way of working, then one a stage, for a terminal."""
    lines = [f'{"px":>5s}  {"what":15s} {"right":>7s} {"n":>5s}  {"ms: median":>10s} {"p95":>7s} {"p99":>7s}  '
             f'{"Y: median":>9s} {"p95":>7s} {"p99":>7s}  {"CPU ms":>7s}  {"ns/px":>6s} {"growth":>6s}']
    for laps in found:
        right = f'{laps.right}/{laps.scenes}' if laps.scenes else '-'
        lines.append(f'{laps.size:5d}  {laps.way:15s} {right:>7s} {len(laps.seconds):5d}  '
                     f'{_quantiles(laps.seconds, 1e-3)}  {_quantiles(laps.seconds, laps.unit, 9)}  '
                     f'{median(laps.cpu) * 1e3:7.1f}  {laps.ns_per_pixel:6.1f} {growth(laps, found):6.2f}')
    lines += ['', f'{"px":>5s}  {"stage":25s} {"n":>5s}  {"ms: median":>10s} {"p95":>7s} {"p99":>7s}  '
                  f'{"Y: median":>9s} {"p95":>7s} {"p99":>7s}']
    for laps in found:
        for stage, seconds in laps.stages.items():
            lines.append(f'{laps.size:5d}  {f"{laps.way}: {stage}":25s} {len(seconds):5d}  '
                         f'{_quantiles(seconds, 1e-3)}  {_quantiles(seconds, laps.unit, 9)}')
    return '\n'.join([*lines, '', *_legend(found)])


def growth(laps: Laps, found: list[Laps]) -> float:
    """Cost per pixel, in yardsticks, as a multiple of the same way's at the smallest size that was timed."""
    return laps.y_per_pixel / min((f for f in found if f.way == laps.way and f.seconds), key=lambda f: f.size,
                                  default=laps).y_per_pixel


def plain(found: list[Laps]) -> list[dict]:
    """For JSON: everything, in s."""
    return [{'size_px': f.size, 'way': f.way, 'scenes': f.scenes, 'right': f.right, 'seconds': f.seconds,
             'yardsticks': f.yardsticks, 'cpu_seconds': f.cpu, 'stages': f.stages,
             'median_y': median(f.seconds) / f.unit, 'p95_y': float(np.percentile(f.seconds, 95)) / f.unit,
             'ns_per_pixel': f.ns_per_pixel, 'growth': growth(f, found)} for f in found if f.seconds]


def _quantiles(seconds: list[float], unit: float, width: int = 10) -> str:
    p50, p95, p99 = np.percentile(seconds, (50, 95, 99)) / unit if seconds else [float('nan')] * 3
    return f'{p50:{width}.1f} {p95:7.1f} {p99:7.1f}'


def _legend(found: list[Laps]) -> list[str]:
    y = [lap for f in found for lap in f.yardsticks]
    return ['Y        cv2.GaussianBlur(float32 1024x1024, sigma 2) on two images, before every repeat: '
            f'{np.median(y) * 1e3:.2f} ms (p95 {np.percentile(y, 95) * 1e3:.2f})',
            f'right    scenes answered within {WITHIN_MEAN * 1e3:g} mm mean and {WITHIN_TIP * 1e3:g} mm at the tip: '
            'only these are timed (paper: all)',
            f'sizes    the same field of {FIELD * 1e3:.0f} mm at the same dose, in finer pixels; '
            'ns/px: median over the pixels of both images',
            'CPU ms   median of all threads together, which other work on the machine hardly touches',
            'growth   cost per pixel, in Y, as a multiple of that at the smallest size',
            f'machine  {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, {cv2.getNumThreads()} threads of OpenCV '
            f'{cv2.__version__}, NumPy {np.__version__}']
