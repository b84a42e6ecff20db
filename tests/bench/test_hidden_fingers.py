"""Hidden fingers against the truth: nothing strays at rest, neighbours tell of a fist, not of one finger."""

import numpy as np
import pytest

from bench.hidden_fingers import rms_deg, strayed_deg
from common.arrays import Float
from tests.hand_helpers import RIGHT


def bending(fingers: tuple[int, ...], count: int = 90) -> Float:
    """Angles (T, 5, 4) [rad]: some fingers rest half a second, then bend at the PIP by 60 degrees a second."""
    angles = np.tile(np.radians([0.0, 20.0, 20.0, 13.0]), (count, 5, 1))
    grown = np.radians(np.clip(np.arange(count) - 30, 0, None))
    for finger in fingers:
        angles[:, finger, 2] += grown
        angles[:, finger, 3] += grown * 2 / 3
    return angles


def test_a_hand_at_rest_strays_nowhere() -> None:
    assert np.abs(strayed_deg(RIGHT, bending(()), 0.3, 1.0)).max() == pytest.approx(0.0, abs=1e-9)


def test_neighbours_tell_of_a_fist_and_mislead_about_one_finger() -> None:
    fist, one = bending((1, 2, 3, 4)), bending((2,))
    alone, together = (rms_deg([strayed_deg(RIGHT, fist, 0.3, natural)]) for natural in (0.0, 1.0))
    assert 1.0 < together < 0.7 * alone
    alone, together = (rms_deg([strayed_deg(RIGHT, one, 0.3, natural)]) for natural in (0.0, 1.0))
    assert together > alone
