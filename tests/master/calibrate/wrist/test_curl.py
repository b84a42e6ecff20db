"""The line of each finger from a curl: exact lines back, strays out, fingers that did not move named."""

import numpy as np
import pytest

from common.arrays import Float
from common.errors import FitError
from master.calibrate.wrist.curl import MIN_POINTS, fit_curls

START = np.array(
    [[0.05, 0.03, 0.08], [0.02, 0.03, 0.16], [0.0, 0.03, 0.17], [-0.02, 0.03, 0.16], [-0.04, 0.03, 0.14]]
)
WAY = np.array([[-0.7, 0, -0.7], [0, 0, -1.0], [0.05, 0, -1.0], [0.1, 0, -1.0], [0.2, 0, -1.0]])
WAY = WAY / np.linalg.norm(WAY, axis=1, keepdims=True)
LENGTH = np.array([0.025, 0.07, 0.08, 0.085, 0.07])


def curl(noise: float = 3e-4, cycles: int = 120, seed: int = 0) -> Float:
    """Laser points (T, 5, 3) [m] of a slow curl there and back."""
    rng = np.random.default_rng(seed)
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, 2.0 * np.pi, cycles))
    points = START + share[:, None, None] * (LENGTH[:, None] * WAY)
    return points + noise * rng.standard_normal(points.shape) * np.array([1.0, 0.0, 1.0])


@pytest.mark.parametrize("seed", range(2))
def test_lines_come_back_with_range_and_residual(seed: int) -> None:
    for found, start, way, length in zip(fit_curls(curl(seed=seed)), START, WAY, LENGTH, strict=True):
        assert found.line is not None
        assert np.degrees(np.arccos(min(1.0, float(np.array(found.line.direction) @ way)))) < 0.5
        assert np.linalg.norm(np.array(found.line.origin_m) - start) < 1.5e-3
        assert found.line.range_m[1] - found.line.range_m[0] == pytest.approx(length, abs=2e-3)
        assert 2e-4 < found.line.residual_m < 5e-4


def test_points_of_a_neighbour_and_lone_points_are_left_out() -> None:
    points = curl()
    points[::9, 1] = points[::9, 2]  # taken for the finger beside it
    points[50, 1] = START[1] - 0.05 * WAY[1]  # on the line, far beyond its end
    found = fit_curls(points)[1]
    assert found.line is not None
    assert found.seen - len(found.points_m) >= 12
    assert found.line.range_m[1] == pytest.approx(LENGTH[1], abs=2e-3)


def test_a_finger_that_rests_or_is_not_seen_is_named_and_the_others_stay() -> None:
    points = curl()
    points[:, 2] = points[0, 2] + 1e-4 * np.random.default_rng(0).standard_normal((len(points), 3))
    points[:, 4] = np.nan
    points[: MIN_POINTS - 1, 4] = START[4]
    curls = fit_curls(points)
    assert [found.finger for found in curls if found.line is None] == ["middle", "little"]
    assert "at least 15 are needed" in curls[2].reason
    assert f"{MIN_POINTS - 1} points" in curls[4].reason


def test_a_finger_seen_in_one_place_only_rested() -> None:
    points = curl()
    points[:, 2] = points[0, 2]
    assert "moved by 0.0 mm" in fit_curls(points)[2].reason


@pytest.mark.parametrize("cycles", [0, 1, 30])
def test_nothing_seen_is_refused_with_the_reason_of_each(cycles: int) -> None:
    with pytest.raises(FitError, match=r"no finger curled .* thumb: 0 points.* little: 0 points"):
        fit_curls(np.full((cycles, 5, 3), np.nan))
