"""Two processes of one name, and sides of different wire versions: who is taken, and that both sides say why not."""

from collections.abc import Callable
from typing import TypeVar

import pytest

import common.link.datagram
from common.link.datagram import HEADER, Kind, Refusal
from common.messages import WIRE_VERSION
from slave.link import SlaveLink
from tests.loopback.test_handshake import BROADCAST, MASTER, Wires, started_pair
from tests.network_helpers import detections

OTHER = WIRE_VERSION - 1
Said = TypeVar("Said")


def stream(wires: Wires, *slaves: SlaveLink, seconds: float, first: int = 0) -> list[int]:
    """Each sends a frame every 20 ms; the processes whose frames were taken, one after another."""
    before = len(wires.got)
    for k in range(round(seconds / 0.02)):
        for slave in slaves:
            wires.send(slave, detections("left", slave.process, first + k, wires.clock.now_ns()))
        wires.run(0.02)
    return [message.session for message in wires.got[before:]]


def test_of_two_with_one_name_the_first_keeps_its_session_and_both_sides_say_so() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    duplicate = wires.new_slave("left")
    taken = stream(wires, left, duplicate, seconds=5.0)
    assert set(taken) == {left.process}
    assert len(taken) == 250
    assert not duplicate.started
    assert master.refused[Refusal.DUPLICATE_SENDER] > 50  # it says hello again and again
    assert set(master.rejected_peers.lately("duplicate", wires.clock.now_ns())) == {"left"}
    assert duplicate.refused[Refusal.DUPLICATE_SENDER] > 10
    assert duplicate.wrong is not None
    assert "'left'" in duplicate.wrong
    assert left.wrong is None
    assert not left.refused


def test_the_second_is_taken_as_soon_as_the_first_is_silent_and_then_keeps_it() -> None:
    wires = Wires()
    master, left, _ = started_pair(wires)
    duplicate = wires.new_slave("left")
    stream(wires, left, duplicate, seconds=1.0)
    address = next(address for address, slave in wires.slaves.items() if slave is left)
    del wires.slaves[address]  # its cable is out
    assert wires.run(1.0, lambda: duplicate.started)
    stream(wires, duplicate, seconds=2.0)
    wires.slaves[address] = left  # and is in again
    taken = stream(wires, left, duplicate, seconds=5.0, first=1000)
    assert set(taken) == {duplicate.process}
    assert left.wrong is not None
    assert duplicate.wrong is None
    assert not master.rejected_peers.lately("version", wires.clock.now_ns())
    wires.remove(left)
    wires.run(3.0)
    assert not master.rejected_peers.lately("duplicate", wires.clock.now_ns())


@pytest.mark.parametrize("seed", [1, 3])
def test_two_that_come_at_once_never_take_turns(seed: int) -> None:
    wires = Wires(loss=0.1, seed=seed)
    wires.new_master(("left",))
    pair = wires.new_slave("left"), wires.new_slave("left")
    assert wires.run(5.0, lambda: any(slave.started for slave in pair))
    stream(wires, *pair, seconds=2.0)
    taken = stream(wires, *pair, seconds=5.0, first=1000)
    assert len(set(taken)) == 1


@pytest.mark.parametrize("seed", [0, 11, 15, 17])
def test_of_two_that_came_at_once_the_other_is_taken_when_the_first_is_gone(seed: int) -> None:
    wires = Wires(loss=0.3, seed=seed)
    master = wires.new_master(("left",))
    pair = wires.new_slave("left"), wires.new_slave("left")
    assert wires.run(5.0, lambda: any(slave.started for slave in pair))
    taken = stream(wires, *pair, seconds=2.0)
    first = next(slave for slave in pair if slave.process == taken[-1])
    wires.remove(first)
    assert wires.run(6.0, lambda: master.events_of("left")["restarts"] > 0)


class Versions:
    """A master of today beside a slave of another wire version, in one process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._patch = monkeypatch
        self.wires = Wires()
        self.master = self.wires.new_master(("left",))
        self.slave = self._old(lambda: self.wires.new_slave("left"))
        self.hellos = 0

    def seconds(self, seconds: float) -> None:
        """Carry the datagrams of both; what the slave seals and reads is of its own version."""
        wires = self.wires
        (address,) = wires.slaves
        end = wires.clock.t_ns + round(seconds * 1e9)
        while wires.clock.t_ns < end:
            for datagram, to in self.master.due():
                if to == BROADCAST:
                    self._old(lambda d=datagram: self.slave.receive_beacon(d, MASTER, wires.clock.now_ns()))
            for datagram, _ in self._old(self.slave.due):
                self.hellos += 1
                assert HEADER.unpack_from(datagram)[1:3] == (OTHER, Kind.HELLO)
                self.master.receive(datagram, address, wires.clock.now_ns())
            wires.clock.t_ns += 5_000_000

    def _old(self, call: Callable[[], Said]) -> Said:
        with self._patch.context() as patch:
            patch.setattr(common.link.datagram, "WIRE_VERSION", OTHER)
            return call()


def test_a_slave_of_another_wire_version_is_named_on_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    both = Versions(monkeypatch)
    both.seconds(5.0)
    now_ns = both.wires.clock.now_ns()
    assert both.hellos == 5  # once a second
    assert both.master.refused == {Refusal.VERSION: 5}
    ((name, away),) = both.master.rejected_peers.lately("version", now_ns).items()
    assert (name, away.version) == ("left", OTHER)
    assert both.slave.refused[Refusal.VERSION] == 50  # beacons
    assert both.slave.wrong is not None
    assert f"wire version {WIRE_VERSION}" in both.slave.wrong
    assert not both.master.connected()
    both.wires.clock.t_ns += 2_000_000_000
    assert not both.master.rejected_peers.lately("version", both.wires.clock.now_ns())


def test_only_a_hello_of_this_rig_makes_a_name_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """What anybody could make is counted, and names nobody; a flood of it is not even unsealed."""
    both = Versions(monkeypatch)
    both.seconds(0.5)
    now_ns = both.wires.clock.now_ns() + 10_000_000_000
    hello = HEADER.pack(b"PHLX", OTHER, Kind.HELLO, 100, both.master._keys.rig_tag, 7, 7) + bytes(72)
    for datagram in (hello, hello[:20], hello[:28], b"PHLX" + bytes([OTHER]) + bytes(60)):
        both.master.receive(datagram, ("6.6.6.6", 6), now_ns)
    assert not both.master.rejected_peers.lately("version", now_ns)
    assert both.master.refused[Refusal.VERSION] >= 3
    slave = both.slave
    forged = HEADER.pack(
        b"PHLX", WIRE_VERSION + 1, Kind.BEACON, 100, both.master._keys.rig_tag, 7, 7
    ) + bytes(72)
    slave.due()
    for _ in range(1000):
        slave.receive_beacon(forged, ("6.6.6.6", 6), now_ns)
    assert len(slave.due()) <= 1
