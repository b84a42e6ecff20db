"""Any recording at all: what is not ours is refused or counted, whatever its records, messages and bytes say."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import msgspec
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Channel

from common.errors import PhalanxError
from common.messages import MAX_STILL_BYTES, Backlog, MarkerDetections, Message, Still, encode
from common.messages.parts import MAX_TIME_NS
from common.messages.streams import STREAMS, sender_of
from common.recording.mcap_file import BOUNDS, CHUNK_RECORDS
from common.recording.messages import MessageWriter, open_messages
from master.recording.export.run import Wanted, export
from master.recording.files import recorded_setups
from master.recording.lines import events_of, table
from master.recording.player import Player
from tests.common.hostile_mcap import RECORD, HostileMcap, chunk, message, record
from tests.master.recording.export.made import poses_of, results
from tests.master.recording.recorded_run import report, scene

MOST_S = 5.0  # of processor time for some kB
NUMBERS = st.sampled_from([0, 1, 8, 22, 31, 2**31, 2**32 - 1, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1])
TEXTS = st.sampled_from(
    ["", "left", "..", "../x", "a/b", "\0", "\x1b[2J", "x" * 5000, "[" * 5000, '["desk"]', "é"]
)
VALUES: st.SearchStrategy[Any] = st.one_of(
    NUMBERS,
    st.sampled_from([-1, -(2**63), 1e300, -1e300, float("nan"), float("inf"), None, True, [], {}, [[[[]]]]]),
    TEXTS,
    st.sampled_from(
        [b"", b"\xff" * 8, b"\x7f" * 4096, np.full(48, 1e300).tobytes(), np.full(6, -1.0).tobytes()]
    ),
)
NESTED = st.sampled_from(
    [b"\x91" * 3000, b"\x81\xa1a" * 3000, b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"]
)


def seldom(honest: Any, hostile: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Mostly what is honest, so that what else is hostile is reached."""
    return st.integers(0, 11).flatmap(lambda chance: hostile if chance == 7 else st.just(honest))


def honest() -> list[tuple[str, Message]]:
    """One message or more of each stream that a recording keeps and a command reads."""
    kinds = {row.message: stream for stream, row in STREAMS.items()}
    own: list[Message] = [report(10**9), *poses_of(1, 2), *results("made-right")]
    taken: list[tuple[str, Message]] = [("taken", one) for one in scene()[:4]]
    return taken + [(kinds[type(one)], one) for one in own]


HONEST = honest()


@st.composite
def messages(draw: st.DrawFn) -> tuple[Channel, bytes]:
    """The channel of an honest message, and its record with a field, a length or a time of another kind."""
    stream, one = draw(st.sampled_from(HONEST))
    own = HONEST.index((stream, one)) + 1
    data = msgspec.msgpack.decode(encode(one))
    for key in draw(st.lists(st.sampled_from(sorted(data)), max_size=2)):
        data[key] = draw(VALUES)
    content = msgspec.msgpack.encode(data)
    names = {
        "stream": draw(seldom(stream, st.sampled_from(sorted(STREAMS)))),
        "name": draw(seldom(sender_of(one), TEXTS)),
    }
    row = Channel(own, "topic", "msgpack", names, 0)
    body = draw(seldom(content, NESTED | st.binary(max_size=40)))
    return row, record(message(body, draw(seldom(10**9 + own, NUMBERS)), own))


@st.composite
def files(draw: st.DrawFn) -> bytes:
    """A whole or cut file of such messages, whose sizes, times and counts may lie, with flipped bytes or none."""
    mcap = HostileMcap()
    for key in draw(st.lists(st.sampled_from(["rigs", "raw", "wire"]), max_size=2)):
        mcap.about({key: draw(TEXTS)})
        mcap.attach(draw(seldom("rigs/desk.json", TEXTS)), draw(st.binary(max_size=40)))
    for _ in range(draw(st.integers(1, 3))):
        rows = draw(st.lists(messages(), min_size=1, max_size=6))
        content = b"".join(record(row) + data for row, data in rows)
        content += draw(seldom(b"", st.sampled_from([b"\5", RECORD.pack(5, 2**63), RECORD.pack(7, 0) * 99])))
        size, kind = draw(seldom(None, NUMBERS)), draw(seldom("zstd", st.sampled_from(["", "lz4"])))
        times = draw(seldom((10**9, 2 * 10**9), st.sampled_from([(0, 2**64 - 1), (2**62, 0)])))
        again = draw(seldom(1, st.integers(0, 3)))
        mcap.add(chunk(content, *times, compression=kind, size=size), [row for row, _ in rows], again)
    counts = draw(seldom({}, st.dictionaries(st.integers(0, 65_535), NUMBERS, max_size=4)))
    data = bytearray(mcap.ended(dict.fromkeys(range(12), 1) | counts) if draw(st.booleans()) else mcap.cut())
    for at in draw(seldom([], st.lists(st.integers(8, len(data) - 1), max_size=3))):
        data[at] ^= 1 << draw(st.integers(0, 7))
    return bytes(data)


def shown(path: Path) -> None:
    recording = open_messages(path)
    for line in table(recording, events_of(recording)):
        assert line.isprintable()
    for one in recording.read():
        assert isinstance(one.message, STREAMS[one.stream].message)
        assert (one.name, abs(one.t_ns) <= MAX_TIME_NS) == (sender_of(one.message), True)
        assert abs(getattr(one.message, "t_ns", 0)) <= MAX_TIME_NS


def played(path: Path) -> None:
    recording = open_messages(path)
    Player(recording, (), [], solved=True).run()
    with suppress(PhalanxError):
        recorded_setups(recording)


def exported(path: Path) -> None:
    export(path, Wanted("csv", path.parent), print_nothing, print_nothing)


def print_nothing(*_: object) -> None:
    """In place of a person."""


def spent_s(read: Callable[[Path], None], path: Path) -> float:
    """Processor time of a command's work, which may refuse the file and do nothing else."""
    before = time.process_time()
    with suppress(PhalanxError):
        read(path)
    return time.process_time() - before


@settings(max_examples=120)
@given(data=files())
def test_any_file_is_refused_or_its_losses_are_counted(data: bytes) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.mcap"
        path.write_bytes(data)
        for read in (shown, played, exported):
            assert spent_s(read, path) < MOST_S
        assert {one.suffix for one in Path(folder).rglob("*")} <= {".mcap", ".csv"}


def test_what_we_write_ourselves_is_within_all_bounds(tmp_path: Path) -> None:
    nothing, none = np.full((48, 2), np.nan), np.full(48, np.nan)
    blind = MarkerDetections("left", 1, 0, 0, 0, nothing, none, none, none, nothing)
    jpeg = cv2.imencode(".jpg", np.zeros((480, 640), np.uint8))[1].tobytes()
    still = Still("left", 0, 0, jpeg.ljust(MAX_STILL_BYTES, b"\0"))
    for kind, one, count in (
        ("taken", blind, 3000),
        ("taken", Backlog("m", 0, 0), 60_000),
        ("still", still, 20),
    ):
        path = tmp_path / f"{type(one).__name__}.mcap"
        writer = MessageWriter(path, {})
        for _ in range(count):
            writer.write(kind, one, 0)  # all alike, at one instant: nothing can be packed closer
        writer.close()
        recording = open_messages(path)
        assert sum(1 for _ in recording.read()) == count
        assert (recording.broken, recording.cut) == (0, False)


def test_a_chunk_at_a_bound_is_read_and_one_beyond_is_lost(tmp_path: Path) -> None:
    row = Channel(1, "topic", "msgpack", {"stream": "health", "name": "master"}, 0)
    first = record(row) + record(message(encode(report(1))))
    room = BOUNDS.chunk_bytes - len(first) - RECORD.size
    for more, read in (
        (RECORD.pack(99, room) + bytes(room), 1),
        (RECORD.pack(99, room + 1) + bytes(room + 1), 0),
    ):
        assert read_of(tmp_path, first + more) == (read, 1 - read)
    empty = RECORD.pack(99, 0)
    for count, read in ((CHUNK_RECORDS - 2, 1), (CHUNK_RECORDS - 1, 0)):
        assert read_of(tmp_path, first + empty * count) == (read, 1 - read)


def read_of(folder: Path, content: bytes) -> tuple[int, int]:
    """Messages and losses of a file with one chunk of this content."""
    path = folder / "x.mcap"
    path.write_bytes(HostileMcap().add(chunk(content)).cut())
    recording = open_messages(path)
    return sum(1 for _ in recording.read()), recording.broken
