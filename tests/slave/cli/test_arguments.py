"""The slave's command line: each help teaches its own command, and what is mistyped is said in plain words."""

import argparse

import pytest

from common.sim.scenes import VIEWS
from common.sim.wrist.scene import WRIST_NAMES
from slave.cli.table import PROGRAM

RECORD = ["record", "--name", "left", "--camera", "synthetic", "-o", "out"]


@pytest.mark.parametrize("command", ["run", "record"])
def test_help_lists_every_scene(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # nothing is broken at its hyphen
    with pytest.raises(SystemExit):
        PROGRAM.parse([command, "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert VIEWS in text
    assert WRIST_NAMES in text


@pytest.mark.parametrize(
    ("option", "text", "expected"),
    [
        ("--queue-mb", "abc", "abc: must be a number"),
        ("--queue-mb", "-1", "must not be negative"),
        ("--queue-mb", "nan", "must be a finite number"),
        ("--clock-ppm", "inf", "must be a finite number"),
        ("--seconds", "soon", "soon: must be a number"),
        ("--seconds", "0", "must be positive"),
        ("--frames", "1.5", "1.5: must be a whole number"),
        ("--frames", "0", "at least 1"),
    ],
)
def test_a_wrong_number_is_named_and_no_function_is(
    option: str, text: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        PROGRAM.parse([*RECORD, f"{option}={text}"])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert expected in error
    assert option in error
    assert " _" not in error


@pytest.mark.parametrize("text", ["99999", "0", "x"])
def test_a_wrong_port_is_named(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        PROGRAM.parse(["run", "--name", "left", "--camera", "synthetic", "--beacon-port", text])
    assert f"{text}: must be a port, 1 to 65535" in capsys.readouterr().err


def test_what_is_right_is_taken() -> None:
    options = PROGRAM.parse([*RECORD, "--frames", "3", "--queue-mb", "1.5"])[1]
    assert isinstance(options, argparse.Namespace)
    assert (options.frames, options.queue_mb, options.reserve_mb) == (3, 1.5, 200.0)
