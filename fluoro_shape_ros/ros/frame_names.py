"""Names of frames that contradict what they stand for: results that look right and lie elsewhere. Nothing here imports
ROS."""

from __future__ import annotations

import re
from functools import lru_cache

from msg_adapters.calibration import Calibration
from msg_adapters.cameras import has_pose
from msg_adapters.messages import short

from ..cli import ToolError
from ..config import Config
from .pairing import PLANES
from .worker import Camera


def doubts(config: Config, image_frames: tuple[str, str],
           cameras: tuple[Camera | None, Camera | None]) -> tuple[str, ...]:
    """What contradicts in the names of a pair, in words: `image_frames` are the frame_ids of its images, `cameras` what
    holds for them."""
    return _doubts(config.input.geometry == 'camera_info' and not config.input.reference_frame, image_frames, cameras)


@lru_cache(maxsize=8)
def _doubts(unnamed: bool, image_frames: tuple[str, str],
            cameras: tuple[Camera | None, Camera | None]) -> tuple[str, ...]:
    """The same, with whether results are labelled with plane A's frame although P may be anything."""
    frames = tuple('' if known is None else known.msg.header.frame_id for known in cameras)
    notes = [mislabelled(frames[0])] if unnamed and cameras[0] is not None and has_pose(cameras[0].msg) else []
    for plane, image, info in zip(PLANES, image_frames, frames):
        if image and info and image != info:
            notes.append(f'plane {plane.upper()}: its images are of frame "{short(image)}", '
                         f'its camera info of "{short(info)}": are the calibrations exchanged?')
    return (*notes, *(_exchanged(frames) or _exchanged(image_frames)))


def mislabelled(frame_id: str) -> str:
    """What is to be said where results are labelled with plane A's own frame, but P has a pose."""
    return (f'results are labelled "{short(frame_id)}", but P of plane A has a pose, '
            'so that they lie in another frame: name it by reference_frame')


def _exchanged(frames: tuple[str, str]) -> tuple[str, ...]:
    try:
        check_names([None, None], list(frames))
    except ToolError as error:
        return (str(error),)
    return ()


def check_names(calibrations: list[Calibration | None], frame_ids: list[str]) -> None:
    """Raises ToolError where the name of a plane's camera or frame is the other plane's."""
    for plane, calibration, frame_id in zip(PLANES, calibrations, frame_ids):
        for what, name in (('camera_name', calibration.camera_name if calibration else ''), ('frame_id', frame_id)):
            told = re.fullmatch(r'(?:.*[^a-z])?(?:bi)?plane[ _-]?([ab])(?:[^a-z].*)?|([ab])', name.lower())
            if told and (told[1] or told[2]) != plane:
                raise ToolError(f'{what} "{short(name)}" was given for plane {plane.upper()}: are the '
                                'planes exchanged?')
