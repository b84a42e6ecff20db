"""Relative depth from the light of the LEDs: a wall, a vignette, the dark."""

import numpy as np
from msgspec.structs import replace

from common.calibration.rig import FlatField, flat_of
from slave.wrist.led_image import WristView, depth_about, led_optics, nearness, shrink
from tests.slave.wrist.wrist_frames import CAMERA, HAND, RIG, VIEW

VIGNETTE = FlatField((1.0, 0.05, -0.04, -0.7, 0.02, -0.7))
BARE = WristView.of(replace(RIG, flat_field=None), CAMERA, HAND)
SHAPED = WristView.of(replace(RIG, flat_field=VIGNETTE), CAMERA, HAND)


def test_with_its_flat_field_a_vignetted_image_gives_the_same_nearness() -> None:
    optics = led_optics(SHAPED)
    even = np.full(optics.cosine.shape, 100.0, dtype=np.float32)
    vignetted = even / optics.level**2
    np.testing.assert_allclose(nearness(vignetted, optics), nearness(even, led_optics(BARE)), rtol=1e-5)
    assert (vignetted[0] < vignetted[60]).all()


def test_depth_of_a_wall_is_the_same_all_over_and_falls_as_the_light_grows() -> None:
    # Light from the lens on a wall at Z, each piece turned towards it: I = k / |X|^2, |X| = Z / cos(alpha).
    optics = led_optics(BARE)
    for z in (0.1, 0.15, 0.24):
        near = nearness((2.0 * optics.cosine**2 / z**2).astype(np.float32), optics)
        depths = [
            depth_about(near, optics, u, v, 3.0) for u, v in ((80.0, 60.0), (320.0, 240.0), (600.0, 400.0))
        ]
        np.testing.assert_allclose(np.array(depths) * np.sqrt(2.0), z, rtol=2e-2)


def test_the_dark_has_no_depth() -> None:
    optics = led_optics(VIEW)
    grey = np.full(optics.cosine.shape, 100.0, dtype=np.float32)
    grey[:20] = 0.0
    near = nearness(grey, optics)
    assert (near[:20] == 0.0).all()
    assert np.isnan(depth_about(near, optics, 320.0, 30.0, 8.0))
    assert np.isfinite(depth_about(near, optics, 320.0, 300.0, 8.0))


def test_a_polynomial_beyond_its_measured_field_does_not_turn_the_image_inside_out() -> None:
    far = np.array([[3.0, 3.0], [0.0, 0.0]])
    np.testing.assert_allclose(flat_of(VIGNETTE, far), [0.02, 1.0])


def test_shrinking_keeps_the_mean() -> None:
    image = np.random.default_rng(1).integers(0, 255, (480, 640), dtype=np.uint8)
    small = shrink(image)
    assert small.shape == (120, 160)
    np.testing.assert_allclose(small, image.reshape(120, 4, 160, 4).mean(axis=(1, 3)), atol=0.51)
