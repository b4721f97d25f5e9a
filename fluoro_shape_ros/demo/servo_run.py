"""One run of the servo demo: its processes, what the tip is asked to do, and what came of it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..cli import ToolError
from ..geometry.curve import arc_length, at_arc_length
from ..resources import resource_path
from ..sim import plant
from ..sim.scenes import FRAME_ID
from .main import check_alive, child
from .servo_referee import Record, Referee

SPEED = 0.006           # m/s, of a target that moves
SETTLED, STEADY = 0.12e-3, 6    # m; pairs: the tip has arrived when so many in a row were measured as near as that
TARGET_S = 10.0         # by the robot's clock, for a target
STALL_S = 120.0         # by the wall's clock, without a measured tip


@dataclass(frozen=True)
class Run:
    """What a run showed. Errors are of the true tip, m."""

    seed: int
    record: Record
    ends: tuple[int, ...]               # stamps at which the square, then each target was done with
    open_loop: tuple[float, ...]        # for each target: how far the same robot misses it where its model alone places
                                        # the joints
    square: tuple[int, int] | None      # stamps between which the tip was driven along a square
    seconds: float                      # by the wall's clock

    @property
    def final(self) -> np.ndarray:
        """(K,) m, the true tip's distance from each target at the end."""
        return np.array([self.record.error(stamp) for stamp in self.ends])

    @property
    def tracking(self) -> float:
        """m rms, along the square; NaN without one."""
        errors = [self.record.error(t) for t in self.record.target
                  if self.square and self.square[0] <= t < self.square[1]]
        return float(np.sqrt(np.mean(np.square(errors)))) if errors else float('nan')

    @property
    def robot_seconds(self) -> float:
        return (max(self.record.true) - min(self.record.target)) * 1e-9

    def blackout(self, period: float) -> tuple[float, int] | None:
        """How far the tip moved while the controller had to hold (m), and the number of pairs after the blackout up to
        the first measured one."""
        if self.record.blackout is None:
            return None
        start, stop = self.record.blackout
        # two pair times of patience, one for the command to come and one for the joints to stop
        held = np.array([x for t, x in sorted(self.record.true.items()) if start + 4e9 * period <= t < stop])
        after = sorted(t for t in self.record.true if t >= stop)
        back = next((k + 1 for k, t in enumerate(after) if t in self.record.measured), len(after) + 1)
        return float(np.linalg.norm(held - held[0], axis=1).max()) if len(held) else float('nan'), back


def commands(args, seed: int) -> dict[str, list[str]]:
    """The arguments of Python for each process."""
    robot = ['--robot', args.robot, '--seed', str(seed), '--rate', str(args.rate), '--size', str(args.size),
             '--imaging', args.imaging]
    for name, value in (('--device', args.device), ('--ct', args.ct)):
        robot += [name, value] if value else []
    device = ['-p', f'device:={args.device}'] if args.device else []
    return {'node': ['-m', 'fluoro_shape_ros.node', '--ros-args', '-p', f'reference_frame:={FRAME_ID}', *device],
            'robot': ['-m', 'fluoro_shape_ros.demo.servo_robot', *robot,
                      *(['--no-anatomy'] if args.no_anatomy else [])],
            'controller': [str(resource_path('example_controller.py')), '--ros-args', '-p', f'robot:={args.robot}',
                           '-p', f'rate:={float(args.rate)}']}


def run(args, seed: int) -> Run:
    """Start robot, node and controller, drive the tip along a square and to targets, end them. Raises ToolError where
    one of them fails or stalls."""
    begun = time.monotonic()
    what = plant.plant(args.robot, seed, args.size, with_anatomy=False)
    targets, joints = plant.goals(args.robot, seed, what, args.targets)
    open_loop = tuple(float(np.linalg.norm(what.backbone(q)[-1] - target)) for q, target in zip(joints, targets))
    with contextlib.ExitStack() as stack:
        children = {name: stack.enter_context(child(arguments, args.out / f'{name}.log'))
                    for name, arguments in commands(args, seed).items()}
        course = Course(stack.enter_context(Referee()), children, args.out)
        course.until(course.referee.ready)
        if not args.no_mask:
            course.referee.capture_mask()
            course.until(lambda: course.referee.masked)
        course.referee.insert()
        course.until(lambda: course.record.measured and course.referee.now)
        ends, square = [], None
        if args.square:
            square = course.along(_square(next(iter(course.record.measured.values())), args.square), args.blackout)
            ends.append(course.settle(course.referee.target))
        ends += [course.settle(target) for target in targets]
    return Run(seed, course.record, tuple(ends), open_loop, square, time.monotonic() - begun)


class Course:
    """Leads the tip by moving the referee's target, pair by pair."""

    def __init__(self, referee: Referee, children, out: Path):
        self.referee, self.record, self._children, self._out = referee, referee.record, children, out

    def until(self, condition: Callable[[], object]) -> None:
        """Serve until `condition()`; raises ToolError where no tip was measured for STALL_S or a process has ended."""
        seen, alive = len(self.record.measured), time.monotonic()
        while not condition():
            self.referee.spin(0.05)
            check_alive(self._children, self._out)
            if len(self.record.measured) != seen:
                seen, alive = len(self.record.measured), time.monotonic()
            if time.monotonic() > alive + STALL_S:
                raise ToolError(f'no tip was measured for {STALL_S:g} s, see the logs in {self._out}')

    def along(self, path: np.ndarray, blackout: bool) -> tuple[int, int]:
        """Move the target along the (N, 3) path at SPEED, with a blackout halfway if asked for; the stamps of start and
        end."""
        start, length = self.referee.now, arc_length(path)[-1]

        def arrived() -> bool:
            s = SPEED * (self.referee.now - start) * 1e-9
            self.referee.target = at_arc_length(path, np.array([min(s, length)]))[0]
            nonlocal blackout
            if blackout and s > length / 2:
                self.referee.black_out()
                blackout = False
            return s >= length
        self.until(arrived)
        return start, self.referee.now

    def settle(self, target: np.ndarray) -> int:
        """Set the target; the stamp at which the tip was measured to have arrived, or gave up."""
        self.referee.target, start = target, self.referee.now

        def arrived() -> bool:
            last = sorted(t for t in self.record.measured if t > start and t in self.record.target)[-STEADY:]
            near = [np.linalg.norm(self.record.measured[t] - target) < SETTLED for t in last]
            return len(near) == STEADY and all(near) or self.referee.now > start + TARGET_S * 1e9
        self.until(arrived)
        return max(t for t in self.record.target if t in self.record.true)


def _square(centre: np.ndarray, side: float) -> np.ndarray:
    """(N, 3) m: from the centre to a corner and around, across plane A's beam (y), so that its image shows a square."""
    corners = np.array([[0, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * side / 2
    return centre + np.c_[corners[:, 0], np.zeros(len(corners)), corners[:, 1]]
