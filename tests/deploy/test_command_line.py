"""`phalanx`: help that teaches, errors that name file and fix."""

import json
from pathlib import Path

import pytest

from common.calibration import RigCalibration
from common.sim.scene import APART_PPM, LATE_NS
from common.sim.scenes import NAMES
from common.sim.two_rigs import TWO_RIG_SCENES
from common.sim.wrist.scene import AMBIENTS, MOTIONS
from deploy import commands, demo
from deploy.remote import DeployError
from master.cli.table import program
from master.commands.summary import summary_lines
from master.replay import offline
from slave.cli.table import PROGRAM
from tests.common.recording.test_frame_recording import camera, rig, write

ROOT = Path(__file__).resolve().parents[2]


def main(words: list[str]) -> int:
    return program().main(words)


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
    ("kind", "expected"), [("glove", r"Invalid enum value 'glove'"), ("none", r"no rig to solve")]
)
def test_a_recording_of_no_known_kind_is_refused_by_name(
    kind: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = json.loads((write(tmp_path) / "recording.json").read_text())
    manifest["rig"] = None if kind == "none" else manifest["rig"] | {"kind": kind}
    (tmp_path / "recording.json").write_text(json.dumps(manifest))
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert expected in capsys.readouterr().err


Step = tuple[str, ...]


def steps_of_replay(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *words: str
) -> tuple[list[Step], list[str]]:
    """The commands that detect a recording of both kinds, and the kinds of the rigs that are solved."""
    steps: list[Step] = []
    solved: list[str] = []

    def solve(_recording: object, rigs: list[RigCalibration], *_rest: object) -> None:
        solved.extend(rig.kind for rig in rigs)

    def setups(rigs: list[RigCalibration], *_rest: object) -> list[RigCalibration]:
        return rigs

    def step(*words: str) -> None:
        steps.append(words)

    monkeypatch.setattr(offline, "_slave", step)
    monkeypatch.setattr(offline, "setups_with_hands", setups)
    monkeypatch.setattr(offline, "solve", solve)
    write(folder, cameras={name: camera(name) for name in ("left", "right", "palm")}, kind="both", rig=None,
          rigs=[rig("wrist", ("palm",)), rig()])  # fmt: skip
    (folder / "hand.json").write_text("{}")
    command, options = program().parse(
        ["replay", str(folder), "--out", str(folder / "out"), "--hand", str(folder / "hand.json"), *words]
    )
    assert command.work == "master.commands.replay:replay"
    offline.replay_recording(options, lambda _line: None)
    return steps, solved


def test_both_kinds_are_detected_camera_by_camera_and_solved_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, solved = steps_of_replay(tmp_path, monkeypatch, "--solver-mode", "fk")
    assert [step[step.index("--name") + 1] for step in steps] == ["left", "right", "palm"]
    assert ["--hand" in step for step in steps] == [False, False, True]  # markers know no hand
    assert steps[2][-1] == str(tmp_path / "out/detections_palm.npz")
    assert sorted(solved) == ["markers", "wrist"]


@pytest.mark.parametrize(("only", "cameras"), [("markers", ["left", "right"]), ("wrist", ["palm"])])
def test_one_stream_of_both_can_be_replayed_alone(
    only: str, cameras: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, solved = steps_of_replay(tmp_path, monkeypatch, "--only", only)
    assert [step[step.index("--name") + 1] for step in steps] == cameras
    assert solved == [only]


def test_what_was_detected_before_is_only_solved_and_the_other_way_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, solved = steps_of_replay(tmp_path, monkeypatch, "--detections", str(tmp_path))
    assert (steps, len(solved)) == ([], 2)
    steps, solved = steps_of_replay(tmp_path, monkeypatch, "--detect-only")
    assert (len(steps), solved) == (3, [])


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
    assert "recording.json: " in capsys.readouterr().err


@pytest.mark.parametrize("command", [["demo", "--headless"], ["replay", "RECORDING"]])
def test_an_out_that_is_a_file_is_said(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path)
    (tmp_path / "taken").write_text("")
    place = [str(tmp_path) if word == "RECORDING" else word for word in command]
    assert main([*place, "--out", str(tmp_path / "taken")]) == 1
    assert "cannot make the folder" in capsys.readouterr().err


def test_a_missing_hand_is_said_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path)
    hand = tmp_path / "nobody.json"
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out"), "--hand", str(hand)]) == 1
    printed = capsys.readouterr()
    assert "nobody.json: no such hand profile" in printed.err
    assert "detecting" not in printed.out


def test_levels_of_a_marker_rig_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path)
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out"), "--solver-mode", "ik"]) == 1
    assert "a wrist device has levels" in capsys.readouterr().err


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


def rows(
    rigs: str | tuple[str, ...], calibration: Path, out: Path, scene: str = "standard"
) -> dict[str, list[str]]:
    """Process -> its command line, in the order of the table."""
    settings = demo.DemoSettings(
        1.0, True, out, calibration, (rigs,) if isinstance(rigs, str) else rigs, 7, scene
    )
    return {name: command for name, command, _ in demo._table(settings, out / "keys", 10**12)}


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
    slaves = [PROGRAM.parse(table[name][3:])[1] for name in ("left", "right", "palm-imu")]
    assert [(one.camera, one.imu) for one in slaves] == [("synthetic", None)] * 2 + [(None, "synthetic")]
    assert {(one.scene, one.seed, one.scene_epoch_ns, one.rig) for one in slaves} == {
        ("standard", 7, 10**12, "desk-imu")
    }
    assert len({(one.clock_offset_ms, one.clock_ppm) for one in slaves}) == 3  # a clock of its own


def test_others_read_along_at_the_bus_that_the_user_names(tmp_path: Path) -> None:
    settings = demo.DemoSettings(
        1.0, True, tmp_path, ROOT / "calib_json", ("desk",), 7, bus="tcp/127.0.0.1:47999"
    )
    (master,) = (
        command for name, command, _ in demo._table(settings, tmp_path / "keys", 10**12) if name == "master"
    )
    assert master[master.index("--bus") + 1] == "tcp/127.0.0.1:47999"


def test_the_console_takes_the_place_of_the_viewer(tmp_path: Path) -> None:
    settings = demo.DemoSettings(1.0, False, tmp_path, ROOT / "calib_json", ("desk",), 7, console=True)
    table = {name: command for name, command, _ in demo._table(settings, tmp_path / "keys", 10**12)}
    assert list(table) == ["left", "right", "master", "viewer"]
    viewer, master = table["viewer"], table["master"]
    assert viewer[1:4] == ["-m", "master", "console"]
    assert viewer[viewer.index("--bus") + 1] == master[master.index("--bus") + 1]
    assert viewer[viewer.index("--port") + 1] == "0"  # a port that is free


def test_a_tracker_on_an_object_is_a_slave_of_its_own(tmp_path: Path) -> None:
    table = rows("desk-tracker", ROOT / "calib_json", tmp_path, "object")
    assert list(table) == ["left", "right", "tracker", "master"]
    slave = PROGRAM.parse(table["tracker"][3:])[1]
    assert (slave.tracker, slave.scene) == ("synthetic", "object")


def test_the_summary_lists_the_results_of_objects_and_gestures() -> None:
    lines = summary_lines(
        {
            "poses_per_s": 60.0,
            "object_mm": 1.2,
            "gestures_right": 11,
            "gestures_made": 12,
            "gestures_false": 1,
            "gestures": {"pinch index": 3, "tap 5": 1},
        }
    )
    assert [line.split() for line in lines[:2]] == [
        ["poses", "60.0", "/s"],
        ["object,", "error", "of", "its", "place,", "median", "1.2", "mm"],
    ]
    assert lines[2].endswith("11/12 (1 false)")
    assert lines[3] == "gestures: pinch index 3x, tap 5 1x"
    assert summary_lines({}) == []


def test_a_rig_whose_imu_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "rigs").mkdir()
    (tmp_path / "rigs/odd.json").write_text(json.dumps({"cameras": ["left"], "imu": 5}))
    with pytest.raises(DeployError, match=r"odd\.json: cannot read the rig"):
        rows("odd", tmp_path, tmp_path)


def test_of_both_kinds_each_sensor_has_its_rig_and_one_master_runs_all(tmp_path: Path) -> None:
    table = rows(("desk", "wrist"), ROOT / "calib_json", tmp_path, "grasp@dark")
    assert list(table) == ["left", "right", "wrist", "imu", "master"]
    slaves = {name: PROGRAM.parse(table[name][3:])[1] for name in list(table)[:-1]}
    assert [one.rig for one in slaves.values()] == ["desk", "desk", "wrist", "wrist"]
    # The light is the wrist device's.
    assert [one.scene for one in slaves.values()] == ["grasp", "grasp", "grasp@dark", "grasp@dark"]
    master = table["master"]
    assert [master[k + 1] for k, word in enumerate(master) if word == "--rig"] == ["desk", "wrist"]


@pytest.mark.parametrize(
    ("rigs", "scene", "expected"),
    [
        (("desk", "wrist"), "standard", "desk, wrist see one hand together only in grasp, both-poses"),
        (("desk", "desk"), "grasp", "a rig stands twice"),
        (("desk", "desk4"), "grasp", "'left' stands twice"),
        (("desk",), "object", "rig desk tracks no object; --rig desk-wand"),
    ],
)
def test_rigs_that_cannot_be_played_together_are_refused(
    rigs: tuple[str, ...], scene: str, expected: str, tmp_path: Path
) -> None:
    with pytest.raises(DeployError, match=expected):
        rows(rigs, ROOT / "calib_json", tmp_path, scene)


def test_two_hands_are_played_each_by_its_own_scene(tmp_path: Path) -> None:
    table = rows(("desk", "wrist-left"), ROOT / "calib_json", tmp_path)
    assert list(table) == ["left", "right", "wrist", "imu", "master"]


@pytest.mark.parametrize(
    ("words", "rigs"),
    [
        ([], ("desk",)),
        (["--scene", "grasp@dark"], ("desk-back3", "wrist-back3")),
        (["--scene", "grasp", "--rig", "desk"], ("desk",)),
        (["--wrist", "--scene", "grasp"], ("wrist",)),
        (["--scene", "object"], ("desk-wand",)),
        (["--scene", "gestures"], ("desk4",)),
        (["--scene", "object", "--rig", "desk-cube"], ("desk-cube",)),
    ],
)
def test_a_scene_of_both_kinds_is_played_before_both(
    words: list[str], rigs: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[demo.DemoSettings] = []

    def run(settings: demo.DemoSettings, *_rest: object) -> dict[str, object]:
        ran.append(settings)
        return {}

    monkeypatch.setattr(commands, "run_demo", run)
    monkeypatch.setattr(commands, "stop_on_signals", lambda: None)
    assert main(["demo", "--headless", *words]) == 0
    assert ran[0].rigs == rigs


def test_the_demo_runs_its_cameras_as_the_standard_scene_says() -> None:
    # The launcher imports nothing of what it starts, so these stand twice.
    assert demo.TWO_RIG_SCENES == TWO_RIG_SCENES
    assert demo._LATE_MS * 1e6 == LATE_NS
    assert demo._APART_PPM == APART_PPM
