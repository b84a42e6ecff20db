"""A plausible message of each type that a slave may say.

Hostile messages are made from them.
"""

import cv2
import numpy as np
from msgspec import Struct

from bench.rigs.fuzz import Attack, Fields, wire
from bench.rigs.rooms import detections
from common.arrays import Float
from common.link.handshake import EchoAnswer, Hello, Started
from common.messages import (
    Backlog,
    CheckItem,
    Checklist,
    Command,
    Contact,
    Gesture,
    HandPose,
    Health,
    ImuSample,
    MarkerDetections,
    Message,
    ObjectPose,
    Preview,
    Still,
    TagDetections,
    TrackerPose,
    WristDetections,
)
from common.sim.wrist.scene import WristScene
from master.rig.setup import RigSetup

_JPEG = cv2.imencode(".jpg", np.full((16, 16, 3), 90, np.uint8))[1].tobytes()
_LOOP, _RATE_HZ = 300, 30.0  # frames, then the same again
_FOLLOWED = 10**6
_UNIT = np.array([1.0, 0.0, 0.0, 0.0])


class Speaker:
    """Make the messages of one device.

    Holds plausible messages of each type, and the number of the newest.
    """

    def __init__(self, name: str, setup: RigSetup | None = None) -> None:
        """Make messages of the device `name`.

        Where it is a camera of `setup`, it sees what the camera of a simulation does.
        """
        self.bases = examples(name)
        self._frames = frames_of(name, setup)
        self._seq = 0

    def body(self, attack: Attack, session: int, now_ns: int) -> bytes:
        """The bytes of an attack, made of a plausible message of now."""
        self._seq += 1
        frames = self._frames.get(attack.kind)
        base = self.bases[attack.kind] if frames is None else frames[self._seq % len(frames)]
        live: Fields = {
            "session": session,
            "seq": self._seq,
            "t_ns": now_ns,
            "ready_t_ns": now_ns + 1_000_000,
        }
        seq = attack.changes.get("seq")
        if isinstance(seq, int) and 0 < seq - self._seq < _FOLLOWED:
            self._seq = seq  # it may have been taken: what comes after it is not to be late
        return attack.body(base | {name: live[name] for name in live if name in base}, now_ns)


def frames_of(name: str, setup: RigSetup | None) -> dict[type[Struct], list[Fields]]:
    """Messages of the camera `name` before a moving hand.

    Empty where `name` is no camera of the setup.
    """
    if setup is None or name not in setup.models:
        return {}
    if setup.wrist_cameras:
        return {WristDetections: [wire(one) for one in cycles(setup, _LOOP, _RATE_HZ)]}
    return {MarkerDetections: [wire(one) for one in detections(setup, _RATE_HZ)[name][:_LOOP]]}


def own_kinds(name: str, setup: RigSetup) -> tuple[type[Message], ...]:
    """The types that a device of that name says."""
    if name in setup.imus:
        return (ImuSample,)
    if name in setup.trackers:
        return (TrackerPose,)
    return (WristDetections,) if name in setup.wrist_cameras else (MarkerDetections, TagDetections)


def cycles(setup: RigSetup, count: int, rate_hz: float) -> list[WristDetections]:
    """What the camera of a wrist device measures, without errors."""
    scene = WristScene.by_name("standard", setup.rig, setup.cameras, setup.hand.profile, 7)
    out: list[WristDetections] = []
    for k in range(count):
        now = scene.truth(k / rate_hz)
        laser, tips = now.laser_uv[1:6], np.where(now.tip_visible[:, None], now.tip_uv, np.nan)
        depth = np.where(now.tip_visible, now.tip_xyz[:, 2], np.nan)
        sigma, length, tip_sigma = _seen(laser, 0.2), _seen(laser, 20.0), _seen(tips, 2.0)
        name = setup.rig.cameras[0]
        out.append(WristDetections(name, 1, 3 * k, 0, 0, laser, sigma, length, tips, tip_sigma, depth))
    return out


def examples(name: str) -> dict[type[Struct], Fields]:
    """One of each type, in the name of a device."""
    said = (*_sensed(name), *_solved(name), *_state(name), *_handshakes(name))
    return {type(message): wire(message) for message in said}


def _seen(uv: Float, value: float) -> Float:
    return np.where(np.isnan(uv).any(axis=1), np.nan, value)


def _sensed(name: str) -> tuple[Struct, ...]:
    six, five = np.ones(6), np.ones(5)
    uv = np.array(
        [[260.0, 180.0], [300.0, 150.0], [325.0, 145.0], [350.0, 150.0], [375.0, 170.0], [320.0, 260.0]]
    )
    line, ids = 100.0 + 40.0 * np.arange(10.0).reshape(5, 2), np.arange(3, dtype=np.uint16)
    corners = 100.0 + 20.0 * np.arange(24.0).reshape(3, 4, 2)
    return (
        MarkerDetections(name, 1, 1, 1, 1, uv, 150.0 * six, six, 0.1 * six, uv + 40.0, 1000.0),
        WristDetections(name, 1, 1, 1, 1, line, 0.2 * five, 20.0 * five, line - 50.0, 2.0 * five, 0.1 * five),
        TagDetections(name, 1, 1, 1, 1, ids, corners, np.full(3, 0.1), 1000.0),
        TrackerPose(name, 1, 1, 1, np.array([0.3, 1.0, -0.5]), _UNIT),
        ImuSample(name, 1, 1, 1, np.zeros(3), np.array([0.0, 0.0, 9.81]), np.array([20.0, 0.0, -40.0]), _UNIT, 0.01),
    )  # fmt: skip


def _solved(name: str) -> tuple[Struct, ...]:
    joints, truth, code = np.zeros((26, 3)), np.ones(26, np.bool_), np.ones(26, np.uint8)
    markers, covariance = np.zeros((6, 3)), np.tile(1e-6 * np.eye(3), (26, 1, 1))
    five = np.full(5, 0.01)
    return (
        HandPose(
            name, 1, joints, np.tile(_UNIT, (26, 1)), np.full(26, 0.008), truth, truth, covariance, code,
            np.zeros((5, 4)), markers, markers, covariance[:6], truth, 1,
        ),
        ObjectPose(name, 1, np.zeros(3), _UNIT, 1e-6 * np.eye(6), 0.001, 1, True, 3, 4, False, 1),
        Contact(name, "cube", 1, five, five, np.zeros((5, 3)), np.zeros(5, np.bool_), 0.02, False),
        Gesture(name, 1, "pinch", "index", "begin", 1, 0.9, 0.01, 0.5, 0.1, np.zeros(3), np.ones(3)),
    )  # fmt: skip


def _state(name: str) -> tuple[Struct, ...]:
    item = CheckItem("rate_low", name, "it is slow", "make it faster")
    return (
        Health(name, 1, 1, {"frames": 5}, {"rate_hz": 30.0}, "pi", "0.4.0"),
        Checklist(name, 1, 1, (item,)),
        Command(name, "report", "{}"),
        Backlog(name, 1, 2),
        Preview(name, 1, _JPEG),
        Still(name, 1, 1, _JPEG),
    )


def _handshakes(name: str) -> tuple[Struct, ...]:
    nonce = bytes(16)
    return (
        Hello(name, 1, nonce, nonce, nonce),
        Started(1),
        EchoAnswer(1, 2, 3),
    )
