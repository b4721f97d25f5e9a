"""Counting, judging and the message; no ROS needed but for the last one."""

import threading

import pytest

from fluoro_shape_ros.data import Outcome, Reconstruction
from fluoro_shape_ros.ros.pairing import Counts
from msg_adapters.diagnostics import (
    ERROR,
    LOST,
    OK,
    STALE,
    WARN,
    WINDOW_S,
    PairingSummary,
    PlaneSummary,
    ReconstructionSummary,
    Status,
    Tally,
    diagnostic_array,
    pairing_status,
    plane_status,
    reconstruction_status,
    trouble,
)


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def tally(clock):
    return Tally(clock)


@pytest.mark.parametrize('summary, level, words', [
    (PlaneSummary('a'), STALE, 'no image yet'),
    (PlaneSummary('a', silent_s=0.1, has_camera=True, rate_hz=15.0), OK, '15.0 images/s'),
    (PlaneSummary('a', silent_s=0.1), ERROR, 'no camera info yet'),
    (PlaneSummary('a', silent_s=9.0, has_camera=True), STALE, 'no image for 9 s'),
    (PlaneSummary('a', unheard=lambda: '/plane_a/image_raw'), STALE,
     'no image yet: nobody publishes /plane_a/image_raw'),
    (PlaneSummary('a', silent_s=0.1, unheard=lambda: '/plane_a/camera_info'), ERROR,
     'no camera info yet: nobody publishes /plane_a/camera_info'),
    (PlaneSummary('a', silent_s=0.1, has_camera=True, publishers=2), WARN, '2 publishers'),
    (PlaneSummary('a', silent_s=0.1, has_camera=True, fell_back=True), WARN, 'best-effort'),
    (PlaneSummary('a', publishers=1, reliability='best_effort'), STALE, f'no image yet: {LOST}'),
    (PlaneSummary('a', silent_s=9.0, has_camera=True, publishers=1, reliability='best_effort'), STALE,
     f'no image for 9 s: {LOST}'),
    (PlaneSummary('a', silent_s=9.0, image_fault='too short'), ERROR, 'bad image: too short'),
    (PlaneSummary('a', silent_s=0.1, camera_fault='K is zero'), ERROR, 'camera info refused: K is zero'),
    (PlaneSummary('a', silent_s=0.1, camera_fault='K is zero', has_camera=True), WARN,
     'the one before holds: K is zero'),
])
def test_plane(summary, level, words):
    status = plane_status(summary)
    assert status.name == 'plane a' and status.level == level and words in status.message


@pytest.mark.parametrize('summary, level, words', [
    (PairingSummary(Counts(), 0.01), STALE, 'no pair yet'),
    (PairingSummary(Counts(), 0.01, both_alive=True, gap_s=-0.03), WARN, 'differ by 30.0 ms, sync_slop is 10.0 ms'),
    (PairingSummary(Counts(), 0.01, silent_s=0.1, rate_hz=7.5), OK, '7.5 pairs/s'),
    (PairingSummary(Counts(), 0.01, silent_s=0.1, rate_hz=30.0, dropped_hz=12.0), OK,
     '30.0 pairs/s, 12.0 of them dropped'),
    (PairingSummary(Counts(), 0.01, silent_s=0.1, rate_hz=2.0, unpaired_hz=6.0, lossy=True), WARN,
     f'60 % of the images have no partner: {LOST}'),
    (PairingSummary(Counts(), 0.01, silent_s=0.1, rate_hz=15.0, unpaired_hz=1.0, lossy=True), OK, '15.0 pairs/s'),
    # 30/s beside 15/s
    (PairingSummary(Counts(), 0.01, silent_s=0.1, rate_hz=15.0, unpaired_hz=15.0), OK, '15.0 pairs/s'),
    (PairingSummary(Counts(), 0.01, both_alive=True, gap_s=-0.03, unpaired_hz=6.0, lossy=True), WARN,
     f'sync_slop is 10.0 ms; or {LOST}'),
    (PairingSummary(Counts(), 0.01, silent_s=20.0), STALE, 'no pair for 20 s'),
    (PairingSummary(Counts(), 0.01, silent_s=0.1, jumped=True), WARN, 'jumped back'),
    (PairingSummary(Counts(), 0.01, silent_s=0.1, unstamped=True), ERROR, 'without a stamp'),
])
def test_pairing(summary, level, words):
    status = pairing_status(summary)
    assert status.level == level and words in status.message


@pytest.mark.parametrize('summary, level, words', [
    (ReconstructionSummary(), STALE, 'no pair yet'),
    (ReconstructionSummary(enabled=False), WARN, 'paused'),
    (ReconstructionSummary(outcome=Outcome.OK, silent_s=9.0, overdue_s=8.6), ERROR, 'takes 9 s already'),
    (ReconstructionSummary(outcome=Outcome.OK, silent_s=9.0, notes=('no /clock',)), STALE, 'no /clock'),
    (ReconstructionSummary(capturing=True, mask='capturing, 3 of 8 pairs'), OK, '3 of 8'),
    (ReconstructionSummary(outcome=Outcome.OK, detail='ok', silent_s=0.1, rate_hz=4.0), OK, '4.0 results/s'),
    (ReconstructionSummary(outcome=Outcome.OK, silent_s=0.1, rate_hz=4.0, latency_s=(0.03, 0.04, 0.2)), OK,
     '4.0 results/s, 40 ms after'),
    (ReconstructionSummary(outcome=Outcome.OK, silent_s=0.1, rate_hz=4.0, latency_s=(0.04,), out_of_time=0.2), OK,
     'images, 20 % of the pairs out of time'),
    (ReconstructionSummary(outcome=Outcome.OUT_OF_TIME, detail='no curve', silent_s=0.1), WARN,
     'out_of_time: no curve'),
    (ReconstructionSummary(outcome=Outcome.OK, silent_s=0.1, warnings=('tip_ambiguous',)), WARN, 'tip_ambiguous'),
    (ReconstructionSummary(outcome=Outcome.OK, silent_s=0.1, notes=('mask cleared',)), WARN, 'mask cleared'),
    (ReconstructionSummary(outcome=Outcome.NO_DEVICE_A, detail='no curve', silent_s=0.1), WARN,
     'no_device_in_plane_a: no curve'),
    (ReconstructionSummary(outcome=Outcome.BAD_IMAGE, detail='plane b: step', silent_s=0.1), ERROR,
     'bad_image: plane b: step'),
    (ReconstructionSummary(outcome=Outcome.INTERNAL_ERROR, silent_s=0.1), ERROR, 'internal_error'),
    (ReconstructionSummary(outcome=Outcome.NO_DEVICE_B, detail='no curve', silent_s=9.0), STALE,
     'no pair for 9 s; the last one: no_device_in_plane_b: no curve'),
])
def test_reconstruction(summary, level, words):
    status = reconstruction_status(summary)
    assert status.level == level and words in status.message


def test_values_name_every_counter():
    counts = Counts(pairs=7, unpaired=1, out_of_order=2, duplicates=3, unstamped=4, jumps=5)
    values = pairing_status(PairingSummary(counts, 0.01, dropped=6)).values
    assert [values[k] for k in ('pairs', 'unpaired', 'out of order', 'duplicates', 'unstamped', 'jumps back',
                                'dropped')] == [7, 1, 2, 3, 4, 5, 6]
    values = reconstruction_status(ReconstructionSummary(outcome=Outcome.OK, silent_s=0.0, latency_s=(0.01, 0.02, 0.06),
                                                         outcomes={'ok': 3})).values
    assert ((values['latency median (ms)'], values['latency max (ms)'], values['count ok'], values['last outcome'])
            == ('20.0', '60.0', 3, 'ok'))
    assert plane_status(PlaneSummary('b', reliability='best_effort')).values['reliability'] == 'best_effort'


@pytest.mark.parametrize('result, shown', [
    (Reconstruction(Outcome.LOW_CONFIDENCE, 'it ends at a wire', confidence=0.41263), '0.413'),
    (Reconstruction(Outcome.NO_DEVICE_A, 'no curve'), ''),
])
def test_the_confidence_of_the_last_pair_is_told(tally, result, shown):
    assert reconstruction_status(tally.reconstruction()).values['confidence'] == ''
    tally.result(Reconstruction(Outcome.CURVATURE, 'too bent', confidence=0.9), 0.02)
    tally.result(result, 0.02)
    status = reconstruction_status(tally.reconstruction())
    assert (status.level == WARN and status.message == f'{result.outcome.value}: {result.detail}'
            and status.values['confidence'] == shown)


def test_rates_fade_and_silence_grows(tally, clock):
    clock.now += 60
    assert tally.silent_s('image a') is None
    for _ in range(30):
        clock.now += 0.1
        tally.event('image a')
    summary = tally.plane('a')
    assert summary.images == 30 and summary.rate_hz == pytest.approx(10.0, abs=0.4) and summary.silent_s == 0
    clock.now += WINDOW_S + 1
    summary = tally.plane('a')
    assert summary.images == 30 and summary.rate_hz == 0 and summary.silent_s == pytest.approx(WINDOW_S + 1)


def test_a_fault_lasts_until_the_next_good_one(tally):
    tally.refused('image a', 'too short')
    tally.refused('camera info a', 'K is zero')
    summary = tally.plane('a')
    assert ((summary.image_fault, summary.bad_images, summary.camera_fault, summary.bad_camera_infos)
            == ('too short', 1, 'K is zero', 1))
    tally.accepted('image a')
    summary = tally.plane('a')
    assert (summary.image_fault, summary.bad_images, summary.camera_fault) == ('', 1, 'K is zero')
    assert tally.plane('b').image_fault == ''


def test_outcomes_are_counted_and_the_last_one_told(tally, clock):
    for k in range(3):
        tally.result(Reconstruction(Outcome.NO_DEVICE_A, f'number {k}', warnings=('w',)), 0.02)
    tally.result(Reconstruction(Outcome.CURVATURE, 'too bent'), 0.05)
    clock.now += 0.5
    summary = tally.reconstruction()
    assert summary.outcomes == {'no_device_in_plane_a': 3, 'curvature_too_high': 1}
    assert (summary.outcome, summary.detail, summary.warnings, summary.silent_s) == (Outcome.CURVATURE,
                                                                                     'too bent', (), 0.5)
    assert summary.rate_hz == 0 and summary.latency_s == ()     # of results, and there was none


def test_the_share_of_the_pairs_that_are_out_of_time_is_told(tally, clock):
    share = lambda: reconstruction_status(tally.reconstruction()).values['out of time (%)']     # noqa: E731
    assert share() == '0'
    for outcome in (Outcome.OUT_OF_TIME, Outcome.NO_DEVICE_A, Outcome.OUT_OF_TIME, Outcome.LENGTH):
        tally.result(Reconstruction(outcome), 0.2)
    assert share() == '50' and tally.reconstruction().outcomes['out_of_time'] == 2
    clock.now += WINDOW_S + 1
    tally.result(Reconstruction(Outcome.LENGTH), 0.2)
    assert share() == '0' and tally.reconstruction().outcomes['out_of_time'] == 2


def test_the_commonest_reason_is_told_where_everything_is_refused(tally, clock):
    assert tally.reconstruction().refused == ''
    for outcome, detail in ((Outcome.LENGTH, 'too long'), (Outcome.NO_DEVICE_A, 'no line'),
                            (Outcome.NO_DEVICE_A, 'no line'), (Outcome.CURVATURE, '')):
        tally.result(Reconstruction(outcome, detail), 0.02)
    assert (tally.reconstruction().refused
            == 'none of the last 4 pairs gave a result, most often for no_device_in_plane_a: no line')
    tally.event(f'outcome {Outcome.OK.value}')
    assert tally.reconstruction().refused == ''
    clock.now += WINDOW_S + 1
    assert tally.reconstruction().refused == ''


ALIVE, PAIRS = dict(silent_s=0.1, has_camera=True, rate_hz=15.0), PairingSummary(Counts(), 0.01, silent_s=0.1,
                                                                                 rate_hz=15.0)
UNPAIRED = PairingSummary(Counts(), 0.01, both_alive=True, gap_s=-0.03)


@pytest.mark.parametrize('a, pairing, results, words', [
    ({}, UNPAIRED, {}, 'plane a: no image yet'),
    (dict(silent_s=0.1), PAIRS, dict(refused='none'), 'plane a: no camera info yet'),
    (ALIVE, PAIRS, dict(refused='none of the last 3 pairs'), 'none of the last 3 pairs'),
    (ALIVE, UNPAIRED, {}, 'nothing pairs: the newest stamps differ by 30.0 ms, sync_slop is 10.0 ms'),
    (ALIVE, PairingSummary(Counts(), 0.01), {}, ''),        # a moment after the streams began
    (ALIVE, PAIRS, dict(outcome=Outcome.OK, rate_hz=7.0, warnings=('tip_ambiguous',), silent_s=0.1), ''),
    ({}, UNPAIRED, dict(enabled=False), ''),
    (ALIVE, PAIRS, dict(capturing=True, refused='none'), ''),
])
def test_what_keeps_results_from_coming(a, pairing, results, words):
    assert trouble([PlaneSummary('a', **a), PlaneSummary('b', **ALIVE)], pairing,
                   ReconstructionSummary(**results)) == words


def test_pairing_summary_sees_both_streams(tally):
    tally.event('image a')
    assert not tally.pairing(Counts(), slop_s=0.01).both_alive
    tally.event('image b')
    tally.event('jump')
    summary = tally.pairing(Counts(), slop_s=0.01)
    assert summary.both_alive and summary.jumped and not summary.unstamped


def test_counts_from_many_threads(tally):
    def work():
        for _ in range(2000):
            tally.event('image a')
            tally.plane('a')
    threads = [threading.Thread(target=work) for _ in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert tally.count('image a') == 8000


def test_message():
    pytest.importorskip('diagnostic_msgs')
    from msg_adapters.messages import ros_message
    msg = diagnostic_array([Status('plane a', WARN, 'why', {'images': 3}), Status('pairing', OK, 'fine')],
                           5_000_000_007, 'fluoro_shape', ros_message)
    assert (msg.header.stamp.sec, msg.header.stamp.nanosec) == (5, 7)
    a, b = msg.status
    assert (a.name, a.level, a.message, a.hardware_id) == ('fluoro_shape: plane a', b'\x01', 'why', 'fluoro_shape')
    assert [(v.key, v.value) for v in a.values] == [('images', '3')]
    assert (b.name, b.level) == ('fluoro_shape: pairing', b'\x00')
