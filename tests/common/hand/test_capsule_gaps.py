"""Gaps between round cones against balls counted one by one."""

import numpy as np
import pytest

from common.arrays import Float
from common.geometry.tapered_capsules import Capsules
from common.hand.skin import gaps_between


def _cones(start: Float, along: Float, radius_m: Float, growth_m: Float) -> Capsules:
    return Capsules(start, start + along, radius_m, radius_m + growth_m)


def _capsules(rng: np.random.Generator, count: int) -> Capsules:
    along = rng.normal(size=(count, 3))
    along *= rng.uniform(0.015, 0.04, (count, 1)) / np.linalg.norm(along, axis=1, keepdims=True)
    start = rng.normal(0.0, 0.04, (count, 3))
    return _cones(start, along, rng.uniform(0.006, 0.009, count), rng.uniform(-0.002, 0.001, count))


def _balls(capsules: Capsules, k: int) -> tuple[Float, Float]:
    share = np.linspace(0.0, 1.0, 201)
    return (
        capsules.start_m[k] + share[:, None] * (capsules.stop_m[k] - capsules.start_m[k]),
        capsules.start_radius_m[k] + share * (capsules.stop_radius_m[k] - capsules.start_radius_m[k]),
    )


def test_the_gap_is_that_of_the_nearest_two_balls() -> None:
    rng = np.random.default_rng(5)
    a, b = _capsules(rng, 200), _capsules(rng, 200)
    found = gaps_between(a, b)
    for k in range(200):
        (middle_a, radius_a), (middle_b, radius_b) = _balls(a, k), _balls(b, k)
        apart = np.linalg.norm(middle_a[:, None] - middle_b[None], axis=-1)
        nearest = float((apart - radius_a[:, None] - radius_b[None]).min())
        # Skins that cross deeply have no one nearest pair of balls; there the gap may be a little too large.
        assert found.gap_m[k] == pytest.approx(nearest, abs=1e-4 if nearest > 0.0 else 1e-3)


def test_golden_two_balls_and_two_rods() -> None:
    ball = _cones(np.zeros(3), np.array([1e-6, 0.0, 0.0]), np.array(0.010), np.array(0.0))
    other = _cones(np.array([0.0, 0.03, 0.0]), np.array([1e-6, 0.0, 0.0]), np.array(0.008), np.array(0.0))
    found = gaps_between(ball, other)
    assert float(found.gap_m) == pytest.approx(0.012)  # 30 - 10 - 8
    np.testing.assert_allclose(found.middle_m, [0.0, 0.016, 0.0], atol=1e-5)  # 10 + 12 / 2
    np.testing.assert_allclose(found.a_to_b, [0.0, 1.0, 0.0], atol=1e-4)
    crossed = _cones(
        np.array([0.01, 0.02, -0.01]), np.array([0.0, 0.0, 0.02]), np.array(0.005), np.array(0.0)
    )
    rod = _cones(np.zeros(3), np.array([0.02, 0.0, 0.0]), np.array(0.005), np.array(0.0))
    assert float(gaps_between(rod, crossed).gap_m) == pytest.approx(0.010)  # two rods that cross 20 apart


def test_either_way_round_it_is_the_same_gap() -> None:
    rng = np.random.default_rng(6)
    a, b = _capsules(rng, 50), _capsules(rng, 50)
    np.testing.assert_allclose(gaps_between(a, b).gap_m, gaps_between(b, a).gap_m, atol=2e-4)
