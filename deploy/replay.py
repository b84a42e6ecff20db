"""Replay: `phalanx-slave detect` in every camera of a recording, then `phalanx-master solve` of all together.

Videos and pictures of other programs become a recording before that: `phalanx-slave import`.
"""

import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

_MANIFEST_BYTES = 4 << 20
_PLAIN = re.compile(r"[A-Za-z0-9_.-]{1,64}")


class ReplayError(Exception):
    """The recording cannot be replayed; the text says why."""


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """What the user chose.

    Attributes:
        paths: A folder of raw frames; or videos, folders of pictures, or folders of these.
        out: Folder for detections, poses and summary.
        calibration: calib_json tree for marker colours and hands, or None.
        hand: Hand profile, or None for the rig's.
        solver_mode: What the fingers before a wrist device are solved from: fk, ik, auto; None: as its rig says.
        solver: Whose hand a rig of markers publishes: estimator, fabrik; None: as it says.
        cameras, rig, times: Of videos: NAME=PATH each, the rig's name, the table of times.
        only: "markers" or "wrist": the rigs of that kind alone; None: all.
    """

    paths: Sequence[Path]
    out: Path
    calibration: Path | None
    hand: Path | None
    solver_mode: str | None = None
    solver: str | None = None
    only: str | None = None
    cameras: Sequence[str] = ()
    rig: str | None = None
    times: Path | None = None


def run_replay(settings: ReplaySettings, notify: Callable[[str], None]) -> dict[str, object]:
    """Detect in every camera and solve, and return the summary.

    Raises:
        ReplayError: The recording is unreadable, or a step failed (its own message is on stderr).
    """
    folder = _recording_of(settings, notify)
    rigs = _rigs(folder, settings.only)
    if settings.solver_mode is not None and all(rig.kind != "wrist" for rig in rigs):
        raise ReplayError(f"--solver-mode: {folder} is of no wrist device, which alone has levels")
    if settings.solver is not None and all(rig.kind != "markers" for rig in rigs):
        raise ReplayError(f"--solver: {folder} is of no rig of markers, which alone has solvers")
    if settings.hand is not None and not settings.hand.is_file():  # said now, not after all the detection
        raise ReplayError(f"{settings.hand}: no such hand profile")
    out = settings.out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ReplayError(f"--out {out}: cannot make the folder: {error.strerror}") from error
    recording = str(folder)
    calibration = [] if settings.calibration is None else ["--calibration", str(settings.calibration)]
    hand = [] if settings.hand is None else ["--hand", str(settings.hand)]
    for camera, kind in {camera: rig.kind for rig in rigs for camera in rig.cameras}.items():
        what, needs = ("markers", []) if kind == "markers" else ("fingers", hand)
        notify(f"detecting {what} in camera {camera} ...")
        target = ["-o", str(out / f"detections_{camera}.npz")]
        _step("slave", "detect", recording, "--camera", camera, *calibration, *needs, *target)
    notify("solving ...")
    which = [] if settings.only is None else ["--only", settings.only]
    which += [] if settings.solver_mode is None else ["--solver-mode", settings.solver_mode]
    which += [] if settings.solver is None else ["--solver", settings.solver]
    results = ["--detections", str(out), "--out", str(out)]
    _step("master", "solve", recording, *calibration, *hand, *which, *results)
    return cast(dict[str, object], json.loads((out / "summary.json").read_text()))


def _recording_of(settings: ReplaySettings, notify: Callable[[str], None]) -> Path:
    """The recording, made of videos or pictures in OUT/recording if need be.

    Raises:
        ReplayError: Nothing is named, or the import failed.
    """
    paths, foreign = settings.paths, (*settings.cameras, settings.rig, settings.times)
    if not paths and not settings.cameras:
        raise ReplayError("replay: name a recording, or a video for each camera")
    manifest = paths[0] / "recording.json" if len(paths) == 1 and paths[0].is_dir() else None
    if manifest is not None and (manifest.is_symlink() or manifest.exists() or settings.calibration is None):
        if any(value is not None for value in foreign):
            raise ReplayError(f"--camera, --rig, --times: {paths[0]} is a recording, which has its own")
        return paths[0]
    if settings.calibration is None:
        raise ReplayError(
            "videos and pictures need --calibration DIR: lenses, places and colours of their cameras"
        )
    notify("reading the videos or pictures ...")
    made = settings.out / "recording"
    options = ["--calibration", str(settings.calibration), "-o", str(made)]
    options += [text for camera in settings.cameras for text in ("--camera", camera)]
    options += [] if settings.rig is None else ["--rig", settings.rig]
    options += [] if settings.times is None else ["--times", str(settings.times)]
    _step("slave", "import", *options, *("--", *map(str, paths)) * bool(paths))
    return made


@dataclass(frozen=True, slots=True)
class _Rig:
    """A rig of the recording, as far as it matters here."""

    kind: str
    cameras: list[str]


def _step(module: str, *arguments: str) -> None:
    done = subprocess.run([sys.executable, "-m", module, *arguments], check=False)
    if done.returncode != 0:
        raise ReplayError(f"phalanx-{module} {arguments[0]} ended with code {done.returncode}")


def _rigs(recording: Path, only: str | None) -> list[_Rig]:
    """The recording's rigs, those of markers before those of a wrist device; or those of one kind."""
    path = recording / "recording.json"
    kinds = ("markers", "wrist") if only is None else (only,)
    try:
        if path.resolve().parent != recording.resolve():
            raise ValueError(f"a link to {path.resolve()}")
        if path.stat().st_size > _MANIFEST_BYTES:
            raise ValueError(f"larger than {_MANIFEST_BYTES >> 20} MiB")
        manifest = json.loads(path.read_text())
        rigs = [rig for rig in (manifest.get("rig"), *(manifest.get("rigs") or ())) if rig is not None]
        found = [_Rig(rig["kind"], [_camera(name) for name in rig["cameras"]]) for rig in rigs]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ReplayError(f"{path}: not a recording of raw frames ({reason})") from error
    if wanted := sorted((rig for rig in found if rig.kind in kinds), key=lambda rig: rig.kind):
        return wanted
    raise ReplayError(f"{path}: no rig of kind {' or '.join(map(repr, kinds))}")


def _camera(name: object) -> str:
    """A name that goes into a command line and a file's name.

    Raises:
        ValueError: It is not plain.
    """
    if not isinstance(name, str) or not _PLAIN.fullmatch(name):
        raise ValueError(f"cameras: {name!r:.80}: must be letters, digits, _ . -, at most 64")
    return name
