"""The exposed field: blades and intensifier corners are outside, a device is not."""

import numpy as np
from numpy.testing import assert_allclose

from fluoro_shape_ros.imaging.field import border_distance, field_of_view


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


def test_distance_to_the_border():
    image = np.full((200, 240), 180, np.uint8)
    image[:, :40] = 5
    d = border_distance(field_of_view(image), np.array([[100.0, 100], [239, 100], [150, 195], [60, 100]]))
    assert_allclose(d, [60, 0, 4, 20], atol=6)
