"""What the servo demo moves: robots as their model has them, and the same robots as they are: a little different, and
pushed by tissue."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..device import REST, Device, Segment
from . import anatomy, carm, ct, imaging, placement, variety
from .kinematics import TendonRobot, Tube, TubeRobot, loaded, reaching
from .scenes import FLUOROSCOPY, RADIUS, Background, Run, Scene, with_device
from .shapes import Pose
from .xray import Exposure

FIELD = 0.3e-3 * 512        # m at the isocentre, whatever the number of pixels
SHAFT = 0.05                # m before the base: it comes in through the border of both images
STEP = 5e-4                 # m, of a backbone that is drawn
MODEL_ERROR = 0.12          # by which a robot bends otherwise than its model
PUSHED = (0.008, 0.012)     # m, by which tissue pushes the tip aside at the start
REACHED = 0.1e-3        # m
MISSED = 3e-3           # m: a target that the model alone gets nearer to shows nothing
# what a robot is before a CT: one as pale as before drawn anatomy could not be seen
METAL = Device((Segment(REST, RADIUS, 'metal'),))
PLACES = 50             # of a CT, of which at least one must show the robot
UP = Pose(np.array([0.0, 0.0, -0.05]), np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]))      # along z, across both beams


@dataclass(frozen=True)
class Known:
    """A robot as its model has it, and where it is used."""

    robot: TubeRobot | TendonRobot
    start: np.ndarray       # (n,) joint values
    spread: np.ndarray      # (n,) by which targets stray from there, at most, in joint values


ROBOTS = {
    'two_tubes': Known(TubeRobot((Tube(5.0, 7.0, 0.06), Tube(1.0, 20.0, 0.06)), UP),
                       np.array([0.035, 0.035, 0.0, 0.8]), np.array([0.012, 0.012, 0.8, 0.8])),
    'three_tubes': Known(TubeRobot((Tube(8.0, 5.0, 0.05), Tube(3.0, 12.0, 0.05), Tube(1.0, 22.0, 0.05)), UP),
                         np.array([0.025, 0.025, 0.025, 0.0, 0.5, 1.0]),
                         np.array([0.008, 0.008, 0.008, 0.6, 0.6, 0.6])),
    'tendon': Known(TendonRobot(0.05, 0.001, UP), np.array([0.025, 0.0, 0.5e-3, 0.3e-3]),
                    np.array([0.015, 0.5, 0.3e-3, 0.3e-3])),
}


@dataclass(frozen=True)
class Plant:
    """A robot as it is, in front of an X-ray system."""

    robot: TubeRobot | TendonRobot
    load: np.ndarray        # (3,) force at the tip over bending stiffness, 1/m^2
    run: Run

    def backbone(self, q: np.ndarray) -> np.ndarray:
        """(N, 3) m, base to tip, without the shaft."""
        return loaded(self.robot.backbone(q, STEP), self.load)

    def scene(self, q: np.ndarray, index: int, stamp_ns: int) -> Scene:
        """What both planes see of it."""
        return self.run.scene_of(placement.with_shaft(self.backbone(q), SHAFT), index, stamp_ns)


def plant(name: str, seed: int, size: int = 512, with_anatomy: bool = True, error: float = MODEL_ERROR,
          pushed: tuple[float, float] = PUSHED,
          device: Device | None = None, volume: ct.Volume | None = None, chain: imaging.Imaging = FLUOROSCOPY) -> Plant:
    """The robot `name` of ROBOTS as the seed makes it: it bends by `error` otherwise, and a load moves its tip aside by
    `pushed` m at the start, so that the two do not cancel. Images have `size` x `size` px and always show the same
    field. It is a rod, or looks like `device` by an imaging `chain`.

    With a CT `volume`, which then stands in place of the drawn anatomy, it is by default METAL, and the patient lies
    where the seed has him, drawn anew until the robot at the start is `variety.visible` under fluoroscopy. Raises
    CtError where it never is.
    """
    known, rng = ROBOTS[name], np.random.default_rng([seed, 8])
    views = carm.biplane(arm=carm.CArm(pixel_size_iso=FIELD / size, width=size, height=size))
    beams = (tuple(anatomy.anatomy(np.random.default_rng([seed, 3, i]), (size, size)) for i in (0, 1))
             if with_anatomy and volume is None else None)
    run = Run(f'servo_{name}', seed, tuple(placement.Field(v) for v in views), None, 0.0, RADIUS, 'xray',
              Exposure(), beams)
    if device is not None:
        run = with_device(run, device, (chain, chain))
    points = known.robot.backbone(known.start, STEP)
    aside = np.cross(points[-1] - points[-2], rng.normal(size=3))
    length = STEP * (len(points) - 1)
    load = aside / np.linalg.norm(aside) * 3 * rng.uniform(*pushed) / length**3
    robots = (known.robot.misjudged(error), known.robot.misjudged(-error))
    moved = Plant(max(robots, key=lambda robot: (robot.backbone(known.start, STEP)[-1] - points[-1]) @ load), load, run)
    if volume is None:
        return moved
    background = _place(moved, known.start, device or METAL, volume, np.random.default_rng([seed, 3]))
    return dataclasses.replace(moved, run=_before(background, run, device or METAL, chain))


def _place(moved: Plant, q: np.ndarray, device: Device, volume: ct.Volume, rng: np.random.Generator) -> Background:
    """The first drawn place of a CT before which a `device` at joint values `q` can be seen. Raises CtError where there
    is none."""
    whole = placement.with_shaft(moved.backbone(q), SHAFT)
    for _ in range(PLACES):
        background = variety.in_ct(volume, rng)
        if variety.visible(_before(background, moved.run, device, FLUOROSCOPY), True, whole):
            return background
    raise ct.CtError(f'the robot of seed {moved.run.seed} can be seen in none of {PLACES} places of the CT')


def _before(background: Background, run: Run, device: Device, chain: imaging.Imaging) -> Run:
    """The run of a `device` before a `background`, which draws nothing more, in both planes by one imaging chain."""
    beams = tuple(background(None, field.view, chain.energy_kev) for field in run.fields)
    return with_device(dataclasses.replace(run, beams=beams), device, (chain, chain))


def predicted(name: str, q: np.ndarray) -> np.ndarray:
    """(N, 3) the backbone of robot `name` as its model has it, with the shaft, m."""
    return placement.with_shaft(ROBOTS[name].robot.backbone(q, 2e-3), SHAFT)


def goals(name: str, seed: int, moved: Plant, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` targets (count, 3) in m that both the robot `moved` and its model can reach, and the joint values
    (count, n) at which the model does and `moved` misses."""
    known, rng, found = ROBOTS[name], np.random.default_rng([seed, 9]), []
    while len(found) < count:
        target = moved.backbone(known.start + known.spread * rng.uniform(-1, 1, len(known.start)))[-1]
        q = reaching(known.robot, target, known.start)
        if (np.linalg.norm(known.robot.backbone(q, STEP)[-1] - target) < REACHED
                and np.linalg.norm(moved.backbone(q)[-1] - target) > MISSED):
            found.append((target, q))
    return tuple(map(np.stack, zip(*found)))


def without_device(plant: Plant, index: int, scene: Scene, plane: int) -> Scene:
    """`scene`, but plane 0 (A) or 1 (B) sees no device."""
    images = list(scene.frame.images)
    images[plane] = plant.run.without_device(index).images[plane]
    return dataclasses.replace(scene, frame=dataclasses.replace(scene.frame, images=tuple(images)))
