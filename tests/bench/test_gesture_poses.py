"""The bench of poses counts what it should."""

import numpy as np

from bench.gestures.poses import RecognisedPoses, agrees
from common.geometry.transforms import axis_rotation
from common.sim.motion import POSES
from tests.hand_helpers import LEFT, RIGHT
from tests.master.gestures.shown_hands import posture


def test_frames_count_from_the_third_of_a_held_pose_on() -> None:
    found = RecognisedPoses()
    truth = [None, "pinch", "pinch", "pinch", "pinch", None, "pointing", "pointing", "pointing"]
    found.add(truth, [None, None, None, "pinch", None, "open_palm", None, None, "pinch"])
    assert dict(found.frames) == {("pinch", "pinch"): 1, ("pinch", "none"): 1, ("pointing", "pinch"): 1}
    assert (found.episodes, found.in_time) == (2, 1)
    assert found.right == 100.0 / 3.0
    assert found.wrong == 100.0 / 3.0


def test_the_rule_for_recorded_joints_agrees_with_its_own_pose() -> None:
    for model in (RIGHT, LEFT):
        for name in POSES:
            fingers = model.chains(posture(name, model=model)).position_m
            assert agrees(name, fingers)
    # Fingers spread aside are no less stretched; an open palm is no fist.
    spread = RIGHT.chains(posture("open_palm")).position_m.copy()
    spread[4] = spread[4, 0] + (spread[4] - spread[4, 0]) @ axis_rotation(1, np.radians(-35.0)).T
    assert agrees("open_palm", spread)
    assert not agrees("small_grasp", spread)
    assert not agrees("open_palm", RIGHT.chains(posture("small_grasp")).position_m)
