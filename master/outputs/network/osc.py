"""Hands, objects, contact and gestures as Open Sound Control.

For sound and light, patches and sketches.

Each message of the master is one bundle whose time tag is the epoch it describes, in one datagram (addresses:
docs/outputs.md). What is not known has no message in its bundle. All is in the rig's frame, in metres and radians.
"""

from collections.abc import Callable, Hashable, Sequence

import numpy as np

from common.calibration.output_settings import OscOutput
from common.hand.model import FINGERS, JOINTS
from common.messages import Contact, Gesture, HandPose, ObjectPose, ResultMessage
from master.outputs.network.osc_packets import Blank, BlankBundle, Words, floats, ints
from master.outputs.network.sides import Side, side_of
from master.outputs.network.times import Times
from master.outputs.network.udp import UdpSender

POSE = "fffffffi"  # x y z, quaternion x y z w, tracked
_XYZW = [1, 2, 3, 0]


class OscSink:
    """A `Sink` that sends each message as one OSC bundle.

    Holds the socket, the blanks, and a count of poses.
    """

    def __init__(self, settings: OscOutput, times: Times) -> None:
        """Open the socket.

        Raises:
            PhalanxError: The host is unknown.
        """
        self._times = times
        self._blanks: dict[Hashable, BlankBundle] = {}
        self._count = 0
        self._udp = UdpSender(settings.host, settings.port, "osc")

    def write(self, message: ResultMessage) -> None:
        """Send one message.

        Raises:
            PhalanxError: This machine cannot send there.
        """
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
            [
                floats(pose.position_m),
                floats(pose.orientation_wxyz[_XYZW]),
                ints([pose.tracked]),
            ]
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
    """Return the messages of a hand.

    Its number and latency, every joint, the angles of every finger.
    """
    top = f"/phalanx/hand/{side}"
    return [
        Blank(f"{top}/frame", (hand,), "if"),
        *(Blank(f"{top}/{joint}", (), POSE) for joint in JOINTS),
        *(Blank(f"{top}/{finger}/angles", (), "ffff") for finger in FINGERS),
    ]
