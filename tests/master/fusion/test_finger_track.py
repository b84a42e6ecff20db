"""Fingers between a wrist device's triples: led on at their speed, doubted as they are led, never beyond reach."""

import numpy as np
import pytest

from common.arrays import Float
from common.messages import Level
from master.fusion.finger_track import REACH_NS, FingerTrack
from master.wrist.belief import FingerAngles
from master.wrist.bend_slope import SightWorth
from master.wrist.fingers import SeenFingers

TRIPLE_NS = 33_333_333
STRAIGHT = np.zeros(2)
NOBODY = np.zeros(5, np.bool_)


def triple(k: int, pip: float, level: Level = Level.IK, **changes: object) -> SeenFingers:
    """What triple `k` says of five fingers with this PIP [rad]."""
    angles = np.zeros((5, 4))
    angles[:, 2] = pip
    found = {
        "angles_rad": angles,
        "cov_rad2": np.tile(0.04 * np.eye(4), (5, 1, 1)),
        "told": ~NOBODY,
        "past": NOBODY,
        "off": NOBODY,
        "level": np.full(5, level, np.uint8),
        "ambiguous": NOBODY,
    } | changes
    slope, own = np.zeros((5, 4, 2)), np.tile(400.0 * np.eye(4), (5, 1, 1))
    worth = SightWorth(own, -own @ slope, np.zeros((5, 2, 2)))
    return SeenFingers(k * TRIPLE_NS, FingerAngles(**found), np.full((5, 3), np.nan), slope, worth)  # type: ignore[arg-type]


def pip(track: FingerTrack, t_ns: int) -> Float:
    """The PIPs (5,) at an instant."""
    found = track.at(t_ns)
    assert found is not None
    return found.angles_rad[:, 2]


def test_a_finger_goes_on_at_its_speed_and_lies_between_what_two_triples_say() -> None:
    track = FingerTrack()
    for k in range(3):
        track.push(triple(k, 0.2 * k), STRAIGHT)
    np.testing.assert_allclose(pip(track, round(1.5 * TRIPLE_NS)), 0.3, atol=1e-6)
    np.testing.assert_allclose(pip(track, round(2.5 * TRIPLE_NS)), 0.5, atol=1e-6)


def test_a_change_from_laser_to_laser_and_tip_is_no_motion() -> None:
    track = FingerTrack()
    track.push(triple(0, 0.2, Level.FK), STRAIGHT)
    track.push(triple(1, 0.6, Level.IK), STRAIGHT)
    np.testing.assert_allclose(pip(track, round(1.5 * TRIPLE_NS)), 0.6)


def test_the_farther_and_the_faster_it_is_led_the_less_the_sights_are_worth() -> None:
    slow, fast = FingerTrack(), FingerTrack()
    for k in range(2):
        slow.push(triple(k, 0.3), STRAIGHT)
        fast.push(triple(k, 0.3 * k), STRAIGHT)

    def worth(track: FingerTrack, ahead: float) -> float:
        found = track.at(round((1.0 + ahead) * TRIPLE_NS))
        assert found is not None
        return float(found.left().angles[1, 2, 2])

    assert worth(slow, 0.0) > worth(slow, 0.5) > worth(slow, 1.5)
    assert worth(slow, 0.5) > 1.5 * worth(fast, 0.5)
    assert worth(slow, 0.0) < 400.0  # hinges and skin are not known as well as light shows them


def test_nothing_is_said_beyond_reach_and_after_a_clock_that_was_set_back_it_begins_anew() -> None:
    track = FingerTrack()
    assert track.at(0) is None
    track.push(triple(10, 0.2), STRAIGHT)
    assert track.at(10 * TRIPLE_NS + REACH_NS + 1) is None
    assert track.at(10 * TRIPLE_NS - REACH_NS - 1) is None
    track.push(triple(0, 0.7), STRAIGHT)
    np.testing.assert_allclose(pip(track, 0), 0.7)
    assert track.at(10 * TRIPLE_NS) is None


def test_what_fits_no_finger_says_nothing_and_of_two_poses_the_whole_doubt_counts() -> None:
    track = FingerTrack()
    one = np.arange(5) == 1
    track.push(triple(0, 0.2, off=one, ambiguous=np.arange(5) == 2), STRAIGHT)
    found = track.at(0)
    assert found is not None
    assert np.isnan(found.angles_rad[1]).all()
    assert found.told.tolist() == [True, False, True, True, True]
    left = found.left().angles
    assert not left[1].any()
    assert left[2, 2, 2] == pytest.approx(1.0 / (0.04 + 1.0 / 400.0))


def test_of_unrelated_poses_each_has_its_own_triple() -> None:
    track = FingerTrack(continuous=False)
    for k in range(3):
        track.push(triple(k, 0.4 * k), STRAIGHT)
    np.testing.assert_allclose(pip(track, round(1.4 * TRIPLE_NS)), 0.4)
    np.testing.assert_allclose(pip(track, round(2.4 * TRIPLE_NS)), 0.8)
    assert track.at(3 * TRIPLE_NS) is None
