"""Calibration files: what camera_calibration writes, and what is wrong with others."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from msg_adapters.calibration import (
    BadCalibration,
    Calibration,
    calibration_to_camera_info,
    read_calibration,
    write_calibration,
)
from msg_adapters.messages import stamp_ns

pytest.importorskip('yaml')

# as camera_calibration writes it, but for 1e-05, which yaml-cpp writes and YAML 1.1 takes for text
TEXT = '''image_width: 640
image_height: 480
camera_name: plane_a
camera_matrix:
  rows: 3
  cols: 3
  data: [1000.5, 0, 320, 0, 1000, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2, 0.05, 1e-05, -0.002, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]
'''


def read(tmp_path, text):
    path = tmp_path / 'plane_a.yaml'
    path.write_text(text)
    return read_calibration(path)


def test_reads_the_camera_info_format(tmp_path):
    c = read(tmp_path, TEXT)
    assert (c.camera_name, c.width, c.height, c.distortion_model) == ('plane_a', 640, 480, 'plumb_bob')
    assert_array_equal(c.K, [[1000.5, 0, 320], [0, 1000, 240], [0, 0, 1]])
    assert_array_equal(c.D, [-0.2, 0.05, 1e-5, -0.002, 0])
    assert_array_equal(c.R, np.eye(3))
    assert_array_equal(c.P, [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]])


def test_distortion_may_be_missing(tmp_path):
    head, _, rest = TEXT.partition('distortion_model')
    c = read(tmp_path, head + rest[rest.index('projection_matrix'):])
    assert c.distortion_model == '' and c.D.size == 0
    assert_array_equal(c.R, np.eye(3))


def test_what_is_written_reads_the_same(tmp_path):
    rng = np.random.default_rng(1)
    c = Calibration('b', 3, 2, rng.normal(size=(3, 3)), rng.normal(size=(3, 4)), 'equidistant',
                    rng.normal(size=4) * 1e-9, rng.normal(size=(3, 3)))
    write_calibration(tmp_path / 'b.yaml', c)
    again = read_calibration(tmp_path / 'b.yaml')
    assert (again.camera_name, again.width, again.height, again.distortion_model) == ('b', 3, 2, 'equidistant')
    for name in 'KPDR':
        assert_array_equal(getattr(again, name), getattr(c, name))


def test_becomes_a_camera_info(tmp_path, new):
    msg = calibration_to_camera_info(read(tmp_path, TEXT), 2_000_000_005, 'plane_a_optical', new)
    assert ((stamp_ns(msg), msg.header.frame_id, msg.width, msg.height, msg.distortion_model)
            == (2_000_000_005, 'plane_a_optical', 640, 480, 'plumb_bob'))
    assert list(msg.p) == list(range(1, 13))
    assert list(msg.k) == [1000.5, 0, 320, 0, 1000, 240, 0, 0, 1]
    assert list(msg.d) == [-0.2, 0.05, 1e-5, -0.002, 0]
    assert list(msg.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]


@pytest.mark.parametrize('old, fresh, says', [
    ('image_width: 640', '', 'image_width is missing'),
    ('projection_matrix', 'something_else', 'projection_matrix is missing'),
    ('camera_matrix', 'something_else', 'camera_matrix is missing'),
    ('image_height: 480', 'image_height: 480.5', 'image_height must be'),
    ('image_height: 480', 'image_height: -1', 'image_height must be'),
    ('[1000.5, 0,', '[1000.5,', 'camera_matrix has 8 entries instead of 3x3'),
    ('[1000.5, 0,', '[big, 0,', 'camera_matrix needs rows, cols and data'),
    ('data: [-0.2, 0.05, 1e-05, -0.002, 0]', 'dada: []', 'distortion_coefficients needs'),
    ('  rows: 1\n  cols: 5\n  data: [-0.2, 0.05, 1e-05, -0.002, 0]', '  none', 'distortion_coefficients needs'),
    ('image_width: 640', 'image_width: [640', 'no YAML'),
    (TEXT, 'a list', 'no calibration'),
    (TEXT, '', 'no calibration'),
], ids=lambda text: text.split('\n')[0][:30])
def test_a_bad_file_is_named_with_its_field(tmp_path, old, fresh, says):
    with pytest.raises(BadCalibration, match=f'plane_a.yaml: .*{says}'):
        read(tmp_path, TEXT.replace(old, fresh))


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_calibration(tmp_path / 'none.yaml')
