"""Faults on real processes, each once: steady and right poses again within two seconds of its end, counted, none false.

`make faults` brings all of them about, several times, and prints the table of docs/faults.md: the goal is
judged there. Here are those that no test of the link alone can show, on a machine that may have other things to do, by
the same measure.
"""

import time
from collections.abc import Iterator

import pytest

from bench.rigs.local import UP_S, until
from tests.faults.links import LEAST_HZ, Fault, FaultRig, Pace, Run, cut, measured, of_links
from tests.hostile_datagrams import Capture, assault, flood, hostile, targets

FAULTS = {fault.name: fault for fault in of_links(seconds=1.5)}
# Loss, reordering, duplicates, a cut, restarts and twins are in simulated time, or over sockets, in the tests beside; a
# master that stood still is in `tests.master.run.test_load_shedding`.
LIVE = ("step_ahead", "slave_stopped")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FaultRig]:
    made = FaultRig(tmp_path_factory.mktemp("faults") / "rig")
    try:
        yield made
    finally:
        made.close()


@pytest.fixture(autouse=True)
def paced(rig: FaultRig) -> None:
    """What is steady is what the rig does now, before anything is put wrong."""
    rate_hz = rig.own_pace().rate_hz
    if rate_hz < LEAST_HZ:
        pytest.skip(f"{rate_hz:.0f} poses a second before any fault: this machine has too much else to do")


def over(rig: FaultRig, fault: Fault) -> Run:
    """Bring it about, and see that it is over in time and nothing was false."""
    run = measured(rig, fault)
    assert not run.false
    assert run.over, f"{fault.name}: over after {run.recovery_s} s, {run.allowed_s:.1f} s are allowed"
    return run


def well_again(rig: FaultRig, moment_s: float) -> bool:
    """Whether right poses come steadily again after a moment, at half the pace of before: other tests take the rest."""
    before = rig.pace
    rig.pace = Pace(0.5 * before.rate_hz, 2.0 * before.gap_s)
    try:
        return rig.steady_after(moment_s, UP_S) is not None
    finally:
        rig.pace = before


@pytest.mark.parametrize("name", LIVE)
def test_a_fault_ends_and_all_is_well_within_two_seconds(name: str, rig: FaultRig) -> None:
    run = over(rig, FAULTS[name])
    assert not FAULTS[name].counts or any(run.counts.values())
    assert run.grown_mb < 10.0


def test_after_a_pause_no_pose_is_as_old_as_the_pause(rig: FaultRig) -> None:
    """A frame still waited for its partner's when the cable was pulled: nobody asks for that pose any more."""
    out_s = 3.0

    run = over(rig, Fault("short cut", "", "", cut(out_s)))
    assert run.oldest_s < 0.8 * out_s


def test_hostile_datagrams_at_every_port_are_refused_while_the_hand_is_tracked(rig: FaultRig) -> None:
    capture = Capture(rig)
    time.sleep(1.0)
    capture.end()
    pool = hostile(capture.to_master[:300] + capture.to_slaves[:300], bytes.fromhex(rig.key))
    before, began = rig.counts(), time.monotonic()
    flood(pool, targets(rig), 20_000, per_s=10_000.0)
    ended = time.monotonic()
    assert well_again(rig, ended)
    after = rig.counts()
    received = rig.poses.since(began, ended)
    assert received
    assert not any(one.false for one in received)
    rise = {name: after[name] - before.get(name, 0) for name in after if name.startswith("refused.")}
    assert {"refused.foreign", "refused.forged", "refused.stale", "refused.cut"} <= set(rise)
    assert min(rise.values()) >= 0
    assert sum(rise.values()) > 1000
    assert all(process.poll() is None for process in rig.processes.values())
    sessions = [name for name in after if name.endswith((".restarts", ".clock_steps"))]
    assert all(after[name] == before.get(name, 0) for name in sessions)


def test_a_capture_shows_nothing_that_can_be_read_and_is_not_taken_again_by_either_side(
    rig: FaultRig,
) -> None:
    """No name, no field and no number of a message: what is not header looks like noise."""
    capture = Capture(rig)
    assert until(lambda: sum(map(len, capture.to_master)) > 50_000, UP_S)
    capture.end()
    sent = b"".join(one[28:] for one in (*capture.to_master, *capture.to_slaves))
    for word in (
        b"left",
        b"right",
        b"camera",
        b"thumb",
        b"index",
        b"uv",
        b"t_ns",
        b"tcp/",
        b"127.0",
        b"Marker",
    ):
        assert sent.count(word) <= len(sent) / 256.0 ** len(word) * 10.0 + 1.0, word
    often, expected = [sent.count(bytes([value])) for value in range(256)], len(sent) / 256.0
    assert max(abs(one - expected) for one in often) < 6.0 * expected**0.5  # of noise: each byte as often

    before = rig.counts()
    flood(capture.to_master, [("127.0.0.1", rig.master_port)], len(capture.to_master), per_s=2000.0)
    flood(
        capture.to_slaves,
        [*rig.relay.slaves(), ("127.255.255.255", rig.beacon_port)],
        len(capture.to_slaves) * 3,
    )
    # And to the side that said it.
    flood(capture.to_slaves, [("127.0.0.1", rig.master_port)], len(capture.to_slaves), per_s=2000.0)
    began = time.monotonic()
    assert well_again(rig, began)
    after = rig.counts()
    refused = sum(after[name] - before.get(name, 0) for name in after if name.startswith("refused."))
    assert refused >= 0.5 * (len(capture.to_master) + len(capture.to_slaves))
    for name in ("left.restarts", "right.restarts", "left.clock_steps", "right.clock_steps"):
        assert after.get(name, 0) == before.get(name, 0)
    received = rig.poses.since(began - 1.0)
    assert not any(one.false for one in received)


def test_strangers_at_the_bus_neither_stop_the_hand_nor_cost_memory(rig: FaultRig) -> None:
    memory_mb, began = rig.footprint().anonymous_mb, time.monotonic()
    became = assault(("127.0.0.1", rig.bus_port), 150, 60, 2.0)
    ended = time.monotonic()
    assert became["open"] > 10
    received = rig.poses.since(began, ended)
    assert received
    assert not any(one.false for one in received)
    assert well_again(rig, ended)
    assert rig.ask().source == "master"
    assert rig.footprint().anonymous_mb - memory_mb < 20.0
