"""Whether the calibrations of both planes belong together, told from where each plane by itself sees the device's ends,
bands and bends, over a run.

A place that both planes see must lie on its epipolar line in plane B. By how many px it lies beside it is a linear
function of what is wrong: a plane is shifted, turned about its image's centre, or as a whole too large. What else moves
it is known by size: noise, and a bias of each kind of landmark that stays the same over a run. So the odds that
something is wrong are a ratio of two Gaussian integrals in closed form (a Bayes factor). By Ville's inequality it
exceeds 1 / FALSE_ALARM in at most that share of the runs whose calibrations are right, however often it is looked at.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable
from dataclasses import dataclass, replace

import numpy as np

from ..data import Landmarks, Reconstruction, View
from ..geometry.cameras import epipolar_lines, fundamental

FALSE_ALARM = 1e-2      # share of the runs with right calibrations in which it cries, at most, by the model (drawn from
                        # that: 1 of 1800)
RATHER = 0.5            # confidence of a curve, refused or not, from which on its landmarks count
BLOCK = 5               # landmarks of a kind, successive ones, of which the middle one counts: some are wrong ...
TOGETHER = 2            # ... and as they look alike, it is worth no more than so many of them
MEMORY = 200            # observations after which what was seen counts a third as much
PLACE_PX = 0.1          # what a landmark is worth at best
KINDS = 'tip', 'base', 'steps', 'bend'
# What may be wrong, and its typical size where it is: px, rad, rad, a share; where it is not it is as good as
# calibrations are
WRONG = {'shifted': (3.0, 0.1), 'turned a': (0.03, 3.5e-4), 'turned b': (0.03, 3.5e-4), 'scaled': (0.02, 4e-4)}
BIAS = 0.5, 0.5, 0.5, 0.15      # of each kind, in its own standard deviations (measured: 0.3 to 0.5); of a bend px
EVEN = np.log(20)       # log odds from which on one explanation is better than another


@dataclass(frozen=True)
class Finding:
    """What a run says of the calibrations."""

    pairs: int = 0
    noticed: bool = False
    apart_px: float | None = None   # by how much the planes' landmarks lie beside their epipolar lines, typically,
                                    # biases taken off; None: not known yet
    sigma_px: float | None = None
    looks_like: str = ''            # what explains it best; empty where several do

    def __str__(self) -> str:
        if self.apart_px is None:
            return f'too little seen yet to tell ({self.pairs} pairs)'
        over = f'across the epipolar lines over {self.pairs} pairs'
        if not self.noticed:
            return f'nothing noticed: the planes agree within {self.apart_px + 2 * self.sigma_px:.1f} px {over}'
        like = f', {self.looks_like}' if self.looks_like else ''
        return (f'the planes disagree by {self.apart_px:.1f} px +- {max(self.sigma_px, 0.05):.1f} {over}{like}: '
                'check the calibration')


class CalibrationWatch:
    """Takes the results of a run, one after another; `finding` is what they say. May be told and asked from any
    thread."""

    finding: Finding
    _waiting: dict[str, list]                   # by kind, landmarks that are not yet a BLOCK, as given and exchanged
    _evidence: tuple[Evidence, Evidence]        # with the calibrations as given, and exchanged

    def __init__(self):
        self._lock, self._cameras = threading.Lock(), None
        self._begin()

    def reset(self) -> None:
        """Begin anew."""
        with self._lock:
            self._begin()

    def take(self, result: Reconstruction, views: tuple[View, View], cameras: Hashable) -> None:
        """The answer to one more pair, and its views. Where the `cameras` are others than those before it begins
        anew."""
        with self._lock:
            if cameras != self._cameras:
                self._cameras = cameras
                self._begin()
            if result.landmarks is None or not result.landmarks.kinds or not result.confidence >= RATHER:
                return
            self.finding = replace(self.finding, pairs=self.finding.pairs + 1)
            as_given, exchanged = observed(result.landmarks, views), observed(result.landmarks, views[::-1])
            for kind, *rows in zip(result.landmarks.kinds, as_given, exchanged):
                waiting = self._waiting[kind]
                waiting.append(rows)
                if len(waiting) == BLOCK:
                    for evidence, block in zip(self._evidence, zip(*waiting)):
                        evidence.add(*_typical(np.stack(block)))
                    waiting.clear()
                    self.finding = judged(self.finding, *self._evidence)

    def _begin(self) -> None:
        self.finding, self._waiting, self._evidence = Finding(), {kind: [] for kind in KINDS}, (Evidence(), Evidence())


class Evidence:
    """Sums of observations y = row . (what is wrong, biases) + noise, that are all one needs to know of them."""

    def __init__(self):
        n = len(WRONG) + len(KINDS)
        self.information, self.pull, self.surprise, self.weight = np.zeros((n, n)), np.zeros(n), 0.0, 0.0

    def add(self, y: float, sigma: float, row: np.ndarray) -> None:
        """One observation."""
        old = np.exp(-1 / MEMORY)
        self.information = old * self.information + np.outer(row, row) / sigma**2
        self.pull = old * self.pull + row * y / sigma**2
        self.surprise = old * self.surprise + y * y / sigma**2 + 2 * np.log(sigma)
        self.weight = old * self.weight + 1 / sigma**2

    def log_likelihood(self, size: np.ndarray) -> float:
        """Of all observations, if the unknowns have standard deviations `size` (n,), integrated over them; up to a
        constant."""
        return 0.5 * float(self.pull @ self.likeliest(size) - np.linalg.slogdet(self._given(size))[1] - self.surprise)

    def likeliest(self, size: np.ndarray) -> np.ndarray:
        """(n,) the unknowns, where they have standard deviations `size`."""
        return size * np.linalg.solve(self._given(size), size * self.pull)

    def apart(self, size: np.ndarray) -> tuple[float, float]:
        """px that landmarks lie beside their lines, root mean square of what is wrong alone, and its standard
        deviation."""
        covariance = size[:, None] * np.linalg.inv(self._given(size)) * size
        wrong = slice(len(WRONG))
        mean, part = (covariance @ self.pull)[wrong], self.information[wrong, wrong] / self.weight
        apart = float(np.sqrt(mean @ part @ mean))
        slope = part @ mean / max(apart, 1e-9)
        return apart, float(np.sqrt(slope @ covariance[wrong, wrong] @ slope))

    def _given(self, size: np.ndarray) -> np.ndarray:
        """(n, n) information on the unknowns in their standard deviations, with what is known of them beforehand."""
        return np.eye(len(size)) + size[:, None] * self.information * size


def judged(before: Finding, as_given: Evidence, exchanged: Evidence) -> Finding:
    """What the evidence says now, of at least one observation with the calibrations as given and exchanged."""
    nothing = as_given.log_likelihood(_size())
    odds = {what: as_given.log_likelihood(_size(what)) - nothing for what in (*WRONG, '')}
    odds['exchanged'] = exchanged.log_likelihood(_size()) - nothing
    total = float(np.logaddexp.reduce(list(odds.values())) - np.log(len(odds)))
    # what was noticed is not taken back at once
    noticed = bool(total > -np.log(FALSE_ALARM)) or before.noticed and total > 0
    everything, (best, second) = odds.pop(''), sorted(odds, key=odds.get)[:-3:-1]
    best = '' if everything - odds[best] > EVEN else best if odds[best] - odds[second] > EVEN else None
    return Finding(before.pairs, noticed, *as_given.apart(_size(*WRONG)),
                   _in_words(best, as_given) if noticed and best is not None else '')


def _in_words(what: str, evidence: Evidence) -> str:
    """What explains the evidence: one of WRONG, '' (all of it) or exchanged planes."""
    if what not in WRONG:
        return ('and would agree if the calibrations were exchanged'
                if what else 'by more than a shift, a turn or a scale alone')
    by = abs(evidence.likeliest(_size(what))[list(WRONG).index(what)])
    return {'shifted': f'as if one were shifted by {by:.1f} px',
            'scaled': f'as if one were {100 * by:.1f} % too large'}.get(
                what, f'as if plane {what[-1].upper()} were turned by {np.rad2deg(by):.1f} degrees')


def _size(*wrong: str) -> np.ndarray:
    """(n,) standard deviations of the unknowns where so much is wrong; '': all of it."""
    return np.array([off if what in wrong or '' in wrong else right for what, (off, right) in WRONG.items()]
                    + list(BIAS))


def observed(landmarks: Landmarks, views: tuple[View, View]) -> np.ndarray:
    """(N, 2 + n): for each landmark the px by which it lies beside its epipolar line in plane B, their standard
    deviation, and how they depend on each unknown."""
    Pa, Pb = (v.P for v in views)
    F = fundamental(Pa, Pb)
    lines, back = epipolar_lines(F, landmarks.a_px), epipolar_lines(F.T, landmarks.b_px)
    normal_b, normal_a = lines[:, :2], back[:, :2]
    apart = (normal_b * landmarks.b_px).sum(axis=1) + lines[:, 2]
    finer = _steepness(F.T, landmarks.b_px) / _steepness(F, landmarks.a_px)     # px in plane B for one in plane A
    (ua, va), (ub, vb) = ((px - [(v.width - 1) / 2, (v.height - 1) / 2]).T
                          for px, v in zip((landmarks.a_px, landmarks.b_px), views))
    turned_a = finer * (normal_a[:, 1] * ua - normal_a[:, 0] * va)
    turned_b = normal_b[:, 1] * ub - normal_b[:, 0] * vb
    scaled = normal_b[:, 0] * ub + normal_b[:, 1] * vb
    slack = (normal_b * landmarks.slack_px).sum(axis=1)
    slack = np.where(slack < 0, -1, 1) * np.hypot(slack, PLACE_PX)
    bias = (np.array([[kind == k for k in KINDS] for kind in landmarks.kinds], float)
            * np.where(np.array(landmarks.kinds) == 'bend', 1.0, slack)[:, None])
    return np.column_stack([apart, np.abs(slack), np.ones(len(apart)), turned_a, turned_b, scaled, bias])


def _steepness(F: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """(N,) by how much x' F x grows for a px across the epipolar lines of (N, 2) points."""
    return np.linalg.norm(points_px @ F[:2, :2].T + F[:2, 2], axis=1)


def _typical(rows: np.ndarray) -> tuple[float, float, np.ndarray]:
    """The middle one of (N, 2 + n) observations of successive pairs, worth as much as they agree."""
    middle = rows[np.argsort(rows[:, 0])[len(rows) // 2]]
    scatter = 1.4826 * float(np.median(np.abs(rows[:, 0] - middle[0])))
    return float(middle[0]), max(float(np.median(rows[:, 1])), scatter) / np.sqrt(TOGETHER), middle[2:]
