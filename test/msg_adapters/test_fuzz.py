"""A short run of every target of fuzz.py, and what long runs found."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('atheris')
pytest.importorskip('rosbags')
pytest.importorskip('pydicom', '3.0.1')

FUZZ = Path(__file__).parents[1] / 'fuzz.py'


def test_nothing_but_refusals(tmp_path):
    import fluoro_shape_ros
    # the package that is tested, wherever the run is
    places = [str(Path(fluoro_shape_ros.__file__).parents[1]), os.environ.get('PYTHONPATH', '')]
    # a process begins with the peak of memory of the one that starts it: a small one in between,
    # since libFuzzer has a limit
    between = 'import subprocess, sys; sys.exit(subprocess.run(sys.argv[1:]).returncode)'
    done = subprocess.run([sys.executable, '-c', between, sys.executable, str(FUZZ), 'everything', '--runs', '3000'],
                          cwd=tmp_path, env={**os.environ, 'PYTHONPATH': os.pathsep.join(places)}, capture_output=True,
                          text=True, timeout=300)
    assert done.returncode == 0 and 'Done 3000 runs' in done.stderr, done.stderr[-3000:]
    assert not list(tmp_path.glob('crash-*'))
