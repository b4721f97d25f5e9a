"""Messages into a Frame, what the node remembers, and the thread that takes the newest pair. No ROS."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluoro_shape_ros.config import Config
from fluoro_shape_ros.data import Frame, Outcome, Reconstruction, Searched, Shape
from fluoro_shape_ros.ros.worker import (
    Job,
    Memory,
    NoTransform,
    Prediction,
    Worker,
    adapt,
    camera,
    checked_camera,
    image_window,
    view_of,
)
from msg_adapters.cameras import BadCameraInfo
from msg_adapters.diagnostics import Tally

SECONDS = 10    # deadline of whatever must happen at once
P_A = np.array([[500.0, 0, 20, 0.8 * 20], [0, 500, 20, 0.8 * 20], [0, 0, 1, 0.8]])
P_B = np.array([[20, 0, -500.0, 0.8 * 20], [20, 500, 0, 0.8 * 20], [1, 0, 0, 0.8]])


def info(P=P_A, frame_id='plane_a_optical', **fields):
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    values = dict(header=SimpleNamespace(frame_id=frame_id), height=40, width=40, distortion_model='', d=[],
                  k=[500.0, 0, 20, 0, 500, 20, 0, 0, 1],
                  r=np.eye(3).ravel(), p=P.ravel(), binning_x=0, binning_y=0, roi=roi)
    return SimpleNamespace(**{**values, **fields})


def image(value=7, size=40, encoding='mono8', stamp=5):
    head = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=stamp))
    return SimpleNamespace(header=head, encoding=encoding, height=size, width=size, step=size, is_bigendian=0,
                           data=bytes([value]) * size * size)


def job(images=None, infos=None, generation=0, prediction=None, **values):
    infos = (info(), info(P_B, 'plane_b_optical')) if infos is None else infos
    cameras = tuple(None if i is None else camera(i) for i in infos)
    return Job(5, images or (image(), image()), cameras, Config.from_values(**values), generation, 0.0, prediction)


def no_lookup(*_):
    raise AssertionError('tf is not asked')


def test_a_frame_of_two_messages():
    frame = adapt(job(), view_of, no_lookup, Tally())
    assert isinstance(frame, Frame) and (frame.stamp_ns, frame.frame_id) == (5, 'plane_a_optical')
    assert [i.shape for i in frame.images] == [(40, 40)] * 2 and frame.images[0][0, 0] == 7
    assert [v.name for v in frame.views] == ['a', 'b'] and np.allclose(frame.views[1].P, P_B)
    assert adapt(job(reference_frame='cell'), view_of, no_lookup, Tally()).frame_id == 'cell'


@pytest.mark.parametrize('given, outcome, words', [
    (dict(images=(image(), image(encoding='jpg'))), Outcome.BAD_IMAGE, 'plane b: encoding "jpg"'),
    (dict(infos=(info(), None)), Outcome.NO_CAMERA_INFO, 'plane b: no valid camera info'),
    (dict(infos=(None, None)), Outcome.NO_CAMERA_INFO, 'plane a and plane b'),
    (dict(images=(image(size=30), image())), Outcome.BAD_CAMERA_INFO, 'plane a: CameraInfo is for 40x40'),
])
def test_what_can_not_be_a_frame_is_named(given, outcome, words):
    result = adapt(job(**given), view_of, no_lookup, Tally())
    assert result.outcome is outcome and words in result.detail


def test_bad_images_are_told_to_their_plane():
    tally = Tally()
    adapt(job(images=(image(), image(encoding='jpg'))), view_of, no_lookup, tally)
    assert 'jpg' in tally.plane('b').image_fault and not tally.plane('a').image_fault
    adapt(job(), view_of, no_lookup, tally)
    assert not tally.plane('b').image_fault and tally.plane('b').bad_images == 1


def test_poses_come_from_tf_when_they_should():
    """The camera looks along y of the cell from 0.8 m away."""
    asked = []

    def lookup(reference, camera_frame, stamp_ns):
        asked.append((reference, camera_frame, stamp_ns))
        return ((1.0, 0, 0), (0, 0, -1.0), (0, 1.0, 0)), (0.0, 0.0, 0.8)
    infos = info(), info(frame_id='plane_b_optical')
    frame = adapt(job((image(), image(stamp=8)), infos, geometry='tf', reference_frame='cell'), view_of,
                  lookup, Tally())
    assert asked == [('cell', 'plane_a_optical', 5), ('cell', 'plane_b_optical', 8)]
    assert np.allclose(frame.views[0].P, [[500, 20, 0, 16], [0, 20, -500, 16], [0, 1, 0, 0.8]])


def test_a_pose_that_tf_does_not_know_is_named():
    def lookup(*_):
        raise NoTransform('plane_a_optical from cell: unknown')
    result = adapt(job(geometry='tf', reference_frame='cell'), view_of, lookup, Tally())
    assert result.outcome is Outcome.NO_TRANSFORM and 'cell: unknown' in result.detail


def test_cameras_are_the_same_whatever_their_stamps():
    assert camera(info()) == camera(info()) and hash(camera(info())) == hash(camera(info()))
    for other in (info(P_B), info(frame_id='x'), info(binning_x=2), info(width=41), info(d=[0.1])):
        assert camera(other) != camera(info())


def test_a_camera_is_checked_before_any_image():
    assert checked_camera(info(binning_x=2, binning_y=2), Config()) == camera(info(binning_x=2, binning_y=2))
    with pytest.raises(BadCameraInfo, match='P is zero'):
        checked_camera(info(np.zeros((3, 4))), Config())


SHAPE = Shape(np.zeros((2, 3)), np.array([0.0, 0.001]), np.zeros((2, 3, 3)), np.zeros((2, 2)))
GOOD = Reconstruction(Outcome.OK, shape=SHAPE)


def recall(memory, **options):
    the_job = job(**options)
    frame = adapt(the_job, view_of, no_lookup, Tally())
    return memory.prior(the_job, frame, image_window(the_job, frame))


def after_good(memory):
    the_job = job(generation=memory.generation)
    assert memory.remember(the_job, adapt(the_job, view_of, no_lookup, Tally()), GOOD)


def test_the_last_shape_is_remembered_until_reset():
    memory = Memory()
    assert recall(memory).previous is None
    after_good(memory)
    assert recall(memory).previous is SHAPE and recall(memory).previous_stamp_ns == 5
    assert recall(memory, tracking=False).previous is None
    assert recall(memory, reference_frame='cell').previous is None      # its numbers mean something else there
    memory.reset()
    assert recall(memory).previous is None


def test_the_shape_before_the_last_is_remembered_too():
    memory = Memory()
    after_good(memory)
    assert recall(memory).before is None
    later = replace(GOOD, shape=replace(SHAPE, points=SHAPE.points + 1))
    the_job = job(generation=memory.generation)
    memory.remember(the_job, replace(adapt(the_job, view_of, no_lookup, Tally()), stamp_ns=9), later)
    prior = recall(memory)
    assert (prior.previous, prior.previous_stamp_ns, prior.before, prior.before_stamp_ns) == (later.shape, 9, SHAPE, 5)


def test_what_a_search_found_counts_until_something_changes():
    memory, found = Memory(), Searched(3.0, 0.5)
    the_job = job(generation=memory.generation)
    frame = adapt(the_job, view_of, no_lookup, Tally())

    def find(**values):
        recall(memory, **values)
        memory.remember(the_job, frame, replace(GOOD, searched=found))

    find()
    assert recall(memory).searched is found
    assert recall(memory, robot_radius=0.002).searched is None      # another radius shows other things
    find()
    memory.capture_mask(1)
    assert memory.take_for_mask(frame, image_window(the_job, frame))
    assert recall(memory).searched is None                          # so does a mask
    find()
    assert recall(memory).searched is found
    memory.clear_mask()
    assert recall(memory).searched is None
    find(tracking=False)
    assert recall(memory, tracking=False).searched is None
    find()
    assert recall(memory, reference_frame='cell').searched is None
    find()
    memory.remember(the_job, frame, Reconstruction(Outcome.LOW_CONFIDENCE))
    assert recall(memory).previous is SHAPE and recall(memory).searched is None
    find()
    memory.reset()
    assert recall(memory).searched is None


def test_a_result_begun_before_a_reset_is_out_of_date():
    memory = Memory()
    the_job = job(generation=memory.generation)
    memory.reset()
    assert not memory.remember(the_job, adapt(the_job, view_of, no_lookup, Tally()), GOOD)
    assert recall(memory).previous is None


def capture(memory, *values, **options):
    taken = []
    for value in values:
        the_job = job(images=(image(value, **options), image(value + 1, **options)))
        frame = adapt(the_job, view_of, no_lookup, Tally())
        taken.append(memory.take_for_mask(frame, image_window(the_job, frame)))
    return taken


def test_a_mask_is_the_mean_of_the_pairs():
    memory = Memory()
    assert capture(memory, 3) == [False]
    memory.capture_mask(2)
    assert capture(memory, 10, 15, 99) == [True, True, False]
    a, b = recall(memory).masks
    assert a.dtype == np.float32 and (a == 12.5).all() and (b == 13.5).all()
    memory.reset()
    assert recall(memory).masks is not None     # not tracking state
    memory.clear_mask()
    assert recall(memory).masks is None


@pytest.mark.parametrize('changed', [
    dict(images=(image(size=30), image()), infos=(info(height=30, width=30), info(P_B))),
    dict(infos=(info(height=80, width=80, roi=SimpleNamespace(x_offset=3, y_offset=0, width=40, height=40)),
                info(P_B))),
])
def test_a_mask_that_no_longer_fits_is_cleared_and_said_so(changed):
    memory = Memory()
    memory.capture_mask(1)
    capture(memory, 10)
    assert recall(memory, infos=(info(), info(P_B, 'moved'))).masks is not None
    assert recall(memory, **changed).masks is None and 'mask cleared' in memory.note
    assert recall(memory).masks is None


@pytest.mark.parametrize('frame_id, stamp_ns, fault', [
    ('plane_a_optical', 5, ''),
    ('', 5, ''),
    ('elsewhere', 5, 'it is in frame "elsewhere", not in "plane_a_optical"'),
    ('', 0, 'it has no stamp'),
])
def test_a_prediction_goes_along_unless_it_is_in_another_frame_or_has_no_stamp(frame_id, stamp_ns, fault):
    points = np.ones((2, 3))
    prior = recall(Memory(), prediction=Prediction(points, frame_id, stamp_ns))
    assert prior.prediction_fault == fault
    assert prior.predicted is (None if fault else points)


class Gate:
    """Work that can be held up; `done` are the jobs in the order they were begun."""

    def __init__(self):
        self.begun, self.open, self.done, self.failed, self.idle = (threading.Event(), threading.Event(), [], [],
                                                                    threading.Event())

    def work(self, job):
        self.done.append(job)
        self.begun.set()
        assert self.open.wait(SECONDS)
        if job == 'last':
            self.idle.set()
        if job == 'bug':
            raise ZeroDivisionError('a bug')

    def fail(self, job, error):
        self.failed.append((job, str(error)))


@pytest.fixture
def gate():
    return Gate()


@pytest.fixture
def worker(gate):
    worker = Worker(gate.work, gate.fail)
    yield worker
    gate.open.set()
    assert worker.stop(SECONDS)


def test_the_newest_job_wins(worker, gate):
    assert not worker.offer('first') and gate.begun.wait(SECONDS)
    assert not worker.offer('second') and worker.offer('third') and worker.offer('last')
    gate.open.set()
    assert gate.idle.wait(SECONDS) and gate.done == ['first', 'last']


def test_a_cleared_job_is_never_begun(worker, gate):
    worker.offer('first')
    assert gate.begun.wait(SECONDS)
    worker.offer('second')
    worker.clear()
    assert not worker.offer('last')
    gate.open.set()
    assert gate.idle.wait(SECONDS) and gate.done == ['first', 'last']


def test_a_bug_is_reported_and_the_next_job_goes_on(worker, gate):
    gate.open.set()
    worker.offer('bug')
    assert gate.begun.wait(SECONDS)
    worker.offer('last')
    assert gate.idle.wait(SECONDS) and gate.failed == [('bug', 'a bug')]


def test_no_job_is_taken_before_all_is_ready_and_then_the_newest(gate):
    asked, ready = threading.Event(), threading.Event()

    def get_ready(waits):
        asked.set()
        assert ready.wait(SECONDS)
    gate.open.set()
    worker = Worker(gate.work, gate.fail, get_ready)
    assert asked.wait(SECONDS) and not worker.offer('first') and worker.offer('last')
    assert gate.done == [] and worker.busy_s == 0
    ready.set()
    assert gate.idle.wait(SECONDS) and gate.done == ['last']
    asked.clear()
    assert asked.wait(SECONDS)      # also while there is no job
    assert worker.stop(SECONDS)


def test_how_long_a_job_has_been_at_work_is_known(worker, gate):
    assert worker.busy_s == 0
    worker.offer('first')
    assert gate.begun.wait(SECONDS)
    before = worker.busy_s
    gate.open.wait(0.01)
    assert 0 < before < worker.busy_s


def test_stopping_does_not_wait_for_ever(worker, gate):
    worker.offer('first')
    assert gate.begun.wait(SECONDS)
    worker.offer('second')
    assert not worker.stop(0.01)
    gate.open.set()
    assert worker.stop(SECONDS) and gate.done == ['first']
