"""From one plane's line to the device: paths through gains, darkness of lines, and a device between other lines."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from fluoro_shape_ros.geometry.cameras import project, source
from fluoro_shape_ros.imaging.field import field_of_view
from fluoro_shape_ros.method.propose.sweep import BEND_COST, _expected, darkness, most_probable, sweep
from fluoro_shape_ros.sim.carm import CArm, biplane
from fluoro_shape_ros.sim.scenes import xray_run

VIEWS = biplane(arm=CArm(pixel_size_iso=0.3e-3, width=512, height=512))
HALF_WIDTH = 2.0        # px


def gains(lines, rows, columns=60, slopes=5):
    """(rows, slopes, columns) that are 1 along lines (column of the first row, columns a row), whatever the slope, and
    -1 elsewhere."""
    gain = np.full((rows, slopes, columns), -1, np.float32)
    for start, slope in lines:
        for row in range(rows):
            gain[row, :, start + slope * row] = 1
    return gain


def test_a_path_goes_straight_on_where_another_crosses():
    columns, first, score = most_probable(gains([(5, 1), (25, -1)], 20))
    assert first == 0 and len(columns) == 20 and score == 20
    assert set(np.diff(columns)) in ({1}, {-1})


def test_a_path_begins_and_ends_where_its_line_does():
    gain = gains([(30, 0)], 20)
    gain[:4], gain[15:] = -1, -1
    columns, first, score = most_probable(gain)
    assert first == 4 and score == 11
    assert_allclose(columns, 30)


def test_a_bend_has_its_price():
    gain = gains([(10, 0)], 20)
    gain[10:] = -1
    gain[np.arange(10, 20), :, 11 + np.arange(10)] = 1      # from the tenth row on it moves by one column a row
    columns, first, score = most_probable(gain)
    assert_allclose(columns, [10] * 10 + list(range(11, 21)))
    assert_allclose(score, 20 - BEND_COST, rtol=1e-6)


def test_a_gain_counts_for_the_slope_that_a_path_comes_with():
    gain = np.full((10, 3, 40), -1, np.float32)
    gain[:, 1, 20] = 1          # straight on
    gain[:, 2, 5:15] = 1        # moving by one column a row
    gain[5:, 1, 20] = -1
    columns, first, score = most_probable(gain)
    assert score == 10 and set(np.diff(columns)) == {1}


def test_darkness_does_not_depend_on_brightness_and_ends_with_the_field():
    v, _ = np.mgrid[0:120, 0:120].astype(np.float32)
    image = 100 * (1 - 0.2 * np.sqrt(np.maximum(1 - ((v - 60) / 2) ** 2, 0))).astype(np.float32)
    field = np.full(image.shape, 255, np.uint8)
    field[:, 90:] = 0
    dark = darkness(image, field, HALF_WIDTH)
    k = 120 // dark.shape[1]
    assert_allclose(darkness(3 * image, field, HALF_WIDTH), dark, atol=1e-5)
    assert dark[60 // k, 40 // k] > 10 * dark[20 // k, 40 // k] and dark[60 // k, 40 // k] == dark.max()
    assert dark[60 // k, 92 // k] == 0


def test_a_device_is_darker_where_it_points_to_the_source():
    a, b = (source(v.P) for v in VIEWS)
    ray = -a / np.linalg.norm(a)            # through the isocenter, along the first plane's depth
    across = np.cross(ray, -b / np.linalg.norm(b))
    rays = np.stack([ray + 0.001 * k * across for k in range(3)])
    d = np.linalg.norm(a)
    straight, oblique = _expected(rays, d + np.array([-0.001, 0, 0.001]) * d, a, b)[1][1:]
    assert_allclose(straight, 0, atol=1e-3)                 # across both rays: as dark in both
    # 45 degrees to the first plane's ray, across the second's: there sqrt(2) fainter
    assert_allclose(oblique, np.log(np.sqrt(0.5)), atol=1e-2)


@pytest.mark.parametrize(('seed', 'swept'), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_one_planes_line_finds_the_device_among_leads_in_the_other(seed, swept):
    scene = xray_run(seed, views=VIEWS, lengths=(0.06, 0.08), clutter=('leads', 'wire')).scene()
    images = [np.sqrt(i.astype(np.float32)) for i in scene.frame.images]
    dark = [darkness(i, field_of_view(c), HALF_WIDTH) for i, c in zip(images, scene.frame.images)]
    order = (0, 1)[::1 - 2 * swept]
    line = project(VIEWS[swept].P, scene.truth)
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    line = line[np.linspace(0, len(line) - 1, int(length)).astype(int)]
    path = sweep(line, tuple(VIEWS[k] for k in order), tuple(dark[k] for k in order))
    assert path.share > 0.6
    assert np.percentile(cKDTree(scene.truth).query(path.points)[0], 90) < 1.5e-3


def test_without_anything_dark_there_is_no_path():
    line = np.c_[np.linspace(150, 350, 200), np.full(200, 256.0)]
    nothing = np.zeros((256, 256), np.float32)
    assert sweep(line, VIEWS, (np.ones_like(nothing), nothing)) is None
    assert sweep(line[:20], VIEWS, (np.ones_like(nothing), np.ones_like(nothing))) is None
