"""A short soak: test/soak.py in a process of its own; how fast it went is not looked at, and memory has room for what
is still warming up."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy')


def test_a_short_soak():
    import fluoro_shape_ros
    # the package that is tested
    places = [str(Path(fluoro_shape_ros.__file__).parents[1]), os.environ.get('PYTHONPATH', '')]
    done = subprocess.run([sys.executable, str(Path(__file__).parents[1] / 'soak.py'), '--seconds',
                           os.environ.get('SOAK_SECONDS', '15'), '--growth', '60', '--kills', '1'],
                          env={**os.environ, 'PYTHONPATH': os.pathsep.join(places)},
                          capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and done.stdout.endswith('passed\n'), done.stdout + done.stderr
