"""fluoro_shape_replay: a bag of drawn pairs in, results out."""

import csv
import dataclasses
import subprocess
import sys

import cv2
import numpy as np
import pytest

pytest.importorskip('rosbags')
pytest.importorskip('yaml')

from drawing import BASE, BLANK, CALIBRATIONS, GOOD, TOLERANCE, curve
from recording import IMAGE, INFO, RADIUS, SECOND, SKEW, main, outcomes, read, record
from scipy.spatial import cKDTree

from fluoro_shape_ros.config import Config, ConfigError
from fluoro_shape_ros.files import offline
from fluoro_shape_ros.files.parameter_files import read_parameters
from msg_adapters.bags import create_bag, open_bag
from msg_adapters.calibration import calibration_to_camera_info
from msg_adapters.images import array_to_image
from msg_adapters.messages import stamp_ns
from msg_adapters.shapes import path_to_points


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """Good, blank, good."""
    return record(tmp_path_factory.mktemp('recorded') / 'run', [GOOD, BLANK, GOOD])


def test_results_follow_the_contract(run, tmp_path, capsys):
    assert main(run, '--out', tmp_path / 'out', '-p', BASE, '-p', 'reference_frame=cell') == 0
    results, stamps = read(tmp_path / 'out'), [5 * SECOND, 5_200_000_000]
    for topic in ('/backbone', '/tip', '/tip_pose', '/backbone_points'):
        assert ([(log, stamp_ns(m), m.header.frame_id) for log, m in results[topic]]
                == [(s, s, 'cell') for s in stamps]), topic
    points = path_to_points(results['/backbone'][0][1])
    assert cKDTree(curve()).query(points)[0].max() < TOLERANCE
    tip = results['/tip'][0][1].point
    assert [tip.x, tip.y, tip.z] == points[-1].tolist()
    assert np.linalg.norm(points[-1] - curve()[-1]) < TOLERANCE
    assert outcomes(tmp_path / 'out') == {5 * SECOND: 'ok', 5_100_000_000: 'no_device_in_plane_a', 5_200_000_000: 'ok'}
    said = capsys.readouterr().out
    assert '3 pairs of 3 images of plane A and 3 of plane B' in said
    assert '2  ok' in said and '1  no_device_in_plane_a' in said
    assert set(results) == {'/backbone', '/tip', '/tip_pose', '/backbone_points', '/diagnostics'}


def test_the_reference_frame_is_by_default_that_of_plane_a(run, tmp_path):
    main(run, '--out', tmp_path / 'out')
    assert {m.header.frame_id for _, m in read(tmp_path / 'out')['/backbone']} == {'plane_a_optical'}


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_same_output_twice(run, tmp_path, storage):
    for folder in 'ab':
        assert main(run, '--out', tmp_path / folder / 'out', '--storage', storage, '--with-images') == 0
    first, second = ({f.name: f.read_bytes() for f in (tmp_path / folder / 'out').iterdir()} for folder in 'ab')
    assert first == second


def test_storages_agree(tmp_path):
    for storage in ('mcap', 'sqlite3'):
        record(tmp_path / storage, [GOOD], storage)
        main(tmp_path / storage, '--out', tmp_path / f'{storage}_out')
    a, b = (path_to_points(read(tmp_path / f'{storage}_out')['/backbone'][0][1]) for storage in ('mcap', 'sqlite3'))
    assert np.array_equal(a, b)


def test_images_are_copied_on_demand(run, tmp_path):
    main(run, '--out', tmp_path / 'out', '--with-images')
    results = read(tmp_path / 'out')
    assert ([(log, stamp_ns(m)) for log, m in results['/plane_b/image_raw']]
            == [(5 * SECOND + k * SECOND // 10 + SKEW,) * 2 for k in range(3)])
    assert bytes(results['/plane_a/image_raw'][0][1].data) == GOOD[0].tobytes()
    assert len(results['/plane_a/camera_info']) == 3
    # such a bag can be replayed itself
    assert main(tmp_path / 'out', '--out', tmp_path / 'again') == 0
    assert outcomes(tmp_path / 'again') == outcomes(tmp_path / 'out')


def test_a_part_of_the_bag(run, tmp_path):
    main(run, '--out', tmp_path / 'out', '--start', 0.05, '--duration', 0.1)
    assert list(outcomes(tmp_path / 'out')) == [5_100_000_000]
    main(run, '--out', tmp_path / 'first', '--duration', 0.05)
    assert list(outcomes(tmp_path / 'first')) == [5 * SECOND]


@pytest.mark.parametrize('full', [1, 255])
@pytest.mark.parametrize('compressed', [False, True])
def test_silhouettes(tmp_path, full, compressed):
    masks = [((pixels < 140) * full).astype(np.uint8) for pixels in GOOD]
    record(tmp_path / 'run', [masks, [0 * m for m in masks]], compressed=compressed)
    topics = [word for p in 'ab' for word in (f'--image-{p}', f'plane_{p}/image_raw/compressed')] if compressed else []
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '-p', BASE, '-p', 'image_kind=silhouette', *topics) == 0
    assert outcomes(tmp_path / 'out') == {5 * SECOND: 'ok', 5_100_000_000: 'no_device_in_plane_a'}
    points = path_to_points(read(tmp_path / 'out')['/backbone'][0][1])
    assert cKDTree(curve()).query(points)[0].max() < TOLERANCE and np.linalg.norm(points[-1] - curve()[-1]) < TOLERANCE


def cluttered(pair):
    """The pair in front of another, longer wire, which takes half of the beam."""
    lines = [np.array([[20, 40], [300, 290]]), np.array([[20, 290], [300, 50]])]
    passed = [cv2.GaussianBlur(cv2.polylines(np.ones(pixels.shape, np.float32), [line], False, 0.5, 2), (5, 5), 0)
              for pixels, line in zip(pair, lines)]
    return [np.round(pixels * share).astype(np.uint8) for pixels, share in zip(pair, passed)]


def test_the_first_seconds_as_mask(tmp_path, monkeypatch, capsys):
    """Their pairs get no answer, and their mean goes along with every pair after them."""
    masks, intact = [], offline.reconstruct
    monkeypatch.setattr(offline, 'reconstruct',
                        lambda frame, config, prior: masks.append(prior.masks) or intact(frame, config, prior))
    record(tmp_path / 'run', [cluttered(BLANK), cluttered(BLANK), cluttered(GOOD), cluttered(GOOD)])
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '-p', BASE, '--mask', 0.15) == 0
    assert outcomes(tmp_path / 'out') == {5_200_000_000: 'ok', 5_300_000_000: 'ok'}
    for _, path in read(tmp_path / 'out')['/backbone']:
        assert cKDTree(curve()).query(path_to_points(path))[0].max() < TOLERANCE
    assert len(masks) == 2 and all(np.array_equal(seen, drawn) for pair in masks
                                   for seen, drawn in zip(pair, cluttered(BLANK)))
    said = capsys.readouterr().out
    assert '2  made the mask' in said and '2  ok' in said


def test_a_mask_of_bad_images_is_none(tmp_path, capsys):
    def spoil(message):
        message.encoding = 'yuv422' if stamp_ns(message) < 5_050_000_000 else message.encoding
    record(tmp_path / 'run', [BLANK, GOOD], spoil=spoil)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '--mask', 0.05) == 1
    assert '--mask 0.05: there is no usable pair in the first 0.05 s of the bag' in capsys.readouterr().err


def test_a_mask_and_a_later_part_of_the_bag(tmp_path):
    record(tmp_path / 'run', [BLANK, GOOD, GOOD, GOOD])
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '--mask', 0.05, '--start', 0.25) == 0
    assert outcomes(tmp_path / 'out') == {5_300_000_000: 'ok'}
    assert main(tmp_path / 'run', '--out', tmp_path / 'first', '--mask', 0.05, '--duration', 0.15) == 0
    assert outcomes(tmp_path / 'first') == {5_100_000_000: 'ok'}


@pytest.mark.parametrize('tracking, previous', [('true', [False, True, True]), ('false', [False] * 3)])
def test_tracking_can_be_switched_off(tmp_path, monkeypatch, tracking, previous):
    seen, intact = [], offline.reconstruct
    monkeypatch.setattr(offline, 'reconstruct', lambda frame, config, prior: seen.append(prior.previous is not None)
                                                                             or intact(frame, config, prior))
    record(tmp_path / 'run', [GOOD] * 3)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '-p', f'tracking={tracking}') == 0
    assert seen == previous


def test_compressed_images(tmp_path):
    record(tmp_path / 'run', [GOOD], compressed=True)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '-p', 'image_transport=compressed') == 0
    assert list(outcomes(tmp_path / 'out').values()) == ['ok']


def test_topics_are_remapped_as_for_the_node(run, tmp_path):
    """Inputs and outputs, relative and absolute, with the node's own syntax."""
    with open_bag(run) as bag, create_bag(tmp_path / 'cell') as out:
        for topic, kind in bag.types().items():
            out.declare(f'/xray{topic}', kind)
        for r in bag.messages(bag.types()):
            out.write_raw(f'/xray{r.topic}', r.raw, r.log_ns)
    rules = [word for p in 'ab' for topic in ('image_raw', 'camera_info')
             for word in ('-r', f'plane_{p}/{topic}:=/xray/plane_{p}/{topic}')]
    assert main(tmp_path / 'cell', '--out', tmp_path / 'out', '--ros-args', *rules, '-r', 'backbone:=robot/shape', '-p',
                'tracking:=false') == 0
    topics = set(read(tmp_path / 'out'))
    assert topics == {'/robot/shape', '/tip', '/tip_pose', '/backbone_points', '/diagnostics'}


def test_what_is_left_of_a_damaged_bag_is_replayed(tmp_path, capsys):
    record(tmp_path / 'run', [GOOD] * 12)       # of 200 KB a pair: MCAP chunks of 1 MB
    file = tmp_path / 'run' / 'run.mcap'
    file.write_bytes(file.read_bytes()[:-150_000])
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '--csv', tmp_path / 'out.csv') == 1
    error = capsys.readouterr().err
    assert 'run: damaged: ' in error and len(error.splitlines()) == 1
    found = outcomes(tmp_path / 'out')
    assert 3 <= len(found) < 12 and set(found.values()) == {'ok'}
    assert (tmp_path / 'out.csv').exists()


def test_ctrl_c_keeps_what_was_computed(run, tmp_path, monkeypatch, capsys):
    def interrupted(frame, config, prior):
        if frame.stamp_ns == 5_200_000_000:
            raise KeyboardInterrupt
        return intact(frame, config, prior)
    intact = offline.reconstruct
    monkeypatch.setattr(offline, 'reconstruct', interrupted)
    assert main(run, '--out', tmp_path / 'out', '--npz', tmp_path / 'out.npz') == 130
    assert list(outcomes(tmp_path / 'out').values()) == ['ok', 'no_device_in_plane_a']
    assert list(np.load(tmp_path / 'out.npz')['outcome']) == ['ok', 'no_device_in_plane_a']
    assert '2 pairs of 3 images of plane A' in capsys.readouterr().out       # the third was read, but not answered


def test_tables_for_other_programs(run, tmp_path):
    """CSV and NPZ say the same as the bag, and the same bytes every time."""
    for folder in ('first', 'second'):
        (tmp_path / folder).mkdir()
        assert main(run, '--out', tmp_path / folder / 'out', '--csv', tmp_path / folder / 'out.csv', '--npz',
                    tmp_path / folder / 'out.npz', '-p', BASE) == 0
    assert all((tmp_path / 'first' / name).read_bytes() == (tmp_path / 'second' / name).read_bytes()
               for name in ('out.csv', 'out.npz'))
    paths = [path_to_points(path) for _, path in read(tmp_path / 'first' / 'out')['/backbone']]
    with (tmp_path / 'first' / 'out.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ['stamp_s', 'outcome', 's_m', 'x_m', 'y_m', 'z_m', 'sigma_m', 'residual_a_px',
                             'residual_b_px', 'reason', 'confidence']
    points = np.array([[row[f'{axis}_m'] or 'nan' for axis in 'xyz'] for row in rows], float)
    n = len(paths[0])
    assert np.allclose(points[:n], paths[0], atol=1e-9) and np.allclose(points[n + 1:], paths[1], atol=1e-9)
    assert ({row['stamp_s'] for row in rows[:n]} == {'5.000000000'}
            and float(rows[n - 1]['s_m']) == pytest.approx(0.1, abs=0.01))
    assert ((rows[n]['outcome'], rows[n]['stamp_s'], rows[n]['x_m']) == ('no_device_in_plane_a', '5.100000000', '')
            and rows[n]['reason'])
    arrays = np.load(tmp_path / 'first' / 'out.npz')
    assert (arrays['stamp_ns'].tolist() == [5 * SECOND, 5_100_000_000, 5_200_000_000]
            and arrays['outcome'][1] == 'no_device_in_plane_a')
    assert np.array_equal(arrays['points_m'][arrays['pair'] == 2], paths[1]) and not (arrays['pair'] == 1).any()
    assert (arrays['residual_px'].shape == (2 * n, 2) and arrays['sigma_m'].shape == arrays['s_m'].shape == (2 * n,)
            and str(arrays['frame_id']) == 'plane_a_optical')


def test_the_confidence_goes_everywhere(run, tmp_path, monkeypatch):
    """Bag, CSV and NPZ have it of every pair; where it is not known, it is empty or NaN."""
    given = {5 * SECOND: 0.998, 5_100_000_000: 0.25, 5_200_000_000: np.nan}
    intact = offline.reconstruct
    monkeypatch.setattr(offline, 'reconstruct',
                        lambda frame, config, prior: dataclasses.replace(intact(frame, config, prior),
                                                                         confidence=given[frame.stamp_ns]))
    assert main(run, '--out', tmp_path / 'out', '--csv', tmp_path / 'out.csv', '--npz', tmp_path / 'out.npz', '-p',
                BASE, '-p', 'min_confidence=0') == 0
    results = read(tmp_path / 'out')
    assert ([{v.key: v.value for v in m.status[0].values}['confidence'] for _, m in results['/diagnostics']]
            == ['0.998', '0.250', ''])
    first, last = (np.frombuffer(bytes(m.data), '<f4').reshape(m.width, -1)[:, -1]
                   for _, m in results['/backbone_points'])
    assert [m.fields[-1].name for _, m in results['/backbone_points']] == ['confidence'] * 2
    assert set(first) == {np.float32(0.998)} and np.isnan(last).all()
    with (tmp_path / 'out.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert {(row['stamp_s'], row['outcome'], row['confidence']) for row in rows} == {
        ('5.000000000', 'ok', '0.998000000'), ('5.100000000', 'no_device_in_plane_a', '0.250000000'),
        ('5.200000000', 'ok', '')}
    assert [bool(row['reason']) for row in rows] == [row['outcome'] != 'ok' for row in rows]
    assert np.array_equal(np.load(tmp_path / 'out.npz')['confidence'], list(given.values()), equal_nan=True)


def test_images_read_ahead_come_in_order_and_errors_in_their_turn():
    def items():
        yield from range(20)
        raise OSError('at last')
    taken = []
    with pytest.raises(OSError, match='at last'):
        for item in offline.ahead(items(), 3):
            taken.append(item)
    assert taken == list(range(20))
    assert list(offline.ahead([], 3)) == []


def test_other_topics(tmp_path, run):
    """Planes may be swapped by name: the answer is the same, stamped by the other plane."""
    names = [f'--{what}-{p}={f"plane_{q}/{topic}"}' for what, topic in (('image', 'image_raw'), ('info', 'camera_info'))
             for p, q in ('ab', 'ba')]
    assert main(run, '--out', tmp_path / 'out', '-p', BASE, *names) == 0
    assert [log for log, _ in read(tmp_path / 'out')['/tip']] == [5 * SECOND + SKEW, 5_200_000_000 + SKEW]


def test_a_bad_image_is_named_and_the_next_pair_works(tmp_path):
    def spoil(message):
        if message.header.stamp.nanosec == 0:
            message.encoding = 'bayer_rggb8'
    record(tmp_path / 'run', [GOOD, GOOD], spoil=spoil)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out') == 0
    assert outcomes(tmp_path / 'out') == {5 * SECOND: 'bad_image', 5_100_000_000: 'ok'}
    status = read(tmp_path / 'out')['/diagnostics'][0][1].status[0]
    assert 'plane a' in status.message and 'bayer_rggb8' in status.message and status.level == 2


def test_frames_that_contradict_are_said(tmp_path, capsys):
    """Images of plane A with the camera info of another frame."""
    def spoil(message):
        message.header.frame_id = message.header.frame_id.replace('plane_a', 'plane_b')
    record(tmp_path / 'run', [GOOD], spoil=spoil)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out') == 0
    lines = capsys.readouterr().out.splitlines()
    assert (lines[-1] == 'plane A: its images are of frame "plane_b_optical", its camera info of "plane_a_optical": '
                         'are the calibrations exchanged?')
    assert not any('plane B' in line for line in lines[1:])


def test_no_camera_info(tmp_path):
    record(tmp_path / 'run', [GOOD], infos=False)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out') == 0
    assert list(outcomes(tmp_path / 'out').values()) == ['no_camera_info']


@pytest.mark.parametrize('field, value, says', [('p', np.zeros(12), 'P is zero'),
                                                ('d', np.zeros(1000), 'D has 1000 coefficients')], ids=['p', 'd'])
def test_a_refused_camera_info_is_reported_and_the_one_before_holds(tmp_path, capsys, field, value, says):
    with create_bag(tmp_path / 'run') as bag:
        for p, pixels, c in zip('ab', GOOD, CALIBRATIONS):
            bag.declare(f'/plane_{p}/image_raw', IMAGE)
            bag.declare(f'/plane_{p}/camera_info', INFO)
            good, bad = (calibration_to_camera_info(c, stamp, 'f', bag.new) for stamp in (SECOND, 2 * SECOND))
            setattr(bad, field, value)
            for message in (good, bad):
                bag.write(f'/plane_{p}/camera_info', message, stamp_ns(message))
            bag.write(f'/plane_{p}/image_raw', array_to_image(pixels, 3 * SECOND, 'f', bag.new), 3 * SECOND)
    assert main(tmp_path / 'run', '--out', tmp_path / 'out') == 0
    assert list(outcomes(tmp_path / 'out').values()) == ['ok']
    assert f'camera infos refused: plane b: {says}' in capsys.readouterr().out


def test_a_camera_holds_from_its_stamp_on():
    known = [(10, 'first'), (20, 'second'), (30, 'third')]
    assert ([offline.camera_at(known, stamp) for stamp in (5, 10, 19, 20, 29, 30, 99)]
            == ['first', 'first', 'first', 'second', 'second', 'third', 'third'])
    assert offline.camera_at([], 5) is None


def test_a_bag_that_loops(tmp_path, capsys):
    """Stamps jump back, as when a looping `ros2 bag play` was recorded: the pairs after it count."""
    stamps = [5 * SECOND, 5_100_000_000, 1 * SECOND, 1_100_000_000]
    record(tmp_path / 'run', [GOOD] * 4, stamps=stamps)
    main(tmp_path / 'run', '--out', tmp_path / 'out')
    assert outcomes(tmp_path / 'out')[1_100_000_000] == 'ok'
    assert 'stamps jumped back' in capsys.readouterr().out


def test_an_error_of_the_program_costs_its_pair_and_the_exit_code(run, tmp_path, monkeypatch, capsys):
    def broken(frame, config, prior):
        if frame.stamp_ns == 5_100_000_000:
            raise ZeroDivisionError('a bug')
        return intact(frame, config, prior)
    intact = offline.reconstruct
    monkeypatch.setattr(offline, 'reconstruct', broken)
    assert main(run, '--out', tmp_path / 'out') == 1
    assert outcomes(tmp_path / 'out') == {5 * SECOND: 'ok', 5_100_000_000: 'internal_error', 5_200_000_000: 'ok'}
    assert 'ZeroDivisionError: a bug (stamp 5.100 s)' in capsys.readouterr().err


def test_parameters_from_file_and_command_line(tmp_path):
    path = tmp_path / 'params.yaml'
    path.write_text('/**:\n  ros__parameters:\n    use_sim_time: true\n    robot_radius: 1e-3\n    polarity: bright\n'
                    'fluoro_shape:\n  ros__parameters:\n    polarity: auto\n    expected_length: '
                    '[0.01, 1.0]\n    tracking: false\nother:\n  ros__parameters: {x: 1}\n')
    values = read_parameters(str(path), ['tracking=true', 'spacing_px:=1e1', 'base_position=[1, 2e-1, 3]'])
    assert values == dict(robot_radius=1e-3, polarity='auto', expected_length=(0.01, 1), tracking=True, spacing_px=10.0,
                          base_position=(1, 0.2, 3))
    assert Config.from_values(**values).detection.robot_radius == 0.001


@pytest.mark.parametrize('text, says', [('', 'not a ROS parameter file'), ('fluoro_shape: 3', 'no ros__parameters'),
                                        ('a: [', 'not YAML'),
                                        ('other:\n  ros__parameters: {}', 'no ros__parameters of fluoro_shape')])
def test_a_bad_parameter_file_is_named(tmp_path, text, says):
    (tmp_path / 'params.yaml').write_text(text)
    with pytest.raises(ConfigError, match=f'params.yaml: {says}'):
        read_parameters(str(tmp_path / 'params.yaml'))


def test_a_device_gives_the_radius(run, tmp_path):
    path = tmp_path / 'rod.yaml'
    path.write_text('segments: [{length: rest, radius: 0.001, material: metal}]')
    assert main(run, '--out', tmp_path / 'out') == 0
    assert main(run, '--out', tmp_path / 'described', '-p', f'device={path}', '-p', 'robot_radius=0.0003') == 0
    tips, described = ([(m.point.x, m.point.y, m.point.z) for _, m in read(tmp_path / out)['/tip']]
                       for out in ('out', 'described'))
    assert tips == described and len(tips) == 2


def process(*arguments, code=None):
    start = ['-m', 'fluoro_shape_ros.files.replay'] if code is None else ['-c', code]
    return subprocess.run([sys.executable, *start, '-p', RADIUS, *map(str, arguments)], capture_output=True, text=True,
                          timeout=120)


def test_as_a_process(run, tmp_path):
    done = process(run, '--out', tmp_path / 'out.db3', '-p', BASE)
    assert (done.returncode, done.stderr) == (0, '')
    assert list(outcomes(tmp_path / 'out.db3').values()) == ['ok', 'no_device_in_plane_a', 'ok']
    assert (tmp_path / 'out.db3' / 'out.db3.db3').exists()


@pytest.mark.parametrize('arguments, code, says', [
    (['none'], 1, 'none: no such bag'),
    (['damaged'], 1, 'damaged: can\'t be read as a bag'),
    (['run', '--image-a', 'elsewhere'], 1, '/elsewhere is not in the bag; name another with --image-a '
                                           '(such topics in it: /plane_a/image_raw, /plane_b/image_raw)'),
    (['run', '--info-b', 'plane_b/image_raw'], 1,
     '/plane_b/image_raw is a sensor_msgs/msg/Image; name another with --info-b'),
    (['run', '-p', 'sync_slop=0.001'], 1, 'no images pair: there are 3 of plane A and 3 of plane B, 0 without a stamp; '
                                          'sync_slop is 1 ms'),
    (['run', '--params', 'none.yaml'], 1, 'none.yaml'),
    (['run', '--out', '.'], 1, '. exists already'),
    (['run', '-p', 'robot_radius=-1'], 2, 'robot_radius: must lie in'),
    (['run', '-p', 'colour=red'], 2, 'no such parameter: colour'),
    (['run', '-p', 'image_kind=mri'], 2, 'image_kind: must be one of xray, silhouette'),
    (['run', '-p', 'device=none.yaml'], 2, 'device: none.yaml: no such file'),
    (['run', '-p', 'robot_radius'], 2, 'needs the form name=value'),
    (['run', '-p', 'geometry=tf'], 2, 'geometry: '),
    (['run', '--image-a', 'x', '--image-b', '/x'], 2, 'same topic'),
    (['run', '--start', '-1'], 2, '--start'),
    (['run', '--mask', '1', '--duration', '0.5'], 2, '--mask: nothing is left'),
    (['run', '--mask', '9'], 1, '--mask 9: no pair comes after the 3 that made the mask'),
    (['run', '-r', 'plane_c/image_raw:=/x'], 2, '-r plane_c/image_raw:=/x: there is no topic plane_c/image_raw; '
                                                'those are plane_a/image_raw, '),
    (['run', '-r', 'tip'], 2, '-r tip: needs the form FROM:=TO'),
    (['run', '-r', 'tip:=backbone'], 2, 'two results have the same topic'),
    (['run', '--csv', 'run'], 1, 'run exists already'),
    (['run', '--npz', 'none/out.npz'], 1, 'none/out.npz: there is no folder none'),
    ([], 2, 'required'),
], ids=lambda value: ' '.join(value) if isinstance(value, list) else '')
def test_what_can_not_work_is_said_in_one_line(run, tmp_path, monkeypatch, capsys, arguments, code, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'run').symlink_to(run)
    (tmp_path / 'damaged').write_bytes((run / 'run.mcap').read_bytes()[:5000])
    arguments = arguments if '--out' in arguments else [*arguments, '--out', 'out']
    try:
        assert main(*arguments) == code == 1
    except SystemExit as end:       # of argparse
        assert end.code == code == 2
    error = capsys.readouterr().err
    assert says in error.splitlines()[-1]
    assert len(error.splitlines()) == 1 or error.startswith('usage: ')
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize('arguments, code', [(['none', '--out', 'out'], 1), (['none'], 2), (['--help'], 0)])
def test_exit_codes_of_the_process(tmp_path, arguments, code):
    done = process(*arguments)
    assert done.returncode == code
    assert 'Traceback' not in done.stderr


@pytest.mark.parametrize('missing, extra, more', [('rosbags', 'bags', ()), ('mcap', 'bags', ()),
                                                  ('plotly', 'report', ('--report', 'page.html'))])
def test_what_is_not_installed_is_named_with_its_extra(run, tmp_path, capsys, monkeypatch, missing, extra, more):
    for module in [name for name in sys.modules if name.split('.')[0] == missing]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(run, '--out', tmp_path / 'out', *more) == 1
    error = capsys.readouterr().err
    assert f'needs {missing}' in error and f'fluoro_shape_ros[{extra}]' in error and len(error.splitlines()) == 1
    assert not (tmp_path / 'out').exists()


def test_needs_no_ros(run, tmp_path):
    code = ('import sys\nfor name in ("rclpy", "sensor_msgs", "nav_msgs", "std_msgs"): sys.modules[name] = None\n'
            'from fluoro_shape_ros.files.replay import main\nsys.exit(main())')
    done = process(run, '--out', tmp_path / 'out', '--duration', '0.05', code=code)
    assert (done.returncode, done.stderr) == (0, '')
