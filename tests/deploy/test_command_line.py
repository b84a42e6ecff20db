"""`phalanx`: help that teaches, errors that name file and fix."""

import json
from pathlib import Path

import pytest

from common.sim.scene import APART_PPM, LATE_NS
from common.sim.scenes import NAMES
from common.sim.wrist.scene import AMBIENTS, MOTIONS
from deploy import demo, replay
from deploy.__main__ import main
from slave.arguments import parser

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("command", "other"), [("demo", "replay"), ("replay", "demo")])
def test_help_of_a_command_shows_its_own_examples_only(
    command: str, other: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    examples = capsys.readouterr().out.split("examples:")[1]
    assert f"phalanx {command} " in examples
    assert f"phalanx {other} " not in examples


def test_help_of_the_demo_lists_every_scene(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # nothing is broken at its hyphen
    with pytest.raises(SystemExit):
        main(["demo", "--help"])
    text = capsys.readouterr().out
    assert [scene for scene in NAMES.split(" | ") if scene not in text] == []
    assert [scene for scene in (*MOTIONS, *AMBIENTS) if scene not in text] == []


def test_a_folder_that_is_no_recording_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "recording.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rigs", "says"),
    [
        ([{"name": "g", "kind": "glove", "cameras": []}], "no rig of kind 'markers' or 'wrist'"),
        ([], "no rig of kind"),
    ],
)
def test_a_recording_of_no_known_kind_is_refused_by_name(
    rigs: list[object], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recording.json").write_text(json.dumps({"rigs": rigs}))
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert says in capsys.readouterr().err


def test_of_both_kinds_each_rig_is_replayed_with_results_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[tuple[str, ...]] = []

    def step(module: str, *arguments: str) -> None:
        steps.append((module, *arguments))
        if arguments[0] == "solve":
            (Path(arguments[-1]) / "summary.json").write_text(json.dumps({"poses": len(steps)}))

    monkeypatch.setattr(replay, "_step", step)
    wrist = {"name": "w", "kind": "wrist", "cameras": ["palm"]}
    markers = {"name": "d", "kind": "markers", "cameras": ["left", "right"]}
    (tmp_path / "recording.json").write_text(json.dumps({"rigs": [wrist, markers]}))
    (tmp_path / "hand.json").write_text("{}")
    out = tmp_path / "out"
    settings = replay.ReplaySettings(tmp_path, out, None, tmp_path / "hand.json", "fk")
    assert replay.run_replay(settings, lambda _line: None) == {"poses": 3}
    assert [step[step.index("--camera") + 1] for step in steps if "detect" in step] == [
        "left",
        "right",
        "palm",
    ]
    assert ["--hand" in step for step in steps] == [False, False, True, True, True]  # markers know no hand
    assert ["--level" in step for step in steps] == [False, False, False, False, True]  # nor levels
    assert [step[step.index("--rig") + 1] for step in steps if "solve" in step] == ["d", "w"]
    assert steps[3][-1] == str(out / "wrist/detections_palm.npz")
    assert steps[4][-1] == str(out / "wrist")


def test_the_wrist_device_is_a_rig_like_any_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "demo",
        "--headless",
        "--wrist",
        "--calibration",
        str(tmp_path),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(command) == 1
    assert "rigs/wrist.json" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*command, "--rig", "desk4"])
    assert "not allowed with" in capsys.readouterr().err


@pytest.mark.parametrize("content", ["[]", "null", "{", '{"rigs": 5}', '{"rig": {}}', '{"rig": 1}'])
def test_a_manifest_of_another_form_is_named(
    content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recording.json").write_text(content)
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "recording.json: not a recording of raw frames" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["demo", "--headless"], ["replay", "RECORDING"]])
def test_an_out_that_is_a_file_is_said(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = {"name": "desk", "kind": "markers", "cameras": ["left", "right"]}
    (tmp_path / "recording.json").write_text(json.dumps({"rig": None, "rigs": [rig]}))
    (tmp_path / "taken").write_text("")
    place = [str(tmp_path) if word == "RECORDING" else word for word in command]
    assert main([*place, "--out", str(tmp_path / "taken")]) == 1
    assert "cannot make the folder" in capsys.readouterr().err


def test_a_missing_hand_is_said_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = {"name": "desk", "kind": "markers", "cameras": ["left", "right"]}
    (tmp_path / "recording.json").write_text(json.dumps({"rig": rig}))
    hand = tmp_path / "nobody.json"
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out"), "--hand", str(hand)]) == 1
    printed = capsys.readouterr()
    assert "nobody.json: no such hand profile" in printed.err
    assert "detecting" not in printed.out


def test_levels_of_a_marker_rig_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = {"name": "desk", "kind": "markers", "cameras": ["left", "right"]}
    (tmp_path / "recording.json").write_text(json.dumps({"rig": rig}))
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out"), "--level", "ik"]) == 1
    assert "of no wrist device" in capsys.readouterr().err


def test_a_missing_rig_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "demo",
        "--headless",
        "--rig",
        "attic",
        "--calibration",
        str(tmp_path),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(command) == 1
    error = capsys.readouterr().err
    assert "attic.json" in error
    assert "--calibration" in error


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "soon"])
def test_a_length_that_is_none_is_refused(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["demo", "--seconds", seconds])
    assert ended.value.code == 2
    assert " _" not in capsys.readouterr().err, "no name of a function"


def rows(rig: str, calibration: Path, out: Path) -> dict[str, list[str]]:
    """Process -> its command line, in the order of the table."""
    settings = demo.DemoSettings(1.0, True, out, calibration, rig, 7, "standard")
    return {name: command for name, command, _ in demo._table(settings, 10**12)}


def test_the_demo_starts_a_slave_for_the_imu_of_a_rig_that_has_one(tmp_path: Path) -> None:
    desk = json.loads((ROOT / "calib_json/rigs/desk.json").read_text())
    (tmp_path / "rigs").mkdir()
    still = [1.0, 0.0, 0.0, 0.0]
    placed = {"name": "palm-imu", "q_palm_imu": still, "q_rig_world": still}
    (tmp_path / "rigs/desk-imu.json").write_text(json.dumps(desk | {"imu": placed}))
    assert list(rows("desk", ROOT / "calib_json", tmp_path)) == ["left", "right", "master"]
    assert list(rows("wrist", ROOT / "calib_json", tmp_path)) == ["wrist", "imu", "master"]
    (tmp_path / "rigs/unplaced.json").write_text(json.dumps(desk | {"imu": {}}))
    assert list(rows("unplaced", tmp_path, tmp_path)) == ["left", "right", "master"]
    table = rows("desk-imu", tmp_path, tmp_path)
    assert list(table) == ["left", "right", "palm-imu", "master"]
    slaves = [parser().parse_args(table[name][3:]) for name in ("left", "right", "palm-imu")]
    assert [one.command for one in slaves] == ["run", "run", "imu"]
    assert {(one.scene, one.seed, one.scene_epoch_ns, one.rig) for one in slaves} == {
        ("standard", 7, 10**12, "desk-imu")
    }
    assert len({(one.clock_offset_ms, one.clock_ppm) for one in slaves}) == 3  # a clock of its own


def test_a_rig_whose_imu_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "rigs").mkdir()
    (tmp_path / "rigs/odd.json").write_text(json.dumps({"cameras": ["left"], "imu": 5}))
    with pytest.raises(demo.DemoError, match=r"odd\.json: cannot read the rig"):
        rows("odd", tmp_path, tmp_path)


def test_the_demo_runs_its_cameras_as_the_standard_scene_says() -> None:
    # The launcher imports nothing of what it starts, so the two numbers stand twice.
    assert demo._LATE_MS * 1e6 == LATE_NS
    assert demo._APART_PPM == APART_PPM
