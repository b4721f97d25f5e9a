"""The exposed field: blades and intensifier corners are outside, a device is not, nor is dense anatomy."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.imaging.field import border_distance, common_field, field_of_view
from fluoro_shape_ros.imaging.prepare import dark_device


def test_a_plain_image_is_all_field():
    image = np.full((200, 240), 180, np.uint8)
    image[100:104, :] = 0                       # a black device that runs out on both sides
    assert (field_of_view(image) == 255).all()


def test_blades_are_outside():
    image = np.full((200, 240), 180, np.uint8)
    image[:, :40] = 5
    field = field_of_view(image)
    assert (field[:, :36] == 0).all() and (field[:, 48:] == 255).all()


def test_circular_field():
    v, u = np.mgrid[0:256, 0:256]
    inside = np.hypot(u - 128, v - 128) < 120
    field = field_of_view(np.where(inside, 30000, 300).astype(np.uint16))
    assert (field[np.hypot(u - 128, v - 128) < 112] == 255).all()
    assert (field[np.hypot(u - 128, v - 128) > 132] == 0).all()


def test_a_dark_organ_inside_stays_field():
    image = np.full((200, 240), 180, np.uint8)
    image[80:130, 80:130] = 3
    assert (field_of_view(image) == 255).all()


V, U = np.mgrid[0:256, 0:320]


def blocked_where(dark, level=4, bright=180):
    """The field of an image that is `level` where `dark`, and a `bright` ramp elsewhere."""
    return field_of_view(np.where(dark, level, bright - 0.1 * U).astype(np.uint8))


def assert_found(field, dark):
    """Whether a field is what is not `dark`, but for pixels at its border."""
    near = cv2.dilate(cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3))),
                      np.ones((17, 17))) > 0
    assert ((field == 0) == dark)[~near].all() and 0 < near.mean() < 0.5


OPENINGS = {
    'one blade': U < 50,
    'two blades': (U < 50) | (U > 270),
    'four blades': (U < 50) | (U > 270) | (V < 30) | (V > 200),
    'an intensifier': np.hypot(U - 160, V - 128) > 125,
    'an intensifier aside': np.hypot(U - 130, V - 110) > 150,
    'an intensifier with a blade': (np.hypot(U - 160, V - 128) > 125) | (V < 60),
    'a small opening': np.hypot(U - 160, V - 128) > 50,
}


@pytest.mark.parametrize('name', OPENINGS)
def test_a_convex_opening_is_found(name):
    assert_found(blocked_where(OPENINGS[name]), OPENINGS[name])


@pytest.mark.parametrize('name', OPENINGS)
def test_on_an_inverted_display_the_bright_side_is_not_exposed(name):
    image = 255 - np.where(OPENINGS[name], 4, 180 - 0.1 * U).astype(np.uint8)
    for polarity in ('bright', 'auto'):
        assert_found(field_of_view(image, polarity), OPENINGS[name])
    assert (field_of_view(image) == 255).all()


@pytest.mark.parametrize('turn_deg', [5, 20, 45])
def test_blades_may_be_turned(turn_deg):
    v, u = np.mgrid[0:768, 0:768] - 383.5
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    dark = (np.abs(c * u + s * v) > 270) | (np.abs(c * v - s * u) > 190)
    assert_found(field_of_view(np.where(dark, 4, 180).astype(np.uint8)), dark)


DENSE = {
    'in a corner': np.hypot(U, V) < 120,
    'in two corners': (np.hypot(U, V) < 100) | (np.hypot(U - 319, V - 255) < 100),
    'at one side': np.hypot(U + 40, V - 128) < 110,
    'a spine': np.abs(U - 160 - 20 * np.sin(V / 40)) < 40,
    'a shoulder': (U < 120) & (V > 140),
    'an island in the middle': np.hypot(U - 160, V - 128) < 60,
}


@pytest.mark.parametrize('name', DENSE)
@pytest.mark.parametrize('level', [4, 12, 20])
def test_dense_anatomy_blocks_nothing(name, level):
    assert (blocked_where(DENSE[name], level) == 255).all()


@pytest.mark.parametrize('name', ['in a corner', 'a spine', 'at one side'])
def test_dense_anatomy_beside_a_blade_does_not_hide_that(name):
    """At 8 % of the bright level, what is dark is not convex; the blade alone is darker still."""
    blade = V < 40
    image = np.where(DENSE[name], 14, 180)
    assert_found(field_of_view(np.where(blade, 1, image).astype(np.uint8)), blade)


@pytest.mark.parametrize('change', [lambda i: i.astype(np.uint16) * 200, lambda i: i.astype(np.float32) / 255,
                                    lambda i: i.astype(np.float32) - 4,
                                    lambda i: i.astype(np.float32) * np.float32(1e35)])
@pytest.mark.filterwarnings('error')
def test_depth_and_range_of_the_image_do_not_matter(change):
    image = np.where(OPENINGS['an intensifier'], 4, 180).astype(np.uint8)
    assert np.array_equal(field_of_view(change(image)), field_of_view(image))


def test_a_wide_device_that_runs_out_of_the_image_stays_field():
    assert (blocked_where(np.abs(V - 0.5 * U - 40) < 10) == 255).all()


def test_distance_to_the_border():
    image = np.full((200, 240), 180, np.uint8)
    image[:, :40] = 5
    d = border_distance(field_of_view(image), np.array([[100.0, 100], [239, 100], [150, 195], [60, 100]]))
    assert_allclose(d, [60, 0, 4, 20], atol=6)


DISPLAYS = {'linear': lambda x: x, 'logarithmic': lambda x: np.log1p(15 * x) / np.log(16), 'gamma': lambda x: x**0.5,
            'windowed': lambda x: np.clip(2 * x - 0.3, 0, 1)}


@pytest.mark.parametrize('display', DISPLAYS)
@pytest.mark.parametrize('name', ['four blades', 'an intensifier', 'an intensifier with a blade'])
def test_scatter_beyond_the_blades_hides_them_on_no_display(name, display):
    """Two fifths of what is bright inside goes on as a glow outside, as scatter does."""
    dark = OPENINGS[name]
    primary = np.where(dark, 0.0, 0.9 - 0.4 * np.exp(-((U - 110) / 60.0)**2 - ((V - 150) / 50.0)**2))
    light = 0.6 * primary + 0.4 * cv2.GaussianBlur(primary, (0, 0), 25)
    counted = np.random.default_rng(3).poisson(2000 * light) / 2000
    assert_found(field_of_view(np.clip(255 * DISPLAYS[display](np.clip(counted, 0, 1)), 0, 255).astype(np.uint8)), dark)


def test_letters_beyond_the_blades_are_not_the_patient():
    dark = OPENINGS['four blades']
    image = cv2.resize(np.where(dark, 4, 180 - 0.1 * U).astype(np.uint8), None, fx=4, fy=4,
                       interpolation=cv2.INTER_NEAREST)
    cv2.putText(image, 'L  12 mA', (20, 50), cv2.FONT_HERSHEY_PLAIN, 2, 255, 2)
    assert_found(field_of_view(image), np.kron(dark, np.ones((4, 4), bool)))


def test_where_a_blade_stood_when_the_mask_was_taken_is_not_exposed():
    image, mask = (np.where(U < edge, 4, 180).astype(np.uint8) for edge in (50, 70))
    assert_found(common_field(image, mask.astype(np.float32)), U < 70)
    assert_found(common_field(mask, image.astype(np.float32)), U < 70)
    assert_found(common_field(image, None), U < 50)


@pytest.mark.parametrize('name', [None, *OPENINGS])
def test_blades_and_bones_do_not_tell_a_bright_device_from_a_dark_one(name):
    rng = np.random.default_rng(7)
    light = 150 - 60 * np.exp(-((U - 160) / 25.0)**2)       # a spine
    light = light + np.where(np.abs((V % 60) - 30) < 5, 25, 0) * (np.abs(U - 160) < 40)
    light[np.abs(V - 128 - 12 * np.sin(U / 25.0)) < 2] -= 30        # the device
    dark = np.zeros(light.shape, bool) if name is None else OPENINGS[name]
    image = np.clip(np.where(dark, 4, light) + rng.normal(0, 2, light.shape), 0, 255).astype(np.uint8)
    assert (dark_device(image, 'auto') == image).all()
    assert (dark_device(255 - image, 'auto') == image).all()


@pytest.mark.parametrize('h, w', [(1, 1), (2, 3), (8, 8), (3, 2000), (17, 40), (700, 90)])
@pytest.mark.parametrize('polarity', ['dark', 'bright', 'auto'])
def test_an_image_of_any_size_has_a_field(h, w, polarity):
    image = np.random.default_rng(h).integers(0, 256, (h, w)).astype(np.uint8)
    assert (field_of_view(image, polarity) == 255).all()
    assert dark_device(image, polarity).shape == image.shape
