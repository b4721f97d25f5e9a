"""Two cameras from pictures of a board that are drawn here: the cameras with which they were drawn come back."""

import cv2
import numpy as np
import pytest

pytest.importorskip('yaml')

from scipy.spatial.transform import Rotation

from fluoro_shape_ros.files import calibrate
from fluoro_shape_ros.files.boards import Board, find_boards
from msg_adapters.calibration import read_calibration

SIZE = 640, 480
K = np.array([[800.0, 0, 310], [0, 790, 250], [0, 0, 1]])
SQUARE = 0.02
# of camera B: 60 degrees around the board
R, T = Rotation.from_euler('y', 60, degrees=True).as_matrix(), np.array([-0.45, 0.01, 0.28])
# of the board, facing between the cameras
POSES = [((0.2, -0.5, 0.1), (0.0, 0.0, 0.5)), ((-0.4, -0.6, 0.0), (0.03, 0.02, 0.52)),
         ((0.5, -0.4, -0.2), (-0.03, 0.0, 0.48)), ((0.0, -0.7, 0.3), (0.02, -0.03, 0.5)),
         ((-0.2, -0.3, 0.4), (0.0, 0.03, 0.55)), ((0.4, -0.6, 0.15), (0.02, 0.02, 0.45))]
PER_SQUARE = 60     # px in the drawing


def chessboard(columns, rows):
    """The drawing of a board with so many inner corners and a white rim, and where its first inner corner is, px."""
    squares = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2 * 255
    return np.pad(np.kron(squares, np.ones((PER_SQUARE, PER_SQUARE))).astype(np.uint8), PER_SQUARE,
                  constant_values=255), 2.0 * PER_SQUARE - 0.5


def picture(drawing, first, pose, turn, shift):
    """What a camera sees of a drawing in a pose of camera A's frame; its middle is the pose's origin."""
    A = Rotation.from_rotvec(pose[0]).as_matrix()
    height, width = drawing.shape
    to_board = np.array([[SQUARE / PER_SQUARE, 0, -first * SQUARE / PER_SQUARE],
                         [0, SQUARE / PER_SQUARE, -first * SQUARE / PER_SQUARE], [0, 0, 1]])
    middle = to_board @ [(width - 1) / 2, (height - 1) / 2, 1]
    pose_of_first = A @ -np.array([middle[0], middle[1], 0]) + pose[1]
    H = K @ np.c_[turn @ A[:, :2], turn @ pose_of_first + shift] @ to_board
    big = cv2.warpPerspective(drawing, np.diag([4, 4, 1]) @ np.array([[1, 0, 0.375], [0, 1, 0.375], [0, 0, 1]]) @ H,
                              (4 * SIZE[0], 4 * SIZE[1]), borderValue=200)
    return cv2.GaussianBlur(cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA), (0, 0), 0.7)


def draw(folder, drawing, first):
    for name, turn, shift in (('a', np.eye(3), np.zeros(3)), ('b', R, T)):
        (folder / name).mkdir()
        for k, pose in enumerate(POSES):
            # 5 to 10: 10 comes last
            cv2.imwrite(str(folder / name / f'{k + 5}.png'), picture(drawing, first, pose, turn, shift))


def run(capsys, tmp_path, *board):
    out = [str(tmp_path / f'{p}.yaml') for p in 'ab']
    assert calibrate.main(['--pictures-a', str(tmp_path / 'a'), '--pictures-b', str(tmp_path / 'b'), *board, '--square',
                           '20', '--out', *out]) == 0
    return capsys.readouterr().out, *map(read_calibration, out)


def check(said, a, b):
    assert ('plane_a: 6 of 6 pictures show the board' in said
            and 'the reference frame is the optical frame of plane_a' in said)
    off_mm = float(said.split('off by ')[1].split()[0])
    assert off_mm < 0.2
    # six pictures tell no more
    assert np.allclose(a.K, K, atol=15) and np.allclose(b.K, K, atol=15) and (a.width, a.height) == SIZE
    assert np.allclose(a.P, np.c_[a.K, np.zeros(3)])
    pose = np.linalg.solve(b.K, b.P)
    assert np.degrees(Rotation.from_matrix(pose[:, :3] @ R.T).magnitude()) < 2
    assert np.linalg.norm(-pose[:, :3].T @ pose[:, 3] + R.T @ T) < 0.02       # where camera B stands


def test_a_chessboard_gives_both_cameras_and_their_poses(tmp_path, capsys):
    draw(tmp_path, *chessboard(8, 5))
    check(*run(capsys, tmp_path, '--board', '8', '5'))


def test_a_charuco_board_of_which_a_part_will_do(tmp_path, capsys):
    if not hasattr(getattr(cv2, 'aruco', None), 'CharucoDetector'):
        out = [str(tmp_path / f'{p}.yaml') for p in 'ab']
        draw(tmp_path, *chessboard(8, 5))
        assert calibrate.main(['--pictures-a', str(tmp_path / 'a'), '--pictures-b', str(tmp_path / 'b'), '--board', '8',
                               '5', '--square', '20', '--charuco', 'DICT_4X4_50', '--marker', '15', '--out', *out]) == 1
        assert 'needs' in (said := capsys.readouterr().err).replace('need', 'needs') and said.count('\n') == 1
        return
    board = cv2.aruco.CharucoBoard((8, 6), SQUARE, 0.015, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    drawing = np.pad(board.generateImage((8 * PER_SQUARE, 6 * PER_SQUARE)), PER_SQUARE, constant_values=255)
    draw(tmp_path, drawing, 2.0 * PER_SQUARE - 0.5)
    cut = cv2.imread(str(tmp_path / 'b' / '7.png'), cv2.IMREAD_UNCHANGED)
    cut[:, :300] = 200
    cv2.imwrite(str(tmp_path / 'b' / '7.png'), cut)
    check(*run(capsys, tmp_path, '--board', '8', '6', '--charuco', 'DICT_4X4_50', '--marker', '15'))


def test_a_board_upside_down_has_its_corners_in_the_same_order(tmp_path):
    drawing, first = chessboard(8, 5)
    for name, pose in (('up', ((0, 0, 0), (0, 0, 0.5))), ('down', ((0, 0, np.pi), (0, 0, 0.5)))):
        cv2.imwrite(str(tmp_path / f'{name}.png'), picture(drawing, first, pose, np.eye(3), np.zeros(3)))
    up, down = (find_boards(Board(8, 5, SQUARE), [tmp_path / f'{name}.png']).corners[0] for name in ('up', 'down'))
    assert up.keys() == down.keys() and len(up) == 40
    # turned by half a turn about the principal axis: K turns with it
    turned = (np.linalg.inv(K) @ np.c_[np.array(list(up.values())), np.ones(40)].T)[:2].T * [-1, -1]
    assert np.abs(turned * [800, 790] + [310, 250] - np.array(list(down.values()))).max() < 0.3


def test_pictures_that_do_not_do_are_named(tmp_path, capsys):
    draw(tmp_path, *chessboard(8, 5))
    given = ['--board', '8', '5', '--square', '20', '--out', str(tmp_path / 'a.yaml'), str(tmp_path / 'b.yaml')]

    def refused(a, b):
        assert calibrate.main(['--pictures-a', *map(str, a), '--pictures-b', *map(str, b), *given]) == 1
        error = capsys.readouterr().err.splitlines()
        assert len(error) == 1
        return error[0]
    names = [tmp_path / 'b' / f'{k}.png' for k in range(5, 11)]
    assert '6 pictures of plane A and 5 of plane B' in refused([tmp_path / 'a'], names[1:])
    assert ('plane_a: the board is seen in 2 of 2 pictures'
            in refused([tmp_path / 'a' / '5.png', tmp_path / 'a' / '6.png'], names[:2]))
    cv2.imwrite(str(names[0]), np.zeros((100, 100), np.uint8))
    assert 'have one size, not 100x100 and 640x480' in refused([tmp_path / 'a'], [tmp_path / 'b'])
