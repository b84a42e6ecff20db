"""The bytes of an x-IMU3: examples of its manual, and the same bytes through the vendor's own library."""

import random
import struct
import threading
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slave.imu.ximu3 import LONGEST, Answer, Data, Decoder, Fault, Kind, encode, plain
from tests.slave.imu.fake_ximu3 import stuff

STAMP = "40 42 0F 00 00 00 00 00"
# x-IMU3 User Manual v1.11, section "Data messages": the same message as text and as bytes.
MANUAL = [
    (
        "I,1000000,0.0000,0.0000,0.0000,0.0000,0.0000,1.0000",
        "C9",
        "00 00 00 00 " * 5 + "00 00 80 3F",
        (0.0,) * 5,
    ),
    ("M,1000000,1.0000,0.0000,0.0000", "CD", "00 00 80 3F" + " 00 00 00 00" * 2, (1.0, 0.0)),
    ("Q,1000000,1.0000,0.0000,0.0000,0.0000", "D1", "00 00 80 3F" + " 00 00 00 00" * 3, (1.0, 0.0)),
    ("B,1000000,100.0000,4.2000,2.0000", "C2", "00 00 C8 42 66 66 86 40 00 00 00 40", (100.0,)),
    ("W,1000000,100.000,-50.0000", "D7", "00 00 C8 42 00 00 48 C2", (100.0, -50.0)),
    ("N,1000000,Button pressed.", "CE", "42 75 74 74 6F 6E 20 70 72 65 73 73 65 64 2E", b"Button pressed."),
    ("F,1000000,Battery empty.", "C6", "42 61 74 74 65 72 79 20 65 6D 70 74 79 2E", b"Battery empty."),
]
LAST = b"O,18446744073709551615,1\n"  # a button no test presses: after it, all has been decoded


def decode(data: bytes) -> list[Data | Answer | Fault | None]:
    return list(Decoder().push(data))


def same(one: object, other: object) -> bool:
    """Whether two messages are equal, NaN included."""
    return repr(one) == repr(other)


@pytest.mark.parametrize(("text", "first", "rest", "begins"), MANUAL)
def test_the_manuals_examples(text: str, first: str, rest: str, begins: tuple[float, ...] | bytes) -> None:
    [as_text] = decode(text.encode() + b"\n")
    [as_bytes] = decode(bytes.fromhex(f"{first} {STAMP} {rest} 0A"))
    assert isinstance(as_text, Data)
    assert isinstance(as_bytes, Data)
    assert as_text.kind is as_bytes.kind
    assert as_text.t_us == as_bytes.t_us == 1_000_000
    assert as_text.text == as_bytes.text
    assert float32_bits(as_text.values) == float32_bits(as_bytes.values)
    assert as_bytes.text == begins if isinstance(begins, bytes) else as_bytes.values[: len(begins)] == begins


@pytest.mark.parametrize(
    ("plain_bytes", "stuffed"),
    [
        ("45 58 41 4D 50 4C 45", "45 58 41 4D 50 4C 45 0A"),
        ("45 0A 41 4D 50 4C 45", "45 DB DC 41 4D 50 4C 45 0A"),
        ("45 58 DB 4D 50 4C 45", "45 58 DB DD 4D 50 4C 45 0A"),
        ("45 58 41 4D 50 DB 0A", "45 58 41 4D 50 DB DD DB DC 0A"),
    ],
)
def test_the_manuals_examples_of_stuffing(plain_bytes: str, stuffed: str) -> None:
    assert stuff(bytes.fromhex(plain_bytes)) == bytes.fromhex(stuffed)


def test_commands_and_answers() -> None:
    assert encode("ping") == b'{"ping":null}\n'
    assert encode("binary_mode_enabled", True) == b'{"binary_mode_enabled":true}\n'
    assert plain("serial_number") == plain("Serial Number") == plain("serialNumber") == "serialnumber"
    pong = b'{"ping":{"interface":"USB","name":"x-IMU3","sn":"01234567"}}\n'
    assert decode(pong) == [Answer("ping", {"interface": "USB", "name": "x-IMU3", "sn": "01234567"})]
    [refused] = decode(b'{"serial_number":{"error":"Unable to write read-only setting"}}\n')
    assert isinstance(refused, Answer)
    assert refused.fields["error"] == "Unable to write read-only setting"
    assert decode(b'{"a":1,"b":2}\n{"a"\n{"a":' + b"[" * 4000 + b"}\n") == [Fault.JSON] * 3
    assert decode(b"^Aabc\n^\n") == [None, Fault.MUX], "messages of another device behind this one"


def messages(dice: random.Random) -> bytes:
    """One message of a random kind, right or broken in one of many ways."""
    kind = dice.choice(list(Kind))
    stamp = dice.choice([0, 10, 0xDB, 1_000_000, dice.getrandbits(64)])
    if dice.random() < 0.4:
        digits = [dice.choice(["", "+", "-", " "]) + f"{10 ** dice.uniform(-4, 6):.4f}" for _ in range(9)]
        text = dice.choice(["hello, world", "  two  ", "\xe9", "a\r", "1e5"])
        parts = digits[: kind.numbers] if kind.numbers else [text]
        line = f"{kind.letter},{stamp},{','.join(parts)}".encode() + dice.choice([b"", b"\r", b",1", b" "])
        line += b"\n"
    else:
        floats = struct.pack(
            "<9I", *(dice.choice([0, 10, 0xDBDB0A0A, dice.getrandbits(32)]) for _ in range(9))
        )
        body = floats[: 4 * kind.numbers] if kind.numbers else floats[: dice.randrange(36)]
        line = stuff(struct.pack("<BQ", 0x80 + ord(kind.letter), stamp) + body)
    fault = dice.random()
    if fault < 0.1:  # a byte is lost, one is hit, two messages run into one another
        line = line.replace(line[(k := dice.randrange(len(line))) : k + 1], b"", 1)
    elif fault < 0.2:
        line = line[: (k := dice.randrange(len(line)))] + bytes([dice.randrange(256)]) + line[k + 1 :]
    return line


class Vendor:
    """What the vendor's library makes of a file, in its order: messages, and errors by its words."""

    def __init__(self, path: Path) -> None:
        self.ximu3 = pytest.importorskip("ximu3", reason="the vendor's library is not installed")
        self._path = path

    def __call__(self, data: bytes) -> list[Any]:
        self._path.write_bytes(data + LAST)
        found: list[Any] = []
        done = threading.Event()
        connection = self.ximu3.Connection(self.ximu3.FileConnectionConfig(str(self._path)))

        def take(kind: str, message: Any) -> None:
            if kind == "button" and message.timestamp == 2**64 - 1:
                done.set()
            else:
                found.append((kind, message))

        def fault(error: int) -> None:
            found.append(("fault", self.ximu3.receive_error_to_string(error).lower()))

        for kind in Kind:
            name = NAMES.get(kind, kind.name.lower())
            getattr(connection, f"add_{name}_callback")(partial(take, name))
        connection.add_receive_error_callback(fault)
        connection.open()
        assert done.wait(60.0)
        connection.close()
        return found


NAMES = {Kind.TIMECODE: "ltc"}  # where the vendor's are others
NUMBERS = {
    Kind.INERTIAL: "gyroscope_x gyroscope_y gyroscope_z accelerometer_x accelerometer_y accelerometer_z",
    Kind.QUATERNION: "w x y z",
    Kind.ROTATION_MATRIX: "xx xy xz yx yy yz zx zy zz",
    Kind.EULER_ANGLES: "roll pitch yaw",
    Kind.TEMPERATURE: "temperature",
    Kind.BATTERY: "percentage voltage charging_status",
    Kind.RSSI: "percentage power",
    Kind.SYNC: "edge",
    Kind.BUTTON: "state",
}


def float32_bits(values: Any) -> list[int]:
    with np.errstate(over="ignore"):
        return [int(bits) for bits in np.array(values, np.float64).astype(np.float32).view(np.uint32)]


def agree(ours: object, theirs: tuple[str, Any]) -> bool:
    """Whether our message is the vendor's: kind, stamp, and its numbers to the last bit of their 32."""
    kind, message = theirs
    if isinstance(ours, Fault):
        return kind == "fault" and message == ours.value
    assert isinstance(ours, Data)
    if kind != NAMES.get(ours.kind, ours.kind.name.lower()) or message.timestamp != ours.t_us:
        return False
    if not ours.kind.numbers:
        return not ours.text.isascii() or bytes(message.bytes) == ours.text[:255]
    values = [getattr(message, name) for name in NUMBERS.get(ours.kind, "x y z").split()]
    nan = np.isnan(values)  # which of the many NaN it is gets lost in Python's float
    return bool((nan == np.isnan(ours.values)).all()) and all(
        mine == other or skip
        for mine, other, skip in zip(float32_bits(ours.values), float32_bits(values), nan, strict=True)
    )


def test_the_vendors_library_reads_the_same(tmp_path: Path) -> None:
    dice = random.Random(20)
    data = b"".join(messages(dice) for _ in range(4000))
    data += (
        b"x" * (LONGEST - 2) + b"\n" + b"x" * (LONGEST - 1) + b"\n" + b"x" * (2 * LONGEST + 7) + b"T,5,1\n"
    )
    ours = [message for message in decode(data) if message is not None and not isinstance(message, Answer)]
    theirs = Vendor(tmp_path / "bytes.ximu3")(data)
    assert len(ours) == len(theirs) > 3000
    for mine, other in zip(ours, theirs, strict=True):
        assert agree(mine, other), (mine, other[0], str(other[1]))
    seen = {message.kind for message in ours if isinstance(message, Data)}
    assert seen == set(Kind), "every kind came, and"
    assert {message for message in ours if isinstance(message, Fault)} >= {
        Fault.OVERRUN,
        Fault.LETTER,
        Fault.ESCAPE,
        Fault.LENGTH,
        Fault.TEXT,
    }, "every way to be broken but JSON"


def test_a_number_that_differs_is_seen(tmp_path: Path) -> None:
    """The comparison bites: one last bit of one number, one microsecond, another word for the fault."""
    line = struct.pack("<BQf", 0x80 + ord("T"), 7, 25.1)
    [theirs] = Vendor(tmp_path / "bytes.ximu3")(stuff(line))
    [ours] = decode(stuff(line))
    assert isinstance(ours, Data)
    assert agree(ours, theirs)
    nearest = float(np.nextafter(np.float32(ours.values[0]), np.float32(0)))
    assert not agree(ours._replace(values=(nearest,)), theirs)
    assert not agree(ours._replace(t_us=8), theirs)
    assert not agree(Fault.TEXT, theirs)


def test_the_vendors_commands_are_ours(tmp_path: Path) -> None:
    ximu3 = Vendor(tmp_path).ximu3
    for key, value in (("ping", None), ("binary_mode_enabled", True), ("inertial_message_rate_divisor", 3)):
        message = ximu3.CommandMessage.parse(encode(key, value).decode())
        assert message.key == key
        [ours] = decode(encode(key, value))
        assert isinstance(ours, Answer)
        assert ours.key == plain(key)
        assert ours.value == value


def pieces(data: bytes, cuts: list[int]) -> Iterator[bytes]:
    ends = sorted({min(cut, len(data)) for cut in cuts} | {0, len(data)})
    yield from (data[a:b] for a, b in pairwise(ends))


@given(st.integers(0, 2**32), st.lists(st.integers(0, 400), max_size=20))
def test_it_does_not_matter_where_the_bytes_are_cut(seed: int, cuts: list[int]) -> None:
    dice = random.Random(seed)
    data = b"".join(messages(dice) for _ in range(6)) + b'{"ping":1}\n'
    whole = decode(data)
    decoder = Decoder()
    cut = [message for piece in pieces(data, cuts) for message in decoder.push(piece)]
    assert same(cut, whole)
    decoder = Decoder()
    assert same([m for k in range(len(data)) for m in decoder.push(data[k : k + 1])], whole)


def test_endless_junk_is_cut_the_same_way_and_forgotten() -> None:
    data = bytes(3 * LONGEST + 5) + b"\nT,5,1\n"
    decoder = Decoder()
    bit_by_bit = [m for k in range(0, len(data), 100) for m in decoder.push(data[k : k + 100])]
    assert same(bit_by_bit, decode(data))
    assert isinstance(bit_by_bit[-1], Data)


@given(st.binary(max_size=300))
def test_any_bytes_are_messages_or_faults(data: bytes) -> None:
    decoder = Decoder()
    found = list(decoder.push(data + b"\n"))
    assert len(found) == data.count(b"\n") + 1
    [after] = decoder.push(b"T,5,1.5\n")
    assert after == Data(Kind.TEMPERATURE, 5, (1.5,)), "whatever came before"
