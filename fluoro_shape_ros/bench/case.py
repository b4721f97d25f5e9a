"""A scene to try with what belongs to it, and families of such scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..sim.scenes import Run, Scene


@dataclass(frozen=True)
class Case:
    """A scene, and what belongs to it."""

    scene: Scene
    masks: tuple[np.ndarray, np.ndarray] | None = None      # (H, W) float32 device-free images
    note: str = ''                                          # what the seed has drawn
    run: Run | None = None                                  # what a bound can be computed from
    kind: str = ''                                          # of device, where a family has several
    device: bool = True                                     # False: no pair of images shows one


@dataclass(frozen=True)
class Family:
    """Scenes of one kind."""

    text: str
    make: Callable[[int], Case]     # of a seed
    device: bool = True             # False: no pair of images shows a device, so every published shape is wrong
    count: int | None = None        # how many scenes there are, with seeds from 0; None: as many as seeds
