"""One scene through the pipeline, and what its truth says of the answer."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..cli import ToolError
from ..config import Config, ConfigError
from ..data import Outcome, Prior, Reconstruction
from ..geometry.cameras import pixels_per_metre
from ..method.pipeline import reconstruct
from ..metrics import Errors, compare, surprise
from ..sim.scenes import Scene
from .bound import Bound, bound
from .case import Case, Family
from .families import Sources, families, varied
from .sheets import thumbnail

WITHIN_MEAN, WITHIN_TIP = 0.3e-3, 1e-3  # m: an answer as good as this is good
RIGHT_MEAN_PX, RIGHT_TIP_PX = 1.0, 3.0  # px at the device: or as this, where pixels are coarse
SILENT_MEAN, SILENT_TIP = 1e-3, 2e-3    # m: a published result farther off than this is a silent failure
CHI2_95 = 7.815                         # 95 % of chi-squared with three degrees of freedom: what a 95 % ellipsoid holds


@dataclass(frozen=True)
class Answer:
    """What a method says of one scene and, where it published a shape of a device that is there, how far off."""

    seed: int
    outcome: Outcome
    device: bool = True                 # whether both images show one
    errors: Errors | None = None
    surprise: float = math.nan      # squared Mahalanobis distance of the tip; see metrics.surprise
    note: str = ''
    detail: str = ''                    # the reason in words
    kind: str = ''                      # of device, where the family has several
    px_m: float = math.nan              # m a pixel at the device, the mean of both planes
    cpu_s: float = math.nan             # of the whole process, all its threads
    confidence: float = math.nan        # the method's own; of what it refused too

    @property
    def published(self) -> bool:
        return self.outcome is Outcome.OK

    @property
    def within(self) -> bool:
        return self.errors is not None and self.errors.mean <= WITHIN_MEAN and self.errors.tip <= WITHIN_TIP

    @property
    def right(self) -> bool:
        """`within`, or as near as pixels are fine."""
        px = 0.0 if math.isnan(self.px_m) else self.px_m
        return (self.errors is not None and self.errors.mean <= max(WITHIN_MEAN, RIGHT_MEAN_PX * px)
                and self.errors.tip <= max(WITHIN_TIP, RIGHT_TIP_PX * px))

    @property
    def silent_failure(self) -> bool:
        """Published, yet wrong."""
        return self.published and (not self.device or self.errors.mean > SILENT_MEAN or self.errors.tip > SILENT_TIP)


@dataclass(frozen=True)
class Task:
    """A scene to try; small, so that it travels to another process."""

    family: str
    seed: int
    methods: tuple[str, ...]
    real: Path | None = None
    sources: Sources | None = None      # of a family of `varied`
    base: bool = True                   # whether the base's position is given
    radius_error: float = 0.0           # the radius given is off by this share of the true one
    min_confidence: float | None = None # instead of the parameter's default
    picture: str = ''                   # which answers of the first method are worth a thumbnail, one of PICTURES;
                                        # '': none


@dataclass(frozen=True)
class Trial:
    """What came of a task."""

    task: Task
    answers: dict[str, Answer]              # by method
    bound: Bound | None                     # where the family has one
    thumbnail: np.ndarray | None = None     # uint8, the pair as a person sees it, where the task asks for it


PICTURES: dict[str, Callable[[Answer], bool]] = {
    'all': lambda a: True,
    'answered': lambda a: a.published,
    'refused': lambda a: not a.published,
    'silent': lambda a: a.silent_failure,
}


class NotDrawn(ToolError):
    """Nothing can be drawn from a seed."""


def attempt_or_skip(task: Task) -> Trial | None:
    """The same as `attempt`; None where nothing can be drawn from the seed, which is said on stderr: the other scenes
    are not lost by it."""
    try:
        return attempt(task)
    except NotDrawn as error:
        print(f'left out: {error}', file=sys.stderr)
        return None


def attempt(task: Task) -> Trial:
    """Draw the scene of a task and let each method say what it sees. Raises ToolError where the scene can't be drawn.

    A family of `varied` gets no bound: not all of its devices have both ends in both images.
    """
    family = family_of(task)
    try:
        case = family.make(task.seed)
    except ValueError as error:
        raise NotDrawn(f'{task.family}, seed {task.seed}: {error}') from error
    except ImportError as error:    # a renderer is missing here
        raise ToolError(f'{task.family}, seed {task.seed}: {error}') from error
    try:
        least = {} if task.min_confidence is None else {'min_confidence': task.min_confidence}
        answers = {method: answer(case, Config.from_values(method=method, **least), family.device, task.base,
                                  task.radius_error) for method in task.methods}
    except ConfigError as error:    # a radius that no device has
        raise ToolError(f'{task.family}, seed {task.seed}: {error}') from error
    first = next(iter(answers.values()))
    picture = thumbnail(case.scene.frame.images) if task.picture and PICTURES[task.picture](first) else None
    return Trial(task, answers, bound(case.run) if case.run and task.sources is None else None, picture)


def family_of(task: Task) -> Family:
    return (families(task.real) if task.sources is None else varied(task.sources))[task.family]


def answer(case: Case, config: Config, device: bool = True, base: bool = True, radius_error: float = 0.0) -> Answer:
    """What the pipeline says of one scene. The device's radius and its base's position are given, as a robot's user
    would.

    The radius is off by a share `radius_error`; the base's position is kept back without `base`, and where a scene has
    none. Raises ConfigError.
    """
    scene = case.scene
    config = config.replace(robot_radius=scene.radius * (1 + radius_error),
                            base_position=scene.base_position.tolist() if base else [])
    start = time.process_time()
    result = reconstruct(scene.frame, config, Prior(masks=case.masks))
    cpu_s = time.process_time() - start
    return dataclasses.replace(answer_of(case, result, device), cpu_s=cpu_s)


def answer_of(case: Case, result: Reconstruction, device: bool = True) -> Answer:
    """How far off a result for a scene is. `device` False: it shows none, whatever the case says."""
    scene = case.scene
    found = Answer(scene.seed, result.outcome, device and case.device, note=case.note, detail=result.detail,
                   kind=case.kind, px_m=pixel_size(scene), confidence=result.confidence)
    if result.shape is None or not found.device:
        return found
    shape = result.shape
    return dataclasses.replace(found, errors=compare(shape.points, scene.truth),
                               surprise=surprise(shape.tip - scene.truth[-1], shape.covariance[-1]))


def pixel_size(scene: Scene) -> float:
    """m a pixel at the device, the mean of both planes; NaN where no device is."""
    return (float(np.mean([1 / pixels_per_metre(v.P, scene.truth) for v in scene.frame.views]))
            if len(scene.truth) else math.nan)
