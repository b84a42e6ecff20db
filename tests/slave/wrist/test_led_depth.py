"""Relative depth from the light of the LEDs, and normals: a lit sphere, a wall, the dark, white."""

import numpy as np
import pytest
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.flat_field import flat_of
from common.wrist_calibration import FlatField
from slave.wrist.led_depth import (
    SATURATED,
    Float32,
    led_optics,
    nearness,
    relative_depth,
    shrink,
)
from slave.wrist.normals import normals
from slave.wrist.view import WristView
from tests.slave.wrist.wrist_frames import CAMERA, HAND, RIG, VIEW

VIGNETTE = FlatField((1.0, 0.05, -0.04, -0.7, 0.02, -0.7))
BARE = WristView.of(replace(RIG, flat_field=None), CAMERA, HAND)
SHAPED = WristView.of(replace(RIG, flat_field=VIGNETTE), CAMERA, HAND)


def lit_sphere(view: WristView, centre: Float, radius: float) -> tuple[Float32, Float, Bool]:
    """Grey levels (h, w) of a white Lambert sphere lit by the LEDs, its normals (h, w, 3), and where it is."""
    optics = led_optics(view)
    ray = optics.ray.astype(np.float64) * optics.cosine[..., None]
    along = ray @ centre
    inside = along**2 - centre @ centre + radius**2
    hit = inside > 0.0
    points = np.where(hit, along - np.sqrt(np.maximum(inside, 0.0)), np.nan)[..., None] * ray
    normal = (points - centre) / radius
    light = np.zeros(hit.shape)
    for led in view.led_m:
        way = led - points
        distance = np.linalg.norm(way, axis=-1)
        light += np.nan_to_num(np.clip((normal * way).sum(axis=-1) / distance, 0.0, None) / distance**2)
    if view.flat_field is not None:
        light *= flat_of(view.flat_field, ray[..., :2] / ray[..., 2:])
    return (200.0 * light / light.max()).astype(np.float32), normal, hit


def degrees_off(view: WristView, centre: tuple[float, float, float], radius: float) -> Float:
    """Angles (N,) [deg] between found and true normals where the sphere leans by less than 60 degrees."""
    grey, normal, _ = lit_sphere(view, np.array(centre), radius)
    optics = led_optics(view)
    found = normals(relative_depth(grey, optics), optics)
    facing = -(normal * optics.ray).sum(axis=-1) * optics.cosine
    judged = (facing > 0.5) & np.isfinite(found[..., 0])
    assert judged.sum() >= 20
    return np.degrees(np.arccos(np.clip((found * normal).sum(axis=-1)[judged], -1.0, 1.0)))


@pytest.mark.parametrize(
    "centre", [(0.0, 0.0, 0.1), (0.03, -0.02, 0.09), (-0.02, 0.01, 0.13), (0.0, -0.02, 0.07)]
)
@pytest.mark.parametrize("radius", [0.007, 0.009])
def test_normals_of_a_lit_sphere_are_within_five_degrees(
    centre: tuple[float, float, float], radius: float
) -> None:
    assert degrees_off(VIEW, centre, radius).mean() < 5.0


def test_with_its_flat_field_a_vignetted_image_tells_the_same_normals() -> None:
    centre = (0.05, -0.03, 0.1)
    corrected = degrees_off(SHAPED, centre, 0.008).mean()
    assert corrected < 5.0
    grey = lit_sphere(SHAPED, np.array(centre), 0.008)[0]
    plain = relative_depth(grey, led_optics(BARE)).depth
    right = relative_depth(grey, led_optics(SHAPED)).depth
    known = np.isfinite(plain)
    assert (right[known] < plain[known]).all()  # darkened towards the edge, not far


def test_normals_are_unit_vectors_towards_the_camera_and_unknown_beyond_the_edge() -> None:
    grey, _, hit = lit_sphere(VIEW, np.array([0.01, 0.0, 0.1]), 0.008)
    optics = led_optics(VIEW)
    found = normals(relative_depth(grey, optics), optics)
    known: Bool = np.isfinite(found[..., 2])
    np.testing.assert_allclose(np.linalg.norm(found[known], axis=-1), 1.0, atol=1e-4)
    assert ((found * optics.ray).sum(axis=-1)[known] < 1e-3).all()
    assert not known[~hit].any()


def test_depth_of_a_wall_is_the_same_all_over_and_falls_as_the_light_grows() -> None:
    # Light from the lens on a wall at Z, each piece turned towards it: I = k / |X|^2, |X| = Z / cos(alpha).
    optics = led_optics(BARE)
    for z in (0.1, 0.15, 0.24):
        grey = (2.0 * optics.cosine**2 / z**2).astype(np.float32)
        depth = relative_depth(grey, optics).depth
        np.testing.assert_allclose(depth / depth[60, 80], 1.0, rtol=1e-5)
        np.testing.assert_allclose(depth[60, 80] * np.sqrt(2.0), z, rtol=1e-3)


def test_the_dark_has_no_depth_and_white_has_a_bound() -> None:
    optics = led_optics(VIEW)
    grey = np.full(optics.cosine.shape, 100.0, dtype=np.float32)
    grey[:20], grey[100:] = 0.0, 255.0
    seen = relative_depth(grey, optics)
    assert np.isnan(seen.depth[:20]).all()
    assert np.isfinite(seen.depth[20:]).all()
    assert seen.bound[100:].all()
    assert not seen.bound[:100].any()
    assert SATURATED < 255.0
    assert (nearness(grey, optics)[:20] == 0.0).all()
    assert np.isnan(normals(seen, optics)[:20]).all()


def test_a_polynomial_beyond_its_measured_field_does_not_turn_the_image_inside_out() -> None:
    far = np.array([[3.0, 3.0], [0.0, 0.0]])
    np.testing.assert_allclose(flat_of(VIGNETTE, far), [0.02, 1.0])


def test_shrinking_keeps_the_mean() -> None:
    image = np.random.default_rng(1).integers(0, 255, (480, 640), dtype=np.uint8)
    small = shrink(image)
    assert small.shape == (120, 160)
    np.testing.assert_allclose(small, image.reshape(120, 4, 160, 4).mean(axis=(1, 3)), atol=0.51)
