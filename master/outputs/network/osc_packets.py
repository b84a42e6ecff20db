"""OSC bundles whose numbers are filled in.

python-osc writes a message once, after that only its numbers change.

Encoding some 300 arguments anew for every pose would cost a millisecond; filling them in costs some microseconds.
(Open Sound Control 1.0: everything is big-endian and a multiple of four bytes, arguments come last, in their order;
a bundle is `#bundle`, a time tag, and its elements, each behind its size.)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pythonosc.osc_message_builder import OscMessageBuilder

from common.arrays import Bool, Int

Words = npt.NDArray[np.uint32]

_BIG = np.dtype(">u4")
_HEADER = 4  # words: "#bundle" and the time tag


@dataclass(frozen=True, slots=True)
class Blank:
    """One message whose numbers are to be filled in.

    Attributes:
        address: Where it goes.
        texts: Arguments that never change, before the numbers.
        numbers: Types of the numbers: f, i.
    """

    address: str
    texts: tuple[str, ...]
    numbers: str

    def element(self) -> bytes:
        """Return the message as an element of a bundle.

        Its size, then itself, with zeros for numbers.
        """
        builder = OscMessageBuilder(self.address)
        for text in self.texts:
            builder.add_arg(text, OscMessageBuilder.ARG_TYPE_STRING)
        for kind in self.numbers:
            builder.add_arg(0.0 if kind == "f" else 0, kind)
        packet = builder.build().dgram
        return len(packet).to_bytes(4, "big") + packet


class BlankBundle:
    """A bundle of messages of which only time and numbers change.

    Holds it as words of 32 bits, with zeros.
    """

    def __init__(self, blanks: Sequence[Blank]) -> None:
        elements = [np.frombuffer(blank.element(), _BIG) for blank in blanks]
        header = np.frombuffer(b"#bundle\0" + bytes(8), _BIG)
        self._words = np.concatenate([header, *elements]).astype(_BIG)  # which forgets the order of bytes
        self._sizes = np.array([len(element) for element in elements])
        ends: Int = _HEADER + np.cumsum(self._sizes)
        slots: list[Int] = [
            np.arange(end - len(blank.numbers), end) for blank, end in zip(blanks, ends, strict=True)
        ]
        self._slots: Int = np.concatenate(slots)

    def filled(self, wall_ns: int, numbers: Words, present: Bool | None = None) -> bytes:
        """The bundle as bytes.

        Args:
            wall_ns: Nanoseconds since 1970 for the time tag.
            numbers: All numbers in order, as bits: `floats` and `ints`.
            present: Which messages are in it; None: all.
        """
        words = self._words.copy()
        seconds, rest = divmod(wall_ns, 1_000_000_000)
        unix_to_ntp_s = 2_208_988_800  # 1900 to 1970
        words[2], words[3] = (seconds + unix_to_ntp_s) % 2**32, (rest << 32) // 1_000_000_000
        words[self._slots] = numbers
        if present is None or present.all():
            return words.tobytes()
        kept = np.repeat(present, self._sizes)
        return words[:_HEADER].tobytes() + words[_HEADER:][kept].tobytes()


def floats(values: npt.ArrayLike) -> Words:
    """Numbers as the bits of 32-bit floats, in their shape."""
    return np.asarray(values, dtype=np.float32).view(np.uint32)


def ints(values: npt.ArrayLike) -> Words:
    """Numbers as the bits of 32-bit integers, in their shape."""
    return np.asarray(values, dtype=np.int32).view(np.uint32)
