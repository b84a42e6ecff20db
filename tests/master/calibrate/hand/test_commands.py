"""`phalanx calibrate hand` as a user runs it."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.hands.routines import routine
from common.calibration import HandProfile, load, save
from common.errors import CalibrationError, PhalanxError, RecordingError
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from common.recording.recorded_files import write_npz
from tests.cli import calibrate


def run(*options: str) -> str:
    return calibrate("hand", *options)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_quick_start_from_the_length(tmp_path: Path, side: str) -> None:
    output = run("--length-mm", "183", "--side", side, "--name", "anna", "--out", str(tmp_path))
    assert "no bone is measured" in output
    made = load(tmp_path / "hands" / "anna.json", HandProfile)
    assert made.rest_joints == generated_profile("anna", side, 0.183).rest_joints
    assert "no bone is measured" in made.provenance["rest_joints"].note


def test_a_quick_start_with_three_markers_on_the_back(tmp_path: Path) -> None:
    run("--length-mm", "183", "--three-back", "--name", "eve", "--out", str(tmp_path))
    mounts = HandModel.of(load(tmp_path / "hands" / "eve.json", HandProfile)).mounts
    assert [name for name, mount in mounts.items() if mount.joint is None] == ["back", "back2", "back3"]


def test_a_quick_start_from_another_hand_is_mirrored_and_scaled(tmp_path: Path) -> None:
    save(tmp_path / "his.json", generated_profile("his", "left", 0.2))
    run("--length-mm", "180", "--name", "hers", "--hand", str(tmp_path / "his.json"), "--out", str(tmp_path))
    made = load(tmp_path / "hands" / "hers.json", HandProfile)
    expected = HandModel.of(generated_profile("hers", "right", 0.18))
    np.testing.assert_allclose(HandModel.of(made).rest_position_m, expected.rest_position_m, atol=3e-4)


def test_a_routine_from_a_file_of_poses(tmp_path: Path, root: Path) -> None:
    line_of_sight = routine(31, "left")
    poses = {
        "t_ns": line_of_sight.t_ns,
        "markers_raw_m": line_of_sight.points_m,
        "markers_cov_m2": line_of_sight.cov_m2,
    }
    write_npz(tmp_path / "poses.npz", poses)
    calibration = ("--rig", "desk", "--calibration", str(root / "calib_json"))
    given = ("--poses", str(tmp_path / "poses.npz"), "--side", "left", "--name", "ben", *calibration)
    figures, picture = tmp_path / "hand.json", tmp_path / "hand.png"
    output = run(*given, "--out", str(tmp_path), "--json", str(figures), "--picture", str(picture))
    assert "measured" in output
    assert "undetermined" in output
    lengths = json.loads(figures.read_text())["lengths"]
    made = load(tmp_path / "hands" / "ben.json", HandProfile)
    for finger in ("index", "middle", "ring", "little"):
        whole = lengths[f"{finger}_proximal_middle_distal"]
        keys = made.provenance[finger].residual
        assert whole["measured"] == (f"{finger}_proximal_middle_distal_sigma_mm" in keys)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_poses_with_the_markers_of_another_rig_are_refused(tmp_path: Path, root: Path) -> None:
    arrays = {
        "t_ns": np.arange(3),
        "markers_raw_m": np.zeros((3, 8, 3)),
        "markers_cov_m2": np.zeros((3, 8, 3, 3)),
    }
    write_npz(tmp_path / "poses.npz", arrays)
    with pytest.raises(RecordingError, match=r"the rig needs \(3, 6, 3\): name its rig"):
        run("--poses", str(tmp_path / "poses.npz"), "--calibration", str(root / "calib_json"))


def test_the_steps_are_printed_without_anything_else() -> None:
    output = run("--steps")
    assert "lay the back of the hand" in output.lower()
    assert "thumb alone" in output


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ((), CalibrationError, "--length-mm"),
        (("--length-mm", "300"), CalibrationError, "no hand|expected 0.1 to 0.25"),
        (("--poses", "nowhere.npz"), RecordingError, "nowhere.npz"),
        (("--live", "--poses", "a.npz"), CalibrationError, "no meaning with --live"),
        (("--three-back", "--poses", "a.npz"), CalibrationError, "--three-back"),
        (("--length-mm", "190", "--hand", "nowhere.json"), CalibrationError, "nowhere.json"),
    ],
)
def test_what_cannot_be_done_is_reported(
    options: tuple[str, ...], kind: type[PhalanxError], message: str, root: Path
) -> None:
    with pytest.raises(kind, match=message):
        run(*options, "--calibration", str(root / "calib_json"))
