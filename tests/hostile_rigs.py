"""A rig for tests of hostile devices: one that is well for each test, a stolen device, and what others lose by it."""

import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path

from master.rig.setup import load_setup
from tests.faults.hostile import STOLEN, HostileRig, Phase
from tests.faults.hostile_sender import HostileSender
from tests.network_helpers import PATIENCE_S, until

LOST = 0.75  # a master that stands still loses all, a machine with other things to do some; the bench measures how many
MOST, LEAST = 2**63 - 1, -(2**63)
# How the master counts what it refuses.
UNASKED, SESSION, SEQUENCE, MARKERS = "unasked_echo", "foreign_session", "sequence", "marker_count"
BOUNDS, PICTURE, READY, LATE = "out_of_bounds", "outside_picture", "ready_time", "unsynchronised"


class Rigs:
    """The running rig, or a new one where the last is broken: each test fails for its own reason."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._made = folder, 0
        self._rig: HostileRig | None = None

    def well(self) -> HostileRig:
        if self._rig is None or not self._rig.alive() or losing(self._rig) > LOST:
            self.close()
            self._made += 1
            self._rig = HostileRig(self._folder / f"rig{self._made}")
        return self._rig

    def close(self) -> None:
        if self._rig is not None:
            self._rig.close()


def losing(rig: HostileRig) -> float:
    """Share of the honest poses that is lost now; 1 where the master does not answer."""
    end = rig.begin()
    time.sleep(0.5)
    phase = end()
    return 1.0 if rig.report(5.0) is None else phase.lost


@contextmanager
def stolen(rig: HostileRig, name: str) -> Generator[HostileSender]:
    """A stolen device with a session whose clock is known."""
    setup = load_setup(rig.tree, STOLEN[name])
    sender = HostileSender(name, bytes.fromhex(rig.key), rig.beacon_port, setup, rig.endpoint)
    try:
        assert sender.uplink.wait_for_start(PATIENCE_S)
        yield sender
    finally:
        sender.close()


@contextmanager
def unharmed(rig: HostileRig) -> Generator[dict[str, int]]:
    """Judge what becomes of the others meanwhile; by how much counts rose is in the dictionary afterwards."""
    before = counts(rig)
    rise: dict[str, int] = {}
    end, newest = rig.begin(), rig.newest
    yield rise
    time.sleep(0.5)
    assert until(lambda: rig.newest is not newest or not rig.alive()), "it reports no more"
    phase: Phase = end()
    assert rig.alive(), rig.log.read_text()[-2000:]
    assert phase.lost <= LOST
    assert phase.undecodable == 0
    assert phase.threads_ended <= 0
    after = counts(rig)
    assert max(after.values()) < 2**62, "a count that outgrows its field ends the reports"
    rise |= {name: number - before.get(name, 0) for name, number in after.items()}


def counts(rig: HostileRig) -> Mapping[str, int]:
    """What the master counted."""
    report = rig.report()
    assert report is not None, "it answers no more"
    return report.counts


def refused(rise: Mapping[str, int], *reasons: str) -> int:
    """How many were refused for one of these."""
    return sum(rise.get(f"refused.{reason}", rise.get(reason, 0)) for reason in reasons)
