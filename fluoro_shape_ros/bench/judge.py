"""How method/judge.py is calibrated: seeded scenes from the wide world, every curve that a search tries in them, and
which of them are right.

No scene says how well it was learnt itself: the last calibration is cross-validated. The more curves were tried in a
scene, the less each of them counts.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from ..config import Config
from ..geometry.cameras import isocenter, pixels_per_metre
from ..imaging.field import common_field
from ..imaging.mask import subtract
from ..imaging.prepare import sheet_of
from ..method.features import MEAN, MEAN_PX, NAMES, TIP, TIP_PX, at_first_sight, features
from ..method.judge import Judge, load, worse
from ..method.search import Search, exclusive
from ..method.tip import tip_of
from ..metrics import compare
from .families import Sources, families, varied

# shares of the scenes
FAMILIES = {'wide': 12, 'wide_anatomy': 13, 'devices': 12, 'ct': 8, 'wide_blank': 3, 'wide_one_plane': 3,
            'wide_unpaired': 1, 'ct_none': 2, 'blank': 3, 'one_plane': 1.5, 'anatomy': 1, 'clutter': 2, 'tangent': 1,
            'crossing': 1, 'occlusion': 0.5, 'entering': 0.5, 'p_xray': 0.5, 'masked': 0.5, 'angles': 0.5}
FIRST_SEED = 20000
RIDGE = 1e-4        # weight of the squared coefficients beside the mean loss: a feature that tells nothing gets none
FOLDS = 5
LEAST = 200             # right curves, and wrong ones, that are needed
LIMITS = 0.5, 0.9, 0.98, 0.99, 0.995, 0.999     # of confidence, in the table


@dataclass(frozen=True)
class Task:
    """A scene to learn from; small, so that it travels to another process."""

    family: str
    seed: int
    sources: Sources


@dataclass(frozen=True)
class Curves:
    """All that a search tried in a scene."""

    family: str
    seed: int
    device: bool
    features: np.ndarray        # (K, len(NAMES))
    right: np.ndarray           # (K,) bool
    clash: np.ndarray           # (K, K) bool: whether at most one of two can be right


def tasks(scenes: int, first_seed: int, sources: Sources) -> list[Task]:
    """What to learn from: `scenes` times the shares of FAMILIES, as far as their sources are there."""
    known = families() | varied(sources)
    return [Task(name, first_seed + k, sources) for name, share in FAMILIES.items() if name in known
            for k in range(round(scenes * share))]


def gather(task: Task) -> Curves | None:
    """Draw a scene and try everything in it, as a search without a clock does where nothing is beyond doubt; None where
    nothing can be drawn from the seed, which is said on stderr."""
    family = (families() | varied(task.sources))[task.family]
    try:
        case = family.make(task.seed)
    except ValueError as error:
        print(f'left out: {task.family}, seed {task.seed}: {error}', file=sys.stderr)
        return None
    scene, device = case.scene, family.device and case.device
    frame, config = scene.frame, Config.from_values(robot_radius=scene.radius,
                                                    base_position=scene.base_position.tolist())
    cv2.setNumThreads(1)
    images = frame.images if case.masks is None else tuple(subtract(i, m) for i, m in zip(frame.images, case.masks))
    fields = [common_field(image, mask) for image, mask in zip(frame.images, case.masks or (None, None))]
    sheet = sheet_of(images, fields, frame.views, config.detection.polarity)
    order = lambda f: tip_of(f.curve(2), tuple(f.open_end), frame.views, fields, config, None)[0]     # noqa: E731
    model = load()

    def sized_up(f) -> tuple[np.ndarray, float, bool]:
        seen, last = features(f, sheet, scene.radius, order(f)), order(f)
        return seen, float(model.log_odds(seen)), last

    search = Search(sheet, scene.radius, config.detection.min_length_px, sized_up, lambda odds: False,
                    first_sight=lambda points: float(model.log_odds(at_first_sight(points, sheet, scene.radius))))
    search.go_on()
    tried = search.tried
    px = float(np.mean([1 / pixels_per_metre(v.P, scene.truth if device else isocenter(frame.views)[None])
                        for v in frame.views]))
    right = [device and is_right(t.fit.curve(200)[::1 if t.tip_is_last else -1], scene.truth, px) for t in tried]
    clash = np.zeros((len(tried), len(tried)), bool)
    for k, j in zip(*np.triu_indices(len(tried), 1)):
        clash[k, j] = clash[j, k] = exclusive(tried[k], tried[j])
    return Curves(task.family, task.seed, device, np.array([t.features for t in tried]).reshape(-1, len(NAMES)),
                  np.array(right, bool), clash)


def is_right(points: np.ndarray, truth: np.ndarray, px: float) -> bool:
    """Whether a curve (N, 3), base to tip, is as near the true one as the confidence promises; `px` is the size of a
    pixel at the device, m."""
    if cKDTree(truth).query(points)[0].mean() > 2 * max(MEAN, MEAN_PX * px):
        return False        # what is far off need not be measured
    errors = compare(points, truth)
    return errors.mean <= max(MEAN, MEAN_PX * px) and errors.tip <= max(TIP, TIP_PX * px)


def learn(scenes: Sequence[Curves]) -> dict:
    """The coefficients, as resource/judge.json has them; the last calibration is of what judges say that learnt from
    the other FOLDS - 1 parts of the scenes."""
    scenes = [s for s in scenes if len(s.right)]
    right = np.concatenate([s.right for s in scenes])
    if right.sum() < LEAST or (~right).sum() < LEAST:
        raise ValueError(f'{right.sum()} right and {(~right).sum()} wrong curves are too few to learn from: '
                         f'{LEAST} of each are needed')
    said = []
    for k in range(FOLDS):
        judge = _fitted([s for s in scenes if s.seed % FOLDS != k])
        said += [chosen_of(judge, s) for s in scenes if s.seed % FOLDS == k]
    judge, (offset, slope) = _fitted(scenes), calibrate(said)
    terms = {name: dict(typical=round(float(t), 4), scale=round(float(s), 4), near=round(float(n), 4),
                        far=round(float(f), 4))
             for name, t, s, n, f in zip(NAMES, judge.typical, judge.scale, judge.near, judge.far)}
    return dict(scenes=_counts(scenes), bias=round(judge.bias, 4), features=terms, offset=round(offset, 4),
                slope=round(slope, 4))


def _fitted(scenes: Sequence[Curves]) -> Judge:
    """The judge that these scenes teach, not calibrated yet: weighted logistic regression with weights of one sign."""
    X, right = np.concatenate([s.features for s in scenes]), np.concatenate([s.right for s in scenes])
    share = np.concatenate([np.full(len(s.right), 1 / np.sqrt(len(s.right))) for s in scenes])
    share /= share.sum()
    typical = np.nanmedian(X[right], axis=0)    # what is not known is NaN
    scale = np.maximum(1.4826 * np.nanmedian(np.abs(X[right] - typical), axis=0), 0.25 * np.nanstd(X, axis=0) + 1e-6)
    parts = -np.concatenate(worse(X, typical, scale), axis=1)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        z = w[0] + parts @ w[1:]
        p = 1 / (1 + np.exp(-np.clip(z, -40, 40)))
        slope = share * (p - right)
        return (share @ np.logaddexp(0, np.where(right, -z, z)) + RIDGE * w[1:] @ w[1:],
                np.append(slope.sum(), parts.T @ slope + 2 * RIDGE * w[1:]))

    bounds = [(None, None)] + [(0, None)] * parts.shape[1]
    w = minimize(loss, np.zeros(1 + parts.shape[1]), jac=True, bounds=bounds, method='L-BFGS-B',
                 options=dict(maxiter=5000, maxfun=10000)).x
    near, far = np.split(w[1:], 2)
    return Judge(float(w[0]), typical, scale, near, far, 0.0, 1.0)


def calibrate(said: Sequence[tuple[float, bool]]) -> tuple[float, float]:
    """Offset and slope of Platt's calibration of probabilities, each with whether it was right."""
    z, right = np.array([np.log(p / (1 - p)) for p, _ in said]), np.array([r for _, r in said])
    loss = lambda w: float(np.logaddexp(0, np.where(right, -1, 1) * (w[0] + w[1] * z)).sum()    # noqa: E731
                           + 0.05 * (w[0]**2 + (w[1] - 1)**2))
    return tuple(float(x) for x in minimize(loss, [0.0, 1.0], method='Nelder-Mead').x)


def table(judge: Judge, scenes: Sequence[Curves]) -> str:
    """What the judge makes of scenes, by family: how often a right curve was tried, chosen, and published with a given
    confidence, and how many wrong ones."""
    lines = [f'{"":15s} scenes   tried  chosen   published right, wrong with min_confidence '
             + '  '.join(f'{c:g}' for c in LIMITS)]
    chosen = [(s, *(chosen_of(judge, s) if len(s.right) else (0.0, False))) for s in scenes]
    for family in dict.fromkeys(s.family for s in scenes):
        mine = [(s, judge.confidence(p) if len(s.right) else 0.0, right)
                for s, p, right in chosen if s.family == family]
        counts = '   '.join(f'{sum(r and c >= least for _, c, r in mine):4d} '
                            f'{sum(not r and c >= least for _, c, r in mine):2d}' for least in LIMITS)
        lines.append(f'{family:15s} {len(mine):6d} {sum(bool(s.right.any()) for s, _, _ in mine):7d} '
                     f'{sum(r for *_, r in mine):7d}   {counts}')
    return '\n'.join(lines)


def _counts(scenes: Sequence[Curves]) -> dict:
    """How many scenes of each family there were, with which seeds, and how many right and wrong curves in them."""
    return {family: dict(scenes=len(mine), seeds=[min(s.seed for s in mine), max(s.seed for s in mine)],
                         right=int(sum(s.right.sum() for s in mine)), wrong=int(sum((~s.right).sum() for s in mine)))
            for family in dict.fromkeys(s.family for s in scenes)
            if (mine := [s for s in scenes if s.family == family])}


def chosen_of(judge: Judge, scene: Curves) -> tuple[float, bool]:
    """The probability of the likeliest curve beside its rivals, as search.choose has it, and whether it is right."""
    odds = judge.log_odds(scene.features)
    order = np.argsort(-odds, kind='stable')
    rivals: list[int] = []
    for k in order[1:]:
        if all(scene.clash[k, r] for r in (order[0], *rivals)):
            rivals.append(int(k))
    o = np.exp(np.clip(odds[[order[0], *rivals]], -30, 30))
    return float(np.clip(o[0] / (1 + o.sum()), 1e-12, 1 - 1e-12)), bool(scene.right[order[0]])
