"""The bench through its command line, and its table by hand."""

import json

import pytest

from fluoro_shape_ros.data import Outcome
from fluoro_shape_ros.metrics import Errors
from fluoro_shape_ros.tools import bench


def errors(mean_mm, tip_mm):
    return Errors(mean_mm / 1000, 0.0, 0.0, tip_mm / 1000, 0.0, 0.0)


def test_table_counts_answers_silent_failures_and_reasons():
    rows = [bench.Answer(0, Outcome.OK, errors(0.1, 0.5)), bench.Answer(1, Outcome.OK, errors(0.3, 2.5)), bench.Answer(2, Outcome.OK, errors(1.2, 0.1)),
            bench.Answer(3, Outcome.CURVATURE, None)]
    row = bench.table({('p', 'paper'): rows}).splitlines()[1]
    assert '3/   4' in row and ' 2 ' in row and '1 curvature_too_high' in row
    assert '0.533 / ' in row and '/ 1.200' in row


def test_accuracy_of_one_scene_is_written_as_json(tmp_path, capsys):
    pytest.importorskip('tqdm')
    file = tmp_path / 'errors.json'
    assert bench.main(['accuracy', '--families', 'p_xray', '--scenes', '1', '--first-seed', '7', '--json', str(file)]) == 0
    (row,) = json.loads(file.read_text())['p_xray/paper']
    assert row['seed'] == 7 and (row['errors_m'] is None) == (row['outcome'] != 'ok')
    assert 'p_xray' in capsys.readouterr().out


@pytest.mark.parametrize('arguments, code, word', [(['accuracy', '--families', 'nosuch'], 1, 'nosuch'), (['accuracy', '--scenes', '0'], 1, '--scenes')])
def test_what_cannot_be_benched_is_named(arguments, code, word, capsys):
    assert bench.main(arguments) == code
    assert word in capsys.readouterr().err


def test_unusable_arguments_exit_with_2(capsys):
    with pytest.raises(SystemExit) as stop:
        bench.main(['accuracy', '--scenes', 'many'])
    assert stop.value.code == 2
