"""`phalanx export SOURCE --compare FILE` as a user runs it: a run and its truth, which was turned, moved and late."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from common.errors import CalibrationError, FitError, PhalanxError, RecordingError
from common.hand.model import JOINTS
from master.mocap.bvh_file import MARKERS
from tests.cli import invoke
from tests.master.mocap.moved import RIGHT, ROTATION, SHIFT, hand_at, poses_of, write_table
from tests.master.recording.export.test_export_command import recording_of
from tests.master.recording.export.test_export_tables import run_of

T_S = 5.0 + np.arange(600) / 60.0
TRUTH_S = np.arange(1700) / 120.0 + 3.0
SIGMA_M = 2e-3


def run(*options: str) -> str:
    result = invoke("export", *options)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_of(tmp_path_factory.mktemp("run"), poses_of(T_S, SIGMA_M))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Turned, moved, 11.5 s late, with names of another program, some joints missing and a gap."""
    folder = tmp_path_factory.mktemp("truth")
    names = tuple(name for name in JOINTS if "metacarpal" not in name and name != "palm")
    joints = hand_at(TRUTH_S).position_m[:, [JOINTS.index(name) for name in names]] @ ROTATION.T + SHIFT
    joints[500:520] = np.nan
    called = tuple(f"R_{name.replace('-finger', '').replace('phalanx-', '')}" for name in names)
    return write_table(folder / "truth.csv", TRUTH_S + 11.5, called, joints)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In our frame, on our clock."""
    joints = hand_at(TRUTH_S).position_m
    return write_table(tmp_path_factory.mktemp("exact") / "exact.csv", TRUTH_S, JOINTS, joints)


def test_a_disturbed_truth_gives_the_errors_of_the_exact_one(
    source: Path, truth: Path, exact: Path, tmp_path: Path
) -> None:
    results = run(str(source), "--compare", str(truth), "--json", str(tmp_path / "fitted.json"))
    assert "this hides what is constant" in results
    run(str(source), "--compare", str(exact), "--aligned", "--json", str(tmp_path / "exact.json"))
    fitted: dict[str, Any] = json.loads((tmp_path / "fitted.json").read_text())
    plain: dict[str, Any] = json.loads((tmp_path / "exact.json").read_text())
    assert plain["alignment"] == {"aligned": True}
    assert fitted["alignment"]["offset_ns"] == pytest.approx(-11.5e9, abs=2e6)
    assert fitted["alignment"]["rotation_deg"] == pytest.approx(
        np.degrees(np.linalg.norm([0.9, -1.7, 0.4])), abs=0.3
    )
    assert fitted["joint_mm"] == pytest.approx(plain["joint_mm"], rel=0.02)
    assert fitted["coverage_95_percent"] == pytest.approx(95.0, abs=1.0)
    assert fitted["classes"].keys() == plain["classes"].keys() - {"palm", "metacarpal"}
    assert fitted["fingers"]["ring"]["pip_deg"] == pytest.approx(
        plain["fingers"]["ring"]["pip_deg"], rel=0.05
    )


def test_a_recording_is_compared_like_a_run(source: Path, exact: Path, tmp_path: Path) -> None:
    recording = recording_of(tmp_path / "wave.mcap", [*poses_of(T_S, SIGMA_M)])
    tables = [
        [
            line
            for line in run(str(one), "--compare", str(exact), "--aligned").splitlines()
            if "joints" in line
        ]
        for one in (source, recording)
    ]
    assert tables[0] == tables[1] != []


def test_seconds_from_the_beginning_are_aligned_too(source: Path, tmp_path: Path) -> None:
    joints = hand_at(T_S).position_m
    path = write_table(tmp_path / "seconds.csv", T_S - T_S[0], JOINTS, joints)
    results = run(str(source), "--compare", str(path), "--aligned")
    assert "600 poses compared" in results
    assert "seconds from the beginning" in results


def test_a_part_of_the_time(source: Path, exact: Path) -> None:
    results = run(str(source), "--compare", str(exact), "--aligned", "--from", "2", "--until", "4")
    assert "121 poses compared" in results


def test_markers_of_a_rig_are_compared(source: Path, tmp_path: Path) -> None:
    points = RIGHT.marker_points(hand_at(TRUTH_S), MARKERS[:6])
    path = write_table(tmp_path / "markers.csv", TRUTH_S, MARKERS[:6], points)
    results = run(str(source), "--compare", str(path))
    assert "marker back" in results
    assert "all joints" not in results


@pytest.mark.parametrize(
    ("options", "kind", "output"),
    [
        ([], PhalanxError, "give --to FORMAT to export, or --compare FILE"),
        (["--compare", "EXACT", "--to", "csv"], PhalanxError, "--to is for exporting"),
        (["--to", "csv", "--aligned"], PhalanxError, "--aligned is for --compare"),
        (["--compare", "nowhere.csv"], RecordingError, "nowhere.csv: no such file"),
        (["--compare", "EXACT", "--only", "nobody"], RecordingError, "name one of them with --only"),
        (["--compare", "EXACT", "--joints", "nowhere.json"], CalibrationError, "nowhere.json: cannot read"),
        (["--compare", "LATER", "--aligned"], RecordingError, "leave --aligned out"),
        (["--compare", "OTHER"], FitError, "agree nowhere"),
    ],
)
def test_what_cannot_be_is_refused(
    source: Path, exact: Path, tmp_path: Path, options: list[str], kind: type[Exception], output: str
) -> None:
    joints = hand_at(TRUTH_S).position_m
    files = {
        "EXACT": exact,
        "LATER": write_table(tmp_path / "later.csv", TRUTH_S + 900.0, JOINTS, joints),
        "OTHER": write_table(
            tmp_path / "other.csv", TRUTH_S, JOINTS, hand_at(1.7 * TRUTH_S + 300.0).position_m
        ),
    }
    with pytest.raises(kind) as caught:
        run(str(source), *(str(files.get(option, option)) for option in options))
    assert output in str(caught.value)
