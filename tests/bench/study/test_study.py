"""A small study through the real line: rendered, detected by the slave's process, calibrated, solved, judged."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.errors import CalibrationError, PhalanxError, RecordingError
from common.hand_model import FINGERS
from common.sim.motion import POSES
from master.study.command import evaluate_app
from master.study.line import claim, detect
from master.study.one import Condition, Task, run_participant
from master.study.run import Study, finish, recorded, simulate

CALIB = Path(__file__).resolve().parents[3] / "calib_json"
HAND_FILE = CALIB / "hands/default-right.json"
HAND = load(HAND_FILE, HandProfile)
JUDGED: Condition = ("calibrated", "detected")
EXACT: Condition = ("all", "exact")


def task(out: Path) -> Task:
    return Task(
        rig=load(CALIB / "rigs/wrist.json", RigCalibration),
        camera=load(CALIB / "cameras/wrist.json", CameraCalibration),
        hand=HAND,
        seed=3,
        blocks=1,
        conditions=(JUDGED,),
        level="fk",
        step=6,
        guided=8,
        out=out,
        resume="detections",
        keep=True,
        trial_s=0.2,
    )


def quiet(done: int, total: int, what: str) -> None:
    """Progress that nobody follows."""


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def told(out: Path) -> dict[str, Any]:
    """study.json of two participants, one after the other."""
    steps: list[tuple[int, int, str]] = []
    study = Study(task(out), participants=2, jobs=1, judged=JUDGED)
    result = simulate(study, lambda done, total, what: steps.append((done, total, what)))
    assert steps == [(1, 2, "participant-01"), (2, 2, "participant-02")]
    lines = finish(result, out)
    assert (out / "study.md").read_text() == "\n".join(lines) + "\n"
    return json.loads((out / "study.json").read_text())


def test_every_trial_went_through_the_line(told: dict[str, Any]) -> None:
    trials = told["trials"]["calibrated, detected"]
    assert len(trials) == 12
    for who in ("participant-01", "participant-02"):
        assert {one["pose"] for one in trials if one["participant"] == who} == set(POSES)
    for one in trials:
        assert one["triples"] in (1, 2)
        if one["pose"] == "open_palm":
            off = np.abs(np.array(one["pip_deg"]) - one["truth_deg"])[1:]
            assert off.max() < 35.0  # eight triples calibrate nothing: a device 5 degrees askew costs 20


def test_every_cell_is_there_and_nothing_is_filled_in(told: dict[str, Any]) -> None:
    cells = told["cells"]
    assert [(one["finger"], one["pose"]) for one in cells] == [(f, p) for f in FINGERS for p in POSES]
    for one in cells:
        assert one["is_reached"] is (2 * one["reached"] >= one["trials"])
        assert (one["mean_deg"] is None) is not one["is_reached"]
    assert 0 < sum(one["is_reached"] for one in cells) < len(cells)


def test_tables_and_picture_show_it(out: Path, told: dict[str, Any]) -> None:
    text = (out / "study.md").read_text()
    assert "Open loop" in text
    assert "(closed loop)" in text
    assert "not reached (" in text
    assert "| index | none | none | 0 |" in text  # one block cannot be repeated
    assert "condition: calibrated, detected" in text
    picture = cv2.imread(str(out / "study.png"))
    assert picture is not None
    assert picture.shape[1] > 1000
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


def test_calibration_is_ours_and_what_it_refuses_is_said(told: dict[str, Any]) -> None:
    for one in told["calibrated"].values():
        assert one["said"]
        assert 0.0 < one["nominal_turn_deg"] < 5.3
        if one["refused"]:  # then the rig file's pose is used
            assert one["turn_deg"] == one["nominal_turn_deg"]


def test_a_study_goes_on_from_what_was_detected_and_solves_anew(out: Path, told: dict[str, Any]) -> None:
    detections = out / "participant-01/calibrated-detected/detections_wrist.npz"
    before = detections.stat().st_mtime_ns
    found = run_participant(replace(task(out), level="auto", keep=False, conditions=(EXACT,)), 1)
    assert detections.stat().st_mtime_ns == before
    assert [len(trials) for trials in found.trials.values()] == [6]
    (palm,) = (one for one in found.trials["all, exact"] if one.pose == "open_palm")
    # Two triples after a quick motion: the filter is still on its way.
    assert np.abs(np.array(palm.pip_deg) - palm.truth_deg)[1:].max() < 15.0
    assert (out / "participant-02/trials/wrist").is_dir()
    assert not (out / "participant-01/trials/wrist").exists()  # not kept


def test_a_study_takes_frames_again_and_makes_all_else_anew(
    out: Path, told: dict[str, Any], tmp_path: Path
) -> None:
    shutil.copytree(out / "participant-02", tmp_path / "participant-02")
    folder = tmp_path / "participant-02"
    frame = folder / "trials/wrist/000000.png"
    before = frame.stat().st_mtime_ns
    assert (folder / "calibrated-detected").is_dir()
    found = run_participant(replace(task(tmp_path), resume="frames", conditions=(EXACT,)), 2)
    assert [len(trials) for trials in found.trials.values()] == [6]
    assert frame.stat().st_mtime_ns == before
    assert not (folder / "calibrated-detected").exists()


def test_a_recording_gives_the_same_trials(out: Path, told: dict[str, Any], tmp_path: Path) -> None:
    folder, hand = out / "participant-02/trials", out / "participant-02/calibrated/hand.json"
    rig = load(out / "participant-02/calibrated/rig.json", RigCalibration)
    assert rig.kind == "wrist"
    claim(folder, rig)
    result = recorded([folder], lambda name: (hand, load(hand, HandProfile)), "fk", tmp_path, quiet)
    trials = told["trials"]
    own = [one for one in trials["calibrated, detected"] if one["participant"] == "participant-02"]
    found = result.trials[result.judged]
    assert [one.pose for one in found] == [one["pose"] for one in own]
    for one, other in zip(found, own, strict=True):
        assert list(one.tracked) == other["tracked"]
        np.testing.assert_array_equal(np.array(one.pip_deg), np.array(other["pip_deg"], np.float64))
    with pytest.raises(RecordingError, match="two recordings of this name"):
        recorded([folder, folder], lambda name: (hand, HAND), None, tmp_path, quiet)


def called(*arguments: str) -> Result:
    return CliRunner().invoke(evaluate_app(), ["study", *arguments])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--hand", "me.json"), "--hand: is for recordings"),
        (("--rig", "desk", "--calibration", str(CALIB)), "kind is 'markers'"),
        (("--rig", "none", "--calibration", str(CALIB)), r"none\.json: cannot read"),
        (("nowhere", "--hand", str(HAND_FILE)), r"nowhere/recording\.json: cannot read"),
    ],
)
def test_what_cannot_be_studied_is_named(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    found = called(*arguments, "--out", str(tmp_path))
    assert isinstance(found.exception, PhalanxError)
    with pytest.raises(PhalanxError, match=message):
        raise found.exception


def test_a_recording_without_truth_or_hand_is_refused_before_it_is_detected(
    tmp_path: Path, out: Path, told: dict[str, Any]
) -> None:
    folder = tmp_path / "anna"
    folder.mkdir()
    source = out / "participant-02/trials"
    for name in ("recording.json", "frames.csv"):
        (folder / name).write_bytes((source / name).read_bytes())
    found = called(str(folder), "--hand", str(HAND_FILE), "--out", str(tmp_path))
    assert isinstance(found.exception, RecordingError)
    assert "truth.npz: missing" in str(found.exception)
    found = called(str(folder), "--calibration", str(tmp_path), "--out", str(tmp_path))
    assert isinstance(found.exception, CalibrationError)
    assert "give --hand FILE" in str(found.exception)


def test_what_the_slave_says_when_it_fails_is_passed_on(tmp_path: Path) -> None:
    with pytest.raises(PhalanxError, match=r"phalanx-slave detect .*ended with 1: .*recording\.json"):
        detect(tmp_path, "wrist", HAND_FILE, tmp_path / "found")
