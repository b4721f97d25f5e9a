"""The types that travel through the pipeline; each is made once and never changed."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np


class Outcome(Enum):
    """What became of a pair. Exactly `OK` carries a shape; every other value is a named rejection."""

    OK = 'ok'
    # what the node finds before the pipeline runs
    BAD_IMAGE = 'bad_image'
    BAD_CAMERA_INFO = 'bad_camera_info'
    NO_CAMERA_INFO = 'no_camera_info'
    NO_TRANSFORM = 'no_transform'
    BAD_GEOMETRY = 'bad_geometry'
    INTERNAL_ERROR = 'internal_error'
    # what the stages find
    NO_DEVICE_A = 'no_device_in_plane_a'
    NO_DEVICE_B = 'no_device_in_plane_b'
    NO_CORRESPONDENCE = 'no_correspondence'
    CURVATURE = 'curvature_too_high'
    REPROJECTION = 'reprojection_too_large'
    LENGTH = 'length_out_of_bounds'
    TIP_UNCERTAIN = 'tip_too_uncertain'
    LOW_CONFIDENCE = 'confidence_too_low'
    OUT_OF_TIME = 'out_of_time'


@dataclass(frozen=True)
class Distortion:
    """Lens or intensifier distortion of the raw image (sensor_msgs/CameraInfo K, D, R)."""

    model: str          # plumb_bob, rational_polynomial or equidistant
    K: np.ndarray       # (3, 3) intrinsics of the raw image, px
    D: np.ndarray       # (n,) coefficients
    R: np.ndarray       # (3, 3) rectifying rotation


@dataclass(frozen=True, eq=False)
class View:
    """One calibrated X-ray view: source (pinhole), detector (image) and where they stand. Equal is only the same
    object."""

    name: str           # 'a' or 'b'
    P: np.ndarray       # (3, 4) projection, reference frame (m) to pixels; |P[2, :3]| = 1, so w is the depth in m
    width: int          # px
    height: int         # px
    distortion: Distortion | None = None


@dataclass(frozen=True)
class Frame:
    """A pair of images taken at one time, with their views."""

    stamp_ns: int                           # of plane A's image
    frame_id: str                           # the reference frame
    images: tuple[np.ndarray, np.ndarray]   # (H, W) each: uint8, uint16 or float32, any range
    views: tuple[View, View]


@dataclass(frozen=True)
class Searched:
    """What the last search of whole images found."""

    log_odds: float     # of the curve that was chosen
    rivals: float       # sum of the odds of curves that exclude it


@dataclass(frozen=True)
class Prior:
    """What is known before a pair is looked at; everything is optional."""

    previous: Shape | None = None           # the result of the pair before
    previous_stamp_ns: int | None = None
    before: Shape | None = None             # the result before that
    before_stamp_ns: int | None = None
    masks: tuple[np.ndarray, np.ndarray] | None = None  # (H, W) float32, device-free mean image of each plane
    predicted: np.ndarray | None = None     # (N, 3) a kinematic model's guess, base to tip, m
    prediction_fault: str = ''              # why the newest guess can't be used; empty where it can,
                                            # or where there is none
    search: Any = None                      # a method.search.Search of an earlier pair that was cut short,
                                            # to go on with
    searched: Searched | None = None        # as it came with the pair before


@dataclass(frozen=True)
class Centerline:
    """A device's centreline in one image, ordered along the device."""

    points_px: np.ndarray                   # (N, 2) u, v in the image as received (not undistorted)
    width_px: float = float('nan')          # apparent width of the device
    at_border: tuple[bool, bool] = (False, False)   # whether the first / last end lies at the field's border


@dataclass(frozen=True)
class Shape:
    """The backbone, base to tip, in the reference frame."""

    points: np.ndarray          # (N, 3) m; equal arc-length steps, the last one exactly the tip
    s: np.ndarray               # (N,) m, arc length from the base
    covariance: np.ndarray      # (N, 3, 3) m^2; NaN where the method does not know it
    residuals_px: np.ndarray    # (N, 2) distance of the reprojected point to the centreline seen in plane A, B;
                                # NaN: not seen there

    @property
    def tip(self) -> np.ndarray:
        """(3,) the last backbone point, m."""
        return self.points[-1]

    @property
    def length(self) -> float:
        """Arc length, m."""
        return float(self.s[-1])


@dataclass(frozen=True)
class Landmarks:
    """Places of the device that each plane shows by itself, undistorted pixels: do they lie on one another's epipolar
    lines?"""

    kinds: tuple[str, ...]      # N of: tip, base, steps (bands along it), bend (where it runs along its epipolar line)
    a_px: np.ndarray            # (N, 2)
    b_px: np.ndarray            # (N, 2)
    slack_px: np.ndarray        # (N, 2) standard deviation of b_px along the device in plane B, towards its end;
                                # 0: a bend


@dataclass(frozen=True)
class Reconstruction:
    """The answer to one pair: a shape exactly when `outcome` is OK, and what was seen in any case."""

    outcome: Outcome
    detail: str = ''                                    # the reason in words, with numbers
    shape: Shape | None = None
    warnings: tuple[str, ...] = ()                      # e.g. tip_ambiguous
    centerlines: tuple[Centerline | None, Centerline | None] = (None, None)
    stage_seconds: dict[str, float] = field(default_factory=dict)   # wall time of each stage
    prediction: str = ''                                # agrees, not compared, or ignored and why;
                                                        # empty: there was none
    confidence: float = float('nan')                    # probability that the shape is right; of a rejected pair that
                                                        # of the best curve tried; NaN: none was, or not known

    search: Any = None                                  # a method.search.Search that was cut short
    searched: Searched | None = None                    # what whole images showed in this pair, or in an earlier one
                                                        # if that sufficed; None: they were not searched to the end
    landmarks: Landmarks | None = None                  # of the curve, of a rejected pair too; None: there is none, or
                                                        # the method finds none

    def __post_init__(self) -> None:
        if (self.outcome is Outcome.OK) != (self.shape is not None):
            raise ValueError(f'a {self.outcome.value} reconstruction must '
                             f'{"" if self.shape is None else "not "}have a shape')
