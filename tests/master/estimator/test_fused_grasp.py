"""Both sensors as one hand while it grips a bar that hides the fingers from the cameras, and from the device in part.

Frames are rendered and both slaves look at them: what the object does to tips and laser points is in it.
"""

import pytest

from bench.both.fusion import Outcome
from bench.both.scene import Both, watched

SECONDS, SEED = 4.8, 44  # the grip is closed at 3.3


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    return Outcome.of(watched(Both.of("grasp", SEED), SECONDS))


def test_a_grip_is_solved_better_than_by_either_sensor(outcome: Outcome) -> None:
    fused, markers, wrist = (outcome.figures[kind] for kind in ("fused", "markers", "wrist"))
    assert fused.joint_mm < 6.0
    assert fused.joint_mm < markers.joint_mm
    assert fused.fingers_mm < min(markers.fingers_mm, wrist.fingers_mm)
    assert fused.hidden_deg < 15.0


def test_no_finger_that_the_object_hides_is_tracked_folded(outcome: Outcome) -> None:
    fused = outcome.figures["fused"]
    assert fused.false_tracked < 0.02
    assert fused.inside > 0.9
    assert fused.tracked > 0.3
