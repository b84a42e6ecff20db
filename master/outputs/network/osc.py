"""Open Sound Control carries hands, objects, contact and gestures over UDP.

Each message of the master is one bundle whose time tag is the epoch it describes, in one datagram (addresses:
docs/outputs.md). What is not known has no message in its bundle. All is in the rig's frame, in metres and
radians.

python-osc encodes a message once, after that only its numbers are filled in: some microseconds, where some
300 arguments anew for every pose would cost a millisecond. (Open Sound Control 1.0: everything is big-endian
and a multiple of four bytes, arguments come last, in their order; a bundle is `#bundle`, a time tag, and its
elements, each behind its size.)
"""

import socket
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pythonosc.osc_message_builder import OscMessageBuilder

from common.arrays import Bool, Int
from common.calibration.output_settings import OscOutput
from common.errors import PhalanxError
from common.hand.model import FINGERS, JOINTS
from common.messages import Contact, Gesture, HandPose, ObjectPose, ResultMessage
from master.outputs.network.conventions import MasterTimes, Side, side_of

Words = npt.NDArray[np.uint32]

_BIG = np.dtype(">u4")
_HEADER = 4  # words: "#bundle" and the time tag


@dataclass(frozen=True, slots=True)
class Blank:
    """One message whose numbers are to be filled in."""

    address: str
    texts: tuple[str, ...]  # arguments that never change, before the numbers
    numbers: str  # types of the numbers: f, i

    def element(self) -> bytes:
        """Return the message as an element of a bundle, with zeros for numbers."""
        builder = OscMessageBuilder(self.address)
        for text in self.texts:
            builder.add_arg(text, OscMessageBuilder.ARG_TYPE_STRING)
        for kind in self.numbers:
            builder.add_arg(0.0 if kind == "f" else 0, kind)
        packet = builder.build().dgram
        return len(packet).to_bytes(4, "big") + packet


class BlankBundle:
    """A bundle of messages of which only time and numbers change."""

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
        """The bundle as bytes, time tag `wall_ns` since 1970.

        `numbers`: all in order, as bits: `floats` and `ints`. `present`: which messages are in it; None: all.
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


class UdpSender:
    """UDP socket towards one receiver, who may be absent; the host is looked up once."""

    def __init__(self, host: str, port: int, key: str) -> None:
        """Open the socket; `key` names its settings; PhalanxError: unknown host."""
        self._fix = f"{key}.host, {key}.port of the output settings"
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise PhalanxError(f"{host}:{port}: no such host: {error.strerror}; see {self._fix}") from error
        self._where = f"{host}:{port}"
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)  # several receivers by one address
        try:
            self._socket.connect(address)  # so that the kernel takes nothing in from anybody else
        except OSError as error:
            self._socket.close()
            raise PhalanxError(
                f"{host}:{port}: cannot send: {error.strerror or error}; see {self._fix}"
            ) from error

    def send(self, packet: bytes) -> None:
        """Send one datagram; PhalanxError: this machine cannot: no route, no permission."""
        try:
            try:
                self._socket.send(packet)
            except ConnectionRefusedError:  # of an earlier one, to which nobody listened
                self._socket.send(packet)
        except ConnectionRefusedError:
            return
        except OSError as error:
            raise PhalanxError(
                f"{self._where}: cannot send: {error.strerror or error}; see {self._fix}"
            ) from error

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()


POSE = "fffffffi"  # x y z, quaternion x y z w, tracked
_XYZW = [1, 2, 3, 0]


class OscSink:
    """A `Sink` that sends each message as one OSC bundle."""

    def __init__(self, settings: OscOutput, times: MasterTimes) -> None:
        """Open the socket; PhalanxError: the host is unknown."""
        self._times = times
        self._blanks: dict[Hashable, BlankBundle] = {}
        self._count = 0
        self._udp = UdpSender(settings.host, settings.port, "osc")

    def write(self, message: ResultMessage) -> None:
        """Send one message; PhalanxError: this machine cannot send there."""
        wall_ns = self._times.wall_ns(message.t_ns)
        if isinstance(message, HandPose):
            packet = self._hand(message, wall_ns)
        elif isinstance(message, ObjectPose):
            packet = self._object(message, wall_ns)
        elif isinstance(message, Contact):
            packet = self._contact(message, wall_ns)
        else:
            packet = self._gesture(message, wall_ns)
        if packet is not None:
            self._udp.send(packet)

    def close(self) -> None:
        """Give the socket back."""
        self._udp.close()

    def _hand(self, pose: HandPose, wall_ns: int) -> bytes | None:
        side = side_of(pose)
        if side is None:
            return None  # nothing of it is known
        self._count = (self._count + 1) % 2**31
        joints = np.empty((len(JOINTS), 8), np.uint32)
        joints[:, :3], joints[:, 3:7] = floats(pose.position_m), floats(pose.orientation_wxyz[:, _XYZW])
        joints[:, 7] = pose.tracked
        known = np.isfinite(pose.position_m).all(axis=1) & np.isfinite(pose.orientation_wxyz).all(axis=1)
        bent = np.isfinite(pose.angles_rad).all(axis=1)
        numbers = np.concatenate(
            [
                ints([self._count]),
                floats([1e-9 * pose.latency_ns]),
                joints.ravel(),
                floats(pose.angles_rad).ravel(),
            ]
        )
        blank = self._blank(("hand", pose.hand, side), lambda: hand_blanks(pose.hand, side))
        return blank.filled(wall_ns, numbers, np.concatenate([[True], known & pose.valid, bent]))

    def _object(self, pose: ObjectPose, wall_ns: int) -> bytes | None:
        numbers = np.concatenate(
            [floats(pose.position_m), floats(pose.orientation_wxyz[_XYZW]), ints([pose.tracked])]
        )
        if np.isnan(pose.position_m).any():
            return None
        blank = Blank(f"/phalanx/object/{pose.object}", (), POSE)
        return self._blank(blank, lambda: [blank]).filled(wall_ns, numbers)

    def _contact(self, contact: Contact, wall_ns: int) -> bytes:
        numbers = np.concatenate(
            [
                ints([contact.held]),
                ints(contact.touching),
                floats([contact.palm_distance_m]),
                floats(contact.distance_m),
            ]
        )
        blank = Blank(f"/phalanx/contact/{contact.object}", (contact.hand,), "i" + "iiiii" + "f" + "fffff")
        return self._blank(blank, lambda: [blank]).filled(wall_ns, numbers)

    def _gesture(self, gesture: Gesture, wall_ns: int) -> bytes:
        numbers: Words = floats(
            [
                gesture.confidence,
                gesture.distance_m,
                gesture.strength,
                gesture.angle_rad,
                *gesture.origin_m,
                *gesture.direction,
            ]
        )
        texts = (gesture.hand, gesture.name, gesture.phase)
        blank = Blank(f"/phalanx/gesture/{gesture.kind}", texts, "f" * 10)
        return self._blank(blank, lambda: [blank]).filled(wall_ns, numbers)

    def _blank(self, key: Hashable, make: Callable[[], Sequence[Blank]]) -> BlankBundle:
        known = self._blanks.get(key)
        if known is None:
            most_blanks = 256  # kinds of messages that are remembered: names come from the bus
            if len(self._blanks) >= most_blanks:
                self._blanks.clear()
            known = self._blanks[key] = BlankBundle(make())
        return known


def hand_blanks(hand: str, side: Side) -> list[Blank]:
    """Return a hand's messages: number and latency, joints, angles of each finger."""
    top = f"/phalanx/hand/{side}"
    return [
        Blank(f"{top}/frame", (hand,), "if"),
        *(Blank(f"{top}/{joint}", (), POSE) for joint in JOINTS),
        *(Blank(f"{top}/{finger}/angles", (), "ffff") for finger in FINGERS),
    ]
