"""Cameras of both planes from pictures of a chessboard or a ChArUco board, by OpenCV: for labs that look at a device
with two cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from msg_adapters.calibration import Calibration

from ..geometry.cameras import triangulate
from .beads import CalibrationError
from .image_files import open_images, read_images

MIN_PICTURES = 3        # with the board in view; fewer leave focal length and distance undecided
MIN_CORNERS = 6         # of a ChArUco board, of which a part will do


@dataclass(frozen=True)
class Board:
    """A chessboard, or a ChArUco board where there is a dictionary."""

    columns: int            # inner corners of a chessboard; squares of a ChArUco board, as their makers count
    rows: int
    square: float           # m, side of a square
    marker: float = 0.0     # m, side of a marker
    dictionary: str = ''    # of OpenCV's aruco, as DICT_4X4_50

    @property
    def points(self) -> np.ndarray:
        """(N, 3) m: the inner corners, row by row."""
        columns, rows = (self.columns - 1, self.rows - 1) if self.dictionary else (self.columns, self.rows)
        return np.c_[np.mgrid[:columns, :rows].T.reshape(-1, 2) * self.square, np.zeros(columns * rows)]


@dataclass(frozen=True)
class Views:
    """The board in the pictures of a camera: a dict of corner number to pixel a picture, empty where it is not seen."""

    size: tuple[int, int]           # of the pictures, px, width and height
    corners: list[dict[int, np.ndarray]]


def find_boards(board: Board, files: list[Path]) -> Views:
    """The board in all pictures of a camera. Raises CalibrationError for pictures of several sizes, and BadImage for
    what is none."""
    find = _charuco(board) if board.dictionary else _chessboard(board)
    sizes, corners = set(), []
    for file in tqdm(files, 'finding boards', unit='picture', disable=None):
        for picture in read_images(open_images(file)):
            if picture.dtype != np.uint8:
                picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
            sizes.add((picture.shape[1], picture.shape[0]))
            corners.append(find(picture))
    if len(sizes) != 1:
        raise CalibrationError(f'{files[0]} and others: pictures of one camera have one size, '
                               f'not {" and ".join(f"{w}x{h}" for w, h in sorted(sizes))}')
    return Views(sizes.pop(), corners)


def _chessboard(board: Board):
    """A function from a picture to corners."""
    def find(picture: np.ndarray) -> dict[int, np.ndarray]:
        there, found = cv2.findChessboardCornersSB(picture, (board.columns, board.rows),
                                                   flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY)
        if not there:
            return {}
        found = np.asarray(found, float).reshape(board.rows, board.columns, 2)
        # upside down; of a board with one odd side the first square inside is the dark one
        if _level(picture, found[:2, :2]) > _level(picture, found[-2:, -2:]):
            found = found[::-1, ::-1]
        return dict(enumerate(found.reshape(-1, 2)))
    return find


def _level(picture: np.ndarray, square: np.ndarray) -> float:
    """Mean grey around the middle of four corners (2, 2, 2)."""
    u, v = square.reshape(4, 2).mean(axis=0)
    half = max(float(np.linalg.norm(square[0, 0] - square[1, 1])) / 8, 1.0)
    (top, bottom), (left, right) = ((int(max(c - half, 0)), int(c + half) + 1) for c in (v, u))
    return float(picture[top:bottom, left:right].mean())


def _charuco(board: Board):
    """A function from a picture to corners. Raises CalibrationError where this OpenCV can't."""
    if not hasattr(getattr(cv2, 'aruco', None), 'CharucoDetector'):
        raise CalibrationError('ChArUco boards need the aruco module of OpenCV 4.7 or later, which is not here: '
                               'a chessboard needs no more than is here')
    if not board.dictionary.startswith('DICT_') or not hasattr(cv2.aruco, board.dictionary):
        raise CalibrationError(f'{board.dictionary} is no dictionary of OpenCV, as DICT_4X4_50 is')
    detectors = []
    for legacy in (False, True):        # before OpenCV 4.6 boards with an even number of rows began with a white square
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker,
                                      cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary)))
        made.setLegacyPattern(legacy)
        detectors.append(cv2.aruco.CharucoDetector(made))

    def find(picture: np.ndarray) -> dict[int, np.ndarray]:
        for detector in detectors:
            found, numbers, _, _ = detector.detectBoard(picture)
            if numbers is not None and len(numbers) >= MIN_CORNERS:
                return dict(zip(np.ravel(numbers).tolist(), np.asarray(found, float).reshape(-1, 2)))
        return {}
    return find


def calibrate_camera(board: Board, views: Views, name: str) -> tuple[Calibration, float]:
    """A camera with P = [K | 0] and its residual in px rms a coordinate, OpenCV's model with four coefficients. Raises
    CalibrationError."""
    seen = [corners for corners in views.corners if corners]
    if len(seen) < MIN_PICTURES:
        raise CalibrationError(f'{name or "the camera"}: the board is seen in {len(seen)} of {len(views.corners)} '
                               f'pictures; at least {MIN_PICTURES} are needed')
    objects, pixels = zip(*(_matched(board, corners) for corners in seen))
    try:
        # a third radial coefficient fits noise, unless a lens needs it
        rms, K, D, _, _ = cv2.calibrateCamera(objects, pixels, views.size, None, None, flags=cv2.CALIB_FIX_K3)
    except cv2.error:
        raise CalibrationError(f'{name or "the camera"}: the pictures do not tell a camera: '
                               'hold the board at more angles') from None
    return (Calibration(name, *views.size, K, np.c_[K, np.zeros(3)], 'plumb_bob', np.ravel(D)[:5]),
            float(rms) / np.sqrt(2))


def _matched(board: Board, corners: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    numbers = sorted(corners)
    return board.points[numbers].astype(np.float32), np.array([corners[n] for n in numbers], np.float32)


def place_second(board: Board, views: tuple[Views, Views],
                 cameras: tuple[Calibration, Calibration]) -> tuple[Calibration, float, np.ndarray]:
    """The second camera with its pose: P = K [R | t] takes points from the first camera's optical frame, which is the
    reference frame.

    Also the residual of both in px rms a coordinate, and (N,) m between the corners and where they are triangulated,
    once the board is laid upon them. Raises CalibrationError where the pictures of a pair show too little of the board
    together.
    """
    pairs = [({n: a[n] for n in both}, {n: b[n] for n in both}) for a, b in zip(*(v.corners for v in views))
             if len(both := a.keys() & b.keys()) >= MIN_CORNERS]
    if len(pairs) < MIN_PICTURES:
        raise CalibrationError(f'the board is seen in both pictures of {len(pairs)} pairs; '
                               f'at least {MIN_PICTURES} are needed')
    objects, first, second = zip(*((*_matched(board, a), _matched(board, b)[1]) for a, b in pairs))
    (K1, D1), (K2, D2) = ((c.K, c.D) for c in cameras)
    rms, *_, R, t, _, _ = cv2.stereoCalibrate(objects, first, second, K1, D1, K2, D2, views[0].size,
                                              flags=cv2.CALIB_FIX_INTRINSIC)
    c = cameras[1]
    placed = Calibration(c.camera_name, c.width, c.height, c.K, c.K @ np.c_[R, t], c.distortion_model, c.D)
    errors = [_board_errors(points, triangulate(cameras[0].P, placed.P, _undistorted(a, cameras[0]),
                                                _undistorted(b, placed)))
              for points, a, b in zip(objects, first, second)]
    return placed, float(rms) / np.sqrt(2), np.concatenate(errors)


def _undistorted(pixels: np.ndarray, camera: Calibration) -> np.ndarray:
    return cv2.undistortPoints(pixels.astype(float)[:, None], camera.K, camera.D, P=camera.K)[:, 0]


def _board_errors(points: np.ndarray, found: np.ndarray) -> np.ndarray:
    """(N,) m between (N, 3) points and found ones once the former are turned and shifted on to the latter
    (Kabsch 1976)."""
    P, Q = points - points.mean(axis=0), found - found.mean(axis=0)
    U, _, V = np.linalg.svd(P.T @ Q)
    turn = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ V))]) @ V
    return np.linalg.norm(P @ turn - Q, axis=1)
