"""`phalanx camera`: what it tells the slave, what it shows, and what it says when that cannot be."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from common.bus.bus import Bus
from common.calibration import CameraCalibration, load
from common.calibration.camera_settings import CameraSettings, ColourPick
from common.errors import BusError, CalibrationError, CameraError, PhalanxError
from common.messages import Command, Health
from master.commands import camera
from master.commands.camera import commands, send_all, settings, table
from tests.memory_bus import LoopbackBus

ROOT = Path(__file__).resolve().parents[3]
LEFT = ROOT / "calib_json/cameras/left.json"


def asked(**options: Any) -> list[Command]:
    extra = {key: options.pop(key) for key in ("pick", "load_file", "save") if key in options}
    return commands("left", settings(**options), **extra)


def test_without_options_it_only_asks() -> None:
    assert [(step.target, step.verb, step.body) for step in asked()] == [("left", "settings", "")]


def test_options_become_a_body_that_the_slave_understands() -> None:
    (extra,) = asked(exposure_us=4000.0, colour_gains="1.1,1.6")
    assert (extra.verb, msgspec.json.decode(extra.body)) == (
        "set",
        {"exposure_us": 4000.0, "colour_gains": [1.1, 1.6]},
    )
    assert msgspec.json.decode(extra.body, type=CameraSettings).analogue_gain is None


def test_rate_margin_and_a_pick_are_sent_in_turn() -> None:
    extra, pick, save = asked(rate_hz=30.0, roi_margin=0.1, pick="index@310,204.5", save=True)
    assert msgspec.json.decode(extra.body) == {"frame_rate_hz": 30.0, "roi_margin": 0.1}
    assert (pick.verb, save.verb) == ("pick", "save")
    assert msgspec.json.decode(pick.body, type=ColourPick) == ColourPick(marker="index", uv=(310.0, 204.5))


def test_a_file_is_loaded_then_changed_then_saved() -> None:
    steps = asked(load_file=LEFT, gain=2.0, save=True)
    assert [step.verb for step in steps] == ["load", "set", "save"]
    assert msgspec.json.decode(steps[0].body, type=CameraCalibration) == load(LEFT, CameraCalibration)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"exposure_us": 0.0}, "--exposure-us 0: must be positive"),
        ({"gain": float("nan")}, "--gain nan: must be positive"),
        ({"colour_gains": "1.1"}, "write RED,BLUE"),
        ({"colour_gains": "1,2,3"}, "write RED,BLUE"),
        ({"colour_gains": "red,blue"}, "write RED,BLUE"),
        ({"colour_gains": "1.1,-1"}, "--colour-gains -1: must be positive"),
        ({"rate_hz": 0.0}, "--rate-hz 0: must be positive"),
        ({"roi_margin": 0.9}, "--roi-margin 0.9: must be from 0.01 to 0.5"),
        ({"pick": "index"}, "--pick index: write MARKER@U,V"),
        ({"pick": "index@3"}, "write MARKER@U,V"),
        ({"pick": "@3,4"}, "write MARKER@U,V"),
        ({"load_file": LEFT.with_name("right.json")}, "the file of camera 'right', not of 'left'"),
        ({"load_file": LEFT.with_name("none.json")}, "none.json: cannot read"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_sent(
    options: dict[str, Any], expected: str
) -> None:
    with pytest.raises(PhalanxError, match=expected):
        asked(**options)


def served(name: str, verbs: Mapping[str, Callable[[str], Mapping[str, float]]]) -> Bus:
    """A bus with one slave."""
    hub = LoopbackBus()
    end = hub.join()
    end.announce(name)

    def answer(command: Command) -> Health:
        return Health(name, 1, 2, {"camera.lost": 1}, dict(verbs[command.verb](command.body)))

    end.serve(name, answer)
    return hub


def test_wanted_and_read_back_stand_side_by_side() -> None:
    metrics = {
        "wanted.exposure_us": 5000.0,
        "exposure_us": 4989.0,
        "wanted.red_gain": 0.83,
        "sync_locked": 1.0,
        "rate_hz": 60.0,
    }
    health = send_all(served("left", {"settings": lambda _body: metrics}), asked())
    assert [line.split() for line in table(health)] == [
        ["setting", "wanted", "read", "back"],
        ["exposure_us", "5000", "4989"],
        ["red_gain", "0.83", "-"],
        ["sync_locked", "1"],
        ["camera.lost", "1"],
    ]


def test_a_refusal_ends_the_steps() -> None:
    output: list[str] = []

    def refuse(_body: str) -> Mapping[str, float]:
        raise CameraError("exposure_us: wanted 9000 us, got 8000 us")

    bus = served("left", {"set": refuse, "save": lambda body: output.append(body) or {}})
    with pytest.raises(BusError, match="'left' refused 'set': exposure_us: wanted 9000 us, got 8000 us"):
        send_all(bus, asked(exposure_us=9000.0, save=True))
    assert output == []


def test_a_camera_that_is_not_there_is_named_with_those_that_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera, "APPEAR_S", 0.1)
    with pytest.raises(BusError, match="no camera 'left' is on the bus; there are: right"):
        send_all(served("right", {}), asked())


def test_a_broken_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "left.json"
    path.write_text("{}")
    with pytest.raises(CalibrationError, match=r"left\.json: Object missing required field"):
        asked(load_file=path)
