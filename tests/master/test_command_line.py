"""`phalanx-master`: the help of each command shows its own examples, and only those."""

import subprocess
import sys

import pytest

COMMANDS = ("run", "solve", "view", "report", "camera")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_shows_its_own_examples_only(command: str) -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "master", command, "--help"], capture_output=True, text=True, check=True
    ).stdout
    examples = shown.split("Examples:")[1]
    assert f"phalanx-master {command}" in examples
    assert not [other for other in COMMANDS if other != command and f"phalanx-master {other}" in examples]
