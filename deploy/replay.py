"""Replay: `phalanx-slave detect` for every camera of a recording's rig, then `phalanx-master solve`."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast


class ReplayError(Exception):
    """The recording cannot be replayed; the text says why."""


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """What the user chose.

    Attributes:
        recording: Folder of raw frames.
        out: Folder for detections, poses and summary.
        calibration: calib_json tree for marker colours and hands, or None.
        hand: Hand profile, or None for the rig's.
    """

    recording: Path
    out: Path
    calibration: Path | None
    hand: Path | None


def run_replay(settings: ReplaySettings, say: Callable[[str], None]) -> dict[str, object]:
    """Detect, solve, and return the summary.

    Raises:
        ReplayError: The recording is unreadable, or a step failed (its own message is on stderr).
    """
    kind, cameras = _rig(settings.recording)
    if settings.hand is not None and not settings.hand.is_file():  # said now, not after all the detection
        raise ReplayError(f"{settings.hand}: no such hand profile")
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ReplayError(f"--out {settings.out}: cannot make the folder: {error.strerror}") from error
    recording = str(settings.recording)
    calibration = [] if settings.calibration is None else ["--calibration", str(settings.calibration)]
    hand = [] if settings.hand is None else ["--hand", str(settings.hand)]
    what, needs = ("markers", []) if kind == "markers" else ("fingers", hand)
    for camera in cameras:
        say(f"detecting {what} in camera {camera} ...")
        target = ["-o", str(settings.out / f"detections_{camera}.npz")]
        _step("slave", "detect", recording, "--camera", camera, *calibration, *needs, *target)
    say("solving ...")
    results = ["--detections", str(settings.out), "--out", str(settings.out)]
    _step("master", "solve", recording, *calibration, *hand, *results)
    return cast(dict[str, object], json.loads((settings.out / "summary.json").read_text()))


def _step(module: str, *arguments: str) -> None:
    done = subprocess.run([sys.executable, "-m", module, *arguments], check=False)
    if done.returncode != 0:
        raise ReplayError(f"phalanx-{module} {arguments[0]} ended with code {done.returncode}")


def _rig(recording: Path) -> tuple[str, list[str]]:
    """Kind and cameras of the recording's rig."""
    path = recording / "recording.json"
    try:
        manifest = json.loads(path.read_text())
        rigs = [rig for rig in (manifest.get("rig"), *(manifest.get("rigs") or ())) if rig is not None]
        found = {str(rig["kind"]): list[str](rig["cameras"]) for rig in reversed(rigs)}  # the first of a kind
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ReplayError(f"{path}: not a recording of raw frames ({reason})") from error
    if len(found) > 1:
        raise ReplayError(
            f"{path}: rigs of the kinds {' and '.join(sorted(found))}: one recording with both is not solved yet; "
            "leave one rig out of it"
        )
    for kind in ("markers", "wrist"):
        if kind in found:
            return kind, found[kind]
    raise ReplayError(f"{path}: no rig of kind 'markers' or 'wrist'")
