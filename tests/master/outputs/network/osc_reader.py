"""Reads OSC packets, written from the Open Sound Control 1.0 specification alone: what our packets are checked with.

Strings are ASCII, end with 1 to 4 zeros and fill whole words; numbers are big-endian. A bundle is "#bundle", a 64-bit
NTP time (seconds since 1900, then their fractions by 2^-32), and elements, each behind its size in bytes.
"""

import struct
from dataclasses import dataclass


@dataclass(frozen=True)
class Received:
    """One message: where it goes, its arguments, and the time of its bundle, in seconds since 1900."""

    address: str
    arguments: tuple[str | int | float, ...]
    at_s: float

    @property
    def numbers(self) -> list[float]:
        """The arguments that are numbers."""
        return [float(one) for one in self.arguments if not isinstance(one, str)]


def packet_of(data: bytes, at_s: float = 0.0) -> list[Received]:
    """All messages of a packet; a packet that is not one raises."""
    assert len(data) % 4 == 0, "not a multiple of four bytes"
    if not data.startswith(b"#bundle\0"):
        return [_message(data, at_s)]
    seconds, fraction = struct.unpack(">II", data[8:16])
    rest, out = data[16:], list[Received]()
    while rest:
        (size,) = struct.unpack(">i", rest[:4])
        assert 0 < size <= len(rest) - 4, "an element is longer than its bundle"
        out += packet_of(rest[4 : 4 + size], seconds + fraction / 2**32)
        rest = rest[4 + size :]
    return out


def _message(data: bytes, at_s: float) -> Received:
    address, rest = _string(data)
    types, rest = _string(rest)
    assert address.startswith("/")
    assert types.startswith(",")
    arguments: list[str | int | float] = []
    for kind in types[1:]:
        if kind == "s":
            text, rest = _string(rest)
            arguments.append(text)
        else:
            arguments += struct.unpack({"i": ">i", "f": ">f"}[kind], rest[:4])
            rest = rest[4:]
    assert not rest, "bytes behind the last argument"
    return Received(address, tuple(arguments), at_s)


def _string(data: bytes) -> tuple[str, bytes]:
    end = data.index(0)
    padded = end // 4 * 4 + 4
    assert not any(data[end:padded]), "a string is filled up with something else than zeros"
    return data[:end].decode("ascii"), data[padded:]
