"""Who switches the lights is chosen by name, or there is no light; and what the command `lights` prints."""

from pathlib import Path
from shutil import copytree

import msgspec
import pytest

from common.calibration import CameraCalibration, RigCalibration, load
from common.errors import CalibrationError, LightsError
from slave.__main__ import main
from slave.commands.devices import choose_lights, light_limits, open_lights
from slave.lights.strobed import check_pulses, schedule_of
from tests.slave.lights.stage import CAMERA, RIG, ROOT

DESK = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)


@pytest.mark.parametrize(
    ("lights", "camera", "choice"),
    [
        (None, "synthetic", "synthetic"),
        ("synthetic", "synthetic", "synthetic"),
        ("camera", "synthetic", None),
        ("camera", "v4l2:0", None),
        ("external", "picamera2", None),
        ("gpio:0:17,27", "v4l2", "gpio:0:17,27"),
        ("i2c:1", "picamera2:0", "i2c:1"),
        (None, "replay:rec", None),
    ],
)
def test_what_lights_a_camera(lights: str | None, camera: str, choice: str | None) -> None:
    assert choose_lights(lights, RIG, camera) == choice


@pytest.mark.parametrize(
    ("lights", "camera", "expected"),
    [
        (None, "v4l2:0", "say who switches its laser and LEDs, --lights gpio:"),
        (None, "picamera2", "say who switches"),
        ("synthetic", "v4l2", "lights nothing before --camera v4l2"),
        ("gpio:0:1,2", "synthetic", "a simulated hand is lit by synthetic"),
        ("none", "v4l2", "no such driver; there are gpio:"),
        ("gpio", "v4l2", "no such driver"),
        ("i2c:1", "replay:rec", "a recording is lit already"),
    ],
)
def test_what_is_refused(lights: str | None, camera: str, expected: str) -> None:
    with pytest.raises(LightsError, match=expected):
        choose_lights(lights, RIG, camera)


def test_cameras_of_markers_have_no_lights() -> None:
    assert choose_lights(None, DESK, "v4l2") is None
    with pytest.raises(LightsError, match="sees markers"):
        choose_lights("camera", DESK, "v4l2")


def test_no_lights_without_limits() -> None:
    bare = msgspec.structs.replace(RIG, strobe=None)
    for attempt in (lambda: light_limits("i2c:1", bare), lambda: open_lights("gpio:0:1,2", bare)):
        with pytest.raises(LightsError, match="strobe: missing"):
            attempt()
    with pytest.raises(CalibrationError, match="strobe: missing"):
        schedule_of(bare, CAMERA)
    with pytest.raises(LightsError, match="does not switch these"):
        open_lights("camera", RIG)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"exposure_us": 5000.0},
            "exposure_us 5000: needs light for 6200 us, strobe.max_pulse_us of rig 'wrist' is 5000",
        ),
        ({"row_time_us": 20.0}, "row_time_us 20 .8000 us for all rows.*would reach into the next frame"),
        ({"frame_rate_hz": 130.0}, "for 0.139 of the time, strobe.max_duty of rig 'wrist' is 0.12"),
    ],
)
def test_an_exposure_that_cannot_be_lit_is_refused_at_the_start(
    changes: dict[str, float], expected: str
) -> None:
    with pytest.raises(CalibrationError, match=expected):
        check_pulses(RIG, msgspec.structs.replace(CAMERA, **changes))


def test_the_budget_is_printed_with_every_limit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--lights", "--rig", "wrist", "--calibration", str(ROOT / "calib_json")]) == 0
    output = capsys.readouterr().out
    for line in (
        "30.0 cycles/s, exposure 2000 us",
        "pulse 3200 us (at most 5000)",
        "duty 0.096 (at most 0.12",
        "together 315 mW (at most 400)",
        "laser, never off",
        "78.5 %",
        "LEDs, cornea",
        "no certificate",
    ):
        assert line in output


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--blink", "1"], "--blink and --off need the lights: --lights gpio:"),
        (["--off", "--lights", "camera"], "does not switch these"),
        (["--off", "--lights", "i2c:none"], "write i2c:BUS"),
        (["--off", "--lights", "i2c:77"], "no /dev/i2c-77"),
        (["--rig", "desk"], "rig 'desk': strobe: missing"),
    ],
)
def test_the_command_says_what_is_wrong(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--lights", "--calibration", str(ROOT / "calib_json"), *arguments]) == 1
    assert expected in capsys.readouterr().err


def test_a_rig_that_may_do_too_much_is_refused_by_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tree = tmp_path / "calib"
    copytree(ROOT / "calib_json", tree)
    path = tree / "rigs/wrist.json"
    path.write_text(path.read_text().replace('"power_w": 0.01', '"power_w": 0.2'))
    assert main(["doctor", "--lights", "--calibration", str(tree)]) == 1
    output = capsys.readouterr().err
    assert str(path) in output
    assert "laser.power_w" in output
    assert load(tree / "cameras/wrist.json", CameraCalibration) == CAMERA
