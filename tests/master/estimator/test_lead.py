"""A hand of several sensors goes on as it moves; what is no motion is led in, no faster than allowed."""

import numpy as np
import pytest

from common.arrays import Float
from master.estimator.settings import DEFAULT
from master.estimator.smoothing import Blend

STEP_S, SPEED = 1 / 60, 0.12
ON_PALM = np.array([False, True])


class Shown:
    """A hand of which the place is shown; its markers go along."""

    def __init__(self) -> None:
        self.blend, self.values, self.gap_s = Blend(SPEED, ON_PALM, DEFAULT), np.zeros(26), 0.0

    def push(self, place: float, rests: int, marker: float = np.nan) -> float:
        """What is shown of a place that was solved, by a marker on the back that is seen there."""
        solved, points = np.zeros(26), np.full((2, 3), np.nan)
        solved[0], points[1] = place, (marker, 0.0, 0.0)
        before = self.values[0]
        self.values = solved + self.blend.push(self.gap_s, np.full(6, rests), self.values, solved, points)
        self.blend.moved(self.gap_s, np.append(self.values[0] - before, np.zeros(25)))
        self.gap_s = STEP_S
        return float(self.values[0])


def test_what_another_sensor_has_elsewhere_is_led_in_at_a_steady_speed_and_arrives() -> None:
    hand = Shown()
    for _ in range(5):
        hand.push(0.0, 273)
    places = [0.0] + [hand.push(0.03, 2) for _ in range(60)]
    steps = np.diff(places)
    assert steps.max() <= SPEED * STEP_S + 1e-9
    assert steps.min() >= -1e-9
    assert places[-1] == pytest.approx(0.03, abs=1e-4)


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_palm_goes_as_its_marker_goes_while_others_come_and_go(speed: float) -> None:
    hand = Shown()
    shown: list[float] = []
    for k in range(60):
        at = speed * k * STEP_S
        jump = 0.01 if k >= 30 else 0.0  # another marker is seen, and the palm is solved elsewhere
        shown.append(hand.push(at + jump, 273 + 512 * (k >= 30), marker=at))
    beyond: Float = np.diff(shown) - speed * STEP_S
    assert np.abs(beyond).max() <= SPEED * STEP_S + 1e-9
    assert shown[-1] == pytest.approx(speed * 59 * STEP_S + 0.01, abs=5e-4)


def test_what_markers_place_is_followed_at_once() -> None:
    hand = Shown()
    hand.push(0.0, 273)
    assert hand.push(0.02, 273) == pytest.approx(0.02)


def test_many_changes_one_after_another_do_not_stall_it() -> None:
    hand = Shown()
    hand.push(0.0, 273)
    places = [hand.push(0.02, 2 + 2 * (k % 2)) for k in range(60)]
    assert places[-1] == pytest.approx(0.02, abs=1e-3)
