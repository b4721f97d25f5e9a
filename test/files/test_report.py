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
from drawing import BASE, BLANK, GOOD, curve
from recording import main, record
from scipy.spatial import cKDTree

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Outcome, Reconstruction, Shape
from fluoro_shape_ros.files import history, report
from fluoro_shape_ros.files.offline import Answer, Summary
from fluoro_shape_ros.ros.worker import Job

NAME = 'run<img src=x onerror=alert(1)>'        # of a bag; must stay a name
UP_PX = 8                                       # v of both planes is -z: 1 mm a pixel at the origin


@pytest.fixture(scope='module')
def page(tmp_path_factory):
    """A replay of a device, then none, then the device 8 mm higher."""
    folder = tmp_path_factory.mktemp('report')
    record(folder / NAME, [GOOD, BLANK, [np.roll(pixels, -UP_PX, axis=0) for pixels in GOOD]])
    assert main(folder / NAME, '--out', folder / 'out', '--report', folder / 'page.html', '-p', BASE, '-p', 'tracking=false') == 0
    return folder / 'page.html'


@pytest.fixture(scope='module')
def data(page):
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', page.read_text(encoding='utf-8'), re.DOTALL)[1])


def test_the_page_says_what_became_of_every_pair(data):
    assert data['name'] == NAME
    assert data['outcome'] == ['ok', 'no_device_in_plane_a', 'ok'] and data['t'] == [0, 0.1, 0.2] and data['begin_s'] == 5
    assert data['detail'][1] and data['tip'][0][1] is None and data['length'][1] is None
    assert abs(data['tip'][2][2] - data['tip'][2][0] - UP_PX) < 2
    assert 'tracking = False' in data['parameters'] and len(data['parameters']) == 3
    assert all(ms > 0 for ms in data['ms'])


def test_the_backbones_are_those_of_the_bag(data):
    assert data['kept'] == [0, 1, 2] and data['shapes'][1] is None
    points = np.cumsum(data['shapes'][0][:3], axis=1).T * data['unit'] / 1e3
    assert cKDTree(curve()).query(points)[0].max() < 0.0025
    assert np.allclose(1e3 * points[-1], [axis[0] for axis in data['tip']], atol=0.011)


def test_it_shows_the_worst_the_median_and_an_unanswered_pair(data):
    titles = {o['title']: o['pair'] for o in data['overlays']}
    assert set(titles) == {'worst answered', 'median', 'first unanswered'} and titles['first unanswered'] == 1
    assert all(image.startswith('data:image/jpeg;base64,') for o in data['overlays'] for image in o['images'])


@pytest.mark.skipif(CHROMIUM is None, reason='there is no Chromium here')
def test_the_page_in_a_browser(page, tmp_path):
    """It opens without errors, nothing comes from a network, and the slider moves the curve; a pair without an answer shows none."""
    answer, problems = visit(page, '''
        const now = document.getElementById('now'), slider = document.getElementById('slider'), plot = document.getElementById('backbone');
        const read = () => { const [, line, tip] = plot.data; return { z: [...line.z], tip: [...tip.z], words: now.textContent }; };
        await until(() => now.textContent && plot.data);
        const seen = [read()];
        for (const step of [1, 2]) {
            slider.value = step;
            slider.dispatchEvent(new Event('input'));
            await until(() => now.textContent.startsWith(`pair ${step + 1} `));
            seen.push(read());
        }
        const images = [...document.images].map(i => i.naturalWidth);
        const fetched = performance.getEntriesByType('resource').map(e => e.name).filter(name => !name.startsWith('data:'));
        return { seen, images, fetched, title: document.getElementById('title').textContent, max: slider.max };
        ''', tmp_path)
    assert problems == []
    first, none, last = answer['seen']
    assert len(first['z']) > 50 and first['z'][-1] == first['tip'][0]
    assert none['z'] == none['tip'] == [] and 'no device in plane a' in none['words']
    assert abs(last['tip'][0] - first['tip'][0] - UP_PX) < 2 and 'ok' in last['words']
    assert len(answer['images']) == 6 and min(answer['images']) > 0 and answer['fetched'] == [] and answer['max'] == '2'
    assert answer['title'] == f'Replay of {NAME}'


# ---- what is kept


def answered(k, residual=1.0, points=5, confidence=np.nan):
    """The answer to pair k: a straight backbone along x, or none where residual is NaN."""
    x = np.linspace(0, 0.1, points)
    shape = Shape(np.c_[x, np.full(points, k * 1e-5), 0 * x], x, np.full((points, 3, 3), np.nan), np.full((points, 2), residual))
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
        wild = dataclasses.replace(a.result.shape, points=rng.normal(0, 0.2, (121, 3)), covariance=np.tile(np.eye(3) * rng.uniform(1e-9, 1e-8), (121, 1, 1)))
        h.take(dataclasses.replace(a, result=dataclasses.replace(a.result, shape=wild)))
    size = len(json.dumps(report.page_data(h, NoImages(), 'run'), allow_nan=False, separators=(',', ':')))
    assert size + len(get_plotlyjs().encode()) + 6 * 200_000 < 10e6


def test_what_is_not_known_has_no_number():
    data = report.page_data(taken([np.nan]), NoImages(), 'run')
    assert data['sigma'] == data['length'] == data['tip'][0] == data['confidence'] == [None] and data['overlays'] == [] and data['shapes'] == [None]
    assert report.curve(answered(0).result.shape)[3] == [None] * 5
