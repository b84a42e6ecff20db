"""A recording that another writer of MCAP has written anew, with chunks of its own size, loses nothing."""

from collections.abc import Sequence
from pathlib import Path

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from common.messages import Backlog, Message, encode
from common.recording.messages import MessageWriter, open_messages
from tests.common.hostile_mcap import TINY, HostileMcap, streamed
from tests.master.recording.export.made import poses_of

TARGET = 4 << 20  # the largest that a tool has by default
MOST_OVER = 1 << 20

POSES = poses_of(1, 4)
MESSAGES: dict[str, tuple[str, Sequence[Message]]] = {
    "hands": ("hand", POSES),
    "the smallest": ("taken", [Backlog("m", 0, 0)]),
}


def written(path: Path, stream: str, messages: Sequence[Message], count: int) -> Path:
    writer = MessageWriter(path, {"rigs/desk.json": b"{}"})
    for k in range(count):
        writer.write(stream, messages[k % len(messages)], 1_000_000_000 + k * 100_000)
    writer.close()
    return path


def rewritten(path: Path, out: Path) -> list[Chunk]:
    """Copy a recording with the writer of the library, and return its chunks."""
    with path.open("rb") as file, out.open("wb") as target:
        reader, writer = make_reader(file), Writer(target, TARGET)
        writer.start("phalanx")
        for one in reader.iter_metadata():
            writer.add_metadata(one.name, one.metadata)
        for one in reader.iter_attachments():
            writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        channels: dict[int, int] = {}
        for _, channel, one in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, 0, channel.metadata
                )
            writer.add_message(channels[channel.id], one.log_time, one.data, one.publish_time, one.sequence)
        writer.finish()
    with out.open("rb") as file:
        return [one for one in StreamReader(file, emit_chunks=True).records if isinstance(one, Chunk)]


@pytest.mark.parametrize("name", MESSAGES)
def test_chunks_of_four_mebibytes_and_a_message_are_read(name: str, tmp_path: Path) -> None:
    stream, messages = MESSAGES[name]
    count = TARGET // (TINY + min(len(encode(one)) for one in messages)) + 100  # one full chunk, and a little
    out = tmp_path / "rewritten.mcap"
    chunks = rewritten(written(tmp_path / "own.mcap", stream, messages, count), out)
    assert any(TARGET < one.uncompressed_size <= TARGET + MOST_OVER for one in chunks), "no full chunk"
    recording = open_messages(out)
    assert (recording.cut, recording.counts) == (False, {stream: count})
    assert list(recording.files) == ["rigs/desk.json"]
    assert sum(1 for _ in recording.read()) == count
    assert recording.broken == 0
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(out.read_bytes()[:-100])
    recording = open_messages(cut)
    assert sum(1 for _ in recording.read()) == count
    assert (recording.cut, recording.broken) == (True, 0)


def test_frames_that_do_not_say_their_size_are_read(tmp_path: Path) -> None:
    first, *_ = rewritten(written(tmp_path / "own.mcap", "hand", POSES, 2000), tmp_path / "rewritten.mcap")
    again = streamed(zstandard.decompress(first.data), first.uncompressed_size)
    assert zstandard.frame_content_size(again.data) == -1
    path = tmp_path / "streamed.mcap"
    path.write_bytes(HostileMcap().add(again).cut())
    recording = open_messages(path)
    assert sum(1 for _ in recording.read()) > 100
    assert recording.broken == 0
