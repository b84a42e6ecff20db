"""`phalanx`: help that teaches, errors that name file and fix."""

import json
from pathlib import Path

import pytest

from deploy.__main__ import main


@pytest.mark.parametrize("command", [[], ["demo"], ["replay"]])
def test_help_shows_examples(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command, "--help"])
    assert ended.value.code == 0
    assert "phalanx demo --headless" in capsys.readouterr().out


def test_a_folder_that_is_no_recording_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "recording.json" in capsys.readouterr().err


def test_a_wrist_recording_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "recording.json").write_text(json.dumps({"rig": {"kind": "wrist", "cameras": ["wrist"]}}))
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "no rig of kind 'markers'" in capsys.readouterr().err


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
def test_a_length_that_is_none_is_refused(seconds: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["demo", "--seconds", seconds])
    assert ended.value.code == 2
