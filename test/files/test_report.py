"""The page of a replay: what is kept for it, what is in it, and how it works in a real browser."""

import dataclasses
import json
import re

import numpy as np
import pytest

pytest.importorskip('rosbags')
pytest.importorskip('mcap')
get_plotlyjs = pytest.importorskip('plotly.offline').get_plotlyjs

from browser import CHROMIUM, visit
from drawing import BASE, BLANK, GOOD, SIZE, curve
from recording import main, record
from scipy.spatial import cKDTree

from fluoro_shape_ros import __version__
from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Reconstruction, Shape
from fluoro_shape_ros.files import history, replay, report
from fluoro_shape_ros.files.offline import Answer, Summary
from fluoro_shape_ros.ros.worker import Job

NAME = 'run<img src=x onerror=alert(1)>'        # of a bag; must stay a name
UP_PX = 8                                       # v of both planes is -z: 1 mm a pixel at the origin


@pytest.fixture(scope='module')
def page(tmp_path_factory):
    """A replay of a device, then none, then the device 8 mm higher."""
    folder = tmp_path_factory.mktemp('report')
    record(folder / NAME, [GOOD, BLANK, [np.roll(pixels, -UP_PX, axis=0) for pixels in GOOD]])
    assert main(folder / NAME, '--out', folder / 'out', '--report', folder / 'page.html', '-p', BASE, '-p',
                'tracking=false') == 0
    return folder / 'page.html'


@pytest.fixture(scope='module')
def data(page):
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>',
                                page.read_text(encoding='utf-8'), re.DOTALL)[1])


def test_the_page_says_what_became_of_every_pair(data):
    assert data['name'] == NAME
    assert (data['outcome'] == ['ok', 'no_device_in_plane_a', 'ok'] and data['t'] == [0, 0.1, 0.2]
            and data['begin_s'] == 5)
    assert data['detail'][1] and data['tip'][0][1] is None and data['length'][1] is None
    assert abs(data['tip'][2][2] - data['tip'][2][0] - UP_PX) < 2
    assert 'tracking = False' in data['parameters'] and len(data['parameters']) == 3
    assert all(ms > 0 for ms in data['ms'])
    assert (data['version'] == __version__ and data['command'].startswith('fluoro_shape_replay ')
            and data['command'].endswith('-p tracking=false'))


def test_the_backbones_are_those_of_the_bag(data):
    assert data['kept'] == [0, 1, 2] and data['shapes'][1] is None
    points = np.cumsum(data['shapes'][0][:3], axis=1).T * data['unit'] / 1e3
    assert cKDTree(curve()).query(points)[0].max() < 0.0025
    assert np.allclose(1e3 * points[-1], [axis[0] for axis in data['tip']], atol=0.011)


def test_it_shows_the_worst_the_median_and_an_unanswered_pair(data):
    titles = {o['title']: o['pair'] for o in data['overlays']}
    assert set(titles) == {'worst answered', 'median', 'first unanswered'} and titles['first unanswered'] == 1
    assert all(image.startswith('data:image/jpeg;base64,') for o in data['overlays'] for image in o['images'])


LOOK = '''
        const page = document.documentElement, box = e => e.getBoundingClientRect();
        const said = e => e.textContent.trim() && box(e).width;
        const within = (a, b) => a.left >= b.left - 1 && a.right <= b.right + 1
            && a.top >= b.top - 1 && a.bottom <= b.bottom + 1;
        const touch = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
            && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 3;
        const wide = selector => box(document.querySelector(selector)).width;
        const drawn = () => document.getElementById('now').textContent
            && wide('#timeline .main-svg') === wide('#timeline');
        async function layout(width) {
            frameElement.style.width = width + 'px';
            await until(() => innerWidth === width && drawn());
            const html = [...document.querySelectorAll('main *')]
                .filter(e => !e.closest('.plot') && !e.children.length && said(e));
            const svg = [...document.querySelectorAll('.plot svg text')].filter(said);
            const cut = [...html.filter(e => e.clientWidth && e.scrollWidth > e.clientWidth + 1 || box(e).left < 0
                                        || box(e).right > page.clientWidth),
                         ...svg.filter(e => !within(box(e), box(e.closest('.plot'))))].map(e => e.textContent);
            const touching = svg.flatMap((e, k) => svg.slice(k + 1).filter(o => touch(box(e), box(o)))
                .map(o => `${e.textContent} | ${o.textContent}`));
            return { cut, touching, beyond: page.scrollWidth - page.clientWidth };
        }
'''
SPACE = '''
        async function space() {
            const picture = new Image();
            // drawn anew, as nothing else of WebGL can be read
            picture.src = document.getElementById('backbone')._fullLayout.scene._scene.toImage('png');
            await picture.decode();
            const { width: w, height: h } = picture;
            const context = Object.assign(document.createElement('canvas'), { width: w, height: h }).getContext('2d');
            context.drawImage(picture, 0, 0);
            const inked = (...area) => context.getImageData(...area).data.filter((v, k) => k % 4 === 3 && v > 9).length;
            return { border: [[0, 0, w, 1], [0, h - 1, w, 1], [0, 0, 1, h], [w - 1, 0, 1, h]]
                         .map(area => inked(...area)), all: inked(0, 0, w, h) };
        }
'''
SLIDE = '''
        const now = document.getElementById('now'), slider = document.getElementById('slider');
        const plot = document.getElementById('backbone');
        const read = () => {
            const [, line, tip] = plot.data;
            return { z: [...line.z], tip: [...tip.z], words: now.textContent };
        };
        const seen = [read()];
        for (const step of [1, 2]) {
            slider.value = step;
            slider.dispatchEvent(new Event('input'));
            await until(() => now.textContent.startsWith(`pair ${step + 1} `));
            seen.push(read());
        }
        const images = [...document.images].map(i => i.naturalWidth);
'''
ENLARGE = '''
        const large = document.getElementById('large'), which = document.getElementById('which');
        const full = () => document.querySelector('#pane img');
        const opened = [large.open];
        document.querySelectorAll('.overlays button')[2].click();
        await until(() => full().complete);
        opened.push(large.open, which.textContent, full().naturalWidth, box(full()).width >= full().naturalWidth);
        large.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight' }));
        opened.push(which.textContent);
        document.getElementById('close').click();
        opened.push(large.open);
'''


@pytest.fixture(scope='module')
def visited(page, tmp_path_factory):
    """What is seen in a browser 1400 px wide, and then 400, and the page's problems."""
    if CHROMIUM is None:
        pytest.skip('there is no Chromium here')
    return visit(page, LOOK + SPACE + '''
        const large_page = [await layout(1400), await space()];
        ''' + SLIDE + ENLARGE + '''
        const small_page = [await layout(400), await space()];
        const fetched = performance.getEntriesByType('resource').map(e => e.name)
            .filter(name => !name.startsWith('data:'));
        const colours = document.getElementById('timeline').data.map(trace => [trace.name, trace.marker.color]);
        const [title, made] = ['title', 'made'].map(id => document.getElementById(id).textContent);
        return { wide: large_page, narrow: small_page, colours, title, made, seen, opened, images,
                 fetched, max: slider.max };
        ''', tmp_path_factory.mktemp('visited'), 1400)


def test_the_page_in_a_browser(visited):
    """It opens without errors, nothing comes from a network, and the slider moves the curve; a pair without an answer
    shows none."""
    answer, problems = visited
    assert problems == []
    first, none, last = answer['seen']
    assert len(first['z']) > 50 and first['z'][-1] == first['tip'][0]
    assert none['z'] == none['tip'] == [] and 'no device in plane a' in none['words']
    assert abs(last['tip'][0] - first['tip'][0] - UP_PX) < 2 and 'ok' in last['words']
    assert len(answer['images']) == 6 and min(answer['images']) > 0 and answer['fetched'] == [] and answer['max'] == '2'
    assert answer['title'] == f'Replay of {NAME}' and answer['made'].startswith(
        f'fluoro_shape_ros {__version__}: fluoro_shape_replay -p robot_radius=0.001 ')


@pytest.mark.parametrize('width', ['wide', 'narrow'])
def test_nothing_is_cut(visited, width):
    """All words are whole and none lies on another, and of the 3-D plot with its axis titles nothing reaches the
    border."""
    words, space = visited[0][width]
    assert words == {'cut': [], 'touching': [], 'beyond': 0}
    assert space['border'] == [0, 0, 0, 0] and space['all'] > 1000


def test_different_things_have_different_colours(visited, data):
    """The tip has the same one in plots and overlays, and so has the backbone."""
    colours = dict(visited[0]['colours'])
    assert {colours[f'tip {axis}'] for axis in 'xyz'} == {data['strokes']['tip']}
    things = [*data['strokes'].values(),
              *(colours[name] for name in ('ok', 'no device in plane a', 'plane A', 'plane B'))]
    assert len(things) == 8 and len(set(things)) == 8


def test_an_overlay_opens_at_full_size(visited):
    """By a click, with all of its pixels; a key shows the next one."""
    opened = visited[0]['opened']
    when = '0.00' if '0.00' in opened[2] else '0.20'       # of two pairs both are as near to the median
    assert opened == [False, True, f'median pair, at {when} s, plane A', SIZE, True,
                      f'median pair, at {when} s, plane B', False]


@pytest.mark.skipif(CHROMIUM is None, reason='there is no Chromium here')
def test_a_page_of_refusals_only(tmp_path):
    """It says so in place of an empty plot, and why; only what is known has a plot; what is refused has a colour of its
    own."""
    record(tmp_path / 'run', [BLANK, [GOOD[0], BLANK[1]], BLANK])
    assert main(tmp_path / 'run', '--out', tmp_path / 'out', '--report', tmp_path / 'page.html', '-p', BASE) == 0
    answer, problems = visit(tmp_path / 'page.html', LOOK + '''
        const words = await layout(400);
        const rows = [...document.querySelectorAll('#outcomes tr')]
            .map(row => [...row.cells].map(cell => cell.textContent));
        document.querySelectorAll('#outcomes button')[2].click();
        const titles = [...document.querySelectorAll('h2')].map(e => e.textContent);
        return { words, rows, titles, plot: document.getElementById('backbone'),
                 now: document.getElementById('now').textContent,
                 names: document.getElementById('timeline').data.map(trace => trace.name) };
        ''', tmp_path, 400)
    assert problems == [] and answer['words'] == {'cut': [], 'touching': [], 'beyond': 0} and answer['plot'] is None
    assert [row[:2] for row in answer['rows'] if 'no device' in row[1]] == [['2', 'no device in plane a'],
                                                                            ['1', 'no device in plane b']]
    assert answer['titles'][0] == 'No backbone' and 'The first no device in plane b pair, at 0.10 s' in answer['titles']
    assert answer['now'].startswith('pair 2 of 3 ') and 'no device in plane b' in answer['now']
    assert set(answer['names']) == {'no device in plane a', 'no device in plane b', 'compute time', 'rate'}


def test_the_command_does_not_name_its_user(monkeypatch):
    monkeypatch.setenv('HOME', '/home/jane')
    assert (replay.command_line('fluoro_shape_replay', ['/home/jane/my run', '--out', '/data/jane'])
            == "fluoro_shape_replay '~/my run' --out /data/jane")


# ---- what is kept


def answered(k, residual=1.0, points=5, confidence=np.nan):
    """The answer to pair k: a straight backbone along x, or none where residual is NaN."""
    x = np.linspace(0, 0.1, points)
    shape = Shape(np.c_[x, np.full(points, k * 1e-5), 0 * x], x, np.full((points, 3, 3), np.nan),
                  np.full((points, 2), residual))
    outcome = (Outcome.LENGTH, 'too long') if np.isnan(residual) else (Outcome.OK, 'ok', shape)
    result = Reconstruction(*outcome, confidence=confidence)
    return Answer(Job((k + 1) * 10**8, (np.zeros((4, 4)),) * 2, (None, None), Config(), 0, 0.0), None, result, 0.02)


def taken(residuals, **options):
    kept = history.History()
    for k, residual in enumerate(residuals):
        kept.take(answered(k, residual, **options))
    return kept


def test_worst_and_median():
    h = taken([2.0, np.nan, 9.0, 1.0, 3.0, 8.0])
    assert (h.worst[0], h.median[0], h.unanswered[0]) == (2, 4, 1)
    assert [row.outcome for row in h.rows] == ['ok', 'length_out_of_bounds', 'ok', 'ok', 'ok', 'ok']
    assert all(a.job.images == (None, None) for _, a in h.kept)      # images are let go
    empty = taken([np.nan])
    assert (empty.worst, empty.median, empty.unanswered[0]) == (None, None, 0)


def test_of_a_long_replay_pairs_are_thinned_out_evenly(monkeypatch):
    monkeypatch.setattr(history, 'KEPT', 10)
    h = taken([*range(1, 64), 99, 5])
    kept = [k for k, _ in h.kept]
    assert len(h.rows) == 65 and len(kept) <= 10 and set(np.diff(kept)) == {8} and h.worst[0] == 63


class NoImages:
    """A replay whose bag can't be read again."""

    summary = Summary()

    def frame_of(self, answer):
        return None


def test_every_pair_has_its_confidence_the_rejected_too():
    h = history.History()
    for k, (residual, confidence) in enumerate([(1.0, 0.99849), (np.nan, 0.4), (np.nan, np.nan)]):
        h.take(answered(k, residual, confidence=confidence))
    assert report.page_data(h, NoImages(), 'run')['confidence'] == [0.998, 0.4, None]


def test_a_minute_of_pairs_fits_into_ten_megabytes():
    """With what two overlays of 400 KB add."""
    rng = np.random.default_rng(1)
    h = history.History()
    for k in range(900):
        a = answered(k, points=121)
        wild = dataclasses.replace(a.result.shape, points=rng.normal(0, 0.2, (121, 3)),
                                   covariance=np.tile(np.eye(3) * rng.uniform(1e-9, 1e-8), (121, 1, 1)))
        h.take(dataclasses.replace(a, result=dataclasses.replace(a.result, shape=wild)))
    size = len(json.dumps(report.page_data(h, NoImages(), 'run'), allow_nan=False, separators=(',', ':')))
    assert size + len(get_plotlyjs().encode()) + 6 * 200_000 < 10e6


def test_what_is_not_known_has_no_number():
    data = report.page_data(taken([np.nan]), NoImages(), 'run')
    assert (data['sigma'] == data['length'] == data['tip'][0] == data['confidence'] == [None] and data['overlays'] == []
            and data['shapes'] == [None])
    assert report.curve(answered(0).result.shape)[3] == [None] * 5
