"""Streams on the bench: counting by hand, pairs through the pipeline as the node answers them, and the command line."""

import dataclasses
import json
import math

import numpy as np
import pytest

from fluoro_shape_ros.bench import main, stream_figures, streams
from fluoro_shape_ros.bench.score import Answer
from fluoro_shape_ros.bench.stream_figures import Pair
from fluoro_shape_ros.cli import ToolError
from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome
from fluoro_shape_ros.metrics import Errors
from fluoro_shape_ros.ros.worker import Memory
from fluoro_shape_ros.sim import faults
from fluoro_shape_ros.sim.streams import KINDS, draw

SEED = 3            # one that is drawn at once
MEANT = {   # mean and tip errors in mm of a pair that is r(ight), n(early) right, s(ilent)
    'r': (0.1, 0.2), 'n': (0.5, 1.5), 's': (0.1, 5.0)}


def pair(letter, seconds=0.1, off_mm=0.0, stray_mm=0.0):
    """One of MEANT; - refused, d dark and refused, D dark and published."""
    shown, published = letter not in 'dD', letter not in '-d'
    errors = Errors(MEANT[letter][0] / 1e3, 0.0, 0.0, MEANT[letter][1] / 1e3, 0.0, 0.0) if letter in MEANT else None
    answer = Answer(0, Outcome.OK if published else Outcome.LOW_CONFIDENCE if shown else Outcome.NO_DEVICE_B,
                    shown, errors)
    return Pair(answer, seconds, np.array([off_mm, 0.0, 0.0]) / 1e3 if published else None,
                stray_mm / 1e3 if published else math.nan)


def pairs(letters):
    return [pair(letter) for letter in letters]


# ---- counting


@pytest.mark.parametrize('letters, found, gap, recoveries', [
    ('rrrr', 0, 0, []),
    ('--nrr--', 3, 2, []),          # what is nearly right is an answer, yet not found
    ('-s-n', None, 1, []),
    ('rr---r-', 0, 3, []),
    ('r-ddd--r', 0, 2, [3]),        # gaps do not go on through the dark
    ('rddr', 0, 0, [1]),
    ('rdnnrr', 0, 0, [3]),          # an answer that is not right is no recovery
    ('rd--drd-', 0, 2, [None, 1, None]),
    ('rd', 0, 0, []),
    ('-ddrr', 3, 1, []),            # was never found before
    ('ddrdr', 2, 0, [1]),
    ('----', None, 4, []),
])
def test_found_gap_and_recovery(letters, found, gap, recoveries):
    given = pairs(letters)
    assert ((stream_figures.found(given), stream_figures.gap(given), stream_figures.recoveries(given))
            == (found, gap, recoveries))


@pytest.mark.parametrize('off_mm, stray_mm, jumps', [
    ([0, 0.9, -0.9, 0], [0, 0, 0, 0], 0),
    ([0, 5, 5, 5], [0, 0, 0, 0], 1),        # away, and it stays there: once
    ([0, 5, 0, 0], [0, 0, 0, 0], 2),        # there and back
    ([3, 4, 5, 6], [0, 0, 0, 0], 0),        # far off, but with the device
    ([0, 2.1, 0, 0], [0, 0, 0, 0], 2),
    ([0, 0, 0, 0], [0.1, 9, 9, 0.2], 2),    # the tip is right, and its body goes along something else
])
def test_jumps(off_mm, stray_mm, jumps):
    given = [pair('r', off_mm=o, stray_mm=s) for o, s in zip(off_mm, stray_mm)]
    assert stream_figures.jumps(given) == jumps
    # from one answer to the next, whatever lies between
    assert stream_figures.jumps([given[0], *pairs('--d'), *given[1:]]) == jumps


def test_a_dark_pair_that_is_answered_is_silent():
    r = stream_figures.row([pairs('rdD')])
    assert (r.pairs, r.shown, r.answered, r.silent, r.rejections) == (3, 1, 1, 1, {})


def test_rows_and_table():
    """Times are 1 ms ... 10 ms of ten pairs: their median is 5.5 ms, p95 9.55 ms, p99 9.91 ms."""
    one = [dataclasses.replace(p, seconds=(k + 1) / 1000) for k, p in enumerate(pairs('-rr-nsddrr'))]
    r = stream_figures.row([one])
    assert ((r.streams, r.pairs, r.shown, r.answered, r.right, r.silent, r.found, r.since, r.right_since)
            == (1, 10, 8, 6, 4, 1, 1, 7, 4))
    assert (r.gap, r.back, r.again, r.pairs_to_recover, r.rejections) == (1, 1, 1, 1, {'confidence_too_low': 2})
    np.testing.assert_allclose((r.median, r.p95, r.p99, r.worst), (0.0055, 0.00955, 0.00991, 0.010))
    rows = stream_figures.rows([('plain', one), ('dark', pairs('----')), ('plain', pairs('rr'))])
    assert list(rows) == ['plain', 'dark', 'total']
    assert ((rows['plain'].streams, rows['total'].streams, rows['total'].pairs, rows['total'].gap, rows['dark'].found)
            == (2, 3, 16, 4, 0))
    lines = stream_figures.table(rows).splitlines()
    assert lines[1].split('|')[0].split() == 'plain 2 12 10 80.0 % 60.0 % 1 2 66.7 % 1 1 of 1 1 0'.split()
    assert lines[2].split() == 'dark 1 4 4 0.0 % 0.0 % 0 0 - 4 - - 0 | 100 100 100 100 | 4 confidence_too_low'.split()
    assert list(stream_figures.rows([('dark', one)])) == ['dark']


# ---- through the pipeline


@pytest.fixture(scope='module')
def stream():
    return draw(SEED, 'plain')



def given(stream):
    return Config.from_values(robot_radius=stream.run.radius, base_position=stream.backbone(0.0)[0].tolist(),
                              min_confidence=0.0)


def test_pairs_go_through_the_memory_of_the_node(stream):
    """With tracking the second pair begins where the first was; the memory then holds both."""
    memory, config = Memory(), given(stream)
    first, second = (streams.answered(m, config, memory, 0.0, stream) for m in stream.pairs(2))
    assert first.answer.published and second.answer.published and first.answer.kind == 'plain'
    prior = memory.prior(_job(config), next(stream.pairs(1)).scene.frame, ())
    assert prior.previous_stamp_ns - prior.before_stamp_ns == round(1e9 / stream.rate)
    np.testing.assert_allclose(np.linalg.norm(first.tip_off), first.answer.errors.tip, atol=0.05e-3)
    assert 0 <= first.stray and first.seconds > 0


def _job(config):
    return streams.Job(0, (), (None, None), config, 0, 0.0)


def test_a_pair_without_a_device_in_one_plane_ends_with_its_budget(stream):
    dark = dataclasses.replace(stream, dark=faults.Dark(1, 0.0))
    moment = next(dark.pairs(1))
    ended = streams.answered(moment, given(stream).replace(min_confidence=0.9), Memory(), 1e-6, stream)
    assert not moment.shown and not ended.answer.device and ended.answer.outcome is Outcome.OUT_OF_TIME


def test_a_stale_mask_is_taken_before_the_first_pair():
    stream = draw(SEED, 'stale_mask')
    memory = Memory()
    streams._take_mask(stream, memory, 2)
    frame = next(stream.pairs(1)).scene.frame
    masks = memory.prior(_job(given(stream)), frame, streams._window(frame)).masks
    np.testing.assert_allclose(masks[0], np.mean([f.images[0] for f in stream.mask(2)], axis=0), rtol=1e-6)


# ---- the command


def test_command_line(tmp_path, capsys):
    """A table, JSON and a sheet; the answers are those of the same task in this process."""
    file = tmp_path / 'streams.json'
    words = ['streams', '--streams', '1', '--pairs', '2', '--kinds', 'plain', '--first-seed', str(SEED), '--jobs', '1',
             '--pictures', '1', '--sheets', str(tmp_path / 'sheets')]
    assert main.main([*words, '--json', str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split()[:4] == ['plain', '1', '2', '2'] and 'budget    none' in lines[-1]
    written = json.loads(file.read_text())
    assert written['rows']['plain']['pairs'] == 2 and [len(s['pairs']) for s in written['streams']] == [2]
    here = streams.plain(streams.attempt(streams.Task(SEED, 'plain', 2)))
    for p, q in zip(here['pairs'], written['streams'][0]['pairs'], strict=True):
        assert (p['outcome'], p['shown'], p['right']) == (q['outcome'], q['shown'], q['right'])
        # libraries of more than one thread round otherwise
        np.testing.assert_allclose(p['tip_off_m'], q['tip_off_m'], atol=1e-6)
    assert [f.name for f in (tmp_path / 'sheets').iterdir()] == [f'plain_{SEED}_0.png']


@pytest.mark.parametrize('words, code, said', [
    (['--kinds', 'calm'], 2, 'calm'),
    (['--time-budget', '-1'], 2, '0 to 60'),
    (['--ct', 'nowhere.npz'], 1, 'nowhere.npz'),
    (['--json', 'no/such/folder.json'], 1, 'no such folder'),
])
def test_what_cannot_work_is_said_at_once(words, code, said, capsys):
    try:
        assert main.main(['streams', *words]) == code
    except SystemExit as end:
        assert end.code == code
    assert said in capsys.readouterr().err


def test_a_stream_that_cannot_be_drawn_is_named(monkeypatch):
    monkeypatch.setattr(streams, 'draw', draw_nothing)
    with pytest.raises(ToolError, match='streams, seed 5: no stream'):
        streams.attempt(streams.Task(5, 'plain', 1))


def draw_nothing(seed, kind, volume=None):
    raise ValueError(f'no stream of seed {seed} can be seen')


def test_every_kind_is_explained(capsys):
    with pytest.raises(SystemExit):
        main.main(['streams', '--help'])
    said = capsys.readouterr().out
    assert all(kind in said for kind in KINDS)
