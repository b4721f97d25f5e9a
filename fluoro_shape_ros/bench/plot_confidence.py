"""Whether confidence is what it says: a reliability diagram, and what is answered and wrong over min_confidence. Needs
matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ..files.pictures import FOUND, STYLE, TEXT, TIP
from .score import Answer

BINS = np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0])


def draw(answers: Sequence[Answer], file: Path) -> None:
    """Write the picture of what was published, as PNG. Raises OSError where the file can't be written."""
    known = [a for a in answers if a.published and np.isfinite(a.confidence)]
    said, right = np.array([a.confidence for a in known]), np.array([a.right for a in known], bool)
    wrong = np.array([a.silent_failure for a in known], bool)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(12, 5), dpi=100)
        left, curve = figure.subplots(1, 2)
        left.plot([0, 1], [0, 1], color=TEXT, lw=0.8, ls='--')
        for low, high in zip(BINS[:-1], BINS[1:]):
            mine = (said >= low) & ((said < high) | (high == 1.0))
            if mine.any():
                share, error = right[mine].mean(), np.sqrt(right[mine].mean() * (1 - right[mine].mean()) / mine.sum())
                left.errorbar(said[mine].mean(), share, 2 * error, fmt='o', color=FOUND, ms=6)
                left.annotate(f' {mine.sum()}', (said[mine].mean(), share), color=TEXT, fontsize=9)
        left.set(xlabel='confidence said', ylabel='share that is right', xlim=(-0.02, 1.02), ylim=(-0.02, 1.02),
                 title='how often it is right (number of pairs)')
        least = 1 - np.geomspace(1e-4, 1, 200)
        curve.plot(1 - least, [100 * np.sum(right & (said >= c)) / max(len(answers), 1) for c in least], color=FOUND,
                   label='published and right (% of all pairs)')
        curve.plot(1 - least, [100 * np.sum(wrong & (said >= c)) / max(int(np.sum(said >= c)), 1) for c in least],
                   color=TIP, label='silent failures (% of what is published)')
        curve.set(xscale='log', xlabel='1 - min_confidence', ylim=(0, 100), title='answered against silent')
        curve.legend(frameon=False)
        figure.savefig(file, format='png')
