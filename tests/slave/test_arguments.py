"""The slave's command line: each help teaches its own command, and what is mistyped is said in plain words."""

import argparse

import pytest

from common.sim.scenes import VIEWS
from common.sim.wrist.scene import WRIST_NAMES
from slave.__main__ import COMMANDS
from slave.arguments import HELP, parser

RECORD = ["record", "--name", "left", "--camera", "synthetic", "-o", "out"]


@pytest.mark.parametrize("command", HELP)
def test_help_of_a_command_shows_its_own_examples_only(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        parser().parse_args([command, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    examples = text.split("examples:")[1]
    assert f"phalanx-slave {command} " in examples
    assert not [other for other in HELP if other != command and f"phalanx-slave {other} " in examples]


@pytest.mark.parametrize("command", ["run", "imu", "record"])
def test_help_lists_every_scene(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # nothing is broken at its hyphen
    with pytest.raises(SystemExit):
        parser().parse_args([command, "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert VIEWS in text
    assert WRIST_NAMES in text


def test_help_of_all_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(["--help"])
    text = capsys.readouterr().out
    assert all(f"    {command} " in text for command in HELP)
    assert set(COMMANDS) == set(HELP)


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
        parser().parse_args([*RECORD, f"{option}={text}"])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert expected in error
    assert option in error
    assert " _" not in error


@pytest.mark.parametrize("text", ["99999", "0", "x"])
def test_a_wrong_port_is_named(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(["run", "--name", "left", "--camera", "synthetic", "--beacon-port", text])
    assert f"{text}: must be a port, 1 to 65535" in capsys.readouterr().err


def test_what_is_right_is_taken() -> None:
    options = parser().parse_args([*RECORD, "--frames", "3", "--queue-mb", "1.5"])
    assert isinstance(options, argparse.Namespace)
    assert (options.frames, options.queue_mb, options.reserve_mb) == (3, 1.5, 200.0)
