"""What a kinematic model's prediction is worth: the first pair of a scene with a good one, without, and with wrong
ones."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from ..config import Config
from ..data import Prior, Reconstruction
from ..geometry.curve import arc_length
from ..method.pipeline import reconstruct
from ..metrics import compare
from ..sim.kinematics import loaded
from ..sim.shapes import random_cannula
from .families import Case, families
from .score import Answer, answer_of

FAMILIES = ('low_dose', 'faint', 'clutter', 'crossing')
PUSHED = 0.015              # m, by which tissue pushes the tip aside, at most; at least half of it
SHIFT = 0.050               # m
SAME = 0.02e-3              # m, between two answers that are the same
WITHOUT, GOOD = 'without', 'good'
POSES = 50                  # of a prediction


@dataclass(frozen=True)
class Try:
    """An answer with a prediction of one kind, beside that without."""

    answer: Answer
    seconds: float
    difference: float       # m, of the backbones; NaN where one of the two is missing, 0 where both are
    fate: str               # what the reconstruction says became of the prediction


def pushed(points: np.ndarray, by: float, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) a backbone whose tip a load has moved by `by` m, across its direction there."""
    tangent = points[-1] - points[-2]
    aside = np.cross(tangent, rng.normal(size=3))
    load = aside / np.linalg.norm(aside) * 3 * by / arc_length(points)[-1] ** 3
    once = np.linalg.norm(loaded(points, load)[-1] - points[-1])
    return loaded(points, load * by / once)


def predictions(truth: np.ndarray, seed: int) -> dict[str, np.ndarray | None]:
    """Kind to (POSES, 3) points, m: what a model could say of a robot that is (N, 3) `truth`, base to tip."""
    rng = np.random.default_rng([seed, 7])
    good = pushed(truth, PUSHED * rng.uniform(0.5, 1), rng)
    base, ahead = truth[0], truth[1] - truth[0]
    across = np.cross(ahead, rng.normal(size=3))
    across /= np.linalg.norm(across)
    aside = rng.normal(size=3)
    other = random_cannula(rng, 0.12).backbone()
    turn, _ = Rotation.align_vectors((ahead / np.linalg.norm(ahead))[None],
                                     (other[1] - other[0])[None] / np.linalg.norm(other[1] - other[0]))
    kinds = {WITHOUT: None, GOOD: good,
             'mirrored': base + (good - base) - 2 * ((good - base) @ across)[:, None] * across,
             'shifted': good + SHIFT * aside / np.linalg.norm(aside),
             'reversed': good[::-1],
             'another': base + turn.apply(other - other[0])}
    return {kind: None if points is None else points[np.linspace(0, len(points) - 1, POSES).round().astype(int)]
            for kind, points in kinds.items()}


def tries(case: Case, rounds: int) -> dict[str, Try]:
    """Kind of prediction to what came of it; timed `rounds` times in turns, the fastest counts."""
    scene = case.scene
    config = Config.from_values(robot_radius=scene.radius, base_position=scene.base_position.tolist())
    given = predictions(scene.truth, scene.seed)
    results, seconds = {}, {kind: [] for kind in given}
    for _ in range(rounds):
        for kind, points in given.items():
            start = time.perf_counter()
            results[kind] = reconstruct(scene.frame, config, Prior(masks=case.masks, predicted=points))
            seconds[kind].append(time.perf_counter() - start)
    return {kind: Try(answer_of(case, result), min(seconds[kind]), _difference(result, results[WITHOUT]),
                      result.prediction)
            for kind, result in results.items()}


def _difference(one: Reconstruction, other: Reconstruction) -> float:
    if one.shape is None or other.shape is None:
        return 0.0 if one.outcome is other.outcome else float('nan')
    errors = compare(one.shape.points, other.shape.points)
    return max(errors.worst, errors.tip)


def report(names: list[str], count: int, first_seed: int, rounds: int) -> str:
    """The table: a row a family and kind of prediction."""
    lines = [f'{"family":10s} {"prediction":10s} {"answered":>8s} {"within":>7s} {"silent":>6s} {"mean mm":>8s} '
             f'{"tip mm":>7s} {"cost":>5s} {"same":>8s} {"differs mm":>10s}  what became of it']
    for name in names:
        done = [tries(families()[name].make(first_seed + k), rounds)
                for k in tqdm(range(count), name, unit='scene', disable=None, leave=False)]
        lines += [_line(name, kind, [d[kind] for d in done], [d[WITHOUT] for d in done]) for kind in done[0]]
    return '\n'.join([*lines, '', LEGEND])


LEGEND = f"""\
within     mean <= 0.3 mm and tip <= 1 mm; mean and tip: mean errors of the answers
cost       time without a prediction over time with it, median; the first pair, so nothing is tracked
same       answers that equal those without within {SAME * 1e3:g} mm everywhere, or rejected alike;
           differs: the most that two answers differ
good       the robot's tip is pushed {PUSHED * 500:g} to {PUSHED * 1000:g} mm from where the model has it;
           the wrong ones are made from it"""


def _line(family: str, kind: str, done: list[Try], without: list[Try]) -> str:
    answers = [t.answer for t in done]
    errors = [a.errors for a in answers if a.errors]
    mean, tip = (1e3 * np.mean([getattr(e, n) for e in errors]) if errors else float('nan') for n in ('mean', 'tip'))
    cost = np.median([b.seconds / a.seconds for a, b in zip(done, without)])
    fates = Counter(t.fate.split(':')[0] for t in done if t.fate)
    differences = [t.difference for t in done]
    return (f'{family:10s} {kind:10s} {sum(a.published for a in answers):3d} of {len(done):<2d} '
            f'{sum(a.within for a in answers):7d} {sum(a.silent_failure for a in answers):6d} {mean:8.3f} {tip:7.3f} '
            f'{cost:5.2f} {sum(d <= SAME for d in differences):2d} of {len(done):<2d} '
            f'{1e3 * np.nanmax(differences, initial=0.0):10.3f}  '
            + ', '.join(f'{n} {fate}' for fate, n in fates.most_common())).rstrip()
