"""The files of calibration that a recording carries, and the setups that are made of them again."""

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from common.errors import RecordingError
from common.recording import MessageRecording
from master.rig import RigSetup, load_setups
from master.tuning import RigFiles


def carried_files(files: RigFiles, setups: Sequence[RigSetup]) -> dict[str, bytes]:
    """All files that `setups` were read from, by their path in the calibration tree.

    A hand's file from elsewhere stands where the rig would have it.

    Raises:
        RecordingError: One cannot be read.
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
    """The names of the rigs as a recording keeps them: their order says which hand is the first."""
    return json.dumps(list(rigs))


def recorded_rigs(recording: MessageRecording) -> tuple[str, ...]:
    """The names of the rigs of a recording.

    Raises:
        RecordingError: It does not say.
    """
    try:
        rigs = json.loads(recording.about.get("rigs", ""))
    except ValueError:
        rigs = None
    if not isinstance(rigs, list) or not rigs:
        raise RecordingError(
            f"{recording.path}: does not say which rigs it is of; it was cut before its first message"
        )
    return tuple(str(rig) for rig in rigs)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]


def recorded_setups(recording: MessageRecording) -> tuple[RigSetup, ...]:
    """What watched each hand, from the files that the recording carries.

    Raises:
        RecordingError: It carries none.
        CalibrationError: They are broken.
    """
    rigs = recorded_rigs(recording)
    with tempfile.TemporaryDirectory(prefix="phalanx-") as folder:
        unpack(recording, Path(folder))
        return load_setups(Path(folder), rigs)


def unpack(recording: MessageRecording, folder: Path) -> None:
    """Write the files of a recording into a folder, as the calibration tree that they are.

    Raises:
        RecordingError: One would stand outside the folder, or cannot be written.
    """
    for name, data in recording.files.items():
        inside = PurePosixPath(name)
        if inside.is_absolute() or ".." in inside.parts or not inside.parts:
            raise RecordingError(f"{recording.path}: its file {name!r} would stand outside its folder")
        path = folder / inside
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        except OSError as error:
            raise RecordingError(f"{path}: cannot write: {error.strerror}") from error
