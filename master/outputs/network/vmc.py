"""Hands as bones of a VRM avatar, by the Virtual Motion Capture protocol.

OSC over UDP, protocol.vmc.info, 3.1.

Two datagrams a pose, each below the size that a network splits: what is available, the time and the root; then the
bones of the hand. Bones of which nothing is known are left out, so that the avatar keeps them as they are.
"""

import numpy as np

from common.arrays import Bool, Float
from common.calibration.output_settings import VmcOutput
from common.geometry.transforms import quaternion_to_matrix
from common.hand.wrist_joint import forearm_palm
from common.messages import HandPose, ResultMessage
from master.outputs.network.osc_packets import Blank, BlankBundle, floats, ints
from master.outputs.network.sides import Side, side_of
from master.outputs.network.times import Times
from master.outputs.network.udp import UdpSender
from master.outputs.network.vmc_bones import BoneMap, bone_names

OK, TIME, ROOT, BONE = "/VMC/Ext/OK", "/VMC/Ext/T", "/VMC/Ext/Root/Pos", "/VMC/Ext/Bone/Pos"
_LOADED = ints([1, 3, 0])  # a model is loaded, it is calibrated, normal mode
_ORIGIN = floats([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
_STILL = np.array([0.0, 0.0, 0.0, 1.0])


class VmcSink:
    """A `Sink` that sends every pose as bones.

    It ignores other messages. Holds the socket and the blanks.
    """

    def __init__(self, settings: VmcOutput, times: Times) -> None:
        """Open the socket.

        Raises:
            PhalanxError: The host is unknown.
        """
        self._settings, self._times = settings, times
        rotation = quaternion_to_matrix(np.array(settings.q_avatar_rig))
        sides: tuple[Side, ...] = ("left", "right")
        self._maps = {side: BoneMap(side, rotation) for side in sides}
        self._bones = {
            side: BlankBundle([Blank(BONE, (name,), "f" * 7) for name in bone_names(side)]) for side in sides
        }
        self._state = BlankBundle(
            [Blank(OK, (), "iii"), Blank(TIME, (), "f"), Blank(ROOT, ("root",), "f" * 7)]
        )
        self._began_ns: int | None = None
        self._udp = UdpSender(settings.host, settings.port, "vmc")

    def write(self, message: ResultMessage) -> None:
        """Send one pose.

        Raises:
            PhalanxError: This machine cannot send there.
        """
        if not isinstance(message, HandPose):
            return
        side = side_of(message)
        if side is None:
            return  # nothing of it is known
        if self._began_ns is None:
            self._began_ns = message.t_ns
        wall_ns = self._times.wall_ns(message.t_ns)
        since = floats([1e-9 * (message.t_ns - self._began_ns)])
        self._udp.send(self._state.filled(wall_ns, np.concatenate([_LOADED, since, _ORIGIN])))
        place, quaternion = self._rows(message, side)
        rows: Float = np.concatenate([place, quaternion], axis=1)
        known: Bool = np.asarray(np.isfinite(rows).all(axis=1))
        self._udp.send(self._bones[side].filled(wall_ns, floats(rows).ravel(), known))

    def close(self) -> None:
        """Give the socket back."""
        self._udp.close()

    def _rows(self, pose: HandPose, side: Side) -> tuple[Float, Float]:
        """Return positions (16, 3) [m] and rotations xyzw (16, 4).

        The hand's own bone is as the settings state.
        """
        bones = self._maps[side].bones(pose)
        place, quaternion = bones.position_m, bones.rotation_xyzw
        place[0] = (self._settings.forearm_m if side == "right" else -self._settings.forearm_m, 0.0, 0.0)
        if self._settings.hand == "rest":
            quaternion[0] = _STILL
        elif self._settings.hand == "wrist":
            quaternion[0] = self._maps[side].flexed(forearm_palm(pose.wrist_angles_rad))
        return place, quaternion
