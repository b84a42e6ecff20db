"""Which pose was held when, what a solved run says of it, and what is wrong with files that do not tell."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.hand.model import FINGER_JOINTS
from common.recording.frame_recording import FrameRecording, FrameRow, Illumination, Manifest
from common.sim.wrist.scene import WristTruth
from master.outputs.poses import Poses
from master.rig.setup import RigSetup
from master.study.session import COLUMNS, Held, write_trials
from master.study.trials import read_trials, trials_of
from tests.wrist_run import CYCLE_NS, START_NS, true_poses, wrist_scene, wrist_setup

N = 12
HEADER = ",".join(COLUMNS)


@pytest.fixture(scope="module")
def setup(root: Path) -> RigSetup:
    return wrist_setup(root)


@pytest.fixture(scope="module")
def truths(setup: RigSetup) -> list[WristTruth]:
    scene = wrist_scene(setup, "poses")
    return [scene.truth(float(t)) for t in np.linspace(0.5, 3.0, N)]


def at(k: int) -> int:
    return START_NS + k * CYCLE_NS


def recorded(folder: Path, setup: RigSetup, truths: list[WristTruth], **more: object) -> FrameRecording:
    angles = np.zeros((N, 21))
    angles[:, [3, 7, 11, 15, 19]] = [now.angles_rad[:, 2] for now in truths]
    names = ("laser_pt", "laser_len_vis", "tip_uv", "tip_visible")
    arrays: dict[str, object] = {name: np.array([getattr(now, name) for now in truths]) for name in names}
    arrays |= {"joints": np.array([now.joints.position_m[1:] for now in truths]), "angles": angles}
    arrays |= {"t_ns": np.array([at(k) for k in range(N)])} | more
    np.savez(folder / "truth.npz", **arrays)  # pyright: ignore[reportArgumentType]
    manifest = Manifest(version=1, kind="wrist", cameras=setup.cameras, rig=setup.rig)
    rows = tuple(FrameRow("wrist", k, at(k), Illumination.LASER, f"{k}.png") for k in range(N))
    return FrameRecording(folder, manifest, rows)


def held(folder: Path) -> None:
    write_trials(
        folder / "trials.csv", [Held(1, "pinch", at(0), at(3)), Held(1, "open_palm", at(4), at(N - 1))]
    )


def with_error(poses: Poses, off_deg: float) -> Poses:
    angles = poses.angles_rad.copy()
    angles[:, :, 2] += np.radians(off_deg)
    return replace(poses, angles_rad=angles)


def test_a_trial_is_what_was_held_against_its_truth(
    tmp_path: Path, setup: RigSetup, truths: list[WristTruth]
) -> None:
    held(tmp_path)
    poses = with_error(true_poses(setup, truths), 2.5)
    found = trials_of(recorded(tmp_path, setup, truths), "wrist", "anna", poses)
    assert [(one.participant, one.block, one.pose, one.cycles) for one in found] == [
        ("anna", 1, "pinch", 4),
        ("anna", 1, "open_palm", N - 4),
    ]
    true = np.degrees([now.angles_rad[:, 2] for now in truths])
    np.testing.assert_allclose(found[0].truth_deg, true[:4].mean(axis=0), atol=1e-3)
    np.testing.assert_allclose(found[0].pip_deg, np.median(true[:4], axis=0) + 2.5, atol=1e-3)
    assert found[0].tracked == (True,) * 5
    line = np.array([now.laser_len_vis[1:6] >= 2e-3 for now in truths])[:4]
    assert found[0].laser_seen == tuple((2 * line.sum(axis=0) >= 4).tolist())


def test_cycles_in_which_a_finger_was_not_tracked_do_not_count_and_half_of_them_must_be(
    tmp_path: Path, setup: RigSetup, truths: list[WristTruth]
) -> None:
    held(tmp_path)
    poses = true_poses(setup, truths)
    tracked, angles = poses.tracked.copy(), poses.angles_rad.copy()
    tracked[:2, list(FINGER_JOINTS[1][1:])] = False
    angles[:2, 1, 2] = 3.0  # far off
    tracked[:3, list(FINGER_JOINTS[2][1:])] = False
    angles[:, 3, 2] = np.nan
    spoilt = replace(poses, tracked=tracked, angles_rad=angles)
    one = trials_of(recorded(tmp_path, setup, truths), "wrist", "a", spoilt)[0]
    assert one.tracked == (True, True, False, False, True)
    assert abs(one.pip_deg[1] - one.truth_deg[1]) < 1e-3
    assert np.isnan(one.pip_deg[3])
    assert one.ambiguous == (False,) * 5


def test_cycles_without_a_pose_are_not_tracked(
    tmp_path: Path, setup: RigSetup, truths: list[WristTruth]
) -> None:
    held(tmp_path)
    poses = true_poses(setup, truths).rows(3, N)
    found = trials_of(recorded(tmp_path, setup, truths), "wrist", "a", poses)
    assert [one.tracked for one in found] == [(False,) * 5, (True,) * 5]


def test_labels_of_the_truth_serve_as_well_by_name_and_by_letter(
    tmp_path: Path, setup: RigSetup, truths: list[WristTruth]
) -> None:
    labels = ["rest", *["A_open"] * 3, "F_pinch", *["A_open"] * 2, "large_grasp", "pip30", *["D_grasp"] * 3]
    opened = recorded(tmp_path, setup, truths, label=np.array(labels))
    found = trials_of(opened, "wrist", "a", true_poses(setup, truths))
    assert [(one.block, one.pose, one.cycles) for one in found] == [
        (1, "open_palm", 3),
        (1, "pinch", 1),
        (2, "open_palm", 2),
        (1, "large_grasp", 1),
        (1, "small_grasp", 3),
    ]


def test_a_recording_without_true_poses_says_what_it_needs(
    tmp_path: Path, setup: RigSetup, truths: list[WristTruth]
) -> None:
    opened, poses = recorded(tmp_path, setup, truths), true_poses(setup, truths)
    with pytest.raises(RecordingError, match=r"needs trials\.csv with the columns block,pose,from_ns,to_ns"):
        trials_of(opened, "wrist", "a", poses)
    opened = recorded(tmp_path, setup, truths, label=np.array(["pip10"] * N))
    with pytest.raises(RecordingError, match="none of them is a pose of the study: A_"):
        trials_of(opened, "wrist", "a", poses)
    write_trials(tmp_path / "trials.csv", [Held(1, "pinch", 5, 6)])
    with pytest.raises(RecordingError, match="pinch of block 1: no triple from 5 to 6 ns"):
        trials_of(opened, "wrist", "a", poses)
    (tmp_path / "truth.npz").unlink()
    with pytest.raises(RecordingError, match=r"truth\.npz: missing"):
        trials_of(opened, "wrist", "a", poses)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "header must be block,pose,from_ns,to_ns"),
        ("block,pose\n", "header"),
        (f"{HEADER}\n", "no trial"),
        (f"{HEADER}\n1,pinch,0\n", "line 2: expected block"),
        (f"{HEADER}\n1,pinch,0,1\n2,pinch,a,1\n", "line 3: expected"),
        (f"{HEADER}\n1,wave,0,1\n", "line 2: pose 'wave' is none of open_palm"),
        (f"{HEADER}\n1,pinch,2,1\n", "line 2: to_ns is before from_ns"),
        (f"{HEADER}\n1,pinch,0,1\n1,pinch,2,3\n", "line 3: pinch is twice in block 1"),
        (f"{HEADER}\n1,pinch,0,1\n\xff", "cannot read"),
    ],
)
def test_a_broken_table_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "trials.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(RecordingError, match=rf"trials\.csv: .*{message}"):
        read_trials(path)


def test_a_table_comes_back_as_it_was_written(tmp_path: Path) -> None:
    rows = [Held(1, "pinch", 0, 9), Held(2, "pinch", 10, 10)]
    write_trials(tmp_path / "trials.csv", rows)
    assert read_trials(tmp_path / "trials.csv") == rows
