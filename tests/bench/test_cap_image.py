"""The exact truth of generated caps against brute force, and the drawn light against that truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.markers.cap_image import Cap, Occluder, Patch, draw, segment

WHITE = (1.0, 1.0, 1.0)
BLACK = (0.0, 0.0, 0.0)
FROM_ABOVE = np.array([0.0, 0.0, 1.0])
ALIAS_PX = 3e-3  # the first moment of a box-sampled image is exact only on average over sub-pixel places
CAP = Cap(u=20.3, v=17.8, a=7.3, b=5.1, angle=0.6, marker_colour=WHITE, bulge=0.0)


def clipped_polygon(cap: Cap, corners: int = 200_000) -> tuple[float, float, float]:
    """Centroid and area of the visible ellipse as a polygon of many corners, by the shoelace formula."""
    t = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    q = np.stack([np.cos(t), np.sin(t)], axis=1)
    if cap.occluder is not None:
        normal = np.array([math.cos(cap.occluder.angle), math.sin(cap.occluder.angle)])
        beyond = q @ normal - cap.occluder.height
        q = q[beyond <= 0.0] if (beyond <= 0.0).all() else np.roll(q, -int(np.argmax(beyond)), axis=0)
        q = q[q @ normal <= cap.occluder.height]
    c, s = math.cos(cap.angle), math.sin(cap.angle)
    x, y = c * cap.a * q[:, 0] - s * cap.b * q[:, 1], s * cap.a * q[:, 0] + c * cap.b * q[:, 1]
    x1, y1 = np.roll(x, -1), np.roll(y, -1)
    cross = x * y1 - x1 * y
    area = cross.sum() / 2.0
    u, v = ((x + x1) * cross).sum() / (6.0 * area), ((y + y1) * cross).sum() / (6.0 * area)
    return cap.u + u, cap.v + v, area


def light_centroid(patch: Patch) -> tuple[float, float, float]:
    light = patch.pixels[..., 0].astype(np.float64)
    area = light.sum()
    u = (light.sum(axis=0) @ np.arange(light.shape[1])) / area + patch.left
    v = (light.sum(axis=1) @ np.arange(light.shape[0])) / area + patch.top
    return float(u), float(v), float(area)


@settings(deadline=None, max_examples=40)
@given(
    st.floats(4.0, 12.0), st.floats(0.7, 1.4), st.floats(0.0, 3.1), st.floats(0.0, 6.2), st.floats(0.01, 0.9)
)
def test_truth_of_a_hidden_cap_is_that_of_the_clipped_polygon(
    a: float, ratio: float, angle: float, side: float, share: float
) -> None:
    cap = Cap(31.7, 30.2, a, a * ratio, angle, WHITE, 0.0, occluder=Occluder(side, share, BLACK))
    np.testing.assert_allclose(cap.visible, clipped_polygon(cap), rtol=2e-4, atol=2e-3)


def test_segment_of_half_the_circle_has_the_half_discs_centroid() -> None:
    # 4 / (3 pi), the textbook value for a half disc.
    np.testing.assert_allclose(segment(0.0), (math.pi / 2.0, 4.0 / (3.0 * math.pi)), rtol=1e-12)


@pytest.mark.parametrize("motion", [(0.0, 0.0), (3.0, 0.0), (-2.1, 5.6)])
@pytest.mark.parametrize("share", [0.0, 0.15])
def test_drawn_light_has_its_centroid_at_the_truth(motion: tuple[float, float], share: float) -> None:
    cap = replace(CAP, occluder=Occluder(1.1, share, BLACK) if share else None)
    u, v, area = light_centroid(draw(cap, FROM_ABOVE, motion))
    truth = cap.visible
    np.testing.assert_allclose((u, v), truth[:2], atol=ALIAS_PX)
    np.testing.assert_allclose(area, truth[2], rtol=1e-3)


def test_drawn_light_has_no_bias_over_sub_pixel_places() -> None:
    places = [(i / 7.0, j / 7.0) for i in range(7) for j in range(7)]
    caps = [replace(CAP.moved(*place), occluder=Occluder(1.1, 0.15, BLACK)) for place in places]
    error = np.array([light_centroid(draw(cap, FROM_ABOVE)) for cap in caps]) - [cap.visible for cap in caps]
    np.testing.assert_allclose(error.mean(axis=0)[:2], (0.0, 0.0), atol=2e-4)


def test_that_comparison_sees_a_hundredth_of_a_pixel() -> None:
    u, v, _ = light_centroid(draw(CAP.moved(0.01, 0.0), FROM_ABOVE))
    with pytest.raises(AssertionError):
        np.testing.assert_allclose((u, v), CAP.visible[:2], atol=ALIAS_PX)


def test_motion_smears_the_light_over_its_way() -> None:
    still, moving = draw(CAP, FROM_ABOVE), draw(CAP, FROM_ABOVE, (6.0, 0.0))

    def width(patch: Patch) -> float:
        columns = patch.pixels[..., 0].sum(axis=0, dtype=np.float64)
        place = np.arange(columns.size)
        mean = (columns @ place) / columns.sum()
        return float((columns @ (place - mean) ** 2) / columns.sum())

    # A box of width w has variance w^2 / 12; the moments are 24, spaced 0.25 px.
    np.testing.assert_allclose(width(moving) - width(still), 6.0**2 / 12.0, rtol=0.01)


def test_shading_leaves_the_truth_and_moves_the_light() -> None:
    tilted = np.array([0.6, 0.0, 0.8])
    cap = replace(CAP, bulge=0.9)
    assert cap.visible == CAP.visible
    assert light_centroid(draw(cap, tilted))[0] > cap.u + 0.3


def test_a_patch_that_hangs_over_the_picture_is_cut() -> None:
    light = np.zeros((10, 12, 3), np.float32)
    draw(replace(CAP, u=0.0, v=0.0), FROM_ABOVE).onto(light)
    assert light[0, 0, 0] == 1.0
    assert light[9, 11, 0] == 0.0
    before = light.copy()
    draw(replace(CAP, u=-50.0, v=3.0), FROM_ABOVE).onto(light)
    np.testing.assert_array_equal(light, before)
