"""Hidden fingers against the truth: next to nothing strays at rest, neighbours tell of a fist, not of one finger."""

import numpy as np

from bench.hidden_fingers import HIDDEN_S, growth_deg, rms_deg
from common.arrays import Float
from tests.hand_helpers import RIGHT

_CYCLE = 66  # frames: half a second seen, then hidden for 0.6 s


def bending(fingers: tuple[int, ...]) -> Float:
    """Angles (T, 5, 4) [rad]: some fingers rest while all are seen, then bend at the PIP by 60 degrees a second."""
    angles = np.tile(np.radians([0.0, 20.0, 20.0, 13.0]), (_CYCLE, 5, 1))
    grown = np.radians(np.clip(np.arange(_CYCLE) - 30, 0, None))
    for finger in fingers:
        angles[:, finger, 2] += grown
        angles[:, finger, 3] += grown * 2 / 3
    return angles


def test_a_hand_at_rest_hardly_strays() -> None:
    at_rest = growth_deg(RIGHT, bending(()), alike=True)
    assert at_rest.shape == (len(HIDDEN_S), 4, 2)
    for after_s, most_deg in ((0.1, 0.5), (0.6, 3.0)):  # with fewer markers the palm settles anew
        assert np.abs(at_rest[HIDDEN_S.index(after_s)] - at_rest[0]).max() < most_deg


def test_neighbours_predict_a_fist_and_mislead_about_one_finger() -> None:
    after = HIDDEN_S.index(0.3)
    fist = bending((1, 2, 3, 4))
    alone, together = (rms_deg(growth_deg(RIGHT, fist, alike=alike)[after]) for alike in (False, True))
    assert 1.0 < together < 0.7 * alone
    one = bending((2,))
    alone, together = (rms_deg(growth_deg(RIGHT, one, alike=alike)[after]) for alike in (False, True))
    assert together > alone
