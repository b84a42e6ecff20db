"""`phalanx-master`: the help of each command shows its own examples, and only those."""

import subprocess
import sys

import pytest

HEAVY = (
    "matplotlib",
    "rerun",
    "scipy.stats",
    "scipy.optimize",
)  # seconds, on a machine that is busy tracking
COMMANDS = ("run", "solve", "view", "report", "camera", "send", "install")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_shows_its_own_examples_only(command: str) -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "master", command, "--help"], capture_output=True, text=True, check=True
    ).stdout
    examples = shown.split("Examples:")[1]
    assert f"phalanx-master {command}" in examples
    assert not [other for other in COMMANDS if other != command and f"phalanx-master {other}" in examples]


def loaded_by(statement: str) -> set[str]:
    """Which heavy packages a new process has loaded after a statement."""
    shown = subprocess.run(
        [sys.executable, "-c", f"{statement}\nimport sys; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    return {name for name in HEAVY if name in shown.split()}


def test_the_command_line_starts_without_heavy_packages() -> None:
    assert loaded_by("import master.commands") == set()
    assert loaded_by("import master.commands, scipy.stats") >= {"scipy.stats"}  # the check sees one
