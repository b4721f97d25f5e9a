"""The benches of the node as a process: what they count, by hand, and that they run. No times are asserted."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.bench import latency, main
from fluoro_shape_ros.bench.memory import Memory
from fluoro_shape_ros.bench.process_usage import usage

DOMAIN = 151 + os.getpid() % 50     # not those of other tests
ROW = latency.Row(30.0, 2.0, sent=60, answered=4, refused=3, dropped=50, latency=[0.01, 0.02, 0.03, 0.04],
                  compute=[0.004, 0.004, 0.02, 0.036], services=[0.002, 0.012], reports=1.0, cores=0.5,
                  resident=200_000_000, peak=250_000_000, first_result=1.25, tip_errors=[1e-4, 3e-4])


def test_what_is_lost_is_what_nobody_knows_of():
    assert ROW.lost == 3
    assert_allclose(ROW.overhead, [0.006, 0.016, 0.01, 0.004])


def test_a_line_a_rate():
    line = latency.table([ROW], as_shipped=True).splitlines()[2].split()
    assert (line == '30 30.0 60 4 3 50 3 | 25.0 38.5 39.7 40.0 | 12.0 33.6 | 8.0 15.1 | 11.5 12.0 | 0.50 200 '
                    '250 1.25 | 0.20'.split())
    silent = latency.Row(30.0, 2.0, 60, 0, 60, 0, [], [], [], 1.0, 0.5, 1, 1, 1.0, [])
    assert latency.table([silent], as_shipped=True).splitlines()[2].split()[7:12] == '| - - - -'.split()


def test_growth_is_counted_from_the_end_of_warming_up():
    """100 samples: the first ten rise steeply, from then on a byte a pair."""
    resident = [1000 * k for k in range(10)] + [20_000 + 50 * k for k in range(90)]
    memory = Memory(5000, 5000, 1.0, [50 * (k + 1) for k in range(100)], resident, max(resident))
    assert_allclose(memory.slope, 1.0)
    assert_allclose(memory.growth, 50 * (87 - 2))       # medians of five samples at both ends


def test_usage_of_a_process():
    before = usage(os.getpid())
    ballast = np.ones(50_000_000, np.uint8)
    while usage(os.getpid()).cpu_s < before.cpu_s + 0.05:
        ballast.sum()
    assert usage(os.getpid()).resident > before.resident + 30_000_000
    assert usage(os.getpid()).peak >= usage(os.getpid()).resident - 1_000_000
    ended = subprocess.Popen([sys.executable, '-c', ''])
    ended.wait()
    with pytest.raises(OSError):
        usage(ended.pid)


def test_the_device_moves_as_fast_as_it_should():
    pairs = latency.moving_scenes(256, rate=10.0, seed=9, count=3)
    n = min(len(p.truth) for p in pairs)
    for before, after in zip(pairs, pairs[1:]):
        fastest = np.linalg.norm(after.truth[-n:] - before.truth[-n:], axis=1).max() * 10.0
        assert 0.3 * latency.SPEED < fastest < 1.5 * latency.SPEED


@pytest.mark.parametrize('arguments, word', [
    (['latency', '--rates', '0'], '--rates'),
    (['latency', '--seed', '-1'], '--seed'),
    (['memory', '--pairs', '0'], '--pairs'),
    (['memory', '--domain', '500'], '--domain'),
])
def test_unusable_arguments(arguments, word, capsys):
    with pytest.raises(SystemExit, match='2'):
        main.main(arguments)
    assert word in capsys.readouterr().err


def run(*arguments, file):
    done = subprocess.run([sys.executable, '-m', 'fluoro_shape_ros.bench.main', *arguments, '--rendered', '6',
                           '--domain', str(DOMAIN), '--json', str(file)],
                          capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads(file.read_text())


def test_latency_on_real_topics(tmp_path):
    """Slowly enough for a busy machine; what is not answered in time is dropped, and everything is accounted for."""
    pytest.importorskip('rclpy')
    out, found = run('latency', '--rates', '5', '--seconds', '3', file=tmp_path / 'rows.json')
    row, = found['rows']
    assert row['sent'] >= 5 and row['answered'] >= 1 and row['answered'] == len(row['latency']) == len(row['compute'])
    assert row['lost'] == row['sent'] - row['answered'] - row['refused'] - row['dropped']
    assert all(0 < c < whole for c, whole in zip(row['compute'], row['latency']))
    assert (row['services'] and 0 < row['cores'] < 64 and 5e7 < row['resident'] <= row['peak'] < 2e9
            and np.median(row['tip_errors']) < 1e-3)
    assert 'fastdds_large_images.xml' in out


def test_memory_on_real_topics(tmp_path):
    pytest.importorskip('rclpy')
    out, found = run('memory', '--pairs', '12', '--everything', file=tmp_path / 'memory.json')
    assert found['answered'] >= 6 and len(found['resident']) == 12 and '12 pairs of 1024 px' in out
