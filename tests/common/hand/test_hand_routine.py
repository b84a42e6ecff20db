"""The guided routine and the simulated user who follows it."""

from itertools import pairwise

import numpy as np
import pytest

from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from common.hand.routine import MOVES, ROUTINE_S, STEPS, move_at, posture_at
from common.sim.people import PERIOD_S, REACTION_S, HandRoutine

MODEL = HandModel.of(generated_profile("any", "right"))


def test_it_takes_twenty_seconds_without_gap_or_jump() -> None:
    assert pytest.approx(20.0, abs=1.0) == ROUTINE_S
    for before, after in pairwise(MOVES):
        assert before.stop_s == after.start_s
        np.testing.assert_array_equal(before.after, after.before)
    times = np.arange(0.0, ROUTINE_S, 0.01)
    postures = np.array([posture_at(t) for t in times.tolist()])
    assert np.abs(np.diff(postures, axis=0)).max() < 4.0  # degrees in 10 ms, 88 of them in half a second
    assert {move.step for move in MOVES} == set(range(len(STEPS)))


def test_on_each_way_of_a_measured_finger_one_joint_moves() -> None:
    for name in ("knuckles", "curl", "index", "little"):
        number = [step.name for step in STEPS].index(name)
        for move in (move for move in MOVES if move.step == number):
            moving = move.moving[1:]
            assert (moving.sum(axis=1) <= 1).all()
            assert moving.any()
            if name != "curl":
                assert move.straight.all()


def test_before_and_after_it_the_hand_is_flat() -> None:
    assert move_at(-1.0).step == 0
    np.testing.assert_allclose(posture_at(-5.0)[1:], 0.0)
    np.testing.assert_allclose(posture_at(ROUTINE_S + 5.0)[1:], 0.0)


def test_the_user_is_late_within_limits_seeded_and_rests_the_palm() -> None:
    user, again, other = (HandRoutine(MODEL, np.array([0.0, 0.0, 0.5]), seed) for seed in (1, 1, 2))
    times = np.arange(0.0, PERIOD_S, 0.05)
    states = [user.at(t) for t in times.tolist()]
    assert MODEL.within_limits(np.array([state.angles_rad for state in states])).all()
    np.testing.assert_array_equal(user.at(7.7).angles_rad, again.at(7.7).angles_rad)
    assert (user.at(7.7).angles_rad != other.at(7.7).angles_rad).any()
    script = np.array([user.script_s(t) for t in times.tolist()])
    assert (np.diff(script) >= 0.0).all()
    assert script[-1] == pytest.approx(ROUTINE_S)
    late = times - REACTION_S - script
    middle = (script > 0.5) & (script < ROUTINE_S - 0.5)
    assert late[middle].min() > 0.0
    assert late[middle].max() < 0.5
    place = np.array([state.T_rig_palm[:3, 3] for state in states])
    assert np.ptp(place, axis=0).max() < 3e-3


def test_the_palm_faces_the_cameras() -> None:
    user = HandRoutine(MODEL, np.array([0.0, 0.0, 0.5]), 1)
    dorsal = user.at(0.0).T_rig_palm[:3, 1]
    assert dorsal[2] > 0.9  # away from cameras that look along +z
