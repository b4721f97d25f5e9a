"""fluoro_shape_import: image files and calibrations in, a bag out that replays."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

pytest.importorskip('rosbags')
pytest.importorskip('yaml')

from drawing import CALIBRATIONS, GOOD, RADIUS, SIZE                            # noqa: E402

from fluoro_shape_ros.tools import importer, replay    # noqa: E402
from fluoro_shape_ros.tools.cli import ToolError    # noqa: E402
from msg_adapters.bags import open_bag                                  # noqa: E402
from msg_adapters.calibration import Calibration, write_calibration     # noqa: E402
from msg_adapters.images import image_to_array                          # noqa: E402
from msg_adapters.messages import stamp_ns                              # noqa: E402

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
    return ['--plane-a', *plane_a, '--plane-b', *plane_b, '--camera-a', 'a.yaml', '--camera-b', 'b.yaml', '--out', 'out', *more]


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
    assert 'coincide' in refused(capsys, '--camera-a', 'b.yaml')
    assert 'a exists already' in refused(capsys, '--out', 'a')
    assert not (folder / 'out').exists()


def test_a_calibration_that_is_no_camera_is_refused(folder, capsys):
    write_calibration('a.yaml', Calibration('a', SIZE, SIZE, CALIBRATIONS[0].K, np.zeros((3, 4))))
    assert 'plane a: P is zero' in refused(capsys)


@pytest.mark.parametrize('text, says', [('1\none', 'line 2: "one" is no time'), ('2\n1', 'line 2: 1 s: stamps must be positive and increase'),
                                        ('0', 'line 1: 0 s'), ('nan', 'line 1'), ('1e30', 'line 1'), ('-1', 'line 1')])
def test_bad_stamps_are_named(tmp_path, text, says):
    (tmp_path / 'stamps').write_text(text)
    with pytest.raises(ToolError, match=f'stamps, {says}'):
        importer.read_stamps(str(tmp_path / 'stamps'))


def process(*given, code=None):
    start = ['-m', 'fluoro_shape_ros.tools.importer'] if code is None else ['-c', code]
    return subprocess.run([sys.executable, *start, *given], capture_output=True, text=True, timeout=120)


def test_as_a_process_without_ros(folder):
    # from another working directory than the source's: so that the child finds the package
    code = (f'import sys\nsys.path[:0] = {[p for p in sys.path if p]!r}\nfor name in ("rclpy", "sensor_msgs", "std_msgs"): sys.modules[name] = None\n'
            'from fluoro_shape_ros.tools.importer import main\nsys.exit(main())')
    done = process(*arguments(), code=code)
    assert (done.returncode, done.stderr) == (0, '')
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
