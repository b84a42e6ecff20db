"""Scores of a wrist device: each on triples of which the answer is known by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Bool, Float, Int
from common.errors import RecordingError
from common.messages import SolverMode, WristDetections
from common.recording.frame_recording import FrameRecording, FrameRow, Illumination, Manifest
from master.evaluation.wrist_score import (
    GROUPS,
    WristTruth,
    cycles_missed,
    load_wrist_truth,
    score_tips,
    score_wrist,
)
from master.outputs.poses import Poses
from tests.hand_helpers import camera_file
from tests.results import hand_pose

PERIOD_NS = 33_333_333
N = 4


def truth() -> WristTruth:
    """Four triples; the line's parts of palm, fingers and thenar lie 20 mm apart, 10 mm of each are seen."""
    line = np.zeros((N, len(GROUPS), 3))
    line[:, :, 0] = 0.02 * np.arange(len(GROUPS))
    return WristTruth(
        t_ns=1_000_000_000 + PERIOD_NS * np.arange(N),
        laser_m=line,
        laser_seen_m=np.full((N, len(GROUPS)), 0.01),
        tip_uv=np.tile(100.0 * np.arange(5.0)[:, None], (N, 1, 2)),
        tip_visible=np.ones((N, 5), np.bool_),
        joints_m=np.zeros((N, 25, 3)),
        pip_rad=np.radians(np.tile([15.0, 10.0, 40.0, 80.0, 100.0], (N, 1))),
    )


def poses(exact: WristTruth) -> Poses:
    """What an errorless device makes of it."""
    angles, none = np.zeros((N, 5, 4)), np.empty((0, 3))
    angles[:, :, 2] = exact.pip_rad
    return Poses.of(
        [
            hand_pose(
                t_ns=int(exact.t_ns[k]),
                angles_rad=angles[k],
                markers_m=none,
                laser_m=exact.laser_m[k, 1:6],
                solver_mode=np.full(5, SolverMode.FK, np.uint8),
            )
            for k in range(N)
        ]
    )


def messages(exact: WristTruth, tips: Float) -> list[WristDetections]:
    nowhere, nothing = np.full((5, 2), np.nan), np.full(5, np.nan)
    return [
        WristDetections(
            "wrist", 1, 3 * k + 1, int(exact.t_ns[k]), int(exact.t_ns[k]), nowhere, nothing, nothing,
            tips[k], np.where(np.isnan(tips[k, :, 0]), np.nan, 1.0), nothing,
        )
        for k in range(N)
    ]  # fmt: skip


def test_an_errorless_device_has_no_errors() -> None:
    exact = truth()
    got = score_wrist(poses(exact), exact) | score_tips(messages(exact, exact.tip_uv), exact)
    assert got["laser_mm"] == got["laser_mm_thumb"] == got["laser_mm_little"] == 0.0
    assert got["laser_right"] == 1.0
    assert got["laser_missed"] == got["pip_untracked"] == 0.0
    assert cycles_missed(poses(exact), exact) == 0
    assert got["pip_rms_deg"] == got["pip_deg"] == got["joint_mm"] == 0.0
    assert (got["tip_px"], got["tip_within_6px"], got["tip_false"]) == (0.0, 1.0, 0.0)


def test_a_point_on_the_neighbour_is_wrong_and_a_missing_one_missed() -> None:
    exact = truth()
    laser = exact.laser_m[:, 1:6].copy()
    laser[0, 1, 0] += 0.012  # the index's point lies nearer to the middle finger's
    laser[1, 0, 0] -= 0.012  # the thumb's lies nearer to the palm's
    laser[2, 4] = np.nan
    laser[3, 2, 1] = 0.003
    got = score_wrist(replace(poses(exact), laser_m=laser), exact)
    assert got["laser_right"] == pytest.approx(17 / 20)
    assert got["laser_missed"] == 1.0
    assert got["laser_mm_middle"] == 0.0  # the median of 0, 0, 0 and 3
    assert got["laser_mm"] == 0.0


def test_fingers_with_laser_and_tip_in_sight_are_scored_apart() -> None:
    exact = truth()
    visible, seen = exact.tip_visible.copy(), exact.laser_seen_m.copy()
    visible[0, 1] = False  # the index in triple 0: no tip
    seen[1, 2] = 0.0019  # and in triple 1 too little line
    angles = poses(exact).angles_rad.copy()
    angles[:, 1, 2] += np.radians([50.0, 50.0, 4.0, -8.0])
    angles[3, 3, 2] = np.nan
    solver_mode = np.full((N, 5), SolverMode.FK, np.uint8)
    solver_mode[1:3, 1] = SolverMode.IK
    exact = replace(exact, tip_visible=visible, laser_seen_m=seen)
    got = score_wrist(replace(poses(exact), angles_rad=angles, solver_mode=solver_mode), exact)
    assert (got["both_index"], got["both_ik_index"]) == (2.0, 1.0)
    assert got["both_pip_deg_index"] == pytest.approx(6.0)
    assert (got["both_ring"], got["both_pip_deg_ring"], got["both_ik_ring"]) == (4.0, 0.0, 0.0)
    assert got["both_pip_deg_thumb"] == 0.0


def test_little_line_and_no_line_are_not_scored() -> None:
    exact = truth()
    seen = exact.laser_seen_m.copy()
    seen[:, 2] = 0.0019
    line = exact.laser_m.copy()
    line[:, 3] = np.nan
    laser = exact.laser_m[:, 1:6] + [0.0, 0.001, 0.0]
    got = score_wrist(replace(poses(exact), laser_m=laser), replace(exact, laser_seen_m=seen, laser_m=line))
    assert "laser_mm_index" not in got
    assert "laser_mm_middle" not in got
    assert got["laser_mm"] == got["laser_mm_ring"] == 1.0
    assert got["laser_missed"] == 0.0


def test_a_cycle_of_which_nothing_was_made_is_missed_with_all_its_points() -> None:
    exact = truth()
    found = poses(exact)
    got = score_wrist(found.rows(1, N), exact)
    assert cycles_missed(found.rows(1, N), exact) == 1
    assert got["laser_missed"] == 5.0
    assert got["laser_right"] == 0.75
    tips = score_tips(messages(exact, exact.tip_uv)[1:], exact)
    assert tips["tip_within_6px"] == 0.75
    assert tips["tip_false"] == 0.0


def test_poses_of_adjacent_frames_are_not_taken_for_those_of_the_cycle() -> None:
    exact = truth()
    late = replace(poses(exact), t_ns=exact.t_ns + 11_111_111)
    assert cycles_missed(late, exact) == N
    assert "laser_mm" not in score_wrist(late, exact)
    near = replace(poses(exact), t_ns=exact.t_ns + 4_000_000)  # the centre row of a rolling shutter
    assert cycles_missed(near, exact) == 0


def test_the_pip_is_scored_up_to_85_degrees_where_it_is_tracked() -> None:
    exact = truth()
    angles = poses(exact).angles_rad.copy()
    angles[:, 1, 2] += np.radians(3.0)
    angles[:, 4, 2] += np.radians(30.0)  # beyond: the laser's point stands still there
    tracked = np.ones((N, 26), np.bool_)
    tracked[1, 12:16] = False  # the middle finger, beyond its metacarpal
    got = score_wrist(replace(poses(exact), angles_rad=angles, tracked=tracked), exact)
    assert got["pip_rms_deg_index"] == pytest.approx(3.0)
    assert got["pip_rms_deg_middle"] == 0.0
    assert got["pip_rms_deg"] == pytest.approx(3.0 * np.sqrt(4 / 11), abs=1e-4)
    assert "pip_rms_deg_little" not in got
    assert got["pip_untracked"] == 1.0
    assert got["pip_deg"] == pytest.approx(33.0 / 4)


def test_what_is_not_valid_is_no_error_but_no_pose() -> None:
    exact = truth()
    found = poses(exact)
    valid, at = found.valid.copy(), found.position_m.copy()
    valid[2], at[2] = False, np.nan
    at[:2] += [0.0, 0.004, 0.0]
    got = score_wrist(replace(found, valid=valid, position_m=at), exact)
    assert got["frames_without_pose"] == 1.0
    assert got["joint_mm"] == pytest.approx(8.0 / 3, abs=1e-4)


@pytest.mark.parametrize(
    ("off_px", "seen", "within", "false"), [(5.9, True, 1.0, 0.0), (8.0, True, 0.75, 0.0),
                                            (16.0, True, 0.75, 0.25), (0.0, False, 1.0, 0.25)]
)  # fmt: skip
def test_a_false_tip_is_far_off_or_of_a_tip_that_is_not_seen(
    off_px: float, seen: bool, within: float, false: float
) -> None:
    exact = truth()
    tips, visible = exact.tip_uv.copy(), exact.tip_visible.copy()
    tips[0, :, 0] += off_px
    visible[0] = seen
    got = score_tips(messages(exact, tips), replace(exact, tip_visible=visible))
    assert got["tip_within_6px"] == within
    assert got["tip_false"] == false


def test_a_tip_that_is_not_reported_is_missed_and_not_false() -> None:
    exact = truth()
    tips = exact.tip_uv.copy()
    tips[:, 0] = np.nan
    got = score_tips(messages(exact, tips), exact)
    assert got["tip_within_6px"] == pytest.approx(0.8)
    assert got["tip_false"] == 0.0
    assert score_tips([], exact) == {"tip_within_6px": 0.0}


def recording(folder: Path, cycles: int) -> FrameRecording:
    manifest = Manifest(version=1, kind="wrist", cameras={"wrist": camera_file("wrist", 90.0)})
    lit = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)
    rows = [
        FrameRow("wrist", k, 1_000_000_000 + k * PERIOD_NS // 3, lit[k % 3], f"{k}.png")
        for k in range(3 * cycles)
    ]
    return FrameRecording(folder, manifest, tuple(reversed(rows)))  # the table is in no order


def write_truth(folder: Path, exact: WristTruth, **changes: Float | Bool | Int) -> None:
    angles = np.zeros((N, 21))
    angles[:, [3, 7, 11, 15, 19]] = exact.pip_rad
    arrays = {
        "laser_pt": exact.laser_m,
        "laser_len_vis": exact.laser_seen_m,
        "tip_uv": exact.tip_uv,
        "tip_visible": exact.tip_visible,
        "joints": exact.joints_m,
        "angles": angles,
    } | changes
    np.savez(folder / "truth.npz", **arrays)  # pyright: ignore[reportArgumentType]


def test_a_truth_belongs_to_the_laser_frames(tmp_path: Path) -> None:
    assert load_wrist_truth(recording(tmp_path, N), "wrist") is None
    write_truth(tmp_path, truth())
    exact = load_wrist_truth(recording(tmp_path, N), "wrist")
    assert exact is not None
    np.testing.assert_array_equal(exact.t_ns, 1_000_000_000 + (3 * np.arange(N) + 1) * PERIOD_NS // 3)
    np.testing.assert_allclose(exact.pip_rad, truth().pip_rad)


def test_a_truth_with_times_of_its_own_needs_no_frame_for_each_row(tmp_path: Path) -> None:
    write_truth(tmp_path, truth(), t_ns=truth().t_ns)
    exact = load_wrist_truth(recording(tmp_path, N - 1), "wrist")  # the laser frame of one triple was lost
    assert exact is not None
    np.testing.assert_array_equal(exact.t_ns, truth().t_ns)


def test_frames_that_were_lost_since_leave_a_truth_without_times_unused(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_truth(tmp_path, truth())
    assert load_wrist_truth(recording(tmp_path, 3), "wrist") is None
    assert f"truth.npz: nothing is scored: it has {N} rows and no t_ns, camera wrist has 3" in caplog.text


def test_a_truth_that_does_not_fit_is_named(tmp_path: Path) -> None:
    write_truth(tmp_path, truth(), tip_visible=np.ones((N, 4), np.bool_))
    with pytest.raises(RecordingError, match="tip_visible has shape"):
        load_wrist_truth(recording(tmp_path, N), "wrist")
    np.savez(tmp_path / "truth.npz", laser_pt=truth().laser_m)
    with pytest.raises(RecordingError, match="laser_len_vis"):
        load_wrist_truth(recording(tmp_path, N), "wrist")
