"""How fast a pair is answered: per stage and in total, in ms and in yardsticks measured in between."""

from __future__ import annotations

import time
from collections import defaultdict

import cv2
import numpy as np

from ..config import Config
from ..data import Prior
from ..metrics import compare
from ..pipeline import reconstruct
from ..sim.carm import CArm, biplane
from ..sim.scenes import Scene, xray_run
from .cli import ToolError

FIELD = 0.3e-3 * 1024       # m at the isocentre, whatever the number of pixels
BELIEVED = 0.3e-3           # m mean error: what is timed has to be right


def yardstick(image: np.ndarray) -> float:
    """Y in s: one `cv2.GaussianBlur(float32 1024x1024, sigma 2)` on both images of a pair."""
    start = time.perf_counter()
    for _ in range(2):
        cv2.GaussianBlur(image, (0, 0), 2)
    return time.perf_counter() - start


def scenes(size: int, count: int, seed: int) -> list[Scene]:
    """Anatomy scenes of `size` x `size` px that show the same field."""
    views = biplane(angle_b=(np.pi / 2, 0.0), arm=CArm(pixel_size_iso=FIELD / size, width=size, height=size))
    return [xray_run(seed + k, views=views).scene() for k in range(count)]


def times(trials: list[Scene], method: str, tracked: bool, rounds: int, check: bool = True) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Seconds of every pair, of the yardstick beside each, and the median seconds of each stage.

    Raises ToolError where the method's answer is not the truth: a wrong answer's time means nothing, unless `check` is false. Scenes that it does
    not answer are left out.
    """
    blank = np.random.default_rng(0).random((1024, 1024), np.float32)
    seconds, yardsticks, stages = [], [], defaultdict(list)
    for scene in trials:
        config = Config.from_values(method=method, robot_radius=scene.radius, base_position=scene.base_position.tolist())
        first = reconstruct(scene.frame, config)
        if check and first.shape is None:
            continue
        if check and (error := compare(first.shape.points, scene.truth).mean) > BELIEVED:
            raise ToolError(f'{method}: scene {scene.seed} is {error * 1000:.2f} mm off, so its time means nothing')
        prior = Prior(previous=first.shape) if tracked else Prior()
        for _ in range(rounds):
            yardsticks.append(yardstick(blank))
            start = time.perf_counter()
            result = reconstruct(scene.frame, config, prior)
            seconds.append(time.perf_counter() - start)
            for name, lap in result.stage_seconds.items():
                stages[name].append(lap)
    if not seconds:
        raise ToolError(f'{method}: none of {len(trials)} scenes was answered, nothing to time')
    return np.array(seconds), np.array(yardsticks), {name: float(np.median(laps)) for name, laps in stages.items()}


def frangi(trials: list[Scene]) -> float:
    """Median s of `skimage.filters.frangi` at its defaults on both images of a pair: what others begin with."""
    from skimage.filters import frangi as filter_
    laps = []
    for scene in trials:
        start = time.perf_counter()
        for image in scene.frame.images:
            filter_(image)
        laps.append(time.perf_counter() - start)
    return float(np.median(laps))


def report(sizes: list[int], count: int, rounds: int, seed: int) -> str:
    """The table: a row a size and way of working."""
    lines = [f'{"size":>5s} {"what":16s} {"median ms":>10s} {"p95 ms":>8s} {"p99 ms":>8s} {"median Y":>9s} {"p95 Y":>7s} {"us/kpx":>7s}  stages (median ms)']
    for size in sizes:
        trials = scenes(size, count, seed)
        ways = [('spline, full', 'spline', False, rounds), ('spline, tracked', 'spline', True, rounds)]
        if size == 1024:
            ways.append(('paper, unchecked', 'paper', False, 1))      # over anatomy it finds a rib
        for what, method, tracked, n in ways:
            s, y, stages = times(trials, method, tracked, n, check=method == 'spline')
            unit = np.median(y)
            lines.append(f'{size:5d} {what:16s} {np.median(s) * 1e3:10.1f} {np.percentile(s, 95) * 1e3:8.1f} {np.percentile(s, 99) * 1e3:8.1f} '
                         f'{np.median(s) / unit:9.1f} {np.percentile(s, 95) / unit:7.1f} {np.median(s) * 1e9 / size**2:7.1f}  '
                         + ', '.join(f'{name} {lap * 1e3:.1f}' for name, lap in stages.items()))
        if size == 1024:
            lines.append(f'{size:5d} {"skimage frangi":16s} {frangi(trials[:2]) * 1e3:10.1f}')
            lines.append(f'{size:5d} {"yardstick Y":16s} {unit * 1e3:10.2f}')
    return '\n'.join(lines)
