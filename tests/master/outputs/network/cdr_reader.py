"""Reads CDR as OMG's DDS-XTypes 1.3 (7.4.1, little-endian) has it, by itself: to check what others wrote."""

import struct
from dataclasses import dataclass, field
from typing import Any


@dataclass
class CdrReader:
    """Holds the bytes behind the header, and where it is in them."""

    data: bytes
    at: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        assert self.data[:4] == b"\x00\x01\x00\x00"  # plain CDR, little-endian, no options
        self.data = self.data[4:]

    def number(self, letter: str) -> Any:
        size = struct.calcsize(letter)
        self.at += -self.at % size
        (value,) = struct.unpack_from("<" + letter, self.data, self.at)
        self.at += size
        return value

    def text(self) -> str:
        length = self.number("I")
        raw = self.data[self.at : self.at + length]
        assert raw[-1:] == b"\0"
        self.at += length
        return raw[:-1].decode()

    def numbers(self, letter: str, count: int) -> list[Any]:
        return [self.number(letter) for _ in range(count)]

    def end(self) -> None:
        assert self.at == len(self.data)


def header(cdr: CdrReader) -> tuple[int, str]:
    """Stamp [ns] and frame of a std_msgs/Header."""
    seconds, rest = cdr.number("i"), cdr.number("I")
    return seconds * 1_000_000_000 + rest, cdr.text()


def pose_array(data: bytes) -> tuple[int, str, list[list[float]]]:
    """Stamp [ns], frame, and of each pose x y z and quaternion xyzw."""
    cdr = CdrReader(data)
    t_ns, frame = header(cdr)
    poses = [cdr.numbers("d", 7) for _ in range(cdr.number("I"))]
    cdr.end()
    return t_ns, frame, poses


def joint_state(data: bytes) -> tuple[int, list[str], list[float]]:
    """Stamp [ns], names and positions; no velocities, no efforts."""
    cdr = CdrReader(data)
    t_ns, _ = header(cdr)
    names = [cdr.text() for _ in range(cdr.number("I"))]
    positions = cdr.numbers("d", cdr.number("I"))
    assert cdr.number("I") == 0
    assert cdr.number("I") == 0
    cdr.end()
    return t_ns, names, positions


def flags(data: bytes) -> list[int]:
    """Bytes of a std_msgs/UInt8MultiArray without dimensions."""
    cdr = CdrReader(data)
    assert cdr.number("I") == 0
    assert cdr.number("I") == 0
    values = cdr.numbers("B", cdr.number("I"))
    cdr.end()
    return values


def transforms(data: bytes) -> dict[str, tuple[int, str, list[float]]]:
    """Child frame -> stamp [ns], parent frame, x y z and quaternion xyzw."""
    cdr = CdrReader(data)
    found: dict[str, tuple[int, str, list[float]]] = {}
    for _ in range(cdr.number("I")):
        t_ns, parent = header(cdr)
        child = cdr.text()
        found[child] = t_ns, parent, cdr.numbers("d", 7)
    cdr.end()
    return found


def pose_with_covariance(data: bytes) -> tuple[str, list[float], list[float]]:
    """Frame, x y z and quaternion xyzw, and the covariance, 36 numbers."""
    cdr = CdrReader(data)
    _, frame = header(cdr)
    pose, covariance = cdr.numbers("d", 7), cdr.numbers("d", 36)
    cdr.end()
    return frame, pose, covariance
