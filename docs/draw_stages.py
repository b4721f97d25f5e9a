"""Draws docs/stages.png: one simulated pair on its way through the pipeline's own stages. `python docs/draw_stages.py`,
where the package is installed with `plot`."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Reconstruction
from fluoro_shape_ros.files.pictures import MISSED, STYLE, TEXT, TIP, TRUTH
from fluoro_shape_ros.geometry.cameras import project, source
from fluoro_shape_ros.imaging.field import field_of_view
from fluoro_shape_ros.imaging.lines import Candidate
from fluoro_shape_ros.imaging.prepare import sheet_of
from fluoro_shape_ros.imaging.strips import Sheet, cut
from fluoro_shape_ros.method import judge
from fluoro_shape_ros.method.features import NAMES, features
from fluoro_shape_ros.method.fit.fit import fit
from fluoro_shape_ros.method.fit.result import Fit
from fluoro_shape_ros.method.pipeline import reconstruct
from fluoro_shape_ros.method.propose.lines import Hypothesis, by_lines, candidates
from fluoro_shape_ros.overlay import EPIPOLAR, FOUND, grey_levels
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import Scene, xray_run

SEED, SIZE = 104, 1024
PROPOSED = 8            # hypotheses that are fitted here
SIDE = 339              # px of an image on the sheet
GREYS, COLOURS = 32, 128    # of an image, of the sheet: noise would make it large
REACH_PX = 30.0         # to either side of the curve, in the picture of the strips
DIM, FAINT = 0.35, 0.3  # of what lies outside the field of view, of an image under lines
TITLE = dict(fontsize=13, fontweight='bold')


@dataclass(frozen=True)
class Stages:
    """What each stage made of a pair."""

    scene: Scene
    fields: tuple[np.ndarray, np.ndarray]               # (H, W) uint8
    sheet: Sheet
    lines: tuple[list[Candidate], list[Candidate]]      # best first
    hypotheses: list[Hypothesis]
    fits: list[tuple[Fit, np.ndarray]]                  # with its features; the likeliest first
    answer: Reconstruction


def a_pair(seed: int, size: int) -> Scene:
    """A rod that comes in through the border, before anatomy, beside a wire and between blades; the field is as large
    whatever the `size` in px."""
    arm = CArm(pixel_size_iso=0.3e-3 * SIZE / size, width=size, height=size)
    return xray_run(seed, views=biplane(arm=arm), clutter=('wire', 'blades'), entering=True).scene()


def stages(scene: Scene) -> Stages:
    """The stages of pipeline.reconstruct one by one, where nothing was known before; and its answer."""
    config = Config.from_values(robot_radius=scene.radius, base_position=tuple(map(float, scene.base_position)))
    fields = tuple(field_of_view(image) for image in scene.frame.images)
    sheet = sheet_of(scene.frame.images, fields, scene.frame.views, config.detection.polarity)
    lines = candidates(sheet, scene.radius, config.detection.min_length_px, faint=False)
    hypotheses = list(islice(by_lines(scene.frame.views, lines), PROPOSED))
    fits = [f for f in (fit(sheet, h.curve, scene.radius, h.coarse) for h in hypotheses) if f is not None]
    seen = [(f, features(f, sheet, scene.radius, _tip_is_last(f, scene))) for f in fits]
    return Stages(scene, fields, sheet, lines, hypotheses, sorted(seen, key=lambda s: -judge.load().log_odds(s[1])),
                  reconstruct(scene.frame, config))


def _tip_is_last(f: Fit, scene: Scene) -> bool:
    first, last = np.linalg.norm(f.curve(2) - scene.base_position, axis=1)
    return bool(last > first)


def draw(done: Stages, file: Path) -> None:
    """Write the picture as PNG."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(14, 13), dpi=100)
        side, tall = SIDE / 1400, SIDE / 1300
        for v in (0, 1):
            bottom = 0.692 - 0.272 * v
            pair, lines, curves = (figure.add_axes((0.005 + 0.247 * k, bottom, side, tall)) for k in range(3))
            _pair(pair, done, v)
            _lines(lines, done, v)
            _curves(curves, done, v)
            _strips(figure.add_axes((0.785, bottom, 0.09, tall)),
                    figure.add_axes((0.885, bottom, 0.105, tall)), done, v)
        for x, title in ((0.005, '1  images, fields of view'), (0.252, '2  propose: lines in each image'),
                         (0.499, '3  propose: curves in space'), (0.752, '4  fit: strips along a curve')):
            figure.text(x, 0.967, title, **TITLE)
        figure.text(0.005, 0.362, '5  judge: what speaks against a curve, in log odds', **TITLE)
        figure.text(0.57, 0.362, f'6  publish: backbone and tip, confidence {done.answer.confidence:.3f}', **TITLE)
        _judged(figure.add_axes((0.265, 0.035, 0.27, 0.315)), done)
        _backbone(figure.add_axes((0.58, 0.0, 0.4, 0.36), projection='3d'), done)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
    _few_colours(np.asarray(canvas.buffer_rgba())[..., :3]).save(file, optimize=True)


def _few_colours(picture: np.ndarray) -> Image.Image:
    """The (H, W, 3) RGB picture in COLOURS colours; those of thin lines would get lost among greys, if they did not
    stand beside it in full."""
    beside = np.concatenate([np.full((40, picture.shape[1], 3), [int(c[k:k + 2], 16) for k in (1, 3, 5)], np.uint8)
                             for c in (TIP, EPIPOLAR, FOUND, MISSED)])
    palette = Image.fromarray(np.concatenate([picture, beside])).quantize(COLOURS)
    return Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)


def _image(ax, done: Stages, v: int, brightness: float = 1.0) -> None:
    """The image of plane `v`, darker outside its field of view."""
    image = done.scene.frame.images[v]
    h, w = image.shape
    black, white = grey_levels(image)
    grey = np.clip((image.astype(np.float32) - black) / (white - black), 0, 1) * np.where(done.fields[v] > 0,
                                                                                          brightness, DIM * brightness)
    small = np.round(cv2.resize(grey, (SIDE, SIDE), interpolation=cv2.INTER_AREA) * GREYS) / GREYS
    ax.imshow(small, cmap='gray', vmin=0, vmax=1, interpolation='nearest', extent=(-0.5, w - 0.5, h - 0.5, -0.5))
    ax.set(xticks=[], yticks=[])
    ax.autoscale(False)


def _pair(ax, done: Stages, v: int) -> None:
    _image(ax, done, v)
    ax.contour(done.fields[v] > 0, levels=[0.5], colors=[MISSED], linewidths=1.2)
    ax.text(0.03, 0.97, f'plane {"AB"[v]}', transform=ax.transAxes, va='top', fontsize=13,
            bbox=dict(facecolor='black', edgecolor='none', alpha=0.6, pad=2))


def _lines(ax, done: Stages, v: int) -> None:
    """What is as wide as the device; the more a line's profile is that of one, the thicker it is drawn."""
    _image(ax, done, v, FAINT)
    for line in done.lines[v][::-1]:
        share = line.score / max(other.score for other in done.lines[v])
        ax.plot(*line.points_px.T, color=MISSED, lw=0.8 + 2.2 * share, alpha=0.4 + 0.6 * share)


def _curves(ax, done: Stages, v: int) -> None:
    """First curves, projected; the likeliest fit; and where the other plane says that its tip must be."""
    _image(ax, done, v, FAINT)
    view, other = done.scene.frame.views[v], done.scene.frame.views[1 - v]
    for h in done.hypotheses:
        ax.plot(*project(view.P, h.curve).T, color=TEXT, lw=1.2)
    ax.plot(*project(view.P, done.fits[0][0].curve(200)).T, color=FOUND, lw=2.2, label='the likeliest')
    tip, beam = done.answer.shape.tip, source(other.P)
    ray = beam + np.linspace(0.7, 1.3, 50)[:, None] * (tip - beam)
    ax.plot(*project(view.P, ray).T, '--', color=EPIPOLAR, lw=1.2, label=f'the ray of plane {"BA"[v]} to its tip')
    ax.plot(*project(view.P, tip), 'o', ms=11, mfc='none', mec=TIP, mew=2)
    ax.legend(loc='lower left', fontsize=9)


def _strips(ax, beside, done: Stages, v: int) -> None:
    """The image straightened along the likeliest curve, each strip less its median, and how dark the device is in
    each."""
    f = done.fits[0][0]
    profiles = cut(done.sheet, *f.spline.lines(f.s), REACH_PX).profiles[v]
    profiles = cv2.resize(profiles - np.median(profiles, axis=1, keepdims=True), (126, SIDE),
                          interpolation=cv2.INTER_AREA)
    low, high = np.percentile(profiles, (0.5, 99.5))
    s = (f.s - f.start) * 1e3
    ax.imshow(np.round(np.clip((profiles - low) / (high - low), 0, 1) * GREYS), cmap='gray', aspect='auto',
              extent=(-REACH_PX, REACH_PX, s[-1], s[0]), interpolation='nearest')
    beside.plot(np.clip(f.presence[:, v], -0.5, 2), s, color=FOUND, lw=0.8)
    for at in (0.0, (f.stop - f.start) * 1e3):
        for axes in (ax, beside):
            axes.axhline(at, color=TIP, lw=1.5)
    ax.set(ylim=(s[-1], s[0]), xlabel='px across' if v else '', xticks=[-20, 0, 20],
           xticklabels=['-20', '0', '20'] if v else [])
    ax.set_ylabel('mm along it', labelpad=0)
    beside.set(xlim=(-0.5, 2), ylim=(s[-1], s[0]), yticks=[], xticks=[0, 1], xticklabels=['0', '1'] if v else [],
               xlabel='as dark as usual' if v else '')
    beside.grid(True, axis='x')


def _judged(ax, done: Stages) -> None:
    """What each feature takes from the log odds of the likeliest curve and of the next one."""
    model = judge.load()
    for k, (colour, name, (_, x)) in enumerate(zip((FOUND, MISSED), ('the likeliest', 'the next one'), done.fits)):
        terms = model.terms(x)
        ax.barh(np.arange(len(NAMES)) + 0.4 * k - 0.2, terms, 0.36, color=colour,
                label=f'{name}: {model.bias:+.1f} {terms.sum():+.1f} = {model.bias + terms.sum():+.1f}')
    ax.set(yticks=range(len(NAMES)), ylim=(len(NAMES) - 0.4, -0.6))
    ax.set_yticklabels([judge.REASONS[name] for name in NAMES], fontsize=9)
    ax.grid(True, axis='x')
    ax.legend(loc='lower left', fontsize=9)


def _backbone(ax, done: Stages) -> None:
    """The published backbone and the true one, in mm, with the rays of both planes to the tip."""
    points, truth, tip = done.answer.shape.points * 1e3, done.scene.truth * 1e3, done.answer.shape.tip
    half = 0.6 * np.ptp(truth, axis=0).max()
    for view, name in zip(done.scene.frame.views, 'AB'):
        beam = source(view.P) - tip
        ray = np.stack([tip, tip + beam / np.linalg.norm(beam) * half * 0.8e-3]) * 1e3
        ax.plot(*ray.T, '--', color=EPIPOLAR, lw=1.2)
        ax.text(*ray[1], f' to source {name}', color=EPIPOLAR, fontsize=9)
    ax.plot(*points.T, color=FOUND, lw=3.5, label='backbone')
    ax.plot(*truth.T, '--', color=TRUTH, lw=1.2, label='truth', zorder=10)
    ax.plot(*points[-1:].T, 'o', color=TIP, ms=8, label='tip', zorder=11)
    middle = (truth.max(axis=0) + truth.min(axis=0)) / 2
    ax.set(**{f'{axis}lim': (m - half, m + half) for axis, m in zip('xyz', middle)}, xlabel='x (mm)', ylabel='y (mm)',
           zlabel='z (mm)')
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color('#1b2129')
    ax.tick_params(labelsize=8)
    ax.legend(loc='upper right', fontsize=9)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--out', type=Path, default=Path(__file__).with_name('stages.png'),
                        help='default: beside this file')
    parser.add_argument('--seed', type=int, default=SEED)
    parser.add_argument('--size', type=int, default=SIZE, help='of the images, px (default: %(default)s)')
    args = parser.parse_args(argv)
    draw(stages(a_pair(args.seed, args.size)), args.out)
    return 0


if __name__ == '__main__':
    sys.exit(main())
