"""Reads and writes summary.json: the figures of a run, by name."""

import json
from pathlib import Path
from typing import cast

from common.errors import RecordingError


def write_summary(path: Path, value: dict[str, object]) -> None:
    """Write a summary.

    Raises:
        RecordingError: The file cannot be written.
    """
    try:
        path.write_text(json.dumps(value, indent=1) + "\n")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write: {error.strerror}") from error


def read_summary(path: Path) -> dict[str, object]:
    """Read a summary.

    Raises:
        RecordingError: Missing, or not a JSON object.
    """
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot read the summary: {error}") from error
    if not isinstance(value, dict):
        raise RecordingError(f"{path}: not a JSON object")
    return cast(dict[str, object], value)
