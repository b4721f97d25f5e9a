"""How images are taken and shown, by hand: blur, scatter, noise of a dose, the display's curve, window and unsharp
mask."""

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from fluoro_shape_ros.sim import imaging
from fluoro_shape_ros.sim.imaging import Imaging, Levels

PLAIN = Imaging(scatter=0.0, blur_px=0.0, noise_px=0.0, bits=16)
EVEN = np.ones((256, 256), np.float32)


def spot(value=0.5, size=256):
    beam = np.ones((size, size), np.float32)
    beam[120:137, 120:137] = value
    return beam


def test_without_blur_and_scatter_the_beam_is_what_is_detected():
    assert_allclose(imaging.spread(spot(), PLAIN), spot())


def test_scatter_is_its_share_of_an_even_field_and_fills_up_a_shadow():
    chain = dataclasses.replace(PLAIN, scatter=0.4, scatter_px=60.0)
    assert_allclose(imaging.spread(EVEN, chain), 1 / 0.6, rtol=1e-5)
    detected = imaging.spread(spot(0.0), chain)
    # behind what is opaque there is scatter alone: two thirds of the primary beam, less what the small spot keeps away
    assert 0.60 < detected[128, 128] < 2 / 3


def test_blur_keeps_the_sum_and_has_its_sigma():
    beam = np.zeros((101, 101), np.float32)
    beam[50, 50] = 1.0
    blurred = imaging.spread(beam, dataclasses.replace(PLAIN, blur_px=1.5))
    assert_allclose(blurred.sum(), 1.0, rtol=1e-5)
    assert_allclose((blurred * (np.arange(101) - 50)**2).sum(), 1.5**2, rtol=0.02)


@pytest.mark.parametrize('photons', [80, 2000])
@pytest.mark.parametrize('noise_px', [0.0, 0.4, 0.6])
def test_noise_is_that_of_the_dose_whatever_correlates_it(photons, noise_px):
    chain = dataclasses.replace(PLAIN, photons=photons, noise_px=noise_px)
    detected = imaging.detect(EVEN, chain, Levels(1.0, 0.4, 1.25), np.random.default_rng(0))
    assert_allclose(detected.std(), photons**-0.5, rtol=0.02)
    neighbours = np.corrcoef(detected[:, 1:].ravel(), detected[:, :-1].ravel())[0, 1]
    # a kernel of weights 1, w, w^4 to either side: 2 (w + w^5) / (1 + 2 w^2 + 2 w^8)
    w = np.exp(-0.5 / noise_px**2) if noise_px else 0.0
    assert_allclose(neighbours, 2 * (w + w**5) / (1 + 2 * w**2 + 2 * w**8), atol=0.02)


def test_exposure_is_set_by_the_middle_of_the_open_field():
    """Half as dense an aperture, bright air at the rim: neither counts."""
    beam = np.full((400, 400), 0.3, np.float32)
    beam[:80] = 1.0
    aperture = np.ones_like(beam)
    aperture[:, :150] = 0.02
    levels = imaging.levels(beam * aperture, PLAIN, aperture)
    assert_allclose([levels.median, levels.low, levels.high], [0.3, 0.4, 1.25], rtol=1e-5)


@pytest.mark.parametrize('display, gamma, expected', [
    ('linear', 1.0, (0.8 - 0.4) / 0.8), ('gamma', 0.5, (np.sqrt(0.8) - np.sqrt(0.4)) / (np.sqrt(1.2) - np.sqrt(0.4))),
    ('logarithmic', 1.0, np.log(2) / np.log(3))])
def test_display_is_its_curve_between_black_and_white(display, gamma, expected):
    chain = dataclasses.replace(PLAIN, display=display, gamma=gamma)
    shown = imaging.show(np.array([[0.4, 0.8, 1.2, 0.1, 3.0]], np.float32), chain, Levels(1.0, 0.4, 1.2))[0] / 65535
    assert_allclose(shown, [0, expected, 1, 0, 1], atol=2e-5)


def test_window_moves_by_shares_of_the_range():
    chain = dataclasses.replace(PLAIN, black=-0.5, white=0.5)
    shown = imaging.show(np.array([[0.4, 1.2]], np.float32), chain, Levels(1.0, 0.4, 1.2))[0] / 65535
    assert_allclose(shown, [0.25, 0.75], atol=2e-5)


def test_sharpening_overshoots_beside_an_edge_and_nowhere_else():
    step = np.where(np.arange(200) < 100, 0.6, 1.0).astype(np.float32)[None].repeat(50, 0)
    chain, levels = dataclasses.replace(PLAIN, sharpening=1.0, sharpening_px=2.0), Levels(1.0, 0.0, 2.0)
    plain, sharp = imaging.show(step, PLAIN, levels)[25].astype(int), imaging.show(step, chain, levels)[25].astype(int)
    # half a pixel from the edge a step of 0.2 that is blurred by 2 px has risen by Phi(-0.25) = 0.4013 of its height
    assert_allclose(plain[99] - sharp[99], 0.4013 * 0.2 * 65535, rtol=0.01)
    assert_allclose(sharp[[50, 150]], plain[[50, 150]], atol=1)


@pytest.mark.parametrize('bits, dtype', [(8, np.uint8), (10, np.uint16), (12, np.uint16), (16, np.uint16)])
def test_bits_are_the_full_scale(bits, dtype):
    image = imaging.show(np.array([[0.0, 2.0]], np.float32), dataclasses.replace(PLAIN, bits=bits),
                         Levels(1.0, 0.4, 1.25))
    assert image.dtype == dtype and image.tolist() == [[0, 2**bits - 1]]


def test_draws_lie_in_their_ranges_and_differ():
    drawn = [imaging.draw(np.random.default_rng(k)) for k in range(200)]
    for f in dataclasses.fields(Imaging):
        values = [getattr(d, f.name) for d in drawn]
        if f.metadata:
            low, high = f.metadata['low'], f.metadata['high']
            assert all(low <= v <= high or v == 0.0 for v in values) and np.ptp(values) > 0.8 * (high - low)
    assert {d.display for d in drawn} == set(imaging.DISPLAYS) and {d.bits for d in drawn} == {8, 10, 12, 16}
    assert imaging.draw(np.random.default_rng(3)) == drawn[3]


@pytest.mark.parametrize('wrong', [dict(display='film'), dict(bits=0), dict(bits=17), dict(photons=0),
                                   dict(scatter=1.0), dict(lag=1.0), dict(gamma=0),
                                   dict(blur_px=-1), dict(black=0.5, white=-0.5)])
def test_impossible_imaging_is_refused(wrong):
    with pytest.raises(ValueError, match='no (display|imaging)'):
        Imaging(**wrong)


def test_the_display_is_monotone_in_what_is_detected():
    ramp = np.linspace(0.01, 3, 500, dtype=np.float32)[None]
    for seed in range(30):
        chain = dataclasses.replace(imaging.draw(np.random.default_rng(seed)), sharpening=0.0)
        assert (np.diff(imaging.show(ramp, chain, Levels(1.0, 0.4, 1.3)).astype(int)) >= 0).all()


def test_noise_free_detection_is_linear():
    chain = imaging.draw(np.random.default_rng(1))
    a, b = spot(0.2), cv2.GaussianBlur(spot(0.7), (0, 0), 5)
    assert_allclose(imaging.spread(2 * a + b, chain), 2 * imaging.spread(a, chain) + imaging.spread(b, chain),
                    rtol=1e-4)
