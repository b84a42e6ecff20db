"""Calibration files that a recording carries, and the setups rebuilt from them."""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

from common.errors import RecordingError
from common.recording.messages import MessageRecording, plain_names
from master.rig.setup import RigFiles, RigSetup, load_setups


def carried_files(files: RigFiles, setups: Sequence[RigSetup]) -> dict[str, bytes]:
    """All files that `setups` were read from, by their path in the calibration tree.

    A hand's file from elsewhere stands where the rig would have it. RecordingError: one cannot be read.
    """
    found: dict[str, bytes] = {}
    for path in files.paths(setups):
        if path == files.hand:
            names = [f"hands/{setup.rig.hand}.json" for setup in setups]
        else:
            names = [path.relative_to(files.calibration).as_posix()]
        if not path.exists():
            continue  # gestures need no file
        try:
            data = path.read_bytes()
        except OSError as error:
            raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
        found |= dict.fromkeys(names, data)
    return found


def rigs_text(rigs: Sequence[str]) -> str:
    """Return the names of the rigs as a recording stores them, the first hand first."""
    return json.dumps(list(rigs))


def recorded_rigs(recording: MessageRecording) -> tuple[str, ...]:
    """Rigs of a recording; RecordingError: not stated, or one is no plain name."""
    text = recording.about.get("rigs")
    rigs = plain_names(recording.path, "rigs", text) if text is not None else ()
    if not rigs:
        raise RecordingError(
            f"{recording.path}: does not say which rigs it is of; it was cut before its first message"
        )
    return rigs


def recorded_setups(recording: MessageRecording) -> tuple[RigSetup, ...]:
    """Setups from the files that a recording carries; RecordingError: it has none."""
    rigs = recorded_rigs(recording)
    with tempfile.TemporaryDirectory(prefix="phalanx-") as folder:
        unpack(recording, Path(folder))
        return load_setups(Path(folder), rigs)


def unpack(recording: MessageRecording, folder: Path) -> None:
    """Write a recording's files, of checked names, into a folder; RecordingError."""
    for name, data in recording.files.items():
        path = folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except OSError as error:
            raise RecordingError(f"{path}: cannot write: {error.strerror}") from error
