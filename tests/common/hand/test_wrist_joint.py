"""How a bent wrist turns the palm against the forearm: signs, inverse, many at once."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from common.geometry.transforms import axis_rotation, matrix_of
from common.hand.wrist import STRAIGHT, forearm_palm, wrist_angles_of, wrist_quaternion

ANGLE = st.floats(-1.4, 1.4)


def test_flexion_brings_the_fingers_towards_the_palm_of_the_hand_and_deviation_towards_the_thumb() -> None:
    fingers = np.array([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(forearm_palm(STRAIGHT), np.eye(3))
    assert (forearm_palm(np.array([0.3, 0.0])) @ fingers)[1] < -0.29  # +y is the back of the hand
    assert (forearm_palm(np.array([0.0, 0.3])) @ fingers)[0] > 0.29


@given(ANGLE, ANGLE)
def test_the_bend_of_a_rotation_is_the_one_that_made_it(flexion: float, deviation: float) -> None:
    R = forearm_palm(np.array([flexion, deviation]))
    np.testing.assert_allclose(R, axis_rotation(1, deviation) @ axis_rotation(0, flexion), atol=1e-15)
    np.testing.assert_allclose(matrix_of(wrist_quaternion(flexion, deviation)), R, atol=1e-14)
    np.testing.assert_allclose(wrist_angles_of(R), [flexion, deviation], atol=1e-12)


def test_many_bends_at_once_are_those_one_by_one() -> None:
    bends = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 4, 2))
    many = forearm_palm(bends)
    for index in np.ndindex(3, 4):
        np.testing.assert_array_equal(many[index], forearm_palm(bends[index]))
