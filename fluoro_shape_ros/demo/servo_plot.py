"""The servo demo's picture: where the tip was led, where it was and where it was measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..files.pictures import STYLE, TRUTH
from ..geometry.cameras import project
from ..overlay import FOUND, TIP
from ..sim.plant import Plant
from .servo_run import Run

MISS = '#ffb347'
ACROSS_A = [0, 2]       # x and z: what plane A's beam runs across


def draw(run: Run, file: Path, moved: Plant) -> Path:
    """Write the picture of a run of the robot that it `moved`; its path. Raises OSError where it can't be written."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(12, 4), layout='constrained')
        FigureCanvasAgg(figure)
        seen, path, errors = figure.subplots(1, 3, width_ratios=(1, 1.1, 1.7))
        _seen(seen, run, moved)
        _path(path, run)
        _errors(errors, run)
        figure.savefig(file, dpi=100)
    return file


def _seen(axes, run: Run, moved: Plant) -> None:
    """Plane A when the first task was done, with all that the target and the tip have done until then."""
    now = run.ends[0]
    frame = moved.scene(run.record.joints[now], 0, now).frame
    height, width = frame.images[0].shape
    axes.imshow(frame.images[0], cmap='gray', aspect='equal')
    for points, style in ((run.record.target, dict(color=MISS, lw=2)),
                          (run.record.measured, dict(color=FOUND, ls='', marker='.', ms=2))):
        axes.plot(*project(frame.views[0].P, _between(points, 0, now)).T, **style)
    axes.set(xlim=(0.15 * width, 0.85 * width), ylim=(0.95 * height, 0.05 * height), xticks=[], yticks=[],
             title='plane A')


def _path(axes, run: Run) -> None:
    """Along the square, seen as plane A sees it; without a square all of the run."""
    start, stop = run.square or (min(run.record.target), max(run.record.target) + 1)
    for points, style in ((run.record.target, dict(color=MISS, lw=3, label='target')),
                          (run.record.true, dict(color=TRUTH, lw=1.2, label='true tip')),
                          (run.record.measured, dict(color=FOUND, ls='', marker='.', ms=4, label='measured tip'))):
        axes.plot(*_between(points, start, stop)[:, ACROSS_A].T * 1e3, **style)
    # a single wrong measurement shows in the errors, and need not shrink the path
    x, z = _between(run.record.true, start, stop)[:, ACROSS_A].T * 1e3
    # in plane A's image x runs to the left, z up
    axes.set(xlim=(x.max() + 1.5, x.min() - 1.5), ylim=(z.min() - 1.5, z.max() + 1.5))
    axes.set(aspect='equal', xlabel='x (mm)', ylabel='z (mm)', title='the tip, as plane A sees it')
    axes.grid(True)
    axes.legend(loc='center', bbox_to_anchor=(0.38, 0.32), fontsize=8)


def _errors(axes, run: Run) -> None:
    """Distance of the true and the measured tip from the target over time."""
    record, start = run.record, min(run.record.target)
    for points, style in ((record.measured, dict(color=FOUND, ls='', marker='.', ms=4, label='measured tip')),
                          (record.true, dict(color=TRUTH, lw=1.2, label='true tip'))):
        both = sorted(set(points) & set(record.target))
        t = (np.array(both) - start) * 1e-9
        axes.semilogy(t, [max(1e3 * np.linalg.norm(points[k] - record.target[k]), 1e-2) for k in both], **style)
    begins = [(t - start) * 1e-9 for t in run.ends]
    for k, miss in enumerate(run.open_loop):
        span = begins[len(begins) - len(run.open_loop) + k - 1] if len(begins) > len(run.open_loop) or k else 0.0
        axes.plot([span, begins[len(begins) - len(run.open_loop) + k]], [1e3 * miss] * 2, color=MISS, lw=2, ls='--',
                  label=None if k else 'without the loop')
    if record.blackout:
        axes.axvspan(*((t - start) * 1e-9 for t in record.blackout), color='#8899aa', alpha=0.35, label='plane B blank')
    axes.axhline(0.3, color=TIP, lw=0.8, label='0.3 mm')
    axes.set(xlabel='time (s)', ylabel='mm', title='its distance from the target')
    axes.grid(True)
    axes.legend(fontsize=8, loc='lower left', framealpha=0.9)


def _between(points: dict[int, np.ndarray], start: int, stop: int) -> np.ndarray:
    """(N, 3) the points with stamps in [start, stop), in order."""
    return np.array([x for t, x in sorted(points.items()) if start <= t < stop])

