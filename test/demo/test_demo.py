"""The demo as a process, its bookkeeping against hand-derived answers, and its pictures."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fluoro_shape_ros.demo.score import PATIENCE_S, Score, headline, live_line, summary

SECOND = 10**9
LINE = np.c_[np.zeros(101), np.zeros(101), np.linspace(0.0, 0.1, 101)]


def shifted(x):
    return LINE + [x, 0.0, 0.0]


# ---- bookkeeping


def test_a_result_is_measured_against_the_truth_of_its_own_stamp():
    score = Score()
    score.truth(1 * SECOND, LINE)
    score.truth(2 * SECOND, shifted(0.05))
    score.result(2 * SECOND, shifted(0.052), arrived_ns=int(2.25 * SECOND))
    (answer,) = score.answers
    assert answer.errors.mean == pytest.approx(0.002)
    assert answer.errors.tip == pytest.approx(0.002)
    assert answer.latency_s == pytest.approx(0.25)


def test_truth_may_come_after_the_result():
    score = Score()
    score.result(SECOND, shifted(0.001), arrived_ns=2 * SECOND)
    assert not score.answers
    score.truth(SECOND, LINE)
    assert score.answers[0].errors.tip == pytest.approx(0.001)


def test_a_pair_is_unanswered_once_overtaken_or_overdue():
    score = Score()
    for second in (1, 2, 3):
        score.truth(second * SECOND, LINE)
    assert score.unanswered(3 * SECOND) == []
    score.result(2 * SECOND, LINE, arrived_ns=3 * SECOND)
    assert score.unanswered(3 * SECOND) == [SECOND]                                     # overtaken
    assert score.unanswered(int((3.01 + PATIENCE_S) * SECOND)) == [SECOND, 3 * SECOND]  # overdue


def test_lines_say_what_was_counted():
    score = Score()
    for second in range(1, 5):
        score.truth(second * SECOND, LINE)
    for second in (1, 3):
        score.result(second * SECOND, shifted(0.0005), arrived_ns=second * SECOND + SECOND // 10)
    now = int(3.5 * SECOND)
    line = live_line(score, now, 'curvature_too_high')
    assert re.search(r'latency +100 ms +error: mean 0.50 mm, tip 0.50 mm +answered 2 of 3 +\[curvature_too_high\]',
                     line), line
    assert summary(score, now, {'curvature_too_high': 1})[0] == 'answered    2 of 3 pairs, 0.5 a second'
    assert summary(score, now, {'b': 1, 'a': 2})[-1] == 'no answer   a 2, b 1'
    assert headline(score, now) == '2 of 3 pairs answered, mean error 0.50 mm, tip error 0.50 mm (medians)'
    assert summary(Score(), now, {}) == ['answered    0 of 0 pairs']


# ---- pictures


def snapshot():
    from fluoro_shape_ros.files.pictures import Snapshot
    P = np.array([[1000.0, 127.5, 0, 127.5], [0, 127.5, 1000.0, 60.0], [0, 1.0, 0, 1.0]])     # along y from 1 m away
    image = np.random.default_rng(0).integers(150, 200, (256, 256), dtype=np.uint8)
    return Snapshot((image, image), (P, P), shifted(0.0003), LINE)


def test_pictures_are_written_and_old_ones_removed(tmp_path):
    pytest.importorskip('matplotlib')
    import cv2

    from fluoro_shape_ros.files import pictures
    t = np.arange(5.0)
    history = pictures.History(t, t * 1e-4, t * 2e-4, np.array([2.5]))
    saved = pictures.save(tmp_path, snapshot(), history, 'caption')
    assert sorted(p.stem for p in saved) == sorted(pictures.NAMES)
    for path in saved:
        picture = cv2.imread(str(path))
        assert picture is not None and picture.std() > 5, path     # not a blank sheet
    pictures.clear(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert [p.stem for p in pictures.save(tmp_path, None, history, 'caption')] == ['errors']


def test_the_window_of_an_overlay_holds_the_device_and_stays_in_the_image():
    from fluoro_shape_ros.files.pictures import MARGIN_PX, window
    left, top, side = window(np.array([[400.0, 300.0], [500.0, 360.0]]), (1024, 1024))
    assert (left, top, side) == (450 - (100 + 2 * MARGIN_PX) / 2 - 0.5, 330 - (100 + 2 * MARGIN_PX) / 2 - 0.5,
                                 100 + 2 * MARGIN_PX)
    left, top, side = window(np.array([[0.0, 0.0], [100.0, 1000.0]]), (1024, 900))
    assert (left, side) == (-0.5, 900) and -0.5 <= top <= 1024 - 900 - 0.5


# ---- the demo itself

rclpy_missing = pytest.mark.skipif(subprocess.run([sys.executable, '-c', 'import rclpy, matplotlib'],
                                                  capture_output=True).returncode != 0,
                                   reason='needs ROS and matplotlib')


def start(*arguments, cwd):
    return subprocess.Popen([sys.executable, '-m', 'fluoro_shape_ros.demo.main', '--domain', '57', '--rate', '2',
                             '--out', str(cwd / 'out'), *arguments],
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def started_by(pid):
    """The processes whose parent is `pid`."""
    found = []
    for stat in Path('/proc').glob('[0-9]*/stat'):
        with contextlib.suppress(OSError):      # it may just have ended
            number, rest = int(stat.parent.name), stat.read_text().rpartition(')')[2].split()
            if int(rest[1]) == pid:
                found.append(number)
    return found


def alive(pids):
    return [pid for pid in pids if os.path.exists(f'/proc/{pid}')]


def children_of(demo):
    """Both children, once they run; the demo then renders and connects."""
    line = demo.stdout.readline()
    assert 'rendering' in line, demo.stderr.read()
    children = started_by(demo.pid)
    assert len(children) == 2
    return children


@rclpy_missing
def test_demo_ends_with_summary_and_pictures_and_without_children(tmp_path):
    demo = start('--seconds', '6', cwd=tmp_path)
    children = children_of(demo)
    out, err = demo.communicate(timeout=180)
    assert demo.returncode == 0, err
    assert re.search(r'results/s +latency +\d+ ms +error: mean [\d.]+ mm, tip [\d.]+ mm', out), out
    answered = re.search(r'^answered +(\d+) of (\d+) pairs', out, re.MULTILINE)
    assert answered and int(answered[1]) >= 1, out
    assert float(re.search(r'^mean error +median ([\d.]+) mm', out, re.MULTILINE)[1]) < 0.5, out
    assert {p.name for p in (tmp_path / 'out').glob('*.png')} == {'overlay_a.png', 'overlay_b.png', 'backbone.png',
                                                                  'demo.png', 'errors.png'}, out
    assert not alive(children)


@rclpy_missing
def test_ctrl_c_ends_everything_with_the_summary(tmp_path):
    demo = start('--seconds', '600', cwd=tmp_path)
    children = children_of(demo)
    demo.send_signal(signal.SIGINT)
    out, err = demo.communicate(timeout=60)
    assert demo.returncode == 0, err
    assert 'answered' in out and not err, (out, err)
    assert not alive(children)


@rclpy_missing
def test_a_child_that_dies_is_named_and_the_other_ended(tmp_path):
    demo = start('--seconds', '600', cwd=tmp_path)
    children = children_of(demo)
    os.kill(children[0], signal.SIGKILL)
    _, err = demo.communicate(timeout=60)
    assert demo.returncode == 1
    assert re.fullmatch(r'fluoro_shape_demo: the (node|sim) ended with exit code -9, see \S+: [^\n]*\n', err), err
    assert not alive(children)


def test_unusable_arguments_exit_with_2(tmp_path):
    demo = start('--seconds', '0', cwd=tmp_path)
    _, err = demo.communicate(timeout=60)
    assert demo.returncode == 2 and 'not above zero' in err and 'Traceback' not in err


@rclpy_missing
def test_a_folder_that_cannot_be_is_named(tmp_path):
    (tmp_path / 'out').write_text('a file')
    demo = start(cwd=tmp_path)
    _, err = demo.communicate(timeout=60)
    assert demo.returncode == 1 and str(tmp_path / 'out') in err and err.count('\n') == 1
