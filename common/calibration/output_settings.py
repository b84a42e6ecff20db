"""outputs/<name>.json: which live outputs are on, and where each sends to.

Everything is off until somebody switches it on, and stays on this machine until somebody names another: hands and
gestures of a person are that person's. The defaults here are those of calib_json/outputs/default.json.
"""

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta

from common.calibration.files import Part, Quaternion, check_quaternion
from common.messages import Name

Host = Annotated[str, Meta(min_length=1, max_length=255)]
Port = Annotated[int, Meta(ge=1, le=65535)]
Text = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]+(?!\n)$")]

LOOPBACK = "127.0.0.1"


class OscOutput(Part, frozen=True):
    """Open Sound Control over UDP: hands, objects, contact and gestures, rig frame."""

    on: bool = False
    host: Host = LOOPBACK
    port: Port = 9000


class VmcOutput(Part, frozen=True):
    """Virtual Motion Capture protocol (OSC over UDP): hand bones of a VRM avatar.

    `hand`: how the bone of the hand itself is turned: as the palm lies in the room, behind an arm that is kept in the
    T-pose (palm), as the wrist is bent against the forearm, where a device on the forearm gives it (bend), or not at
    all (rest). `q_avatar_rig`: quaternion wxyz, rig frame -> the avatar's frame in OpenXR axes (x to its right, y up,
    z to its back); the default is that of an upright camera that looks where the avatar looks.
    `forearm_m`: how far the hand is from the elbow, for receivers that move bones, too.
    """

    on: bool = False
    host: Host = LOOPBACK
    port: Port = 39539
    hand: Literal["palm", "wrist", "rest"] = "palm"
    q_avatar_rig: Quaternion = (0.0, 1.0, 0.0, 0.0)
    forearm_m: Annotated[float, Meta(ge=0.01, le=2.0)] = 0.25


class Ros2Output(Part, frozen=True):
    """ROS 2 topics as rmw_zenoh publishes them, by its router; needs no ROS."""

    on: bool = False
    router: Host = "tcp/127.0.0.1:7447"
    domain_id: Annotated[int, Meta(ge=0, le=232)] = 0


class LslOutput(Part, frozen=True):
    """Lab Streaming Layer: one outlet a hand, called `name`-HAND.

    `scope`: who can find it: programs of this machine (machine), or whoever the machine's own configuration of liblsl
    lets find it, usually the whole network (network).
    """

    on: bool = False
    name: Text = "Phalanx"
    scope: Literal["machine", "network"] = "machine"


class WebOutput(Part, frozen=True):
    """WebSocket with JSON in the joint order of WebXR, and the page that shows it."""

    on: bool = False
    host: Host = LOOPBACK
    port: Port = 8765


OutputPart: TypeAlias = OscOutput | VmcOutput | Ros2Output | LslOutput | WebOutput


class OutputSettings(Part, frozen=True):
    """outputs/<name>.json: the live outputs of `phalanx send`."""

    version: Literal[1]
    name: Name
    osc: OscOutput = OscOutput()
    vmc: VmcOutput = VmcOutput()
    ros2: Ros2Output = Ros2Output()
    lsl: LslOutput = LslOutput()
    web: WebOutput = WebOutput()


def default_outputs(name: str = "default") -> OutputSettings:
    """What holds where there is no file: everything off."""
    return OutputSettings(version=1, name=name)


def check_outputs(settings: OutputSettings, where: str) -> None:
    """Refuse a quaternion that is not of length 1: CalibrationError with the key."""
    check_quaternion(settings.vmc.q_avatar_rig, f"{where}: vmc.q_avatar_rig")
