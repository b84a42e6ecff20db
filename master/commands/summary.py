"""A summary holds the figures of a run, as a file and as lines of text."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import cast

from common.command_line import echo
from common.errors import RecordingError


def write_summary(path: Path, value: dict[str, object]) -> None:
    """Write summary.json: the figures of a run, by name.

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


_LABELS = {
    "poses_per_s": ("poses", "/s"),
    "latency_p50_ms": ("latency, median", "ms"),
    "latency_p99_ms": ("latency, 99 %", "ms"),
    "lost": ("frames lost on the way", ""),
    "skipped": ("frames a slave had no time for", ""),
    "frames_without_pose": ("frames without a pose", ""),
    "marker_mm": ("marker error, median", "mm"),
    "laser_mm": ("laser point error, median", "mm"),
    "laser_right": ("laser points on the right finger", "of 1"),
    "tip_within_6px": ("fingertips found within 6 px", "of 1"),
    "tip_false": ("fingertips that are none", "of 1"),
    "pip_rms_deg": ("PIP error up to 85 deg, RMS", "deg"),
    "joint_mm_visible": ("joint error, visible fingers", "mm"),
    "joint_mm": ("joint error, all fingers", "mm"),
    "pip_deg_visible": ("PIP error, visible fingers", "deg"),
    "pip_deg": ("PIP error, all fingers", "deg"),
    "joint_mm_hidden": ("joint error, hidden fingers", "mm"),
    "pip_deg_hidden": ("PIP error, hidden fingers", "deg"),
    "hand_over_step_mm": ("step when a sensor takes over", "mm"),
    "object_mm": ("object, error of its place, median", "mm"),
    "object_deg": ("object, error of its turn, median", "deg"),
    "object_tracked": ("object, share of time tracked", "of 1"),
    "object_latency_p50_ms": ("object, latency, median", "ms"),
    "held_s": ("object held by the hand", "s"),
    "dial_deg": ("dial, error of its angle, median", "deg"),
    "forearm_tilt_deg": ("forearm against the vertical, RMS", "deg"),
}


def summary_lines(summary: Mapping[str, object]) -> list[str]:
    """Format one line for each figure that a run has: poses, objects, then gestures."""
    lines = [
        f"{label:34s} {summary[key]:>9} {unit}".rstrip()
        for key, (label, unit) in _LABELS.items()
        if key in summary
    ]
    if "gestures_made" in summary:
        counted = f"{summary['gestures_right']}/{summary['gestures_made']}"
        lines.append(f"{'gestures recognised':34s} {counted:>9} ({summary['gestures_false']} false)")
    made = summary.get("gestures")
    if isinstance(made, dict):
        counts = cast(dict[str, int], made)
        lines.append(f"gestures: {', '.join(f'{name} {count}x' for name, count in counts.items())}")
    return lines


def print_line(line: str) -> None:
    """A line to whoever started the master."""
    echo(f"master: {line}")


def progress(what: str, done: int, total: int) -> None:
    """How much is done, in place; nothing where no terminal shows it."""
    if sys.stderr.isatty():
        echo(f"\r{what}: {100 * done // max(total, 1)} %   ", end="", error=True)
