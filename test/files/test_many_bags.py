"""fluoro_shape_replay with several bags: each by itself, and one table over all of them."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

pytest.importorskip('rosbags')
pytest.importorskip('yaml')

from cluster import Cluster
from drawing import BLANK, GOOD
from recording import RADIUS, main, outcomes, record

from fluoro_shape_ros.cli import ToolError
from fluoro_shape_ros.files import many_bags as many


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Bags one (good, blank), two (good), three (cut to pieces); it is the working directory."""
    monkeypatch.chdir(tmp_path)
    record(tmp_path / 'one', [GOOD, BLANK])
    record(tmp_path / 'two', [GOOD], 'sqlite3')
    record(tmp_path / 'three', [GOOD])
    for file in (tmp_path / 'three').iterdir():
        file.write_bytes(file.read_bytes()[:40])
    return tmp_path


def cells(line):
    return line.split()


def test_a_bag_that_fails_stops_no_other(folder, capsys):
    assert main('one', 'none', 'three', 'two', '--out', 'out', '--jobs', 2, '--csv', 'tip.csv', '--npz',
                'arrays.npz') == 1
    said = capsys.readouterr()
    assert said.err.splitlines() == ['fluoro_shape_replay: 2 of 4 bags failed: none, three']
    head, one, none, three, two, all_ = said.out.splitlines()
    assert cells(head)[:4] == ['bag', 'pairs', 'answered', 'refused']
    assert cells(one) == ['one', '2', '1', '1', 'no_device_in_plane_a'] and cells(two) == ['two', '1', '1', '0']
    assert (cells(none)[:4] == ['none', '0', '0', '0'] and 'no such bag' in none
            and 'three: can\'t be read as a bag' in three)
    assert cells(all_) == ['all', '3', '2', '1', '2', 'of', '4', 'failed']
    assert (list(outcomes(folder / 'out' / 'one').values()) == ['ok', 'no_device_in_plane_a']
            and list(outcomes(folder / 'out' / 'two').values()) == ['ok'])
    assert sorted(p.name for p in (folder / 'out').iterdir()) == ['one', 'one_arrays.npz', 'one_tip.csv', 'two',
                                                                  'two_arrays.npz', 'two_tip.csv']


def test_the_same_as_one_by_one(folder):
    assert main('one', 'two', '--out', 'out') == 0
    (folder / 'alone').mkdir()
    # in a process of its own too: with more threads, which a test's process may have, BLAS rounds otherwise
    subprocess.run([sys.executable, '-m', 'fluoro_shape_ros.files.replay', 'one', '--out', 'alone/one', '-p', RADIUS],
                   check=True, env={**os.environ, 'PYTHONPATH': ':'.join(filter(None, sys.path))})
    first, second = ({p.name: p.read_bytes() for p in (folder / path / 'one').iterdir()} for path in ('out', 'alone'))
    assert first == second


def test_by_the_workers_of_a_scheduler(folder, tmp_path_factory, capsys):
    pytest.importorskip('distributed')
    cluster = Cluster(tmp_path_factory.mktemp('cluster'))
    try:
        cluster.workers(1)
        assert main('one', 'none', 'two', '--out', 'out', '--scheduler', cluster.address) == 1
    finally:
        cluster.end()
    said = capsys.readouterr()
    assert (said.err.splitlines() == ['fluoro_shape_replay: 1 of 3 bags failed: none']
            and 'none: no such bag' in said.out)
    assert (list(outcomes(folder / 'out' / 'one').values()) == ['ok', 'no_device_in_plane_a']
            and list(outcomes(folder / 'out' / 'two').values()) == ['ok'])


def test_what_can_not_work_is_said_once(folder, capsys):
    with pytest.raises(SystemExit, match='2'):
        main('one', 'two', '--out', 'out', '-p', 'robot_radius=-1')
    assert 'robot_radius: must lie in' in capsys.readouterr().err and not (folder / 'out').exists()
    with pytest.raises(SystemExit, match='2'):
        main('one', 'two', '--out', 'out', '--jobs', 0)
    assert main('one', 'one', '--out', 'out') == 1
    assert 'one was given twice' in capsys.readouterr().err
    assert main('one', 'two', '--out', 'none/out') == 1
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert main('one', 'two', '--out', 'out') == 0 and main('one', 'two', '--out', 'out') == 1  # nothing is overwritten
    assert 'out/one exists already' in capsys.readouterr().out


def test_names_tell_all_bags_apart(tmp_path):
    for name in ('monday/run', 'tuesday/run', 'tuesday/run_2026_01_02-10.11.12'):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / 'tuesday' / 'last.mcap').touch()
    given = [str(tmp_path / name) for name in ('monday/run', 'tuesday/run', 'tuesday/run_2026_01_02-10.11.12',
                                               'tuesday/last.mcap')]
    assert many.names_of(given[1:]) == ['run', 'run_2026_01_02-10.11.12', 'last']
    assert many.names_of(given) == ['monday_run', 'tuesday_run', 'tuesday_run_2026_01_02-10.11.12', 'tuesday_last']
    with pytest.raises(ToolError, match='run was given twice'):
        many.names_of([given[0], str(tmp_path / 'tuesday' / '..' / 'monday' / 'run')])


def test_one_bag_says_in_words_why_pairs_were_refused(folder, capsys):
    assert main('one', '--out', 'out', '--json', 'out.json') == 0
    lines = capsys.readouterr().out.splitlines()
    at = lines.index('      1  no_device_in_plane_a')
    assert lines[at + 1].startswith(' ' * 12 + '1  ') and len(lines[at + 1].split()) > 3
    counted = json.loads((folder / 'out.json').read_text())
    assert (counted['outcomes'] == {'ok': 1, 'no_device_in_plane_a': 1} and counted['pairs'] == 2
            and counted['images'] == {'a': 2, 'b': 2})
    assert counted['reasons'][0]['outcome'] == 'no_device_in_plane_a' and counted['reasons'][0]['pairs'] == 1


def test_ctrl_c_keeps_what_is_done(folder):
    """The table comes nevertheless, with what was at work and what was not begun."""
    for name in 'xyz':
        record(folder / name, [GOOD] * 40)
    process = subprocess.Popen([sys.executable, '-m', 'fluoro_shape_ros.files.replay', 'two',
                                'x', 'y', 'z', '--out', 'out', '-p', RADIUS],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               env={**os.environ, 'PYTHONPATH': ':'.join(filter(None, sys.path))})
    looked = threading.Event()
    try:
        deadline = time.monotonic() + 60
        while not (folder / 'out' / 'x').exists() and time.monotonic() < deadline and process.poll() is None:
            looked.wait(0.02)
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130 and not errors
    rows = {cells(line)[0]: line for line in out.splitlines()}
    assert cells(rows['two']) == ['two', '1', '1', '0'] and 'interrupted' in rows['x'] and 'not begun' in rows['z']
