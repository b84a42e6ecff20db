"""Recordings of messages: what was written is read, in its order, whole, cut at any place, or with flipped bytes."""

import errno
import os
import random
import struct
import subprocess
import sys
import zlib
from collections import Counter
from io import FileIO
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader

from common.errors import RecordingError
from common.messages import Health, Message, TagDetections, encode
from common.messages.streams import sender_of
from common.recording.messages import MessageRecording, MessageWriter, Recorded, open_messages
from tests.network_helpers import cycle, detections

FILES = {"rigs/desk.json": b'{"version": 1}', "cameras/left.json": b"{}"}
STEP_NS = 50_000_000
SUMMARY_START = 28  # bytes before the end: where the footer says where the summary begins
RECORD = struct.Struct("<BQ")  # what it is, and the length of what follows


def tags(seq: int, t_ns: int) -> TagDetections:
    return TagDetections(
        "left", 1, seq, t_ns, t_ns, np.array([3], np.uint16), np.ones((1, 4, 2)), np.array([0.1]), 0.0
    )


def recorded(count: int = 60, step_ns: int = STEP_NS) -> list[tuple[str, Message, int]]:
    """Stream, message and time of arrival; those of two threads are not quite in the order of their times."""
    out: list[tuple[str, Message, int]] = []
    for number in range(count):
        t_ns = 5_000_000_000 + number * step_ns
        kinds = [
            ("taken", detections("left", 1, number, t_ns)),
            ("taken", tags(number, t_ns)),
            ("taken", cycle("wrist", 1, number, t_ns)),
            ("health", Health("master", 7, t_ns, {"poses": number}, {"rate_hz": 60.0})),
        ]
        stream, message = kinds[number % 4]
        out.append((stream, message, t_ns - (number % 3) * 1000))
    return out


def few() -> list[tuple[str, Message, int]]:
    """In as many chunks as all, but quicker to read hundreds of times."""
    return recorded(18, 180_000_000)


def written(path: Path, messages: list[tuple[str, Message, int]]) -> bytes:
    writer = MessageWriter(path, FILES, {"rigs": '["desk"]'})
    for stream, message, t_ns in messages:
        writer.write(stream, message, t_ns)
    writer.close()
    writer.close()
    return path.read_bytes()


Plain = list[tuple[str, str, int, bytes]]


def plain(messages: list[tuple[str, Message, int]]) -> Plain:
    return [(stream, sender_of(message), t_ns, encode(message)) for stream, message, t_ns in messages]


def same(read: list[Recorded], messages: Plain) -> bool:
    """Whether these are the first of those, to the last bit."""
    return [(one.stream, one.name, one.t_ns, encode(one.message)) for one in read] == messages[: len(read)]


def test_what_was_written_is_read_in_its_order(tmp_path: Path) -> None:
    messages = recorded()
    written(tmp_path / "a.mcap", messages)
    recording = open_messages(tmp_path / "a.mcap")
    assert not recording.cut
    assert recording.broken == 0
    assert recording.files == FILES
    assert recording.about["rigs"] == '["desk"]'
    assert {"wire", "program", "started"} <= recording.about.keys()
    assert recording.counts == Counter(stream for stream, _, _ in messages)
    assert recording.senders["taken"] == {"left": 30, "wrist": 15}
    assert recording.begin_t_ns == min(t_ns for _, _, t_ns in messages)
    assert recording.end_t_ns == max(t_ns for _, _, t_ns in messages)
    read = list(recording.read())
    assert len(read) == len(messages)
    assert same(read, plain(messages))


def test_a_stretch_and_some_streams_can_be_read_alone(tmp_path: Path) -> None:
    messages = recorded()
    written(tmp_path / "a.mcap", messages)
    recording = open_messages(tmp_path / "a.mcap")
    first, last = recording.begin_t_ns + 700_000_000, recording.begin_t_ns + 1_400_000_000
    wanted = [one for one in messages if one[0] == "taken" and first <= one[2] <= last]
    read = list(recording.read(["taken"], first, last))
    assert len(read) == len(wanted) > 5
    assert same(read, plain(wanted))
    assert list(recording.read(["hand"])) == []
    assert list(recording.read(from_t_ns=recording.end_t_ns + 1)) == []


def test_a_stranger_reads_it_too(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap", recorded(8))
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [(schema, channel) for schema, channel, _ in reader.iter_messages(log_time_order=False)]
        assert [one.name for one in reader.iter_attachments()] == list(FILES)
    schemas = {schema.name: schema for schema, _ in found if schema is not None}
    assert {channel.topic for _, channel in found} == {
        "phalanx/taken/left",
        "phalanx/taken/wrist",
        "phalanx/health/master",
    }
    assert {channel.message_encoding for _, channel in found} == {"msgpack"}
    assert schemas.keys() == {"MarkerDetections", "TagDetections", "WristDetections", "Health"}
    assert b"Middle of the exposure of row 0" in schemas["MarkerDetections"].data


def read_what_is_there(path: Path) -> tuple[MessageRecording, list[Recorded]] | None:
    """None: it is no recording at all."""
    try:
        recording = open_messages(path)
    except RecordingError:
        return None
    return recording, list(recording.read())


def test_a_file_cut_anywhere_reads_up_to_the_cut(tmp_path: Path) -> None:
    messages, path = few(), tmp_path / "cut.mcap"
    data, expected = written(path, messages), plain(messages)
    cuts = sorted(random.Random(10).sample(range(len(data)), 250), reverse=True)
    header = 17 + int.from_bytes(data[9:17], "little")  # magic, opcode and length; what it says
    had = len(messages)
    for cut in cuts:
        os.truncate(path, cut)
        found = read_what_is_there(path)
        if found is None:
            assert cut < header, "only a file without a whole beginning is none"
            continue
        recording, read = found
        assert recording.cut
        assert recording.broken == 0, "a record that is not whole is no broken record"
        assert same(read, expected)
        assert sum(recording.counts.values()) == len(read) <= had
        had = len(read)
    assert had == 0


def test_a_cut_costs_about_half_a_second(tmp_path: Path) -> None:
    messages = recorded()
    data = written(tmp_path / "a.mcap", messages)
    writer = MessageWriter(tmp_path / "b.mcap", FILES)
    for stream, message, t_ns in messages:
        writer.write(stream, message, t_ns)
    # As after `kill -9`: nothing is closed.
    recording = open_messages(tmp_path / "b.mcap")
    assert recording.cut
    assert messages[-1][2] - recording.end_t_ns <= 0.6e9
    assert (tmp_path / "b.mcap").stat().st_size < len(data)
    writer.close()


def test_flipped_bytes_cost_what_they_hit_and_no_more(tmp_path: Path) -> None:
    messages, path = few(), tmp_path / "flipped.mcap"
    data = written(path, messages)
    bytes_of = Counter(encode(message) for _, message, _ in messages)
    chance = random.Random(11)
    most = 0
    for _ in range(200):
        broken = bytearray(data)
        for _ in range(chance.choice([1, 1, 1, 20])):
            broken[chance.randrange(len(broken))] ^= 1 << chance.randrange(8)
        path.write_bytes(broken)
        if (found := read_what_is_there(path)) is None:
            continue
        recording, read = found
        assert all(bytes_of[encode(one.message)] for one in read), "never a message that was not written"
        for name, content in recording.files.items():
            assert FILES.get(name, content) == content
        most = max(most, len(messages) - len(read))
    assert most > 0, "no flip has hit anything: the check would pass on nothing"


def test_a_footer_that_points_nowhere_is_none(tmp_path: Path) -> None:
    data, expected = bytearray(written(tmp_path / "a.mcap", few())), plain(few())
    begin = len(data) - SUMMARY_START
    (start,) = struct.unpack_from("<Q", data, begin)
    for bit in range(64):
        struct.pack_into("<Q", data, begin, start ^ 1 << bit)
        (tmp_path / "b.mcap").write_bytes(data)
        recording = open_messages(tmp_path / "b.mcap")
        assert recording.cut, bit
        assert same(list(recording.read()), expected), bit


def test_an_index_that_points_nowhere_costs_its_chunk_though_its_sum_is_right(tmp_path: Path) -> None:
    data = bytearray(written(tmp_path / "a.mcap", few()))
    footer = len(data) - SUMMARY_START
    (begin,) = struct.unpack_from("<Q", data, footer)
    at = begin
    while (row := RECORD.unpack_from(data, at))[0] != Opcode.CHUNK_INDEX:
        at += RECORD.size + row[1]
        assert at < footer - RECORD.size, "no chunk stands in the index"
    for offset, length in product(
        (0, 2**31, 2**63 - 1, 2**63, 2**64 - 1), (0, 8, 9, 2**40, 2**63, 2**64 - 1)
    ):
        struct.pack_into("<QQ", data, at + RECORD.size + 16, offset, length)  # behind its two times
        struct.pack_into("<I", data, footer + 16, zlib.crc32(data[begin : footer + 16]))
        (tmp_path / "b.mcap").write_bytes(data)
        recording = open_messages(tmp_path / "b.mcap")
        assert not recording.cut
        read = list(recording.read())
        assert recording.broken == 1, (offset, length)
        assert 0 < len(read) < len(few())


@pytest.mark.parametrize(
    "content", [b"", b"\x89MCAP0\r\n", b"PK\x03\x04" * 30, b"\x89MCAP0\r\n" + b"\0" * 99]
)
def test_what_is_no_recording_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match=r"x\.mcap"):
        open_messages(tmp_path / "x.mcap")


def test_a_missing_file_and_one_that_is_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot read"):
        open_messages(tmp_path / "none.mcap")
    (tmp_path / "a.mcap").touch()
    with pytest.raises(RecordingError, match="is there already"):
        MessageWriter(tmp_path / "a.mcap", {})
    with pytest.raises(RecordingError, match="cannot write"):
        MessageWriter(tmp_path / "no" / "a.mcap", {})


@pytest.mark.parametrize(
    "name", ["../desk.json", "rigs/a/desk.json", "rigs/\0.json", "rigs/...json", "desk.json"]
)
def test_what_could_not_be_read_again_is_not_written(name: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"must be FOLDER/NAME\.json"):
        MessageWriter(tmp_path / "a.mcap", {name: b"{}"})
    assert not list(tmp_path.iterdir())


class SmallDisk:
    """A file that takes so many bytes, and the last write only in part, as a disk that fills does."""

    def __init__(self, path: Path, room: int) -> None:
        self._file, self._room = path.open("xb", buffering=0), room

    def write(self, data: bytes, /) -> int:
        if self._room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        count = self._file.write(data[: self._room])
        self._room -= count
        return count

    def close(self) -> None:
        self._file.close()


def test_a_full_disk_ends_the_file_and_leaves_what_was_written(tmp_path: Path) -> None:
    messages, path = recorded(), tmp_path / "full.mcap"
    writer = MessageWriter(path, FILES, open_disk=lambda where: cast(FileIO, SmallDisk(where, 6000)))

    def write_all() -> None:
        for stream, message, t_ns in messages:
            writer.write(stream, message, t_ns)

    with pytest.raises(RecordingError, match="No space left on device"):
        write_all()
    with pytest.raises(ValueError, match="is closed"):
        writer.write(*messages[0])
    writer.close()
    recording = open_messages(path)
    read = list(recording.read())
    assert recording.cut
    assert len(read) > 10
    assert same(read, plain(messages))
    assert path.stat().st_size < 6000, "the chunk that did not fit was taken back"


LIMITED = """
import sys, resource, signal
from pathlib import Path
from common.errors import RecordingError
from common.recording.messages import MessageWriter
from tests.common.recording.test_recording import FILES, recorded
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))
writer = MessageWriter(Path(sys.argv[1]), FILES)
try:
    for stream, message, t_ns in recorded():
        writer.write(stream, message, t_ns)
except RecordingError as error:
    print(error)
"""


def test_a_limit_of_the_system_ends_it_in_the_same_way(tmp_path: Path, root: Path) -> None:
    path = tmp_path / "limited.mcap"
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(path)], cwd=root, capture_output=True, text=True, check=False
    )
    assert "limited.mcap: cannot write any more: File too large" in done.stdout, done.stderr
    assert same(list(open_messages(path).read()), plain(recorded()))
