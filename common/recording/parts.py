"""What may stand in a recording of messages.

Its names lead no path elsewhere, and its messages fit their channel.

Names come from the file and become names of files. They are checked once, where a recording is opened or begun.
"""

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

import msgspec
from mcap.records import Channel

from common.calibration.plain_names import PLAIN, is_plain
from common.errors import RecordingError
from common.messages import AnyMessage, Message
from common.messages.parts import MAX_TIME_NS
from common.messages.sensed import Detections, ImuSample, TagDetections, TrackerPose
from common.messages.state import Backlog
from common.messages.streams import STREAMS, sender_of
from common.recording.mcap_bounds import BOUNDS


def check_files(where: Path, files: Mapping[str, bytes]) -> None:
    """Refuse files of calibration that are not FOLDER/NAME.json, or too large.

    Raises:
        RecordingError: Naming recording and file.
    """
    for name, data in files.items():
        folder, slash, file = name.partition("/")
        if not (
            is_plain(folder) and slash and file.endswith(".json") and is_plain(file.removesuffix(".json"))
        ):
            raise RecordingError(f"{where}: its file {name!r}: must be FOLDER/NAME.json, each name {PLAIN}")
        if len(data) > BOUNDS.attachment_bytes:
            raise RecordingError(
                f"{where}: its file {name!r}: {len(data)} bytes, at most {BOUNDS.attachment_bytes}"
            )
    if len(files) > BOUNDS.attachments:
        raise RecordingError(f"{where}: {len(files)} files of calibration, at most {BOUNDS.attachments}")


def channel_names(where: Path, channels: Iterable[Channel]) -> dict[int, tuple[str, str]]:
    """Number of each channel of ours -> its stream and sender.

    Raises:
        RecordingError: One of these is no plain name.
    """
    found: dict[int, tuple[str, str]] = {}
    for one in channels:
        if not {"stream", "name"} <= one.metadata.keys():
            continue  # somebody else's
        found[one.id] = one.metadata["stream"], one.metadata["name"]
        for key, name in zip(("stream", "name"), found[one.id], strict=True):
            if not is_plain(name):
                raise RecordingError(f"{where}: channel {one.id}: {key}: {name[:80]!r}: must be {PLAIN}")
    return found


def plain_names(where: Path, key: str, text: str) -> tuple[str, ...]:
    """The names in a JSON list, as `key` of the metadata has it.

    Raises:
        RecordingError: It is no such list, or one is no plain name.
    """
    try:
        names = msgspec.json.decode(text, type=tuple[str, ...])
    except (msgspec.DecodeError, RecursionError) as error:
        raise RecordingError(f"{where}: metadata: {key}: must be a list of names: {error}") from error
    for name in names:
        if not is_plain(name):
            raise RecordingError(f"{where}: metadata: {key}: {name[:80]!r}: must be {PLAIN}")
    return names


def refuse_misplaced(stream: str, name: str, message: AnyMessage) -> None:
    """Refuse a message that its channel cannot have.

    It is of another kind or sender, or of a time that cannot be.

    Raises:
        RecordingError: The message states what, not where.
    """
    if not isinstance(message, _kinds(stream)) or sender_of(message) != name:
        raise RecordingError(
            f"{type(message).__name__} of {sender_of(message)!r} on the channel {stream} of {name!r}"
        )
    for key in _times(type(message)):
        if abs(getattr(message, key)) > MAX_TIME_NS:
            raise RecordingError(f"{key}: {getattr(message, key)}: must be -{MAX_TIME_NS} to {MAX_TIME_NS}")


@cache
def _kinds(stream: str) -> tuple[type[Message], ...]:
    """The types of the messages on a stream; any, where we do not know it."""
    if stream == "taken":
        return (*Detections.__args__, TagDetections, TrackerPose, ImuSample, Backlog)
    return (STREAMS[stream].message if stream in STREAMS else Message,)


@cache
def _times(kind: type[Message]) -> tuple[str, ...]:
    return tuple(one.name for one in msgspec.structs.fields(kind) if one.name.endswith("t_ns"))
