"""Seal and open datagrams, and send and receive them by UDP.

    offset size field
    0      4    magic "PHLX"
    4      1    wire version
    5      1    kind
    6      2    length of the whole datagram
    8      4    rig tag: which rig key, without revealing it
    12     8    key id: which key under the rig key (a process or a session)
    20     8    counter of that key, from 1
    28     n    body, encrypted
    28+n   16   tag of ChaCha20-Poly1305 (RFC 8439), over header and body

All integers big-endian. The nonce is the counter (and 4 zero bytes): a key belongs to one sender in one direction and
counts up, so no nonce is used twice. Refusing must be cheap, hence the order: length, magic, version, rig, kind, then
the key's table, then the cipher.

Whoever has the rig key, which all share, can make and read handshakes. What a device sends in a session needs its
secret as well, which only it and the master know: a device that was stolen reads and forges no datagram of another.
Secrets follow from `devices.key`, 32 random bytes that never leave the PC; where there is the rig key alone (a
simulation, a closed laboratory), they follow from that: who has it has them all.
"""

import errno
import socket
import struct
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from common.errors import BusError
from common.messages import WIRE_VERSION

Address = tuple[str, int]  # IPv4 address and UDP port

MAGIC = b"PHLX"
HEADER = struct.Struct("!4sBBHIQQ")
TAG_BYTES = 16
OVERHEAD = HEADER.size + TAG_BYTES
MAX_DATAGRAM = 4096  # 48 markers take 2.2 kB, 2.9 kB where they have alternatives
KEY_BYTES = 32
WINDOW = 1024  # counters behind the newest within which a late datagram is distinguished from a replayed one


class Kind(IntEnum):
    """What a datagram carries; docs/wire.md has the fields of each."""

    BEACON = 1
    HELLO = 2
    WELCOME = 3
    START = 4
    STARTED = 5
    ECHO_ASK = 6
    ECHO_ANSWER = 7
    DATA = 8
    UNPROVEN = 9


class Refusal(StrEnum):
    """Why a datagram was not taken. Each is counted under this name."""

    FOREIGN = "foreign"  # not ours, or of another rig
    VERSION = "version"  # ours, of another wire version
    CUT = "cut"  # shorter than its header states
    JUNK = "junk"  # longer than its header states
    OVERSIZED = "oversized"  # longer than any of ours
    UNEXPECTED = "unexpected"  # unknown kind, or one that this side does not take
    STALE = "stale"  # sealed for a session that is over, or never was
    FORGED = "forged"  # the seal does not fit
    SECRET = "secret"  # of the rig, but not proven by the secret of the device that it is about
    DUPLICATE = "duplicate"  # this counter was taken already
    REPLAYED = "replayed"  # so old that it can only be a replay; a handshake of an earlier life
    UNDECODABLE = "undecodable"  # sealed rightly, but not a message of its kind
    OUT_OF_BOUNDS = "out_of_bounds"  # a message with a number that no sensor can measure
    OUTSIDE_PICTURE = "outside_picture"  # a point further outside the picture than the picture is large
    READY_TIME = "ready_time"  # a frame that the slave had long before or after it was exposed
    UNASKED_ECHO = "unasked_echo"  # an answer to an echo that was not asked, or was answered
    FOREIGN_SESSION = "foreign_session"  # a message of another process than the one that sent the hello
    SEQUENCE = "sequence"  # a frame number that no camera can have reached since the last
    MARKER_COUNT = "marker_count"  # of a slave whose rig file names more or fewer markers
    RATE = "rate"  # more messages than the sender's rate by its files
    FAULTY = "faulty"  # a message that could not be used, and those of its sender while it is silenced
    IMPOSTOR = "impostor"  # speaks for a camera that it is not
    UNKNOWN = "unknown_camera"  # a slave that this rig does not have
    OTHER_MASTER = "other_master"  # a beacon of another master while ours is well
    DUPLICATE_SENDER = "duplicate_sender"  # a hello of a second process of a name whose first is well


class Header(NamedTuple):
    """First 28 bytes of a datagram, authenticated only by `Opener.open`."""

    kind: Kind
    key_id: int
    counter: int


class Opened(NamedTuple):
    """Authenticated datagram. `reordered`: a later one arrived before it."""

    body: bytes
    reordered: bool


_KINDS = {int(kind): kind for kind in Kind}


def parse(datagram: bytes, rig_tag: int) -> Header | Refusal:
    """Return the header of `datagram`, or why it needs no further look."""
    size = len(datagram)
    if size > MAX_DATAGRAM:
        return Refusal.OVERSIZED
    if datagram[:4] != MAGIC:
        return Refusal.CUT if 0 < size < 4 and MAGIC.startswith(datagram) else Refusal.FOREIGN
    if size < OVERHEAD:
        return Refusal.CUT
    _, version, kind, length, rig, key_id, counter = HEADER.unpack_from(datagram)
    if version != WIRE_VERSION:
        return Refusal.VERSION
    if rig != rig_tag:
        return Refusal.FOREIGN
    if size != length:
        return Refusal.CUT if size < length else Refusal.JUNK
    if kind not in _KINDS:
        return Refusal.UNEXPECTED
    return Header(_KINDS[kind], key_id, counter)


class Sealer:
    """Sealer of the datagrams of one sender under one key; for one thread."""

    def __init__(self, key: bytes, rig_tag: int, key_id: int) -> None:
        """Start counting at 1: a key has one `Sealer` in its life."""
        self._cipher = ChaCha20Poly1305(key)
        self._rig_tag = rig_tag
        self._key_id = key_id
        self._counter = 0

    def seal(self, kind: Kind, body: bytes) -> bytes:
        """Return the datagram; raises ValueError if the body does not fit into one."""
        size = OVERHEAD + len(body)
        if size > MAX_DATAGRAM:
            raise ValueError(f"datagram of {size} bytes, at most {MAX_DATAGRAM}")
        self._counter += 1
        header = HEADER.pack(MAGIC, WIRE_VERSION, kind, size, self._rig_tag, self._key_id, self._counter)
        return header + self._cipher.encrypt(_nonce(self._counter), body, header)


class ReplayWindow:
    """Counters already accepted: the highest and a bit for each of 1024 before it."""

    def __init__(self) -> None:
        self._highest = 0
        self._received = 1  # bit i: counter `highest - i`; 0 is never used and counts as taken
        self._count = 0

    @property
    def missing(self) -> int:
        """How many counters up to the highest never arrived."""
        return self._highest - self._count

    def missing_between(self, after: int, before: int) -> int:
        """How many counters between two received ones never arrived; too old: all."""
        newer, span = self._highest - before + 1, before - after - 1  # where it begins in bits; its length
        known = min(span, max(WINDOW - newer, 0))
        return span - ((self._received >> newer) & ((1 << known) - 1)).bit_count()

    def take(self, counter: int) -> Refusal | bool:
        """Take `counter` once: whether a later one came before it, or why it is refused."""
        ahead = counter - self._highest
        if ahead > 0:
            self._received = ((self._received << ahead) | 1) & _MASK if ahead < WINDOW else 1
            self._highest = counter
            self._count += 1
            return False
        if -ahead >= WINDOW:
            return Refusal.REPLAYED
        bit = 1 << -ahead
        if self._received & bit:
            return Refusal.DUPLICATE
        self._received |= bit
        self._count += 1
        return True


class Opener:
    """Opener of the datagrams that one sender sealed under one key, each once."""

    def __init__(self, key: bytes) -> None:
        self._cipher = ChaCha20Poly1305(key)
        self._window = ReplayWindow()

    @property
    def missing(self) -> int:
        """Return how many sealed datagrams never arrived here, up to the newest one."""
        return self._window.missing

    def missing_between(self, after: int, before: int) -> int:
        """How many sealed datagrams between two received counters never arrived here."""
        return self._window.missing_between(after, before)

    def open(self, header: Header, datagram: bytes) -> Opened | Refusal:
        """Return the body of a datagram whose header `parse` gave, or why it is refused."""
        body = unseal(self._cipher, header, datagram)
        if body is None:
            return Refusal.FORGED
        newness = self._window.take(header.counter)
        return newness if isinstance(newness, Refusal) else Opened(body, newness)


def unseal(cipher: ChaCha20Poly1305, header: Header, datagram: bytes) -> bytes | None:
    """Return the body if the seal is valid, else None. Replay is not checked."""
    try:
        return cipher.decrypt(_nonce(header.counter), datagram[HEADER.size :], datagram[: HEADER.size])
    except InvalidTag:
        return None


_MASK = (1 << WINDOW) - 1


def _nonce(counter: int) -> bytes:
    return counter.to_bytes(12, "big")


def derive(key: bytes, length: int, salt: bytes, info: bytes) -> bytes:
    """Return `length` bytes that follow from `key`, by HKDF-SHA256 (RFC 5869)."""
    return HKDF(algorithm=SHA256(), length=length, salt=salt, info=info).derive(key)


def device_secret(root: bytes, name: str) -> bytes:
    """Return the secret of a device (32 bytes), from `devices.key` or the rig key."""
    return derive(root, KEY_BYTES, b"", b"phalanx device " + name.encode())


@dataclass(frozen=True, slots=True)
class LinkKey:
    """What one process has of the secrets of a rig, 32 bytes each.

    Attributes:
        rig: Rig key.
        root: `devices.key`, of a PC; None: the secrets follow from the rig key, or there is `own`.
        own: Secret of the one device that this process is; None: secrets follow from the root.
    """

    rig: bytes = field(repr=False)
    root: bytes | None = field(default=None, repr=False)
    own: bytes | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Refuse a key that is not 32 bytes (ValueError)."""
        for what, key in (
            ("rig key", self.rig),
            ("devices.key", self.root),
            ("secret of a device", self.own),
        ):
            if key is not None and len(key) != KEY_BYTES:
                raise ValueError(f"{what} of {len(key)} bytes, must be {KEY_BYTES}")

    @property
    def has_secrets(self) -> bool:
        """Whether device secrets need more than the rig key: none makes another's."""
        return self.root is not None or self.own is not None

    def secret(self, name: str) -> bytes:
        """Return the secret of the device `name` (32 bytes)."""
        return self.own if self.own is not None else device_secret(self.root or self.rig, name)


READ_TIMEOUT_S = 0.01  # the grid of everything that a reading thread repeats in between


class UdpSocket:
    """One bound UDP socket: one thread receives; any sends, which never waits.

    `would_block` counts datagrams that the kernel had no room for, `failed` those it refused (no route, no such
    interface): both are lost like any other datagram.
    """

    def __init__(
        self, bind: Address, shared: bool = False, broadcast: bool = False, timeout_s: float = READ_TIMEOUT_S
    ) -> None:
        """Bind the socket. `shared` lets several processes receive the same broadcasts.

        Raises:
            BusError: The address is taken or not of this machine.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if shared:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if broadcast:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        receive_buffer = 1 << 20
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        try:
            self._socket.bind(bind)
        except OSError as error:
            self._socket.close()
            taken = error.errno == errno.EADDRINUSE
            why = "another program has it, perhaps another master" if taken else error.strerror
            raise BusError(f"cannot bind UDP {bind[0]}:{bind[1]}: {why}") from error
        self.address: Address = self._socket.getsockname()
        self._socket.settimeout(timeout_s)
        self._at_once = self._socket.dup()  # the same socket, which never waits
        self._at_once.setblocking(False)
        self.would_block = 0
        self.failed = 0

    def receive(self) -> tuple[bytes, Address] | None:
        """Return the next datagram and its source, or None after the timeout or an error.

        One that is too long comes cut to one byte more than allowed, so that it is seen to be.
        """
        return self._receive(self._socket)

    def receive_waiting(self) -> tuple[bytes, Address] | None:
        """As `receive`, of what has come already: None at once where nothing has."""
        return self._receive(self._at_once)

    def _receive(self, one: socket.socket) -> tuple[bytes, Address] | None:
        try:
            return one.recvfrom(MAX_DATAGRAM + 1)
        except OSError as error:
            if error.errno in (errno.EBADF, errno.ENOTSOCK):
                raise
            return None  # nothing came, or a delayed ICMP complaint about an earlier send: not our concern

    def send(self, datagram: bytes, to: Address) -> bool:
        """Send now or not at all; whether the kernel took it."""
        try:
            self._at_once.sendto(datagram, to)
        except BlockingIOError:
            self.would_block += 1
        except OSError:
            self.failed += 1
        else:
            return True
        return False

    def close(self) -> None:
        """Give the address back."""
        self._socket.close()
        self._at_once.close()
