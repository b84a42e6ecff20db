"""Wizards: one for each calibration, forms that say what the commands take, jobs that run and are taken over."""

import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest
from msgspec.structs import replace

from common.bus.keys import rig_key
from common.errors import CalibrationError
from master.calibrate.session import share_of
from master.cli.table import CALIBRATIONS
from master.commands.keys import make
from master.console.local import LocalProcesses
from master.console.setup.commands import VIEWS, Commands, arguments_of, epoch_of, fields_of
from master.console.setup.files import CameraPlan, Plan, write_cameras, write_rig
from master.console.setup.job import Job, JobState, Stage, fault
from master.console.setup.panel_lens import judged
from master.console.setup.wizards import FILLED, WIZARDS
from master.console.state import ConsoleSettings
from tests.cli import invoke
from tests.network_helpers import until

WAIT_S = 60.0


def missing_wizards(commands: set[str]) -> set[str]:
    return commands - {wizard.command for wizard in WIZARDS.values()}


def test_every_calibration_has_a_wizard() -> None:
    assert missing_wizards(set(CALIBRATIONS)) == set()
    assert {wizard.command for wizard in WIZARDS.values()} == set(CALIBRATIONS)
    assert missing_wizards({*CALIBRATIONS, "new-one"}) == {"new-one"}  # the check sees one that is missing


@pytest.mark.parametrize("name", WIZARDS)
def test_a_form_has_every_option_of_its_command_with_its_help(name: str) -> None:
    wizard = WIZARDS[name]
    command = wizard.command
    fields = {field.name: field for field in fields_of(CALIBRATIONS[command])}
    assert set(wizard.fixed) <= set(fields) - FILLED - set(wizard.first)
    assert set(wizard.first) <= set(fields) - FILLED
    assert set(wizard.defaults) <= set(fields) - FILLED
    assert all(field.help for field in fields.values())
    output = invoke(*CALIBRATIONS[command].name.split(), "--help")
    for field in fields.values():
        assert field.flag in output.output
    # What is required and the page does not fill in by itself is shown at once.
    needed = {field.name for field in fields.values() if field.required} - FILLED
    assert needed <= set(wizard.first)


def test_values_become_the_command_line() -> None:
    fields = fields_of(CALIBRATIONS["stereo"])
    values = {
        "source": "views",
        "board": "9x6",
        "square_mm": 25.0,
        "camera": "left, right",
        "flat_board": True,
    }
    assert arguments_of(fields, values) == [
        *("views", "--board", "9x6", "--square-mm", "25"),
        *("--camera", "left", "--camera", "right", "--flat-board"),
    ]
    with pytest.raises(CalibrationError, match="Source: is needed"):
        arguments_of(fields, {"board": "9x6", "square_mm": 25.0})
    with pytest.raises(CalibrationError, match=r"Square \(mm\): 'wide' is no number"):
        arguments_of(fields, {**values, "square_mm": "wide"})
    views = fields_of(CALIBRATIONS["capture"])
    with pytest.raises(CalibrationError, match="Views: 3 is not in 5 to 200"):
        arguments_of(views, {"out": "x", "views": 3})


def test_lines_show_the_progress() -> None:
    assert share_of(["view 7 of 25: left and right; for left, tilt it"]) == 7 / 25
    assert share_of(["fitting  40 %"]) == 0.4
    assert share_of(["left: hold it still"]) is None
    assert share_of(["view 1 of 4: a", "left: hold it still", "view 2 of 4: b", "hold"]) == 0.5
    assert share_of([]) is None


def test_what_went_wrong_is_the_commands_own_sentence() -> None:
    lines = ["reading", "phalanx: views: 2 views kept; a calibration needs 5"]
    assert fault(lines) == "views: 2 views kept; a calibration needs 5"
    assert fault(_wrong_usage()).startswith("the following arguments are required: SOURCE, --board")
    assert fault([]) == "it printed nothing"


def _wrong_usage() -> list[str]:
    return invoke("calibrate", "cameras", "stereo").output.splitlines()


@pytest.fixture(name="tree")
def _tree(tmp_path: Path, root: Path) -> Path:
    cameras = tuple(
        CameraPlan(name=name, kind="simulated", mode="as-simulated") for name in ("left", "right")
    )
    plan = Plan(cameras=cameras, truth=str(root / "calib_json"))
    write_cameras(tmp_path / "tree", plan)
    write_rig(tmp_path / "tree", plan)
    return tmp_path / "tree"


def job_of(tree: Path, local: LocalProcesses, *programs: str) -> Job:
    stages = [
        lambda program=program, at=at: Stage(f"part {at}", {f"p{at}": [sys.executable, "-c", program]})
        for at, program in enumerate(programs)
    ]
    return Job("Test", stages, local, {}, tree, tree / "console" / "work" / "one")


def test_a_job_runs_its_stages_and_its_result_is_taken_over_once(tree: Path) -> None:
    local = LocalProcesses()
    try:
        rig = tree / "rigs" / "desk.json"
        work = tree / "console" / "work" / "one" / "tree" / "rigs"
        copy = f"import pathlib; p = pathlib.Path({str(work)!r}); p.mkdir(); (p / 'desk.json').write_text("
        new = f"pathlib.Path({str(rig)!r}).read_text().replace('default', 'default'))"
        job = job_of(tree, local, "print('view 1 of 2')", f"{copy}{new}; print('wrote')")
        assert job.wait(WAIT_S) is JobState.DONE
        assert (job.text, job.share) == (["view 1 of 2", "wrote"], 1.0)
        before = rig.read_bytes()
        assert job.use() == (rig,)
        (kept,) = tree.glob("old/*/rigs/desk.json")
        assert kept.read_bytes() == before
        rig.write_bytes(before + b"\n")
        with pytest.raises(CalibrationError, match="changed since this calibration began"):
            job.use()
    finally:
        local.close()


def test_a_job_that_fails_says_why_and_what_follows_does_not_run(tree: Path) -> None:
    local = LocalProcesses()
    try:
        failing = "import sys; print('phalanx: no board; show one'); sys.exit(1)"
        job = job_of(tree, local, failing, "print('never')")
        assert job.wait(WAIT_S) is JobState.FAILED
        assert (job.error, job.text) == ("no board; show one", ["phalanx: no board; show one"])
        with pytest.raises(CalibrationError, match="no result to use"):
            job.use()
    finally:
        local.close()


def test_a_job_is_cancelled_or_ended_early(tree: Path) -> None:
    local = LocalProcesses()
    waits = (
        "import signal, time\nsignal.signal(signal.SIGINT, lambda *_: exit(0))\nprint('up')\ntime.sleep(99)"
    )
    try:
        job = job_of(tree, local, waits, "print('then')")
        assert until(lambda: "up" in job.text)
        job.finish()
        assert job.wait(WAIT_S) is JobState.DONE
        assert job.text == ["up", "then"]
        other = Job(
            "Other", [lambda: Stage("one", {"x": [sys.executable, "-c", waits]})], local, {}, tree, tree / "w"
        )
        assert until(lambda: "up" in other.text)
        other.cancel()
        assert other.wait(WAIT_S) is JobState.CANCELLED
        assert local.running() == {}
    finally:
        local.close()


def test_command_lines_are_ones_that_the_programs_take(tree: Path) -> None:
    """Parsed by the programs' own parsers: the slave's is not imported here, its help is asked."""
    plan = replace(Plan(), cameras=_cameras("usb", device="/dev/v4l/by-id/cam", options="--control gain=32"))
    commands = Commands(ConsoleSettings(tree), plan)
    line = commands.camera(plan.cameras[0], "still", epoch_of("still"))
    assert line[1:5] == ["-m", "slave", "run", "--name"]
    assert "v4l2:/dev/v4l/by-id/cam" in line
    assert line[line.index("--control") + 1] == "gain=32"
    assert line[-1] == "127.0.0.1"
    simulated = replace(plan, cameras=_cameras("simulated"), truth=str(tree))
    line = Commands(ConsoleSettings(tree), simulated).camera(simulated.cameras[1], "board", epoch_of("board"))
    assert [line[line.index(flag) + 1] for flag in ("--camera", "--scene", "--truth-rig")] == [
        "synthetic",
        "board",
        "desk",
    ]
    pi = replace(plan, cameras=_cameras("pi", device="pi@left.local"))
    copy, run = Commands(ConsoleSettings(tree), pi).pi(pi.cameras[0])
    assert copy == f"rsync -a {tree.resolve()}/ pi@left.local:calib_json/"
    assert run.startswith("phalanx-slave run --name left --rig desk --camera picamera2")
    for command in CALIBRATIONS:
        values = {field.name: "1" for field in fields_of(CALIBRATIONS[command]) if field.required}
        words = CALIBRATIONS[command].name.split()
        assert commands.calibrate(command, values, tree / "work", live=False)[3:][: len(words)] == words
    assert set(VIEWS) >= {"board", "still", "standard"}


def _cameras(kind: str, device: str = "", options: str = "") -> tuple[CameraPlan, ...]:
    real = "usb" if kind == "usb" else "pi" if kind == "pi" else "simulated"
    return tuple(
        CameraPlan(name=name, kind=real, mode="usb-640x480", device=device, options=options)
        for name in ("left", "right")
    )


def figures(rms: float, off_mm: float) -> dict[str, object]:
    return {
        "rms_px": rms,
        "pairs": [{"edge_mean_mm": 25.0, "edge_sd_mm": off_mm}],
        "cameras": {"left": {"coverage": {"advice": ""}}},
    }


def test_with_a_keys_folder_each_camera_gets_its_certificate_and_a_pi_its_part(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pi = replace(Plan(), cameras=_cameras("pi", device="pi@left.local"))
    keys = tree.parent / "keys"
    monkeypatch.setenv("PHALANX_KEYS", str(keys))
    make(keys, [], datetime.now(UTC))
    assert len(Commands(ConsoleSettings(tree, key=bytes(32)), pi).environment()["PHALANX_RIG_KEY"]) == 64
    own = ConsoleSettings(tree, key=rig_key({}, None, keys))
    assert Commands(own, pi).environment() == {}, (
        "they take the secrets, too, from the folder that they inherit"
    )
    copy, run = Commands(ConsoleSettings(tree), pi).pi(pi.cameras[0])
    files = ("rig.key", "ca.pem", *(f"devices/left.{kind}" for kind in ("pem", "key", "secret")))
    assert copy.endswith(
        f" && rsync -aR {' '.join(f'{keys}/./{file}' for file in files)} pi@left.local:keys/"
    )
    assert all((keys / file).exists() for file in files)
    assert run.endswith("--keys keys")


def test_residuals_in_words() -> None:
    assert "Good" in judged(figures(0.2, 0.1))
    assert "Fair" in judged(figures(0.8, 0.1))
    assert "Repeat" in judged(figures(0.2, 2.0))
    assert "Repeat" in judged(figures(2.0, 0.1))
