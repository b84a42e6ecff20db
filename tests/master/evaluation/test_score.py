"""Tests of the scores: errors put in by hand come out in millimetres and degrees."""

from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.errors import RecordingError
from common.messages import Source
from master.evaluation.score import Truth, load_truth, score, score_hidden
from master.outputs.poses import Poses
from tests.results import hand_pose

FINGERS = (0, 1, 2, 3, 4, -1)
ALL = np.ones(6, dtype=bool)


def poses(count: int, position: Float, angles: Float, markers: Float, start_ns: int = 0) -> Poses:
    """Rows 10 ms apart, all alike."""
    return Poses.of(
        [
            hand_pose(
                t_ns=start_ns + 10_000_000 * k,
                position_m=position,
                angles_rad=angles,
                markers_m=markers,
                markers_raw_m=markers + np.array([0.0, 0.0, 1e-3]),
            )
            for k in range(count)
        ]
    )


def truth(count: int, visible: Float | None = None, start_ns: int = 0) -> Truth:
    return Truth(
        t_ns=start_ns + 10_000_000 * np.arange(count),
        joints_m=np.zeros((count, 25, 3)),
        pip_rad=np.zeros((count, 4)),
        markers_m=np.zeros((count, 6, 3)),
        visible=np.ones((count, 2, 6)) if visible is None else visible,
    )


def index_off(mm: float) -> Float:
    position = np.zeros((26, 3))
    position[6:11, 0] = 1e-3 * mm
    return position


def test_errors_are_means_over_joints_and_medians_over_markers() -> None:
    angles = np.zeros((5, 4))
    angles[1, 2], angles[0, 2] = np.radians(8.0), 1.0  # the thumb's MCP is not a PIP
    found = score(poses(3, index_off(10.0), angles, np.tile([2e-3, 0.0, 0.0], (6, 1))), truth(3), FINGERS)
    assert found["marker_mm"] == pytest.approx(2.0)
    assert found["marker_raw_mm"] == pytest.approx(5**0.5, abs=1e-4)
    assert found["joint_mm"] == pytest.approx(10.0 * 5 / 25)
    assert found["joint_mm_visible"] == pytest.approx(2.0)
    assert found["pip_deg"] == pytest.approx(2.0)
    assert found["frames_without_pose"] == 0
    assert found["markers_missed"] == 0


def test_a_hidden_finger_counts_only_over_all() -> None:
    visible = np.ones((3, 2, 6))
    visible[:, 1, 1] = 0.4  # half seen by one camera only
    angles = np.zeros((5, 4))
    angles[1, 2] = np.radians(8.0)
    found = score(poses(3, index_off(10.0), angles, np.zeros((6, 3))), truth(3, visible), FINGERS)
    assert found["joint_mm"] == pytest.approx(2.0)
    assert found["joint_mm_visible"] == pytest.approx(0.0)
    assert found["pip_deg"] == pytest.approx(2.0)
    assert found["pip_deg_visible"] == pytest.approx(0.0)


def test_frames_without_a_pose_and_markers_not_found_are_counted() -> None:
    lost = np.zeros((6, 3))
    lost[2] = np.nan
    found = score(poses(4, np.full((26, 3), np.nan), np.full((5, 4), np.nan), lost), truth(4), FINGERS)
    assert found["frames_without_pose"] == 4
    assert found["markers_missed"] == 4
    assert "joint_mm" not in found  # nothing to average is left out, never a NaN
    assert all(np.isfinite(value) for value in found.values())


def test_a_single_truth_holds_for_every_frame() -> None:
    found = score(poses(5, index_off(5.0), np.zeros((5, 4)), np.zeros((6, 3))), truth(1), FINGERS)
    assert found["joint_mm"] == pytest.approx(1.0)


def test_other_truths_are_matched_by_time_within_a_millisecond() -> None:
    near = score(poses(3, index_off(5.0), np.zeros((5, 4)), np.zeros((6, 3)), 900_000), truth(7), FINGERS)
    assert near["joint_mm"] == pytest.approx(1.0)
    far = score(poses(3, index_off(5.0), np.zeros((5, 4)), np.zeros((6, 3)), 3_000_000), truth(7), FINGERS)
    assert "joint_mm" not in far


def test_without_a_truth_there_is_none(tmp_path: Path) -> None:
    assert load_truth(tmp_path, ALL) is None


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"no zip"])
def test_a_broken_truth_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "truth.npz").write_bytes(content)
    with pytest.raises(RecordingError, match=r"truth\.npz"):
        load_truth(tmp_path, ALL)


def test_a_truth_without_a_key_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "truth.npz", t_ref=np.zeros(1), angles=np.zeros((1, 21)))
    with pytest.raises(RecordingError, match=r"truth\.npz.*joints"):
        load_truth(tmp_path, ALL)


def test_rendered_truths_are_read_as_documented(datasets: Path) -> None:
    hand = load_truth(datasets / "stereo" / "flex90", ALL)
    assert hand is not None
    assert hand.joints_m.shape == (30, 25, 3)
    assert hand.visible.shape == (30, 2, 6)
    sweep = load_truth(datasets / "stereo" / "sweep_paper", np.arange(6) == 1)
    assert sweep is not None
    assert np.isnan(sweep.joints_m).all()
    np.testing.assert_array_equal(np.isfinite(sweep.markers_m).all(axis=(0, 2)), np.arange(6) == 1)
    np.testing.assert_allclose(sweep.markers_m[[0, -1], 1, 2], [1.0, 0.2], atol=1e-9)  # 100 -> 20 cm


def test_hidden_fingers_and_steps_at_a_hand_over_are_scored() -> None:
    visible = np.ones((60, 2, 6))
    visible[20:40, 0, 1] = 0.4  # the index marker, by one of two cameras less than half
    found = poses(60, np.zeros((26, 3)), np.zeros((5, 4)), np.zeros((6, 3)))
    found.position_m[20:40, 6:11, 0] = 3e-3
    found.position_m[40:, 6:11, 0] = 10e-3
    found.angles_rad[20:40, 1, 2] = np.radians(8.0)
    found.valid[30:40, 6:11] = False
    out = score_hidden(found, truth(60, visible), FINGERS)
    assert out["joint_mm_hidden"] == pytest.approx(3.0)
    assert out["pip_deg_hidden"] == pytest.approx(8.0)
    assert out["hidden_invalid"] == pytest.approx(0.5)
    assert "hand_over_step_mm" not in out, "no source has changed"
    found.source[25:, 6:11] = Source.WRIST
    assert score_hidden(found, truth(60, visible), FINGERS)["hand_over_step_mm"] == pytest.approx(3.0)
    found.valid[:] = True
    assert score_hidden(found, truth(60, visible), FINGERS)["hand_over_step_mm"] == pytest.approx(7.0)
    found.source[25:, 6:11] = Source.SOLVED
    found.source[55:, 6:11] = Source.WRIST
    assert score_hidden(found, truth(60, visible), FINGERS)["hand_over_step_mm"] == pytest.approx(7.0)
    late = truth(60, visible)
    late.joints_m[40:, 5:10, 0] = 7e-3  # a step that is true
    assert score_hidden(found, late, FINGERS)["hand_over_step_mm"] == pytest.approx(0.0, abs=1e-9)
