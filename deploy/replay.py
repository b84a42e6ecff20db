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
        out: Folder for detections, poses and summary; those of a wrist rig beside a marker rig go to out/wrist.
        calibration: calib_json tree for marker colours and hands, or None.
        hand: Hand profile, or None for the rig's.
        level: What the fingers before a wrist device are solved from: fk, ik, auto; None: as its rig says.
    """

    recording: Path
    out: Path
    calibration: Path | None
    hand: Path | None
    level: str | None = None


def run_replay(settings: ReplaySettings, say: Callable[[str], None]) -> dict[str, object]:
    """Detect and solve every rig, and return the summary of the first.

    Raises:
        ReplayError: The recording is unreadable, or a step failed (its own message is on stderr).
    """
    rigs = _rigs(settings.recording)
    if settings.level is not None and all(rig.kind != "wrist" for rig in rigs):
        raise ReplayError(f"--level: {settings.recording} is of no wrist device, which alone has levels")
    if settings.hand is not None and not settings.hand.is_file():  # said now, not after all the detection
        raise ReplayError(f"{settings.hand}: no such hand profile")
    summaries = [_replay_rig(settings, rig, settings.out, say) for rig in rigs[:1]]
    for rig in rigs[1:]:
        out = settings.out / rig.kind
        summaries.append(_replay_rig(settings, rig, out, say))
        say(f"results of rig {rig.name} are in {out}")
    return summaries[0]


@dataclass(frozen=True, slots=True)
class _Rig:
    """A rig of the recording, as far as it matters here."""

    name: str
    kind: str
    cameras: list[str]


def _replay_rig(
    settings: ReplaySettings, rig: _Rig, out: Path, say: Callable[[str], None]
) -> dict[str, object]:
    """Detect and solve one rig into `out`."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ReplayError(f"--out {out}: cannot make the folder: {error.strerror}") from error
    recording = str(settings.recording)
    calibration = [] if settings.calibration is None else ["--calibration", str(settings.calibration)]
    hand = [] if settings.hand is None else ["--hand", str(settings.hand)]
    what, needs = ("markers", []) if rig.kind == "markers" else ("fingers", hand)
    for camera in rig.cameras:
        say(f"detecting {what} in camera {camera} ...")
        target = ["-o", str(out / f"detections_{camera}.npz")]
        _step("slave", "detect", recording, "--camera", camera, *calibration, *needs, *target)
    say("solving ...")
    results = ["--rig", rig.name, "--detections", str(out), "--out", str(out)]
    level = [] if settings.level is None or rig.kind != "wrist" else ["--level", settings.level]
    _step("master", "solve", recording, *calibration, *hand, *level, *results)
    return cast(dict[str, object], json.loads((out / "summary.json").read_text()))


def _step(module: str, *arguments: str) -> None:
    done = subprocess.run([sys.executable, "-m", module, *arguments], check=False)
    if done.returncode != 0:
        raise ReplayError(f"phalanx-{module} {arguments[0]} ended with code {done.returncode}")


def _rigs(recording: Path) -> list[_Rig]:
    """The recording's rigs, the first of each kind; that of markers before that of a wrist device."""
    path = recording / "recording.json"
    try:
        manifest = json.loads(path.read_text())
        rigs = [rig for rig in (manifest.get("rig"), *(manifest.get("rigs") or ())) if rig is not None]
        found = {
            rig["kind"]: _Rig(rig["name"], rig["kind"], list[str](rig["cameras"])) for rig in reversed(rigs)
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ReplayError(f"{path}: not a recording of raw frames ({reason})") from error
    if wanted := [found[kind] for kind in ("markers", "wrist") if kind in found]:
        return wanted
    raise ReplayError(f"{path}: no rig of kind 'markers' or 'wrist'")
