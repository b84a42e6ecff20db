"""Whatever a message makes the solver raise: counted, its true sender silenced, and the others are tracked on."""

from collections.abc import Iterator

import numpy as np
import pytest

from common.messages import MarkerDetections
from common.messages.streams import sender_of
from master.run.app import Solved
from master.run.dispatcher import Dispatcher
from master.run.link_senders import FIRST_NS, LONGEST_NS, MAX_CAUSES, Quarantine, SensorMessage
from master.run.solver_supervisor import SolverSupervisor, culprit
from tests.network_helpers import ManualClock, detections

S = 1_000_000_000
POISON = 13.0  # as `area` of the first marker


class Fragile(Dispatcher):
    """Fails at the next message of `at` once it has seen poison, and ever after; then holds nothing else."""

    def __init__(self, at: str | None = None) -> None:
        self._at, self.poisoned = at, False
        self.taken: list[str] = []

    def push(self, message: SensorMessage) -> Iterator[Solved]:
        assert isinstance(message, MarkerDetections)
        if message.area[0] == POISON:
            self.poisoned = True
        if self.poisoned and self._at in (None, message.camera):
            raise np.linalg.LinAlgError("SVD did not converge")
        self.taken.append(message.camera)
        return iter(())

    def flush(self) -> Iterator[Solved]:
        if self.poisoned:
            raise np.linalg.LinAlgError("SVD did not converge")
        return iter(())


def frame(camera: str, seq: int, area: float = 50.0) -> MarkerDetections:
    message = detections(camera, 1, seq)
    return MarkerDetections(
        camera,
        1,
        seq,
        0,
        0,
        message.uv,
        np.full(6, area),
        message.quality,
        message.sigma_px,
        message.alt_uv,
    )


class Scene:
    """A guarded solver; what renews it makes a new one in its first state."""

    def __init__(self, at: str | None = None) -> None:
        self.at, self.clock, self.quarantine = at, ManualClock(0), Quarantine()
        self.solver, self.renewed = Fragile(at), list[str]()
        self.guard = SolverSupervisor(
            self.push, self.quarantine, self.clock, self.renew, lambda _sender: Fragile(at)
        )

    def push_inner(self, message: SensorMessage) -> Iterator[Solved]:
        return self.solver.push(message)

    def push(self, message: SensorMessage) -> Iterator[Solved]:
        yield from self.solver.push(message)

    def renew(self, sender: str) -> None:
        self.renewed.append(sender)
        self.solver = Fragile(self.at)

    def send(self, message: SensorMessage) -> None:
        assert list(self.guard.push(message)) == []
        if self.guard._repair is not None:
            self.guard._repair.join()

    def silenced(self) -> set[str]:
        return {
            name for name in ("left", "right", "third") if self.quarantine.holds(name, self.clock.now_ns())
        }


def test_who_sends_what_makes_it_fail_is_silenced_and_the_others_go_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    scene = Scene()
    scene.send(frame("right", 0))
    scene.send(frame("left", 0, POISON))
    assert scene.silenced() == {"left"}
    assert scene.renewed == ["left"]
    for seq in range(1, 5):
        scene.send(frame("right", seq))
        scene.send(frame("left", seq))  # well, but silenced
    assert scene.solver.taken == ["right"] * 4
    assert scene.quarantine.faults == {"left": 1}
    scene.clock.t_ns += FIRST_NS
    scene.send(frame("left", 9))
    assert scene.solver.taken[-1] == "left"
    [record] = caplog.records
    assert "left" in record.getMessage()
    assert "SVD did not converge" in record.getMessage()


def test_not_who_completes_it_but_who_broke_it_is_silenced() -> None:
    scene = Scene(at="right")  # the poison of the left camera shows with the next frame of the right one
    scene.send(frame("third", 0))
    scene.send(frame("left", 0, POISON))
    scene.send(frame("right", 0))
    assert scene.silenced() == {"left"}
    scene.send(frame("right", 1))
    scene.send(frame("third", 1))
    assert scene.solver.taken == ["right", "third"]


def test_the_pause_doubles_up_to_its_longest_and_begins_anew_after_it() -> None:
    quarantine, t_ns = Quarantine(), 0
    lengths: list[int] = []
    for _ in range(9):
        quarantine.fault("left", ValueError(), t_ns)
        length_ns = 0
        while quarantine.holds("left", t_ns + length_ns):
            length_ns += S // 2
        lengths.append(length_ns)
        t_ns += length_ns + S
    assert lengths == [min(2**k * FIRST_NS, LONGEST_NS) for k in range(9)]
    t_ns += LONGEST_NS
    quarantine.fault("left", ValueError(), t_ns)
    assert not quarantine.holds("left", t_ns + FIRST_NS)
    assert not quarantine.holds("right", t_ns)


def test_a_cause_is_logged_once_and_the_log_is_bounded(caplog: pytest.LogCaptureFixture) -> None:
    quarantine = Quarantine()
    for k in range(2000):
        quarantine.note(f"camera{k % (MAX_CAUSES + 50)}", ValueError("a number"))
    assert len(caplog.records) == MAX_CAUSES
    assert sum(quarantine.faults.values()) == 2000


def test_a_fault_that_nobody_alone_causes_has_no_culprit() -> None:
    messages = [frame("left", 0, POISON), frame("right", 0, POISON), frame("left", 1)]
    assert culprit(messages, Fragile) is None
    assert culprit([frame("left", 0), frame("right", 0)], Fragile) is None
    assert culprit([frame("left", 0), frame("right", 0, POISON)], Fragile) == "right"
    assert {sender_of(message) for message in messages} == {"left", "right"}
