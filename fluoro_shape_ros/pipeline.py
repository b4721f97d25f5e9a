"""A pair of images walks straight through."""

from __future__ import annotations

from .config import Config
from .data import Frame, Prior, Reconstruction


def reconstruct(frame: Frame, config: Config, prior: Prior = Prior()) -> Reconstruction:
    """The backbone seen in a pair of images, or the reason why there is none. Pure: the same pair gives the same answer."""
    raise NotImplementedError
