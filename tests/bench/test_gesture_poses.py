"""The bench of poses counts what it should."""

from bench.gestures.poses import RecognisedPoses


def test_frames_count_from_the_third_of_a_held_pose_on() -> None:
    found = RecognisedPoses()
    truth = [None, "pinch", "pinch", "pinch", "pinch", None, "pointing", "pointing", "pointing"]
    found.add(truth, [None, None, None, "pinch", None, "open_palm", None, None, "pinch"])
    assert dict(found.frames) == {("pinch", "pinch"): 1, ("pinch", "none"): 1, ("pointing", "pinch"): 1}
    assert (found.episodes, found.in_time) == (2, 1)
    assert found.right == 100.0 / 3.0
    assert found.wrong == 100.0 / 3.0
