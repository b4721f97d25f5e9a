"""The bench as a picture: every scene's errors on logarithmic axes, and what share of the scenes was answered how.
Needs matplotlib."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ..files.pictures import FOUND, GRID, MISSED, STYLE, TEXT, TIP, TRUTH
from .score import WITHIN_MEAN, WITHIN_TIP, Answer, Trial
from .table import share

COLOURS = (FOUND, MISSED, '#b48cff', '#7ee081')     # of methods
PANELS = (('mean', 'closest point (mm)', WITHIN_MEAN), ('tip', 'tip (mm)', WITHIN_TIP))
SHARES: tuple[tuple[str, str, Callable[[Answer], bool]], ...] = (
    ('within the limits, or rightly silent', '#3fb98f', lambda a: a.within or not (a.device or a.published)),
    ('published, beyond the limits', MISSED, lambda a: a.published and not a.within and not a.silent_failure),
    ('silent failure', TIP, lambda a: a.silent_failure),
    ('not answered', GRID, lambda a: a.device and not a.published),
)
ROW_INCHES = 0.3        # height of a method in a family
GAP = 0.6               # between families, in rows


def draw(trials: Sequence[Trial], file: Path) -> None:
    """Write the picture as PNG. Raises OSError where the file can't be written."""
    families = {}
    for trial in trials:
        families.setdefault(trial.task.family, []).append(trial)
    methods = list(trials[0].answers)
    pitch = len(methods) + GAP
    height = ROW_INCHES * pitch * len(families)
    top, bottom, total = 0.75, 0.75, height + 1.5       # inches
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(15, total), dpi=100)
        axes = [figure.add_axes((left, bottom / total, width, height / total))
                for left, width in ((0.085, 0.3), (0.4, 0.3), (0.715, 0.215))]
        for ax, (name, label, limit) in zip(axes, PANELS):
            _errors(ax, families, methods, name, pitch)
            ax.axvline(limit * 1e3, color=TEXT, lw=0.8, ls='--', zorder=0)
            ax.set(xscale='log', xlabel=label)
            ax.xaxis.set_major_formatter('{x:g}')
            ax.grid(True, axis='x')
        _shares(axes[2], families, methods, pitch)
        for ax in axes:
            ax.set(ylim=(pitch * len(families) - GAP / 2 - 0.5, -GAP / 2 - 0.5), yticks=[])
            for k in range(1, len(families)):
                ax.axhline(k * pitch - GAP / 2 - 0.5, color=GRID, lw=0.6)
            for spine in ('top', 'right', 'left'):
                ax.spines[spine].set_visible(False)
        axes[0].set_yticks([k * pitch + (len(methods) - 1) / 2 for k in range(len(families))], list(families))
        axes[0].tick_params(axis='y', length=0, labelsize=11)
        _legends(figure, axes, methods, top / total)
        figure.savefig(file, format='png')


def _errors(ax, families, methods, name: str, pitch: float) -> None:
    """Dots for scenes, a bar from the median to the 95th percentile, a tick for the bound."""
    for k, trials in enumerate(families.values()):
        if not any(a.device for t in trials for a in t.answers.values()):
            ax.text(0.5, k * pitch + (len(methods) - 1) / 2, 'nothing may be published',
                    transform=ax.get_yaxis_transform(), ha='center', va='center',
                    color=TEXT, alpha=0.5, fontsize=9, style='italic')
        for m, method in enumerate(methods):
            mm = np.array([getattr(t.answers[method].errors, name) for t in trials if t.answers[method].errors]) * 1e3
            y = k * pitch + m
            if len(mm):
                jitter = np.random.default_rng(0).uniform(-0.28, 0.28, len(mm))
                ax.scatter(np.maximum(mm, 1e-3), y + jitter, s=12, color=COLOURS[m % len(COLOURS)], alpha=0.55, lw=0)
                median, p95 = np.percentile(mm, [50, 95])
                ax.plot([median, p95], [y, y], color=TRUTH, lw=1.2)
                ax.plot([median], [y], 'o', color=TRUTH, ms=5)
                ax.plot([p95], [y], '|', color=TRUTH, ms=9, mew=1.2)
        if bounds := [getattr(t.bound, name) for t in trials if t.bound]:
            ax.plot([np.mean(bounds) * 1e3] * 2, [k * pitch - 0.5, k * pitch + len(methods) - 0.5],
                    color='#7ee081', lw=2)


def _shares(ax, families, methods, pitch: float) -> None:
    """Bars of what became of the scenes, and beside them the share that is as it should be."""
    for k, trials in enumerate(families.values()):
        for m, method in enumerate(methods):
            answers, left = [t.answers[method] for t in trials], 0.0
            for _, colour, belongs in SHARES:
                part = 100 * sum(map(belongs, answers)) / len(answers)
                ax.barh(k * pitch + m, part, left=left, height=0.7, color=colour)
                left += part
            right = sum(map(SHARES[0][2], answers))
            ax.text(102, k * pitch + m, f'{method}  {share(right, len(answers))}', va='center', fontsize=9,
                    color=COLOURS[m % len(COLOURS)])
    ax.set(xlim=(0, 100), xlabel='share of the scenes (%)')


def _legends(figure, axes, methods, top: float) -> None:
    """What the marks mean, above the panels."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    marks = [Line2D([], [], ls='', marker='o', ms=5, color=COLOURS[m % len(COLOURS)], label=f'{method}: a scene')
             for m, method in enumerate(methods)]
    marks += [Line2D([], [], color=TRUTH, marker='o', ms=5, lw=1.2, label='median to 95th percentile'),
              Line2D([], [], color='#7ee081', lw=2, label='Cramér-Rao bound'),
              Line2D([], [], color=TEXT, lw=0.8, ls='--', label='limit of "within"')]
    row = dict(loc='lower left', frameon=False, fontsize=10, borderaxespad=0.0, handletextpad=0.5, columnspacing=1.6)
    y = 1 - top * 0.8
    figure.legend(handles=marks, ncol=len(marks), bbox_to_anchor=(axes[0].get_position().x0, y), **row)
    patches = [Patch(color=colour, label=label) for label, colour, _ in SHARES]
    figure.legend(handles=patches, ncol=2, bbox_to_anchor=(axes[2].get_position().x0, y), **row)
