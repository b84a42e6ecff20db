"""Every attack of every device through the link into the solvers, without a guard: within the bounds nothing raises.

In simulated time and without the bound on the rate, so that far more gets as deep as a solver than from a real device.
"""

import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec import Struct

from bench.rigs.rooms import ROOM, detections
from common.link.datagram import MAX_DATAGRAM, OVERHEAD, Kind, Refusal
from common.link.handshake import EchoAnswer, Started
from common.messages import (
    HandPose,
    ImuSample,
    MarkerDetections,
    TagDetections,
    TrackerPose,
    WristDetections,
    decode,
    encode,
)
from master.rig.setup import RigSetup, load_setup, load_setups
from master.run.app import result_at
from master.run.dispatcher import new_dispatcher
from master.run.link import MasterLink
from master.run.link_senders import SensorMessage, limits_of
from slave.link import SlaveLink
from tests.faults.fuzz import Attack, all_attacks
from tests.faults.hostile import HAND, HONEST, RATE_HZ, STOLEN, WRIST_RIG, scratch_tree
from tests.faults.hostile_sender import Speaker, own_kinds
from tests.loopback.test_handshake import BROADCAST, KEY, MASTER, S, Wires
from tests.network_helpers import seeded

BETWEEN = 6  # attacks between two honest frames
KINDS: dict[type[Struct], Kind] = {EchoAnswer: Kind.ECHO_ANSWER, Started: Kind.STARTED}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scratch_tree(tmp_path_factory.mktemp("hostile"))


class Room:
    """A master of two hands and an object, six senders in sessions, of which one says what he likes."""

    def __init__(self, tree: Path, device: str) -> None:
        setups = load_setups(tree, (ROOM, WRIST_RIG), None)
        self.setup: RigSetup = load_setup(tree, STOLEN[device])
        self.wires, self.dispatcher, self.poses = Wires(), new_dispatcher(setups), 0
        limits = {name: replace(one, rate_hz=1e6) for name, one in limits_of(setups).items()}
        others = (("imu",), ("wrist",), ("tracker",))
        cameras = (*HONEST, "cam02", "wrist")
        self.wires.master = self.link = MasterLink(
            cameras, KEY, self.wires.clock, BROADCAST, "", S, seeded(5), *others, limits
        )
        self.slaves = {name: self.wires.new_slave(name) for name in (*cameras, "imu", "tracker")}
        assert self.wires.run(4.0, self.wires.all_started)
        self.wires.run(1.0)
        self._frames, self._seq = detections(load_setup(tree, ROOM), RATE_HZ), 0
        self._speaker, self._stolen = Speaker(device, self.setup), self.slaves[device]

    def honest(self) -> None:
        """The next frame of both honest cameras."""
        self.wires.run(1.0 / RATE_HZ)
        self._seq += 1
        t_ns = self.wires.clock.t_ns
        for name in HONEST:
            frame, slave = self._frames[name][self._seq % len(self._frames[name])], self.slaves[name]
            now: dict[str, int] = {
                "session": slave.process,
                "seq": self._seq,
                "t_ns": t_ns,
                "ready_t_ns": t_ns,
            }
            self.wires.send(slave, msgspec.structs.replace(frame, **now))
            self.solve()

    def attack(self, attack: Attack) -> None:
        """Notify it, and solve what comes of it."""
        session = self._stolen._session
        assert session is not None
        body = self._speaker.body(attack, self._stolen.process, self.wires.clock.t_ns)
        if len(body) <= MAX_DATAGRAM - OVERHEAD:
            sealed = session.sealer.seal(KINDS.get(attack.kind, Kind.DATA), body)
            self.wires.carry(sealed, self.address(self._stolen), MASTER, keep=False)
        self.solve()

    def address(self, slave: SlaveLink) -> tuple[str, int]:
        return next(address for address, other in self.wires.slaves.items() if other is slave)

    def solve(self) -> None:
        """Publish what comes of all that was taken, as a reader decodes it."""
        for message in self.taken():
            for solved in self.dispatcher.push(message):
                out = decode(encode(result_at(solved, self.wires.clock.t_ns)))
                self.poses += isinstance(out, HandPose) and out.hand == HAND

    def taken(self) -> Iterator[SensorMessage]:
        for came in (self.wires.got, self.wires.tags, self.wires.samples, self.wires.tracked):
            while came:
                yield came.pop(0)


@pytest.mark.parametrize("device", STOLEN)
def test_no_attack_makes_a_solver_raise_or_costs_the_honest_hand_a_pose(tree: Path, device: str) -> None:
    room, source = Room(tree, device), random.Random(4)
    kinds = (*own_kinds(device, room.setup), EchoAnswer, Started)
    groups = [group for found in all_attacks(kinds, room._speaker.bases, source).values() for group in found]
    source.shuffle(groups)
    for k, group in enumerate(groups):
        for attack in group:
            try:
                room.attack(attack)
            except Exception as error:
                raise AssertionError(f"{attack.what}: {error!r}") from error
        if k % BETWEEN == 0:
            room.honest()
    assert not room.link.quarantine.faults
    received = room.link.counts_of(device).received
    assert received > 0.05 * len(groups), "some attacks are within all bounds and reach the solvers"
    assert room.poses >= 0.98 * len(groups) / BETWEEN - 3


def array(count: int, value: float) -> bytes:
    return np.full(count, value).tobytes()


# The type, the field, and the reasons, of which one is counted.
Absurd = tuple[type[Struct], dict[str, object], tuple[Refusal, ...]]
BOUNDS, PICTURE, READY = Refusal.OUT_OF_BOUNDS, Refusal.OUTSIDE_PICTURE, Refusal.READY_TIME
LATE: tuple[Refusal, ...] = ()  # counted as a time that no clock explains
LEAST = -(2**63)
ABSURD: dict[str, list[Absurd]] = {
    "cam02": [
        *((MarkerDetections, {"uv": array(12, v)}, (PICTURE, BOUNDS)) for v in (1e9, 1e15, -1e9, 1500.0)),
        *((MarkerDetections, {name: array(6, 1e300)}, (BOUNDS,)) for name in ("sigma_px", "area", "quality")),
        (MarkerDetections, {"ready_t_ns": LEAST}, (READY, BOUNDS)),
        (MarkerDetections, {"ready_t_ns": 0}, (READY,)),
        (MarkerDetections, {"t_ns": 0, "ready_t_ns": 1000}, LATE),
        (TagDetections, {"uv": array(24, 1e300)}, (BOUNDS,)),
        (TagDetections, {"sigma_px": array(3, 1e300)}, (BOUNDS,)),
        (TagDetections, {"ready_t_ns": 0}, (READY,)),
    ],
    "wrist": [
        (WristDetections, {"laser_uv": array(10, 1e15)}, (PICTURE, BOUNDS)),
        (WristDetections, {"laser_sigma_px": array(5, 1e300)}, (BOUNDS,)),
        (WristDetections, {"ready_t_ns": -(2**61)}, (READY,)),
        (WristDetections, {"t_ns": 0, "ready_t_ns": 1000}, LATE),
    ],
    "imu": [
        (ImuSample, {"heading_sigma_rad": 1e300}, (BOUNDS,)),
        (ImuSample, {"gyro_rad_s": array(3, 1e300)}, (BOUNDS,)),
        (ImuSample, {"accel_m_s2": array(3, 1e15)}, (BOUNDS,)),
        (ImuSample, {"t_ns": 0}, LATE),
    ],
    "tracker": [
        (TrackerPose, {"position_m": array(3, 1e300)}, (BOUNDS,)),
        (TrackerPose, {"orientation_wxyz": array(4, 1e9)}, (BOUNDS,)),
        (TrackerPose, {"t_ns": 0}, LATE),
    ],
}


def refused(room: Room, reasons: tuple[Refusal, ...]) -> int:
    """How many were for one of the reasons."""
    return sum(room.link.refused[reason] for reason in reasons) if reasons else room.link.unsynchronised


@pytest.mark.parametrize("device", STOLEN)
def test_numbers_that_cannot_be_are_refused_for_their_reason(tree: Path, device: str) -> None:
    room = Room(tree, device)
    for kind, changes, reasons in ABSURD[device]:
        room.honest()
        room.attack(Attack("as it should be", kind))
        before = refused(room, reasons)
        for _ in range(10):  # frames in which not all is seen are undecodable then
            room.attack(Attack("absurd", kind, changes))
            if refused(room, reasons) > before:
                break
        assert refused(room, reasons) == before + 1, f"{kind.__name__} {list(changes)}: {room.link.refused}"
    assert not room.link.quarantine.faults
