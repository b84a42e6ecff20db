"""Hands as streams of the Lab Streaming Layer.

To be recorded beside EEG, EMG, eye trackers and markers.

One outlet a hand, opened with its first pose; a sample a pose, at the time at which the pose holds. The clock of LSL
is this machine's, so a recording aligns hands with whatever other machines measure.
"""

import logging
import socket
from typing import ClassVar

import numpy as np

from common.arrays import Float
from common.calibration.output_settings import LslOutput
from common.clock import now_ns
from common.errors import PhalanxError
from common.hand.model import FINGERS, JOINTS
from common.messages import HandPose, ResultMessage
from master.outputs.network.here_only import keep_here, sockets
from master.outputs.network.lsl_library import PORTS, Library, Outlet, load_library
from master.outputs.network.times import Times

FINGER_ANGLES = ("abduction", "flexion", "pip", "dip")
THUMB_ANGLES = ("cmc-abduction", "cmc-flexion", "mcp", "ip")
_LOG = logging.getLogger(__name__)


def channels() -> tuple[tuple[str, str, str], ...]:
    """Return label, type and unit of every channel.

    20 angles, 26 times x y z, whether each joint is observed.
    """
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
    """A `Sink` that offers every hand as a stream; other messages are nothing to it.

    Holds the library, the outlets, and how LSL's clock runs against ours.
    """

    _bound_scope: ClassVar[str | None] = None  # the library is one for the process, and listens once

    def __init__(self, settings: LslOutput, times: Times) -> None:
        """Load the library.

        Raises:
            PhalanxError: It, or liblsl, is missing.
        """
        self._library: Library = load_library(settings.scope, LslSink._bound_scope)
        LslSink._bound_scope = settings.scope
        self._name, self._scope, self._times = settings.name, settings.scope, times
        self._outlets: dict[str, Outlet] = {}
        self._clock = self._compared()

    def write(self, message: ResultMessage) -> None:
        """Offer one pose.

        Raises:
            PhalanxError: No stream could be opened.
        """
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

    def _opened(self, hand: str) -> Outlet:
        rows = channels()
        # The same hand of the same machine is the same source: an inlet takes it up again after a restart.
        source = f"phalanx-{socket.gethostname()}-{hand}"
        info = self._library.StreamInfo(
            f"{self._name}-{hand}",
            "MoCap",
            len(rows),
            self._library.IRREGULAR_RATE,
            self._library.cf_float32,
            source,
        )
        description = info.desc()
        description.append_child_value("manufacturer", "Phalanx").append_child_value("hand", hand)
        description.append_child_value("frame", "rig: of the reference camera, x right, y down, z forward")
        listed = description.append_child("channels")
        for label, kind, unit in rows:
            listed.append_child("channel").append_child_value("label", label).append_child_value(
                "type", kind
            ).append_child_value("unit", unit)
        before = sockets()
        try:
            buffered = 60  # hundreds of samples, for an inlet that is slow
            outlet = self._library.StreamOutlet(info, 0, buffered)
        except RuntimeError as error:
            raise PhalanxError(
                f"{self._name}-{hand}: {error}; are ports {PORTS[0]} to {PORTS[-1]} free?"
            ) from error
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
