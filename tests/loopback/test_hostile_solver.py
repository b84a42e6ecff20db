"""Every attack of every device through the link into the solvers, without a guard: within the bounds nothing raises.

In simulated time and without the bound on the rate, so that far more gets as deep as a solver than from a real device.
"""

import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from msgspec import Struct

from bench.rigs.fuzz import Attack, all_attacks
from bench.rigs.hostile import HAND, HONEST, RATE_HZ, STOLEN, WRIST_RIG, scratch_tree
from bench.rigs.hostile_sender import Speaker, own_kinds
from bench.rigs.rooms import ROOM, detections
from common.link.datagram import MAX_DATAGRAM, OVERHEAD, Kind
from common.link.handshake import EchoAnswer, Started
from common.messages import HandPose, decode, encode
from master.rig.setup import RigSetup, load_setup, load_setups
from master.run.app import result_at
from master.run.dispatcher import new_dispatcher
from master.run.link import MasterLink
from master.run.link_senders import SensorMessage, limits_of
from slave.link import SlaveLink
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
