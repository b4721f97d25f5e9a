"""Frames whose names contradict: said by the node, the replay and the importer, and never where all is as it should
be."""

import numpy as np
import pytest
from drawing import CALIBRATIONS, GOOD, VIEWS, K

pytest.importorskip('rosbags')

from recording import main, read, record

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.files import importer
from fluoro_shape_ros.ros.frame_names import doubts
from fluoro_shape_ros.ros.worker import camera
from msg_adapters.calibration import calibration_to_camera_info
from msg_adapters.cameras import has_pose
from msg_adapters.messages import bag_message

FRAMES = 'plane_a_optical', 'plane_b_optical'
POSED = ('results are labelled "plane_a_optical", but P of plane A has a pose, so that they lie in another frame: '
         'name it by reference_frame')
TURNED = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.fixture(scope='module')
def new():
    from rosbags.typesys import Stores, get_typestore
    return bag_message(get_typestore(Stores.ROS2_JAZZY))


def info(new, plane, frame_id, P=None):
    msg = calibration_to_camera_info(CALIBRATIONS[plane], 0, frame_id, new)
    msg.p = msg.p if P is None else P.ravel()
    return msg


@pytest.mark.parametrize('P, posed', [
    (np.c_[K, np.zeros(3)], False),
    (-2 * np.diag([-1.0, 1, 1]) @ np.c_[K, np.zeros(3)] * -1, False),       # seen from behind, scaled
    (np.c_[K, [-80.0, 0, 0]], True),        # the right camera of a rectified stereo pair
    (np.c_[K @ TURNED, np.zeros(3)], True),
    (VIEWS[0], True),
])
def test_a_pose_in_p(new, P, posed):
    assert has_pose(info(new, 0, 'f', P)) is posed


@pytest.mark.parametrize('given, P, images, infos, said', [
    ({}, None, FRAMES, FRAMES, [POSED]),
    ({}, np.c_[K, np.zeros(3)], FRAMES, FRAMES, []),
    (dict(reference_frame='isocenter'), None, FRAMES, FRAMES, []),
    (dict(geometry='tf'), None, FRAMES, FRAMES, []),
    (dict(reference_frame='cell'), None, ('plane_a_optical', 'lateral'), FRAMES,
     ['plane B: its images are of frame "lateral", its camera info of "plane_b_optical": '
      'are the calibrations exchanged?']),
    (dict(reference_frame='cell'), None, ('', ''), FRAMES, []),
    (dict(reference_frame='cell'), None, FRAMES[::-1], FRAMES[::-1],
     ['frame_id "plane_b_optical" was given for plane A: are the planes exchanged?']),
    (dict(reference_frame='cell'), None, FRAMES[::-1], ('', ''),
     ['frame_id "plane_b_optical" was given for plane A: are the planes exchanged?']),
    (dict(reference_frame='cell'), None, ('frontal', 'lateral'), ('frontal', 'lateral'), []),
])
def test_what_contradicts(new, given, P, images, infos, said):
    cameras = tuple(camera(info(new, k, frame, P if k == 0 else None)) for k, frame in enumerate(infos))
    assert list(doubts(Config.from_values(**given), images, cameras)) == said


def test_cameras_that_are_not_there_contradict_nothing():
    assert doubts(Config(), FRAMES, (None, None)) == ()


@pytest.mark.parametrize('frame', [None, 'cell'])
def test_a_replay_says_it_in_the_terminal_and_in_its_bag(tmp_path, capsys, frame):
    record(tmp_path / 'run', [GOOD])
    assert main(tmp_path / 'run', '--out', tmp_path / 'out',
                *(['-p', f'reference_frame={frame}'] if frame else [])) == 0
    assert (POSED in capsys.readouterr().out) is (frame is None)
    status = read(tmp_path / 'out')['/diagnostics'][0][1].status[0]
    assert (POSED in status.message) is (frame is None) and (frame or status.level == 1)


def test_the_importer_prints_a_command_that_names_a_frame(tmp_path, capsys, monkeypatch):
    import cv2
    monkeypatch.chdir(tmp_path)
    for plane, P, pixels in zip('ab', VIEWS, GOOD):
        cv2.imwrite(f'{plane}.png', pixels)
        rows = ', '.join(f'{x:.9g}' for x in P.ravel())
        (tmp_path / f'{plane}.yaml').write_text(f'image_width: 320\nimage_height: 320\ncamera_name: plane_{plane}\n'
                                                'distortion_model: plumb_bob\ncamera_matrix: {rows: '
                                                f'3, cols: 3, data: [{", ".join(map(str, K.ravel()))}]}}\n'
                                                'distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n'
                                                f'projection_matrix: {{rows: 3, cols: 4, data: [{rows}]}}\n')
    given = [word for p in 'ab' for word in (f'--plane-{p}', f'{p}.png', f'--camera-{p}', f'{p}.yaml')]
    assert importer.main([*given, '--rate', '15', '--out', 'run']) == 0
    said = capsys.readouterr()
    assert (said.out == '1 pairs in run\n'
            and 'fluoro_shape_replay run --out results -p reference_frame=isocenter' in said.err)


def test_the_node_says_it_in_log_and_diagnostics(tmp_path):
    """Once while it lasts, and at once when planes' frames contradict."""
    pytest.importorskip('rclpy')
    import ros_client as ros
    with (ros.NodeProcess(tmp_path / 'log.txt', 'time_budget:=0', ros.BASE, ros.RADIUS, domain=ros.OTHER) as node,
          ros.Client(domain=ros.OTHER) as client):
        assert client.connected() and client.insist(lambda: client.paths), node.log
        assert client.good() and client.hears(POSED)
        assert node.log.count(POSED) == 1 and '[WARN]' in next(line for line in node.log.splitlines() if POSED in line)
        assert client.set('reference_frame', 'cell').successful and client.good()

        def mixed():
            """Images of the frames that are the other plane's."""
            images, infos = [ros.image_msg(pixels) for pixels in ros.GOOD], [ros.info_msg(P) for P in ros.VIEWS]
            client.send([], infos=[])
            for plane, m, i in zip('ab', images, infos):
                i.header.stamp = m.header.stamp = ros.time_msg(client.now_ns)
                i.header.frame_id, m.header.frame_id = (f'plane_{plane}_optical',
                                                        f'plane_{"ba"["ab".index(plane)]}_optical')
            for publisher, m in zip((*client.infos, *client.images), (*infos, *images)):
                publisher.publish(m)
        words = 'plane A: its images are of frame "plane_b_optical", its camera info of "plane_a_optical"'
        said = lambda: any(words in s.message and s.level == b'\x01' for s in client.statuses)     # noqa: E731
        assert any(mixed() or client.until(said, 1.0) for _ in range(20))
        assert client.good() and not any(POSED in s.message for s in client.statuses[-4:])
        assert node.end() == 0 and 'Traceback' not in node.log
