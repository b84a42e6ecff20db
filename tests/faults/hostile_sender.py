"""A stolen device of the rig, as a process that attacks the master.

It has its own key and a session as any other, and sends any message in it, and on the bus what devices publish there.

`python -m tests.faults.hostile_sender NAME TREE RIG BEACON_PORT BUS COUNT PER_S SEED`, BUS the endpoint of the master's
bus, the rig key in PHALANX_RIG_KEY. It prints `ready` when it has a session, waits for a line, sends COUNT messages,
and prints how many of each type as JSON.
"""

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import msgspec
import numpy as np
import zenoh
from msgspec import Struct

from bench.rigs.rooms import detections
from common.arrays import Float
from common.bus.keys import rig_key
from common.bus.settings import settings
from common.clock import SystemClock
from common.link.datagram import MAX_DATAGRAM, OVERHEAD, Address, Kind
from common.link.handshake import EchoAnswer, Hello, RigKeys, Started
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
from common.messages.streams import key_of
from common.sim.wrist.scene import WristScene
from master.rig.setup import RigSetup, load_setup
from slave.uplink import Uplink
from tests.faults.fuzz import MESSAGE_TYPES, Attack, Fields, flood, wire

_JPEG = cv2.imencode(".jpg", np.full((16, 16, 3), 90, np.uint8))[1].tobytes()
_UNIT = np.array([1.0, 0.0, 0.0, 0.0])


class Speaker:
    """Plausible messages of one device, by type, and the number of the newest."""

    def __init__(self, name: str, setup: RigSetup | None = None) -> None:
        """Make messages of the device `name`; a camera of `setup` sees what the camera of a simulation does."""
        self.bases = examples(name)
        self._frames = frames_of(name, setup)
        self._seq = 0

    def body(self, attack: Attack, session: int, now_ns: int) -> bytes:
        """The bytes of an attack, made of a plausible message of now."""
        self._seq += 1
        frames = self._frames.get(attack.kind)
        base = self.bases[attack.kind] if frames is None else frames[self._seq % len(frames)]
        ready_ns = now_ns + 1_000_000
        live: Fields = {"session": session, "seq": self._seq, "t_ns": now_ns, "ready_t_ns": ready_ns}
        seq = attack.changes.get("seq")
        followed = 10**6
        if isinstance(seq, int) and 0 < seq - self._seq < followed:
            self._seq = seq  # it may have been taken: what comes after it is not to be late
        return attack.body(base | {name: live[name] for name in live if name in base}, now_ns)


def frames_of(name: str, setup: RigSetup | None) -> dict[type[Struct], list[Fields]]:
    """Messages of the camera `name` before a moving hand; empty where it is no camera of the setup."""
    if setup is None or name not in setup.models:
        return {}
    loop, rate_hz = 300, 30.0  # frames, then the same again
    if setup.wrist_cameras:
        return {WristDetections: [wire(one) for one in cycles(setup, loop, rate_hz)]}
    return {MarkerDetections: [wire(one) for one in detections(setup, rate_hz)[name][:loop]]}


def own_kinds(name: str, setup: RigSetup) -> tuple[type[Message], ...]:
    """The types that a device of that name sends."""
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
    messages = (*_sensed(name), *_solved(name), *_state(name), *_handshakes(name))
    return {type(message): wire(message) for message in messages}


def _seen(uv: Float, value: float) -> Float:
    return np.where(np.isnan(uv).any(axis=1), np.nan, value)


def _sensed(name: str) -> tuple[Struct, ...]:
    six, five = np.ones(6), np.ones(5)
    uv = np.stack([(260.0, 300.0, 325.0, 350.0, 375.0, 320.0), (180.0, 150.0, 145.0, 150.0, 170.0, 260.0)], 1)
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
    return (Hello(name, 1, nonce, nonce, nonce), Started(1), EchoAnswer(1, 2, 3))


ON_BUS: Mapping[type[Struct], str] = {Health: "health", Preview: "preview", Still: "still"}  # with its stream


def raw_bus(endpoint: str) -> zenoh.Session:
    """A session on the bus, in which any bytes can be put under any key."""
    made = settings(None, [endpoint], "client", None)
    return zenoh.open(zenoh.Config.from_json5(msgspec.json.encode(made).decode()))


class HostileUplink(Uplink):
    """An uplink that seals any body as any kind; it answers echoes rightly besides, so the session lives."""

    def notify(self, kind: Kind, body: bytes) -> bool:
        """Send a body in the session; False: there is none, or it does not fit."""
        with self._lock:
            session = self._link._session
            if session is None or len(body) > MAX_DATAGRAM - OVERHEAD:
                return False
            return self._data.send(session.sealer.seal(kind, body), session.address)

    def throw(self, datagram: bytes) -> bool:
        """Send a datagram as it is to the master."""
        with self._lock:
            session = self._link._session
            return session is not None and self._data.send(datagram, session.address)

    @property
    def master(self) -> tuple[bytes, Address] | None:
        """The nonce and the address of the master, or None without a session."""
        session = self._link._session
        return None if session is None else (session.master_nonce, session.address)


class HostileSender:
    """One device that sends attacks. Holds its link, its session on the bus, and its plausible messages."""

    def __init__(
        self, name: str, key: bytes, port: int, setup: RigSetup, endpoint: str, seed: int = 1
    ) -> None:
        """Listen for the master, and connect to its bus at `endpoint`; `setup` as of `Speaker`."""
        self._bus = raw_bus(endpoint)
        self.name, self._clock, self._keys = name, SystemClock(), RigKeys(key)
        self.uplink = HostileUplink(name, key, self._clock, port, "127.0.0.1")
        self._hello = self._keys.sealer(self.uplink.session ^ 1)
        self._speaker, self._own, self._seed = Speaker(name, setup), own_kinds(name, setup), seed
        self.sent: Counter[str] = Counter()

    def attacks(self, count: int) -> Iterator[Attack]:
        """Draw so many, most of the kinds that such a device sends."""
        shakes = (Hello, Started, EchoAnswer)
        others = [kind for kind in MESSAGE_TYPES if kind not in (*self._own, *ON_BUS, *shakes)]
        shares: dict[type[Struct], float] = {}
        for kinds, share in ((self._own, 0.5), (ON_BUS, 0.2), (others, 0.1), (shakes, 0.2)):
            shares |= {kind: share / len(kinds) for kind in kinds}
        return flood(shares, self._speaker.bases, count, self._seed)

    def send(self, attack: Attack) -> bool:
        """Send one; False: it fits into no datagram, or there is no session."""
        body = self._body(attack)
        sent = self._send(attack.kind, body) and (not attack.twice or self._send(attack.kind, body))
        self.sent[attack.kind.__name__ if sent else "unsent"] += 1
        return sent

    def send_message(self, kind: type[Struct], **changes: object) -> bool:
        """Send a plausible message of now with these fields."""
        return self.send(Attack("", kind, changes))

    def close(self) -> None:
        """End its session, and leave the bus."""
        self.uplink.close()
        self._bus.close()

    def send_all(self, attacks: Sequence[Attack], count: int, per_s: float) -> None:
        """Send `count` of them at this rate, or as fast as the machine gives."""
        began = time.monotonic()
        for k, attack in enumerate(attacks):
            if self.sent.total() - self.sent["unsent"] >= count:
                return
            self.send(attack)
            if k % 16 == 15:
                time.sleep(max(0.0, (k + 1) / per_s - (time.monotonic() - began)))

    def _body(self, attack: Attack) -> bytes:
        now_ns, master = self._clock.now_ns(), self.uplink.master
        if attack.kind is Hello and master is not None:
            hello = self._keys.hello(self.name, self.uplink.session, os.urandom(16), master[0])
            return attack.body(wire(hello), now_ns)
        return self._speaker.body(attack, self.uplink.session, now_ns)

    def _send(self, kind: type[Struct], body: bytes) -> bool:
        if kind is Hello:
            fits = len(body) <= MAX_DATAGRAM - OVERHEAD
            return fits and self.uplink.throw(self._hello.seal(Kind.HELLO, body))
        if kind in ON_BUS:  # it waits where the link is full: nothing is dropped on this side
            key, waits = key_of(ON_BUS[kind], self.name), zenoh.CongestionControl.BLOCK
            self._bus.put(key, body, congestion_control=waits)
            return True
        if kind is Started:
            return self.uplink.notify(Kind.STARTED, body)
        return self.uplink.notify(Kind.ECHO_ANSWER if kind is EchoAnswer else Kind.DATA, body)


def main() -> None:
    """Get a session, wait for a line, send."""
    name, tree, rig, port, bus, *numbers = sys.argv[1:]
    count, per_s, seed = int(numbers[0]), float(numbers[1]), int(numbers[2])
    setup, key = load_setup(Path(tree), rig), rig_key(os.environ, None)
    sender = HostileSender(name, key, int(port), setup, bus, seed)
    spare = 1.05  # so many more are made, for those that fit into no datagram
    attacks = list(sender.attacks(round(spare * count)))
    if not sender.uplink.wait_for_start(60.0):
        raise SystemExit("no master: does it have this device, this key and this beacon port?")
    print("ready", flush=True)
    sys.stdin.readline()
    began = time.monotonic()
    sender.send_all(attacks, count, per_s)
    seconds = time.monotonic() - began
    print(json.dumps({"seconds": seconds, **sender.sent}), flush=True)
    sender.close()


if __name__ == "__main__":
    main()
