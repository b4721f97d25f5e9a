"""One scene through the pipeline, and what its truth says of the answer."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import cv2

from ..config import Config
from ..data import Outcome, Prior, Reconstruction
from ..metrics import Errors, compare, surprise
from ..pipeline import reconstruct
from .bound import Bound, bound
from ..tools.cli import ToolError
from .families import Case, families

WITHIN_MEAN, WITHIN_TIP = 0.3e-3, 1e-3  # m: an answer as good as this is good
SILENT_MEAN, SILENT_TIP = 1e-3, 2e-3    # m: a published result farther off than this is a silent failure
CHI2_95 = 7.815                         # 95 % of chi-squared with three degrees of freedom: what a 95 % ellipsoid holds
ONE_THREAD = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')


@dataclass(frozen=True)
class Answer:
    """What a method says of one scene and, where it published a shape of a device that is there, how far off."""

    seed: int
    outcome: Outcome
    device: bool = True                 # whether both images show one
    errors: Errors | None = None
    surprise: float = float('nan')      # squared Mahalanobis distance of the tip; see metrics.surprise
    note: str = ''
    detail: str = ''                    # the reason in words

    @property
    def published(self) -> bool:
        return self.outcome is Outcome.OK

    @property
    def within(self) -> bool:
        return self.errors is not None and self.errors.mean <= WITHIN_MEAN and self.errors.tip <= WITHIN_TIP

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


@dataclass(frozen=True)
class Trial:
    """What came of a task."""

    task: Task
    answers: dict[str, Answer]      # by method
    bound: Bound | None             # where the family has one


def attempt(task: Task) -> Trial:
    """Draw the scene of a task and let each method say what it sees."""
    family = families(task.real)[task.family]
    try:
        case = family.make(task.seed)
    except ValueError as error:
        raise ToolError(f'{task.family}, seed {task.seed}: {error}') from error
    answers = {method: answer(case, Config.from_values(method=method), family.device) for method in task.methods}
    return Trial(task, answers, bound(case.run) if case.run else None)


def answer(case: Case, config: Config, device: bool = True) -> Answer:
    """What the pipeline says of one scene. The device's radius and its base's position are given, as a robot's user would."""
    scene = case.scene
    config = config.replace(robot_radius=scene.radius, base_position=scene.base_position.tolist())
    return answer_of(case, reconstruct(scene.frame, config, Prior(masks=case.masks)), device)


def answer_of(case: Case, result: Reconstruction, device: bool = True) -> Answer:
    """How far off a result for a scene is."""
    scene = case.scene
    if result.shape is None or not device:
        return Answer(scene.seed, result.outcome, device, note=case.note, detail=result.detail)
    shape = result.shape
    return Answer(scene.seed, result.outcome, device, compare(shape.points, scene.truth), surprise(shape.tip - scene.truth[-1], shape.covariance[-1]),
                  case.note, result.detail)


def attempts(tasks: Sequence[Task], jobs: int) -> Iterator[Trial]:
    """The trials of all tasks in their order, made by `jobs` processes of one thread each: the same on any number of them.

    Raises ToolError where a process dies, and whatever a scene raises (VTK may be missing).
    """
    with _one_thread_children(), ProcessPoolExecutor(min(jobs, len(tasks)), get_context('spawn'), _start_child) as pool:
        try:
            yield from pool.map(attempt, tasks)
        except BrokenProcessPool as error:
            raise ToolError('a process that tried scenes was ended from outside or crashed') from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _one_thread_children():
    """Processes started inside get libraries of one thread: these read the environment when they are loaded."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, '1'))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def _start_child() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)    # Ctrl-C is the parent's to answer
    cv2.setNumThreads(1)
