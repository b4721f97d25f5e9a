"""fluoro_shape_import: image files and calibrations in, a bag out that replays."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

pytest.importorskip('rosbags')
pytest.importorskip('yaml')

from drawing import CALIBRATIONS, GOOD, RADIUS, SIZE

from fluoro_shape_ros.cli import ToolError
from fluoro_shape_ros.files import importer, replay
from fluoro_shape_ros.files.stamps import read_stamps
from msg_adapters.bags import open_bag
from msg_adapters.calibration import Calibration, write_calibration
from msg_adapters.images import image_to_array
from msg_adapters.messages import stamp_ns

SECOND = 10**9


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Two pairs in folders a and b, calibrations beside them; it is the working directory."""
    monkeypatch.chdir(tmp_path)
    for plane, pixels, calibration in zip('ab', GOOD, CALIBRATIONS):
        (tmp_path / plane).mkdir()
        for k in (2, 10):
            marked = pixels.copy()
            marked[0, 0] = k
            cv2.imwrite(f'{plane}/frame{k}.png', marked)
        write_calibration(f'{plane}.yaml', calibration)
    return tmp_path


def arguments(*more, plane_a=('a',), plane_b=('b',)):
    return ['--plane-a', *plane_a, '--plane-b', *plane_b, '--camera-a', 'a.yaml', '--camera-b', 'b.yaml', '--out',
            'out', *more]


def read(path='out'):
    with open_bag(path) as bag:
        return {topic: [(r.log_ns, r.message) for r in bag.messages([topic])] for topic in bag.types()}


def refused(capsys, *more, **planes):
    """What the tool says when it ends with 1."""
    assert importer.main(arguments(*more, **planes)) == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    return error


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_makes_the_bag_that_the_contract_names(folder, storage, capsys):
    assert importer.main(arguments('--rate', '8', '--storage', storage)) == 0
    assert '2 pairs in out' in capsys.readouterr().out
    bag = read()
    assert set(bag) == {'/plane_a/image_raw', '/plane_a/camera_info', '/plane_b/image_raw', '/plane_b/camera_info'}
    for topic, messages in bag.items():
        assert [(log, stamp_ns(m)) for log, m in messages] == [(SECOND, SECOND), (1_125_000_000, 1_125_000_000)]
        assert {m.header.frame_id for _, m in messages} == {f'{topic[1:8]}_optical'}
    first, second = (image_to_array(m) for _, m in bag['/plane_b/image_raw'])
    assert (first[0, 0], second[0, 0]) == (2, 10)       # frame2 before frame10
    assert np.array_equal(first[1:, 0], GOOD[1][1:, 0])
    info = bag['/plane_b/camera_info'][0][1]
    assert (info.width, info.height, info.distortion_model) == (SIZE, SIZE, 'plumb_bob')
    assert np.array_equal(info.p.reshape(3, 4), CALIBRATIONS[1].P)


def test_what_is_imported_replays(folder):
    assert importer.main(arguments('--frame-ids', 'left', 'right')) == 0
    assert replay.main(['out', '--out', 'results', '-p', f'robot_radius={RADIUS}']) == 0
    results = read('results')
    assert [log for log, _ in results['/tip']] == [SECOND, SECOND + round(SECOND / 15)]
    assert {m.header.frame_id for _, m in results['/backbone']} == {'left'}


def test_16_bits_are_kept(folder):
    deep = GOOD[0].astype(np.uint16) * 257 + 1
    for name in ('a/frame2.tif', 'a/frame10.png'):
        cv2.imwrite(name, deep)
    assert importer.main(arguments(plane_a=['a/frame2.tif', 'a/frame10.png'])) == 0
    images = [m for _, m in read()['/plane_a/image_raw']]
    assert [m.encoding for m in images] == ['mono16'] * 2
    assert all(np.array_equal(image_to_array(m), deep) for m in images)


def test_all_pages_of_a_file(folder):
    cv2.imwritemulti('a.tif', [np.full((SIZE, SIZE), level, np.uint16) for level in (300, 7)])
    assert importer.main(arguments(plane_a=['a.tif'])) == 0
    assert [image_to_array(m)[0, 0] for _, m in read()['/plane_a/image_raw']] == [300, 7]


def test_videos_bring_their_rate(folder, capsys):
    for p, pixels in zip('ab', GOOD):
        writer = cv2.VideoWriter(f'{p}.avi', cv2.VideoWriter_fourcc(*'MJPG'), 20, (SIZE, SIZE), False)
        for _ in range(3):
            writer.write(pixels)
        writer.release()
    assert importer.main(arguments(plane_a=['a.avi'], plane_b=['b.avi'])) == 0
    assert capsys.readouterr().out == '3 pairs in out\n'
    images = read()['/plane_b/image_raw']
    assert [log for log, _ in images] == [SECOND, 1_050_000_000, 1_100_000_000]
    assert np.abs(image_to_array(images[1][1]).astype(int) - GOOD[1]).mean() < 3


def test_a_rate_that_nobody_told_is_said(folder, capsys):
    assert importer.main(arguments()) == 0
    assert (capsys.readouterr().out.splitlines()
            == ['2 pairs in out', 'no file tells the rate: 15 images/s are a guess; --rate or --stamps says it'])
    assert importer.main(arguments('--rate', '15', '--out', 'other')) == 0
    assert capsys.readouterr().out == '2 pairs in other\n'


def test_what_a_shell_makes_of_a_pattern_comes_in_the_order_of_its_numbers(folder):
    assert importer.main(arguments(plane_a=['a/frame10.png', 'a/frame2.png'])) == 0
    assert [image_to_array(m)[0, 0] for _, m in read()['/plane_a/image_raw']] == [2, 10]


def test_another_order_than_that_of_the_numbers_is_said(folder, capsys):
    (folder / 'a' / 'frame1.png').write_bytes((folder / 'a' / 'frame10.png').read_bytes())
    names = ['a/frame2.png', 'a/frame10.png', 'a/frame1.png']       # as no shell sorts
    assert importer.main(arguments('--rate', '15', plane_a=names,
                                   plane_b=['b/frame2.png', 'b/frame10.png', 'b/frame10.png'])) == 0
    assert (capsys.readouterr().out.splitlines()[1:]
            == ['plane A: its images are taken in the order given, which is not that of the numbers in their names'])
    assert [image_to_array(m)[0, 0] for _, m in read()['/plane_a/image_raw']] == [2, 10, 10]


def test_stamps_from_a_file_keep_their_nanoseconds(folder):
    (folder / 'stamps.txt').write_text('1795366364.835233992\n\n1795366365.058033953\n')
    assert importer.main(arguments('--stamps', 'stamps.txt')) == 0
    assert [log for log, _ in read()['/plane_a/image_raw']] == [1795366364835233992, 1795366365058033953]


def test_files_folders_and_patterns(folder):
    names = lambda *patterns: [str(p) for p in importer.find_files(list(patterns))]   # noqa: E731
    (folder / 'a' / 'notes.txt').write_text('not an image')
    assert names('a') == names('a/*.png') == ['a/frame2.png', 'a/frame10.png']
    assert names('b/frame10.png', 'a/frame2.png') == ['b/frame10.png', 'a/frame2.png']      # as given
    (folder / 'a' / 'frame[1].png').write_bytes((folder / 'a' / 'frame2.png').read_bytes())
    assert names('a/frame[1].png') == ['a/frame[1].png']
    with pytest.raises(ToolError, match='none: no image files'):
        names('none')


def test_what_can_not_work_is_said_in_one_line(folder, capsys):
    (folder / 'empty').mkdir()
    (folder / 'short').write_text('1.5\n')
    (folder / 'text.png').write_text('not an image')
    (folder / 'half.png').write_bytes((folder / 'a' / 'frame2.png').read_bytes()[:30])
    cv2.imwrite('small.png', np.zeros((8, 9), np.uint8))
    assert 'plane A has 1 images, plane B 2' in refused(capsys, plane_a=['a/frame2.png'])
    assert 'empty: no image files' in refused(capsys, plane_a=['empty'])
    assert 'text.png: not an image' in refused(capsys, plane_a=['text.png', 'text.png'])
    assert 'half.png: can\'t be read' in refused(capsys, plane_a=['half.png', 'half.png'])
    assert 'the image is 9x8' in refused(capsys, plane_b=['small.png', 'small.png'])
    assert 'short has 1 stamps for 2 pairs' in refused(capsys, '--stamps', 'short')
    assert 'none.yaml' in refused(capsys, '--camera-a', 'none.yaml')
    assert 'text.png: no calibration' in refused(capsys, '--camera-a', 'text.png')
    assert 'camera_name "plane_b" was given for plane A' in refused(capsys, '--camera-a', 'b.yaml')
    (folder / 'unnamed.yaml').write_text((folder / 'b.yaml').read_text().replace('camera_name: plane_b',
                                                                                 'camera_name: detector'))
    assert 'coincide' in refused(capsys, '--camera-a', 'unnamed.yaml')
    assert 'a exists already' in refused(capsys, '--out', 'a')
    assert not (folder / 'out').exists()


def test_a_stereo_pair_in_one_file_without_its_size_in_millimetres(folder, capsys):
    """As OpenCV gives it: K, D and R, T from camera A, which is the reference frame, to camera B."""
    poses = [np.vstack([np.linalg.solve(c.K, c.P), [0, 0, 0, 1]]) for c in CALIBRATIONS]
    b_from_a = poses[1] @ np.linalg.inv(poses[0])
    K = CALIBRATIONS[0].K
    np.savez('stereo.npz', mtxL=K, distL=np.zeros(5), mtxR=K, distR=np.zeros(5), R=b_from_a[:3, :3],
             T=1e3 * b_from_a[:3, 3])
    assert importer.main(arguments('--camera-a', 'stereo.npz', '--camera-b', 'stereo.npz', '--rate', '15')) == 0
    assert capsys.readouterr().out.splitlines() == ['2 pairs in out', 'the calibrations are in mm, as a source stands '
                                                                      '1131 from the origin; --unit says otherwise']
    info = read()['/plane_b/camera_info'][0][1]
    assert (info.width, info.height) == (SIZE, SIZE) and np.allclose(info.p.reshape(3, 4), K @ b_from_a[:3])


@pytest.mark.parametrize('unit, metres', [('m', 1e3), ('mm', 1e-3)])
def test_calibrations_that_are_not_in_metres_are_said(folder, capsys, unit, metres):
    """A device of 1.2 mm is 1.2 px wide here. Lengths a thousand times as long, or a thousandth, make that 1/1000, or
    1200."""
    for p, c in zip('ab', CALIBRATIONS):
        write_calibration(f'{p}.yaml', Calibration(c.camera_name, SIZE, SIZE, c.K,
                                                   c.P * [1, 1, 1, 1e3 if unit == 'm' else 1]))
    assert importer.main(arguments('--unit', unit, '--rate', '15')) == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 2 and said[1].endswith('px wide where the planes look: are the calibrations in metres?')
    assert f'1.2 mm thick would be {1.2 / metres:.3g} px' in said[1]


@pytest.mark.parametrize('name, plane', [('plane_b', 'a'), ('PLANE A', 'b'), ('biplane_b_optical', 'a'), ('a', 'b')])
def test_names_that_contradict_are_refused(folder, capsys, name, plane):
    """A calibration, or a frame, of the other plane."""
    (folder / 'c.yaml').write_text((folder / f'{plane}.yaml').read_text().replace(f'camera_name: plane_{plane}',
                                                                                  f'camera_name: {name}'))
    assert (f'camera_name "{name}" was given for plane {plane.upper()}: are the planes exchanged?'
            in refused(capsys, f'--camera-{plane}', 'c.yaml'))
    frames = ['left', 'right']
    frames['ab'.index(plane)] = name
    assert f'frame_id "{name}" was given for plane {plane.upper()}' in refused(capsys, '--frame-ids', *frames)
    assert not (folder / 'out').exists()


@pytest.mark.parametrize('name', ['', 'detector', 'airplane_b', 'cab', 'plane_1', 'narrow_stereo/left', 'plane_a', 'A'])
def test_names_that_tell_no_other_plane_pass(folder, name):
    (folder / 'c.yaml').write_text((folder / 'a.yaml').read_text().replace('camera_name: plane_a',
                                                                           f'camera_name: "{name}"'))
    assert importer.main(arguments('--camera-a', 'c.yaml')) == 0


def test_a_calibration_that_is_no_camera_is_refused(folder, capsys):
    write_calibration('a.yaml', Calibration('a', SIZE, SIZE, CALIBRATIONS[0].K, np.zeros((3, 4))))
    assert 'plane a: P is zero' in refused(capsys)


@pytest.mark.parametrize('text, says', [('1\none', 'line 2: "one" is no time'),
                                        ('2\n1', 'line 2: 1 s: stamps must be positive and increase'),
                                        ('0', 'line 1: 0 s'), ('nan', 'line 1'), ('1e30', 'line 1'), ('-1', 'line 1')])
def test_bad_stamps_are_named(tmp_path, text, says):
    (tmp_path / 'stamps').write_text(text)
    with pytest.raises(ToolError, match=f'stamps, {says}'):
        read_stamps(str(tmp_path / 'stamps'))


def process(*given, code=None):
    start = ['-m', 'fluoro_shape_ros.files.importer'] if code is None else ['-c', code]
    return subprocess.run([sys.executable, *start, *given], capture_output=True, text=True, timeout=120)


def test_as_a_process_without_ros(folder):
    # from another working directory than the source's: so that the child finds the package
    code = (f'import sys\nsys.path[:0] = {[p for p in sys.path if p]!r}\n'
            'for name in ("rclpy", "sensor_msgs", "std_msgs"): sys.modules[name] = None\n'
            'from fluoro_shape_ros.files.importer import main\nsys.exit(main())')
    done = process(*arguments(), code=code)
    assert done.returncode == 0 and done.stderr.splitlines() == [
        'results will be in the frame of the calibrations: name it, fluoro_shape_replay out --out results -p '
        'reference_frame=isocenter']
    assert len(read()['/plane_a/image_raw']) == 2


@pytest.mark.parametrize('given, code, says', [
    (arguments(plane_a=['none']), 1, 'fluoro_shape_import: none: no image files there'),
    (arguments('--rate', '0'), 2, '--rate: must lie in'),
    (arguments('--rate', 'fast'), 2, '--rate'),
    (arguments('--storage', 'zip'), 2, '--storage'),
    ([], 2, 'required'),
    (['--help'], 0, ''),
], ids=lambda value: value if isinstance(value, str) else '')
def test_exit_codes_of_the_process(given, code, says):
    done = process(*given)
    assert done.returncode == code
    assert 'Traceback' not in done.stderr
    assert says in (done.stderr.splitlines() or [''])[-1]
