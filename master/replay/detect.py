"""Replay of the slaves' detection on a recording.

In every camera, as processes; then all cameras are solved together.

Videos and pictures of other programs become a recording before that, by `phalanx-slave record --from`.
"""

import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

from common.errors import RecordingError
from common.recording.frame_recording import MANIFEST, load_manifest, open_recording
from master.commands.terminal import progress
from master.replay.solve import rigs_to_solve, solve_hands
from master.rig.files import setups_with_hands

Notify = Callable[[str], None]


def replay_recording(options: Namespace, notify: Notify) -> None:
    """Detect, and solve what was detected.

    Raises:
        PhalanxError: The recording or a file is missing or broken, an option makes no sense for it, or a step failed
            (its own message is on standard error).
    """
    folder = _recording_of(options, notify)
    wanted = () if folder != _given(options) else options.rig
    manifest = load_manifest(folder)
    rigs = rigs_to_solve(manifest, wanted, options.only, options.solver_mode, options.solver)
    if options.hand is not None and not options.hand.is_file():  # reported now, not after all the detection
        raise RecordingError(f"{options.hand}: no such hand profile")
    out: Path = options.out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"--out {out}: cannot make the folder: {error.strerror}") from error
    if options.detections is None:
        for camera, kind in {camera: rig.kind for rig in rigs for camera in rig.cameras}.items():
            _detect(folder, camera, kind, options, notify)
    if options.detect_only:
        return
    notify("solving ...")
    recording = open_recording(folder)
    setups = setups_with_hands(rigs, manifest.cameras, options.calibration, options.hand, manifest.objects)
    found: Path = options.detections or out
    solve_hands(recording, setups, found, out, lambda done, total: progress("solving", done, total))


def _detect(folder: Path, camera: str, kind: str, options: Namespace, notify: Notify) -> None:
    notify(f"detecting {'markers' if kind == 'markers' else 'fingers'} in camera {camera} ...")
    words = ["--name", camera, "--camera", f"replay:{folder}"]
    words += [] if options.calibration is None else ["--calibration", str(options.calibration)]
    words += [] if options.hand is None or kind == "markers" else ["--hand", str(options.hand)]
    _slave("run", *words, "-o", str(options.out / f"detections_{camera}.npz"))


def _given(options: Namespace) -> Path | None:
    """The recording that was named; None: videos or pictures were."""
    paths: list[Path] = options.paths
    manifest = paths[0] / MANIFEST if len(paths) == 1 and paths[0].is_dir() else None
    if manifest is not None and (
        manifest.is_symlink()
        or manifest.exists()
        or options.calibration is None
        or options.detections is not None
    ):
        return paths[0]
    return None


def _recording_of(options: Namespace, notify: Notify) -> Path:
    """The recording, made of videos or pictures in OUT/recording if need be.

    Raises:
        RecordingError: Nothing is named, or the import failed.
    """
    if not options.paths and not options.camera:
        raise RecordingError("replay: name a recording, or a video for each camera")
    if (given := _given(options)) is not None:
        if options.camera or options.times is not None:
            raise RecordingError(f"--camera, --times: {given} is a recording, which has its own")
        return given
    if options.calibration is None:
        raise RecordingError(
            "videos and pictures need --calibration DIR: lenses, places and colours of their cameras"
        )
    if len(options.rig) > 1:
        raise RecordingError(f"--rig {' --rig '.join(options.rig)}: videos are of one rig")
    notify("reading the videos or pictures ...")
    made: Path = options.out / "recording"
    words = ["--calibration", str(options.calibration), "-o", str(made)]
    words += [word for rig in options.rig for word in ("--rig", rig)]
    words += [] if options.times is None else ["--times", str(options.times)]
    _slave("record", *words, "--from", *options.camera, *(str(path) for path in options.paths))
    return made


def _slave(*words: str) -> None:
    done = subprocess.run([sys.executable, "-m", "slave", *words], check=False)
    if done.returncode != 0:
        raise RecordingError(f"phalanx-slave {words[0]} ended with code {done.returncode}")
