"""How likely a fitted curve is right: one calibrated model of what the images say of it, and the words for what speaks
against it.

Logistic regression (Cox 1958) on how much worse each feature x is than it typically is of right curves, in scales that
they differ by,

    u_k = min(max(sign_k (typical_k - x_k) / scale_k, 0), LIMIT)
    ln odds = bias - sum_k (near_k max(u_k - NEAR, 0) + far_k max(u_k - FAR, 0)),     near_k, far_k >= 0,

so that nothing makes up for what speaks against a curve: a tip that is uncertain stays so however dark the device is.
The coefficients stand in resource/judge.json, made by `fluoro_shape_bench judge` from seeded scenes that are named
there. The best of several curves is right with the probability that `search.choose` gives, once more calibrated: ln
odds -> offset + slope ln odds (Platt 1999).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..resources import resource_path
from .features import NAMES

# confidences from which on nothing else is tried, unless min_confidence asks for more: no other line in the whole
# images, where a better one may not have been tried yet, and none beside a curve near where the device was
BEYOND_DOUBT, STILL_THERE = 0.98, 0.97
FLUCTUATES = 1.0        # nats that the odds of one curve vary by from pair to pair, as noise and background do
PREDICTED = 1.0         # what a prediction that a curve bears out adds to its log odds
# scales: what is worse by less says nothing, by more it says more, and in the end no more
NEAR, FAR, LIMIT = 0.7, 2.0, 6.0
# +1: the more the likelier it is right, -1: the less
SIGNS = dict(weakest=1, seen=1, symmetric=-1, wide=-1, narrow=-1, residual=-1, sigma=-1, uneven=-1, tip_stops=1,
             base_stops=1, tip_sigma=-1, base_sigma=-1, tip_apart=-1, base_apart=-1, tip_aside=-1, tip_farther=-1,
             no_tip=-1, no_base=-1, length=1, restless=-1)
REASONS = dict(
    weakest='part of it hardly stands out from what lies beside it',
    seen='one plane does not show all of it', symmetric='one side of it is darker than the other, as at an edge',
    wide='it looks wider than robot_radius', narrow='it looks narrower than robot_radius',
    residual='the planes disagree where it runs', sigma='its course is uncertain',
    uneven='it bends more abruptly than devices do',
    tip_stops='one plane shows it going on past its tip', base_stops='one plane shows it going on past its base',
    tip_sigma='where its tip is, is uncertain', base_sigma='where its base is, is uncertain',
    tip_apart='the planes hardly see its tip at one place', base_apart='the planes hardly see its base at one place',
    tip_aside='a line goes on beside its tip', tip_farther='it goes on past its tip',
    no_tip='it leaves the field at both ends',
    no_base='its base, outside the field, cannot confirm that both planes show one device',
    length='it is short', restless='the fit has not come to rest')


@dataclass(frozen=True)
class Judge:
    """The calibrated model; arrays in the order of features.NAMES."""

    bias: float
    typical: np.ndarray
    scale: np.ndarray
    near: np.ndarray
    far: np.ndarray
    offset: float
    slope: float

    def terms(self, features: np.ndarray) -> np.ndarray:
        """(..., len(NAMES)) what each feature adds to the log odds; what is not known (NaN) nothing."""
        beyond_near, beyond_far = worse(features, self.typical, self.scale)
        return -(self.near * beyond_near + self.far * beyond_far)

    def log_odds(self, features: np.ndarray) -> np.ndarray:
        """(...) of (..., len(NAMES)) features: that one curve alone is right."""
        return self.bias + self.terms(features).sum(axis=-1)

    def confidence(self, probability: float) -> float:
        """The calibrated probability that the chosen one of several curves is right."""
        p = np.clip(probability, 1e-9, 1 - 1e-9)
        return float(1 / (1 + np.exp(-(self.offset + self.slope * np.log(p / (1 - p))))))

    def settles(self, log_odds: float, least: float) -> bool:
        """Whether a curve with these odds, if nothing else is found, has at least the confidence `least`."""
        return self.confidence(probability(log_odds)) >= least

    def why(self, features: np.ndarray, log_odds: float, p: float) -> str:
        """What speaks most against a curve with these odds that has the probability `p` beside others, in words."""
        if p < 0.5 * probability(log_odds):
            return 'another curve explains both images about as well'
        return REASONS[NAMES[int(self.terms(features).argmin())]]


def worse(features: np.ndarray, typical: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(..., len(NAMES)) scales by which features are worse than typical ones, beyond NEAR and beyond FAR."""
    u = np.clip(np.nan_to_num(np.array([SIGNS[name] for name in NAMES]) * (typical - features) / scale), 0, LIMIT)
    return np.maximum(u - NEAR, 0), np.maximum(u - FAR, 0)


def probability(log_odds: float, rivals: float = 0.0) -> float:
    """Of a curve with the odds o beside others that exclude it and one another, the sum of whose odds is `rivals`: at
    most one of them is right, so that it is o / (1 + o + rivals) by Bayes' rule."""
    return float(1 / (1 + (1 + rivals) * np.exp(-np.clip(log_odds, -30, 30))))


@lru_cache(1)
def load() -> Judge:
    """The judge of the package."""
    return judge_of(json.loads(resource_path('judge.json').read_text(encoding='utf-8')))


def judge_of(content: dict) -> Judge:
    """The judge that a file's content describes."""
    terms = [content['features'][name] for name in NAMES]
    typical, scale, near, far = (np.array([t[key] for t in terms]) for key in ('typical', 'scale', 'near', 'far'))
    return Judge(content['bias'], typical, scale, near, far, content['offset'], content['slope'])
