"""Recordings made to harm: each command ends by itself, says why in a line, and reads nothing outside of the file."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.messages import Health, MarkerDetections, Message, encode
from common.messages.parts import MAX_TIME_NS
from common.messages.streams import sender_of
from common.recording.mcap_file import BOUNDS, CHUNK_RECORDS
from master.recording.files import carried_files
from master.rig.setup import RigFiles
from tests.commands import command
from tests.common.hostile_mcap import (
    HostileMcap,
    channel,
    chunk,
    message,
    record,
    streamed,
    tiny_messages,
    wide_channel,
)
from tests.master.recording.export.made import RIGHT, poses_of
from tests.master.recording.recorded_run import scene

SECRET = "secret-of-another-folder"
SMALL = 85_000  # bytes of a file that must not cost much
MOST_S = 2.0  # of processor time for such a file; before there was any bound it was 90 s
INFO, PLAY, EXPORT = ("info",), ("play", "--no-bus", "--speed", "max"), ("export", "--to", "csv")
PACED = ("play", "--no-bus")
DESK = {"rigs": '["desk"]'}
LATE_NS = 4_000_000


@dataclass(frozen=True)
class Made:
    """Where an attack is made, and the files of calibration of an honest rig."""

    folder: Path
    files: dict[str, bytes]

    @property
    def outside(self) -> str:
        """As a rig's name: a rig in another folder, whose hand is called as the secret."""
        rig = msgspec.json.decode(self.files["rigs/desk.json"], type=dict[str, object])
        (self.folder / "planted.json").write_bytes(msgspec.json.encode(rig | {"hand": SECRET}))
        for part in ("cameras", "hands"):
            (self.folder.parent / part).mkdir(exist_ok=True)
        return "../" * 12 + str(self.folder / "planted").lstrip("/")

    def mcap(self, **about: str) -> HostileMcap:
        """A file with the honest calibration, and what it says of itself."""
        made = HostileMcap().about(DESK | about)
        for name, data in self.files.items():
            made.attach(name, data)
        return made

    def taken(self, *messages: tuple[Message, int], stream: str = "taken") -> bytes:
        """A file of these messages, with their log times."""
        names = dict.fromkeys(sender_of(output) for output, _ in messages)
        numbers = {name: number for number, name in enumerate(names, start=1)}
        channels = [channel(number, stream, name) for name, number in numbers.items()]
        content = b"".join(map(record, channels)) + b"".join(
            record(message(encode(output), t_ns, numbers[sender_of(output)])) for output, t_ns in messages
        )
        times = [t_ns for _, t_ns in messages]
        counts = dict.fromkeys(numbers.values(), len(messages) // len(numbers))
        return self.mcap().add(chunk(content, min(times), max(times)), channels).ended(counts)

    def poses(self) -> bytes:
        """Four poses of a hand, the last two a hundred years after the first."""
        poses, years_ns = poses_of(1, 4), MAX_TIME_NS - 10**12
        late = [msgspec.structs.replace(one, t_ns=one.t_ns + years_ns) for one in poses[2:]]
        own = Made(self.folder, self.files | {"hands/made-right.json": msgspec.json.encode(RIGHT.profile)})
        return own.taken(*((one, one.t_ns + LATE_NS) for one in (*poses[:2], *late)), stream="hand")

    def frames(self) -> list[tuple[MarkerDetections, int]]:
        """What two honest cameras saw, with log times."""
        return [(one, one.t_ns + LATE_NS) for one in scene()]


def seen(mcap: HostileMcap) -> bytes:
    """The file with one chunk of nothing behind what it has."""
    one = channel(1, "taken", "left")
    return mcap.add(chunk(record(one) + record(message(b"\x80"))), [one]).ended({1: 1})


def bomb(mcap: HostileMcap, content: bytes, times: int = 1) -> HostileMcap:
    """The file, filled up with chunks of this content that stand in its index as many times each."""
    one = chunk(content)
    while len(mcap.data) + len(mcap.index) < SMALL - len(one.data) - 120 * times:
        mcap.add(one, [channel()], times)
    return mcap


def named(name: str) -> bytes:
    """A file with a sender of this name."""
    one = channel(1, "hand", name)
    return HostileMcap().about(DESK).add(chunk(record(one) + record(message(b"\x80"))), [one]).ended({1: 1})


def jumped(made: Made, to_ns: int) -> bytes:
    """Honest frames, of which the second half comes at another time."""
    frames = made.frames()
    half = len(frames) // 2
    return made.taken(*frames[:half], *((one, to_ns + k) for k, (one, _) in enumerate(frames[half:])))


FULL = record(channel()) + record(message(b"")) * (CHUNK_RECORDS - 1)  # as many as a chunk may have
WIDE = record(channel()) + record(message(b"\xc4" * (1 << 20), number=1)) * 3  # and as much
WIDE_CHANNEL = record(wide_channel(370)) * 1030 + record(message(b""))
WIDE_CHANNELS = b"".join(record(wide_channel(370, number)) for number in range(1030))
MANY_KEYS = {f"{key:04x}": "" for key in range(1250)}  # 15 kB

ATTACKS: dict[str, tuple[Callable[[Made], bytes], dict[tuple[str, ...], str]]] = {
    "rig of NUL": (
        lambda made: seen(made.mcap(rigs='["a\\u0000b"]')),
        {PLAY: r"metadata: rigs: 'a\\x00b': must be letters", EXPORT: "nothing to export", INFO: "taken"},
    ),
    "rig outside": (
        lambda made: seen(made.mcap(rigs=json.dumps([made.outside]))),
        {PLAY: r"metadata: rigs: '\.\./", ("export", "--to", "rrd"): ""},
    ),
    "rigs nested": (lambda made: seen(made.mcap(rigs="[" * 9000)), {PLAY: "rigs: must be a list of names"}),
    "rigs of an escape": (
        lambda made: seen(made.mcap(rigs='["\x1b[2J"]')),
        {INFO: "metadata at byte .*: not printable"},
    ),
    "raw nested": (
        lambda made: seen(made.mcap(raw='{"left":' * 1500)),
        {INFO: "raw frames: the file does not say where they are"},
    ),
    "metadata huge": (lambda made: seen(made.mcap(note="x" * 80_000)), {INFO: "metadata at byte .* 80"}),
    "file of NUL": (
        lambda made: seen(made.mcap().attach("rigs/\0.json", b"{}")),
        {PLAY: r"its file 'rigs/\\x00.json'"},
    ),
    "file outside": (
        lambda made: seen(made.mcap().attach("../../out.json", b"{}")),
        {PLAY: r"its file '\.\./\.\./out\.json': must be FOLDER/NAME\.json"},
    ),
    "file nested": (
        lambda made: seen(HostileMcap().about(DESK).attach("rigs/desk.json", b"[" * 100_000)),
        {PLAY: "desk.json"},
    ),
    "files without end": (
        lambda made: seen(bomb_of_files(made)),
        {INFO: "attachment at byte .* there are 256 already"},
    ),
    "sender outside": (lambda _: named("../../x"), {EXPORT: r"channel 1: name: '\.\./\.\./x'"}),
    "sender of NUL": (lambda _: named("left\0"), {INFO: r"channel 1: name: 'left\\x00'"}),
    "sender of an escape": (lambda _: named("\x1b]0;x\x07"), {INFO: r"channel 1: name: '\\x1b"}),
    "metadata often in the index": (
        lambda made: seen(made.mcap().note("phalanx", MANY_KEYS, 2000)),
        {INFO: "metadata at byte .* there are 16 already"},
    ),
    "a chunk of wide channels": (
        lambda _: bomb(HostileMcap().about(DESK), WIDE_CHANNEL).cut(),
        {INFO: "more than a file of this size can hold"},
    ),
    "a chunk of wide channels, none twice": (
        lambda _: bomb(HostileMcap().about(DESK), WIDE_CHANNELS).cut(),
        {INFO: "more than 1024 channels"},
    ),
    "channels too wide": (
        lambda _: bomb(HostileMcap().about(DESK), record(wide_channel(500)) + record(message(b""))).cut(),
        {INFO: r"chunk at byte \d+: a channel of \d+ bytes, at most 4096"},
    ),
    "channels without end": (lambda _: many_channels(), {INFO: "more than 1024 channels"}),
    "64 MiB of tiny messages": (
        lambda _: bomb(HostileMcap().about(DESK), tiny_messages(63 << 20)).ended({1: 1}),
        {INFO: rf"chunk at byte \d+: 660\d+ bytes unpacked, at most {BOUNDS.chunk_bytes}"},
    ),
    "64 MiB of tiny messages, cut": (
        lambda _: bomb(HostileMcap().about(DESK), tiny_messages(63 << 20)).cut(),
        {INFO: "bytes unpacked, at most"},
    ),
    "full chunks": (
        lambda _: bomb(HostileMcap().about(DESK), FULL).cut(),
        {INFO: "more than a file of this size can hold"},
    ),
    "wide chunks, each often in the index": (
        lambda _: bomb(HostileMcap().about(DESK), WIDE, 100).ended({1: 1}),
        {INFO: "more than a file of this size can hold"},
    ),
    "one chunk too full": (
        lambda _: bomb(HostileMcap().about(DESK), FULL + record(message(b""))).cut(),
        {INFO: f"more than {CHUNK_RECORDS} records"},
    ),
    "a size that lies": (
        lambda _: HostileMcap().about(DESK).add(chunk(bytes(1 << 20), size=100), [channel()]).cut(),
        {INFO: "claims 100 bytes unpacked, its data 1048576"},
    ),
    "a size that lies of a frame that does not say its own": (
        lambda _: HostileMcap().about(DESK).add(streamed(bytes(1 << 20), 1 << 22), [channel()]).cut(),
        {INFO: "claims 4194304 bytes unpacked, its data 1048576"},
    ),
    "more than it says in a frame that does not say": (
        lambda _: HostileMcap().about(DESK).add(streamed(bytes(1 << 22), 1 << 20), [channel()]).cut(),
        {INFO: r"chunk at byte \d+: broken"},
    ),
    "lz4": (
        lambda _: HostileMcap().about(DESK).add(chunk(bytes(99), compression="lz4"), [channel()]).cut(),
        {INFO: "compression 'lz4': must be zstd or none"},
    ),
    "counts that lie": (
        lambda made: made.mcap().add(chunk(FULL), [channel()]).ended({1: 2**64 - 1, 2: 2**64 - 1}),
        {INFO: "cut: it was not ended"},
    ),
    "log time 2^64-1": (lambda made: jumped(made, 2**64 - 100), {PLAY: "nothing to play", EXPORT: "nothing"}),
    "a gap of a hundred years": (
        lambda made: jumped(made, MAX_TIME_NS - 100),
        {PACED: "nothing comes for .* s: skipped"},
    ),
    "own time 2^63-1": (
        lambda made: made.taken(*((replaced(one, t_ns=2**63 - 1), t) for one, t in made.frames())),
        {PLAY: "0 poses"},
    ),
    "ready at -2^63": (
        lambda made: made.taken(*((replaced(one, ready_t_ns=-(2**63)), t) for one, t in made.frames())),
        {PLAY: "0 poses"},
    ),
    "more markers than the rig has": (
        lambda made: made.taken(*((wider(one), t_ns) for one, t_ns in made.frames())),
        {
            PLAY: r"play: messages of (left|right) cannot be solved and are left out: ValueError: "
            r"camera '\1': 8 markers, not 6"
        },
    ),
    "poses a hundred years apart": (
        lambda made: made.poses(),
        {
            ("export", "--to", "bvh"): r"\d+ frames at .* Hz, at most 36064 of 4 poses: export one part",
            EXPORT: "4 rows",
        },
    ),
    "a report in place of a frame": (
        lambda made: made.taken((Health("left", 1, 5, {}, {}), 10**9)),
        {PLAY: "0 poses"},
    ),
    "a frame in place of a pose": (
        lambda made: made.taken(*made.frames()[:3], stream="hand"),
        {(*PLAY, "--solved"): "0 poses", EXPORT: ""},
    ),
}


def replaced(one: MarkerDetections, **times: int) -> MarkerDetections:
    return msgspec.structs.replace(one, **times)


def wider(one: MarkerDetections) -> MarkerDetections:
    """The same frame with two markers more."""
    arrays = {
        name: np.concatenate([getattr(one, name), getattr(one, name)[:2]])
        for name in ("uv", "area", "sigma_px", "quality", "alt_uv")
    }
    return msgspec.structs.replace(one, **arrays)


def bomb_of_files(made: Made) -> HostileMcap:
    mcap = made.mcap()
    for number in range(1000):
        mcap.attach(f"hands/h{number}.json", b"{}")
    return mcap


def many_channels() -> bytes:
    content = b"".join(record(channel(number, "taken", f"c{number}")) for number in range(1, 1026))
    return HostileMcap().about(DESK).add(chunk(content + record(message(b"")))).cut()


@pytest.fixture(scope="module")
def files(root: Path) -> dict[str, bytes]:
    rig = RigFiles(root / "calib_json", ("desk",))
    return carried_files(rig, rig.load())


def test_an_honest_recording_is_read_without_a_loss(tmp_path: Path, files: dict[str, bytes]) -> None:
    made = Made(tmp_path, files)
    path = tmp_path / "honest.mcap"
    path.write_bytes(made.taken(*made.frames()))
    done = command("master", ("info", str(path)), tmp_path)
    assert (done.code, "broken" in done.out) == (0, False), done.text
    assert done.spent_s < MOST_S


@pytest.mark.parametrize(
    ("name", "wanted"),
    [(name, wanted) for name, (_, output) in ATTACKS.items() for wanted in output],
    ids=lambda one: one if isinstance(one, str) else one[0],
)
def test_a_hostile_recording_ends_in_a_line(
    name: str, wanted: tuple[str, ...], tmp_path: Path, files: dict[str, bytes]
) -> None:
    make, output = ATTACKS[name]
    path = tmp_path / "made" / "hostile.mcap"
    path.parent.mkdir()
    path.write_bytes(make(Made(path.parent, files)))
    done = command("master", (wanted[0], str(path), *wanted[1:]), path.parent)
    assert "Traceback" not in done.text, done.text
    assert SECRET not in done.text
    assert all(one.isprintable() for one in done.text.replace("\n", "")), done.text
    assert done.code in (0, 1)
    lines = [line for line in done.err.splitlines() if line.startswith("phalanx-master:")]
    assert len(lines) == done.code, done.err
    assert re.search(output[wanted], done.text), done.text
    if wanted == INFO:
        assert done.spent_s < MOST_S
    inside = {one.relative_to(tmp_path).parts[0] for one in tmp_path.rglob("*")}
    assert inside <= {"made", "cameras", "hands"}, "written elsewhere"
