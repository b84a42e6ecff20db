"""The principal axis of a finger's laser points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import FitError
from master.estimator.priors import on_line, principal_line


@given(st.floats(-1.4, 1.4), st.floats(0.02, 0.1), st.integers(0, 99))
def test_a_noisy_line_is_found_however_it_runs(angle: float, length: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    direction = np.array([np.sin(angle), 0.1, -np.cos(angle)])  # a thumb's runs across, a finger's along
    direction /= np.linalg.norm(direction)
    share = np.concatenate([[0.0, 1.0], rng.uniform(size=60)])
    start = np.array([0.0, 0.02, 0.2])
    points = start + share[:, None] * length * direction + 1e-4 * rng.normal(size=(62, 3))
    line = principal_line(rng.permutation(points))
    assert abs(np.array(line.direction) @ direction) > np.cos(np.radians(2.0))
    assert line.range_m[1] == pytest.approx(length, abs=6e-4)
    assert line.residual_m == pytest.approx(np.sqrt(2) * 1e-4, rel=0.4)


def test_it_runs_from_the_straight_finger_to_the_bent_one() -> None:
    points = np.linspace([0.01, 0.01, 0.18], [0.02, 0.02, 0.09], 20)
    line = principal_line(points[::-1])
    np.testing.assert_allclose(line.origin_m, points[0], atol=1e-12)
    along, deviation = on_line(points, line)
    np.testing.assert_allclose(along, np.linspace(0.0, 1.0, 20), atol=1e-12)
    np.testing.assert_allclose(deviation, 0.0, atol=1e-12)


def test_deviation_keeps_its_sign_and_size() -> None:
    line = principal_line(np.linspace([0.0, 0.02, 0.18], [0.0, 0.02, 0.08], 9))
    along, deviation = on_line(np.array([[0.004, 0.02, 0.13], [-0.004, 0.02, 0.13]]), line)
    np.testing.assert_allclose(along, 0.5, atol=1e-12)
    np.testing.assert_allclose(deviation, [[0.004, 0.0, 0.0], [-0.004, 0.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        (np.full((30, 3), np.nan), "0 points"),
        (np.linspace([0, 0, 0.1], [0, 0, 0.2], 4), "4 points"),
        (np.linspace([0, 0, 0.1], [0, 0, 0.101], 30), "1.0 mm only"),
        (np.random.default_rng(1).normal(size=(50, 3)) * 0.01 + [0, 0, 0.15], "deviate"),
    ],
)
def test_what_is_no_line_is_refused(points: np.ndarray, expected: str) -> None:
    with pytest.raises(FitError, match=expected):
        principal_line(points)
