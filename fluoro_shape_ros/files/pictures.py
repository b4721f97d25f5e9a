"""Pictures of a reconstruction for people: X-ray images with the backbone on them, the 3-D curve against truth, errors
over time.

matplotlib is imported when a picture is made; nothing here opens a window.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ..cli import need
from ..geometry.cameras import pixels_per_metre, project
from ..geometry.curve import arc_length, at_arc_length
from ..overlay import FOUND, TIP, free_corner, grey_levels

GROUND, TEXT, GRID = '#12161c', '#d8dee6', '#39424e'
TRUTH, MISSED = '#ffffff', '#ffb347'
STYLE = {'figure.facecolor': GROUND, 'savefig.facecolor': GROUND, 'axes.facecolor': GROUND, 'axes.edgecolor': GRID,
         'axes.labelcolor': TEXT, 'text.color': TEXT, 'xtick.color': TEXT, 'ytick.color': TEXT, 'grid.color': GRID,
         'grid.linewidth': 0.6, 'legend.facecolor': GROUND, 'legend.edgecolor': GRID}
NAMES = ('overlay_a', 'overlay_b', 'backbone', 'demo', 'errors')
MARGIN_PX = 60          # around the backbone in an overlay
INSET_HALF_PX = 24      # half the side of the magnified region around the tip
INSET = 0.33            # of an overlay's side
SCALE_BAR = 0.02        # m


@dataclass(frozen=True)
class Snapshot:
    """One answered pair: what came in, what came out and what is true."""

    images: tuple[np.ndarray, np.ndarray]   # (H, W) each
    P: tuple[np.ndarray, np.ndarray]        # (3, 4) each, reference frame (m) to pixels
    points: np.ndarray                      # (N, 3) m, base to tip
    truth: np.ndarray                       # (M, 3) m


@dataclass(frozen=True)
class History:
    """Errors of a run, one entry an answered pair, and when pairs got no answer."""

    t: np.ndarray           # (N,) s since the start
    mean: np.ndarray        # (N,) m
    tip: np.ndarray         # (N,) m
    unanswered: np.ndarray  # (M,) s since the start


def clear(out: Path) -> None:
    """Make the folder `out` and remove the pictures of an earlier run, so that nothing old looks new. Raises OSError
    where it can't be written."""
    out.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        (out / f'{name}.png').unlink(missing_ok=True)


def save(out: Path, snapshot: Snapshot | None, history: History, caption: str) -> list[Path]:
    """Write PNGs of NAMES into the folder `out` and return their paths; without a snapshot only the errors over time.

    Raises ToolError without matplotlib, OSError where `out` can't be written.
    """
    matplotlib, figures = need('matplotlib', 'plot'), need('matplotlib.figure', 'plot')
    saved = []

    def sheet(name, size, draw):
        with matplotlib.rc_context(STYLE):
            figure = figures.Figure(figsize=size, dpi=100)
            draw(figure)
            saved.append(out / f'{name}.png')
            figure.savefig(saved[-1])

    if snapshot is not None:
        for i, plane in enumerate('ab'):
            sheet(f'overlay_{plane}', (9, 9), lambda f, i=i: overlay(f.add_axes((0, 0, 1, 1)), snapshot, i))
        sheet('backbone', (9, 8), lambda f: backbone(f.add_axes((0.0, 0.11, 0.98, 0.88), projection='3d'),
                                                     f.add_axes((0.25, 0.07, 0.5, 0.02)), snapshot))
        sheet('demo', (14, 9.4), lambda f: everything(f, snapshot, history, caption))
    sheet('errors', (10, 4), lambda f: errors(f.add_axes((0.08, 0.14, 0.90, 0.82)), history))
    return saved


def everything(figure, snapshot: Snapshot, history: History, caption: str) -> None:
    """All on one sheet: the two planes and the curve above, the errors below."""
    figure.text(0.5, 0.965, caption, ha='center', va='center', fontsize=14)
    for i in (0, 1):
        overlay(figure.add_axes((0.01 + 0.325 * i, 0.44, 0.32, 0.32 * 14 / 9.4)), snapshot, i)
    backbone(figure.add_axes((0.655, 0.475, 0.315, 0.455), projection='3d'),
             figure.add_axes((0.73, 0.465, 0.2, 0.012)), snapshot)
    errors(figure.add_axes((0.06, 0.075, 0.925, 0.29)), history)


def overlay(ax, snapshot: Snapshot, plane: int) -> None:
    """The image of plane 0 (A) or 1 (B) around the device, with the reprojected backbone and its tip, which an inset
    magnifies."""
    image, P = snapshot.images[plane], snapshot.P[plane]
    found, truth = project(P, snapshot.points), project(P, snapshot.truth)
    left, top, side = window(np.vstack([found, truth]), image.shape)
    across = (np.vstack([found, truth]) - (left, top)) / side
    corner = free_corner(across, INSET, ((0, 0), (1, 0), (0, 1), (1, 1)))
    inset = ax.inset_axes((0.015 + corner[0] * (0.97 - INSET), 0.015 + (1 - corner[1]) * (0.97 - INSET), INSET, INSET))
    black, white = grey_levels(image)
    for axes, line in ((ax, 1.8), (inset, 2.2)):
        axes.imshow(image, cmap='gray', vmin=black, vmax=white, interpolation='bilinear')
        axes.plot(*found.T, color=FOUND, lw=line, alpha=0.8)
        axes.set(xticks=[], yticks=[])
    for spine in ax.spines.values():
        spine.set_visible(False)
    for spine in inset.spines.values():
        spine.set(color=TIP, linewidth=1.5)
    ax.plot(*found[-1], 'o', ms=13, mfc='none', mec=TIP, mew=2)
    inset.plot(*truth.T, ':', color=TRUTH, lw=1.4)
    inset.plot(*found[-1], '+', ms=18, color=TIP, mew=2)
    ax.set(xlim=(left, left + side), ylim=(top + side, top))
    inset.set(xlim=found[-1, 0] + np.array([-1, 1]) * INSET_HALF_PX,
              ylim=found[-1, 1] + np.array([1, -1]) * INSET_HALF_PX)
    bar = SCALE_BAR * pixels_per_metre(P, snapshot.points) / side
    begin = 0.96 - bar if free_corner(across, INSET, [c for c in ((1, 1), (0, 1)) if c != corner]) == (1, 1) else 0.04
    for colour, width in ((GROUND, 8), (TRUTH, 4)):     # the dark rim shows it on bright ground
        ax.plot([begin, begin + bar], [0.04, 0.04], color=colour, lw=width, transform=ax.transAxes)
    label = dict(transform=ax.transAxes, ha='center', bbox=dict(facecolor=GROUND, edgecolor='none', alpha=0.7, pad=2))
    ax.text(begin + bar / 2, 0.06, f'{SCALE_BAR * 1e3:g} mm', va='bottom', **label)
    ax.text(0.5, 0.98, f'plane {"AB"[plane]}', va='top', fontsize=14, fontweight='bold', **label)


def window(points_px: np.ndarray, shape: tuple[int, ...]) -> tuple[float, float, float]:
    """Left, top and side (px) of the square around (N, 2) points with a margin, inside the image of `shape` (H, W)
    where that is large enough."""
    low, high = points_px.min(axis=0), points_px.max(axis=0)
    side = min((high - low).max() + 2 * MARGIN_PX, min(shape))
    room = np.array([shape[1], shape[0]]) - side
    left, top = np.clip((low + high - side) / 2, 0, room) - 0.5   # pixel centres are integers: the image begins at -1/2
    return float(left), float(top), float(side)


def backbone(ax, bar_ax, snapshot: Snapshot) -> None:
    """The reconstructed curve against truth in 3-D, in mm; its colour is its distance from the truth."""
    collections = need('mpl_toolkits.mplot3d.art3d', 'plot')
    found, truth = snapshot.points * 1e3, snapshot.truth * 1e3
    off = cKDTree(at_arc_length(truth, np.arange(0.0, arc_length(truth)[-1], 0.05))).query(found)[0]
    both = np.vstack([found, truth])
    middle, half = (both.max(axis=0) + both.min(axis=0)) / 2, np.ptp(both, axis=0) * 0.55
    half = np.maximum(half, 0.5 * half.max())   # room for the ticks of a straight device
    low, high = middle - half, middle + half
    for points, colour in ((found, FOUND), (truth, TRUTH)):     # shadows on floor and wall give the eye depth
        ax.plot(points[:, 0], points[:, 1], low[2], color=colour, lw=1, alpha=0.3)
        ax.plot(points[:, 0], np.full(len(points), high[1]), points[:, 2], color=colour, lw=1, alpha=0.3)
    curve = collections.Line3DCollection(np.stack([found[:-1], found[1:]], axis=1), cmap='cool', lw=5, capstyle='round')
    curve.set_array((off[:-1] + off[1:]) / 2)
    curve.set_clim(0.0, max(0.5, float(off.max())))
    ax.add_collection3d(curve)
    ax.plot(*truth.T, '--', color=TRUTH, lw=1.5, label='truth', zorder=10)
    ax.plot(*found[-1:].T, 'o', color=TIP, ms=9, label='tip found', zorder=11)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]), xlabel='x (mm)', ylabel='y (mm)',
           zlabel='z (mm)')
    ax.set_box_aspect(half, zoom=min(0.9, 0.6 * np.linalg.norm(half) / half[2]))     # a tall box keeps to its axes
    ax.tick_params(labelsize=8)
    ax.patch.set_visible(False)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color((0.10, 0.12, 0.15, 1.0))
        axis.set_major_locator(need('matplotlib.ticker', 'plot').MaxNLocator(4))
    ax.figure.colorbar(curve, cax=bar_ax, label='distance from truth (mm)', orientation='horizontal')
    ax.legend(loc='upper center', ncol=2)


def errors(ax, history: History) -> None:
    """Mean and tip error of every answered pair over time, in mm; marks at the bottom where a pair got no answer."""
    ax.plot(history.t, history.tip * 1e3, '.-', color=TIP, lw=1, ms=6, label='tip')
    ax.plot(history.t, history.mean * 1e3, '.-', color=FOUND, lw=1, ms=6, label='mean over the backbone')
    if len(history.t) and history.tip.max() > 20 * np.median(history.tip):     # a gross error must not hide the others
        ax.set_yscale('log')
    else:
        ax.set_ylim(0, 1.25 * history.tip.max(initial=1e-6) * 1e3)     # room for the legend
    if len(history.unanswered):
        ax.plot(history.unanswered, np.zeros(len(history.unanswered)), '|', color=MISSED, ms=14, mew=1.5,
                label='no answer', clip_on=False, transform=ax.get_xaxis_transform())
    ax.set(xlabel='time (s)', ylabel='error (mm)')
    ax.grid(True)
    ax.legend(loc='upper right', ncol=3)
