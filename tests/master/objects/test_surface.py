"""Distances to boxes, cylinders and balls against calculations by hand, and what they hide."""

import numpy as np
import pytest

from common.calibration.object_profile import BoxShape, CylinderShape, Shape, SphereShape
from common.geometry.tapered_capsules import Capsules
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from master.objects.surface import Surface

BOX = BoxShape(size_m=(0.2, 0.1, 0.04))
BAR = CylinderShape(radius_m=0.012, length_m=0.18)
BALL = SphereShape(radius_m=0.03)


@pytest.mark.parametrize(
    ("shape", "point", "distance", "foot"),
    [
        (BOX, (0.13, 0.0, 0.0), 0.03, (0.1, 0.0, 0.0)),
        (BOX, (0.13, 0.09, 0.02), 0.05, (0.1, 0.05, 0.02)),  # 3, 4, 5 from an edge
        (BOX, (0.0, 0.0, 0.015), -0.005, (0.0, 0.0, 0.02)),
        (BAR, (0.03, 0.04, 0.02), 0.038, (0.0072, 0.0096, 0.02)),
        (BAR, (0.0, 0.0, 0.1), 0.01, (0.0, 0.0, 0.09)),
        (BAR, (0.015, 0.0, 0.094), 0.005, (0.012, 0.0, 0.09)),  # 3, 4, 5 from the rim
        (BAR, (0.01, 0.0, 0.0), -0.002, (0.012, 0.0, 0.0)),
        (BALL, (0.0, -0.05, 0.0), 0.02, (0.0, -0.03, 0.0)),
    ],
)
def test_distance_and_nearest_point_by_hand(
    shape: Shape, point: tuple[float, ...], distance: float, foot: tuple[float, ...]
) -> None:
    found, at = Surface([shape]).nearest(np.array([point]))
    np.testing.assert_allclose(found, [distance], atol=1e-12)
    np.testing.assert_allclose(at, [foot], atol=1e-12)


def test_a_part_that_is_turned_and_moved_is_as_far_as_one_that_is_not() -> None:
    rng = np.random.default_rng(1)
    T = rigid(rotation_vector_to_matrix(rng.normal(size=3)), rng.normal(0.0, 0.1, 3))
    rows = tuple(tuple(float(x) for x in row) for row in T)
    moved = Surface([CylinderShape(radius_m=0.012, length_m=0.18, T_object_part=rows)])  # type: ignore[arg-type]
    points = rng.normal(0.0, 0.1, (50, 3))
    there = points @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(moved.nearest(there)[0], Surface([BAR]).nearest(points)[0], atol=1e-12)


def test_a_union_is_as_far_as_its_nearest_part() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(0.0, 0.15, (50, 3))
    each = np.stack([Surface([part]).nearest(points)[0] for part in (BOX, BAR)])
    np.testing.assert_array_equal(Surface([BOX, BAR]).nearest(points)[0], each.min(axis=0))


def test_nothing_is_infinitely_far_from_no_surface() -> None:
    distance, at = Surface([]).nearest(np.zeros((1, 3)))
    assert np.isinf(distance).all()
    assert np.isnan(at).all()
    assert not Surface([])


def test_round_cones_are_as_near_as_their_nearest_ball() -> None:
    rng = np.random.default_rng(3)
    start, stop = rng.normal(0.0, 0.05, (2, 20, 3))
    stop = start + 0.3 * (stop - start)  # as long as a bone of a finger
    capsules = Capsules(start, stop, rng.uniform(0.005, 0.01, 20), rng.uniform(0.005, 0.01, 20))
    surface = Surface([BOX])
    found = surface.nearest_to_capsules(capsules)
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    for k in range(20):
        middle = start[k] + share * (stop[k] - start[k])
        radius = capsules.start_radius_m[k] + share[:, 0] * (
            capsules.stop_radius_m[k] - capsules.start_radius_m[k]
        )
        assert found.distance_m[k] == pytest.approx((surface.nearest(middle)[0] - radius).min(), abs=1e-4)


@pytest.mark.parametrize(
    ("shape", "point", "hidden"),
    [
        (BOX, (0.0, 0.0, -0.05), True),
        (BOX, (0.0, 0.0, 0.021), False),
        (BOX, (0.5, 0.0, -0.05), False),
        (BAR, (0.0, 0.03, 0.05), False),
        (BAR, (0.0, 0.0, -0.1), True),
        (BALL, (0.0, 0.0, -0.031), True),
        (BALL, (0.0, 0.0, 0.0302), False),
    ],
)
def test_what_is_behind_a_part_is_hidden(shape: Shape, point: tuple[float, ...], hidden: bool) -> None:
    assert Surface([shape]).hides(np.array([0.0, 0.0, 1.0]), np.array([point])).tolist() == [hidden]
