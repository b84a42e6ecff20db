"""The Lab Streaming Layer carries hands as streams of this machine.

One outlet a hand, opened with its first pose; a sample a pose, at the time at which the pose holds. LSL's
clock is this machine's, so a recording aligns hands with EEG, EMG, eye trackers or whatever other machines
measure. liblsl, a C++ library that pylsl's wheels bring for the usual machines only, is imported when the
output is switched on. Names and meanings were read in pylsl 1.18 (info.py, outlet.py, util.py,
lib/__init__.py).

It listens on every network, and has no setting to do otherwise: its sockets are bound to the loopback device.
Linux gives such a socket only what comes through that device, which carries all that a machine sends to
itself, under each of its addresses, and nothing else.
"""

import importlib
import logging
import os
import socket
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from typing import Any, ClassVar, cast

import numpy as np
import psutil

from common.arrays import Float
from common.calibration.output_settings import LslOutput
from common.clock import now_ns
from common.errors import PhalanxError
from common.hand.model import FINGERS, JOINTS
from common.messages import HandPose, ResultMessage
from master.outputs.network.conventions import MasterTimes

_LOOPBACK = b"lo\0"
_ANYWHERE = frozenset({"0.0.0.0", "::"})
_BOUND_TO_DEVICE: int | None = getattr(socket, "SO_BINDTODEVICE", None)  # Linux alone has it
Socket = tuple[int, object]


def sockets() -> frozenset[Socket]:
    """Return descriptor and address of all IP sockets of this process."""
    return frozenset((one.fd, one.laddr) for one in psutil.Process().net_connections("inet"))


def keep_here(before: Collection[Socket], ports: range) -> bool:
    """Bind the sockets opened since `before` that listen everywhere at `ports` to lo.

    Returns:
        Whether each is bound; False: there is one that is not, or the system cannot determine it, or do it.
    """
    opened = (number for number, _ in sockets() - frozenset(before))
    bound = [_bound(one) for one in _listening(opened, ports)]
    return bool(bound) and all(bound)


def _listening(descriptors: Iterable[int], ports: range) -> Iterator[socket.socket]:
    """Copies of those sockets that listen everywhere at one of the ports."""
    for descriptor in descriptors:
        with suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as one:
            if one.family not in (socket.AF_INET, socket.AF_INET6):
                continue
            address, port = one.getsockname()[:2]
            if address in _ANYWHERE and port in ports:
                yield one


def _bound(one: socket.socket) -> bool:
    if _BOUND_TO_DEVICE is None:
        return False
    try:
        one.setsockopt(socket.SOL_SOCKET, _BOUND_TO_DEVICE, _LOOPBACK)
    except OSError:  # before Linux 5.7 only root may
        return False
    return True


INSTALL = (
    "pip install 'phalanx-hand[lsl]'; where that brings no liblsl, install it"
    " (https://github.com/sccn/liblsl/releases) and name it in the variable PYLSL_LIB"
)
PORTS = range(16572, 16604)  # where liblsl listens for who reads a stream, and for who compares clocks
# Discovery by a datagram on the loopback interface, nothing joined and nothing sent on any other.
_MACHINE = """[log]
level = -2
[ports]
IPv6 = disable
AllowRandomPorts = 0
[multicast]
ResolveScope = machine
ListenAddress = 127.0.0.1
"""


def load_library(scope: str, bound_scope: str | None) -> Any:
    """Import `pylsl` and set who can find its streams, "machine" or "network".

    `bound_scope`: what liblsl was configured with before in this process, which is for ever; None: nothing
    yet.

    Raises:
        PhalanxError: It is not installed, has no liblsl, or one that is too old or was configured otherwise.
    """
    try:
        library = cast(Any, importlib.import_module("pylsl"))
    except ImportError as error:
        raise PhalanxError(f"pylsl is not installed: {INSTALL}") from error
    except (OSError, RuntimeError) as error:  # liblsl is loaded at once
        raise PhalanxError(f"pylsl finds no liblsl that runs here: {INSTALL}") from error
    if bound_scope not in (None, scope):
        raise PhalanxError(
            f"lsl.scope is {scope!r}, but liblsl began with {bound_scope!r} in this process: start"
            " `phalanx send` anew"
        )
    if bound_scope is None and scope == "machine":
        try:
            library.set_config_content(_MACHINE)
        except NotImplementedError as error:
            raise PhalanxError(
                f"liblsl is older than 1.17.7 and cannot be kept to this machine: {INSTALL};"
                " or set lsl.scope network"
            ) from error
    return library


FINGER_ANGLES = ("abduction", "flexion", "pip", "dip")
THUMB_ANGLES = ("cmc-abduction", "cmc-flexion", "mcp", "ip")
_LOG = logging.getLogger(__name__)


def channels() -> tuple[tuple[str, str, str], ...]:
    """Label, type, unit of 124 channels: 20 angles, 26 times x y z, 26 times tracked."""
    angles = [
        (f"{finger}.{angle}", "Angle", "radians")
        for finger in FINGERS
        for angle in (THUMB_ANGLES if finger == "thumb" else FINGER_ANGLES)
    ]
    places = [(f"{joint}.{axis}", f"Position{axis.upper()}", "meters") for joint in JOINTS for axis in "xyz"]
    observed = [(f"{joint}.tracked", "Status", "0 or 1") for joint in JOINTS]
    return (*angles, *places, *observed)


def sample_of(pose: HandPose) -> Float:
    """One sample (124,): as `channels`. NaN where a joint is not known."""
    places = np.where(pose.valid[:, None], pose.position_m, np.nan)
    return np.concatenate([pose.angles_rad.ravel(), places.ravel(), pose.tracked.astype(np.float64)])


class LslSink:
    """A `Sink` that offers every hand as a stream; it ignores other messages."""

    _bound_scope: ClassVar[str | None] = None  # the library is one for the process, and listens once

    def __init__(self, settings: LslOutput, times: MasterTimes) -> None:
        """Load the library; PhalanxError: it, or liblsl, is missing."""
        self._library = load_library(settings.scope, LslSink._bound_scope)
        LslSink._bound_scope = settings.scope
        self._name, self._scope, self._times = settings.name, settings.scope, times
        self._outlets: dict[str, Any] = {}
        self._clock = self._compared()

    def write(self, message: ResultMessage) -> None:
        """Offer one pose; PhalanxError: no stream could be opened."""
        if not isinstance(message, HandPose):
            return
        outlet = self._outlets.get(message.hand)
        if outlet is None:
            outlet = self._outlets[message.hand] = self._opened(message.hand)
        compare_ns = 1_000_000_000  # how often LSL's clock is compared with ours
        if now_ns() - self._clock[0] > compare_ns:
            self._clock = self._compared()
        stamp_s = 1e-9 * self._times.local_ns(message.t_ns) + self._clock[1]
        outlet.push_sample(sample_of(message).tolist(), stamp_s)

    def close(self) -> None:
        """Take the streams back: an outlet ends with the last that holds it."""
        self._outlets.clear()

    def _opened(self, hand: str) -> Any:
        rows = channels()
        # The same hand of the same machine is the same source: an inlet takes it up again after a restart.
        source = f"phalanx-{socket.gethostname()}-{hand}"
        library, name = self._library, f"{self._name}-{hand}"
        info = library.StreamInfo(
            name, "MoCap", len(rows), library.IRREGULAR_RATE, library.cf_float32, source
        )
        description = info.desc()
        description.append_child_value("manufacturer", "Phalanx").append_child_value("hand", hand)
        description.append_child_value("frame", "rig: of the reference camera, x right, y down, z forward")
        listed = description.append_child("channels")
        for label, kind, unit in rows:
            channel = listed.append_child("channel")
            for key, value in (("label", label), ("type", kind), ("unit", unit)):
                channel.append_child_value(key, value)
        before = sockets()
        try:
            buffered = 60  # hundreds of samples, for an inlet that is slow
            outlet = library.StreamOutlet(info, 0, buffered)
        except RuntimeError as error:
            raise PhalanxError(f"{name}: {error}; are ports {PORTS[0]} to {PORTS[-1]} free?") from error
        if self._scope == "machine" and not keep_here(before, PORTS):
            _LOG.warning(
                "lsl: liblsl listens on every network, and this system cannot keep it to itself: let a firewall"
                " close tcp and udp %d to %d",
                PORTS[0],
                PORTS[-1],
            )
        return outlet

    def _compared(self) -> tuple[int, float]:
        """Our clock [ns], and by how many seconds LSL's is ahead of it."""
        before, theirs, after = now_ns(), self._library.local_clock(), now_ns()
        middle = (before + after) // 2
        return middle, theirs - 1e-9 * middle
