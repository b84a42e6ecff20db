"""Faults of the links, the clocks and the processes: how each comes and goes, and what is expected while it lasts."""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass

from bench.faults_rig import FaultRig
from bench.udp_relay import Impairment
from common.messages import WIRE_VERSION
from common.messages.streams import MASTER

CUT_S, STOPPED_S, CRASHES, RESTART_S, STEP_S = 5.0, 3.0, 4, 1.0, 10.0


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        name: For the command line.
        what: What is done.
        expected: What is to happen, besides coming back within two seconds.
        bring: Brings it about, waits for as long as it lasts, takes it away; returns when its cause had ended.
        counts: Of the master's counts those that tell it: at least one rises. None named: nothing need.
        listed: What the checklist says meanwhile, if anything.
        tracks: Poses go on during it at this share of the nominal rate at least.
        restarts: The master is a new process afterwards: its counts begin at 0.
    """

    name: str
    what: str
    expected: str
    bring: Callable[[FaultRig], float]
    counts: tuple[str, ...] = ()
    listed: tuple[str, ...] = ()
    tracks: float = 0.0
    restarts: bool = False


def of_links(long: bool) -> list[Fault]:
    """All of them; those that only change a number last four seconds, or one and a half."""
    s = 4.0 if long else 1.5
    return [
        Fault("loss", "20 % of all datagrams lost", "tracks on; lost ones counted", _way(s, loss=0.2),
              ("left.lost", "right.lost"), ("packet_loss",), tracks=0.7),
        Fault("jitter", "0 to 50 ms late, evenly", "tracks on; a frame overtaken by its next is dropped as late",
              _way(s, jitter_s=0.05), ("left.late", "right.late"), tracks=0.5),
        Fault("reorder", "a tenth held back by 40 ms", "tracks on; late frames counted",
              _way(s, reorder=0.1, held_s=0.04), ("left.reordered", "right.reordered"), tracks=0.7),
        Fault("duplicates", "every third datagram twice", "tracks on; copies refused", _way(s, duplicate=0.34),
              ("refused.duplicate",), tracks=0.7),
        Fault("cut", f"cable out for {CUT_S:g} s", "no poses, none made up; back with the sessions of before", _cut,
              ("left.lost", "right.lost", "left.skipped", "right.skipped"), ("camera_absent",)),
        Fault("master_restart", "kill -9 of the master, and a new one", "cameras join the new one by themselves",
              _master_again, restarts=True),
        Fault("slave_crashes", f"kill -9 of a slave, {CRASHES} times, begun again after {RESTART_S:g} s",
              "each new process replaces the last", _crash_loop, ("left.restarts",), ("camera_absent",)),
        Fault("step_ahead", f"a slave's clock jumps {STEP_S:g} s ahead", "frames of the future are not taken; clock"
              " measured anew", _step(STEP_S), ("left.clock_steps",)),
        Fault("step_back", f"a slave's clock jumps {STEP_S:g} s back", "clock measured anew", _step(-STEP_S),
              ("left.clock_steps",)),
        Fault("slave_stopped", f"SIGSTOP of a slave for {STOPPED_S:g} s", "one camera alone: tracked for 0.4 s,"
              " then depth is unsure", _stopped("left"), ("left.lost", "left.skipped"), ("camera_absent",)),
        Fault("master_stopped", f"SIGSTOP of the master for {STOPPED_S:g} s", "of what waited the newest second counts",
              _stopped(MASTER)),
        Fault("wrong_key", "a slave comes back with another rig's key, then with its own", "not taken: it"
              " hears a foreign rig; the camera is absent", _wrong_key, (), ("camera_absent",)),
        Fault("version", "a slave of another wire version, then ours", "not taken; named on both sides", _version,
              ("refused.version",), ("version_mismatch",)),
        Fault("duplicate", "a second process of a camera's name", "the first keeps its session; both sides log it",
              _duplicate, ("refused.duplicate_sender",), ("duplicate_sender",), tracks=0.7),
    ]  # fmt: skip


def _way(seconds: float, **worse: float) -> Callable[[FaultRig], float]:
    def bring(rig: FaultRig) -> float:
        rig.relay.way = Impairment(**worse)
        time.sleep(seconds)
        rig.relay.way = Impairment()
        return time.monotonic()

    return bring


def _cut(rig: FaultRig) -> float:
    rig.relay.cut = True
    time.sleep(CUT_S)
    rig.relay.cut = False
    return time.monotonic()


def _master_again(rig: FaultRig) -> float:
    """It is away until the new one listens: that takes as long as such a process takes to start."""
    rig.kill(MASTER)
    rig.start_master()
    return time.monotonic()


def _crash_loop(rig: FaultRig) -> float:
    for _ in range(CRASHES):
        rig.kill("left")
        time.sleep(RESTART_S)
        rig.start_camera("left")
    return time.monotonic()


def _step(by_s: float) -> Callable[[FaultRig], float]:
    def bring(rig: FaultRig) -> float:
        rig.send_line("left", f"step {by_s}")
        return time.monotonic()

    return bring


def _stopped(name: str) -> Callable[[FaultRig], float]:
    def bring(rig: FaultRig) -> float:
        process = rig.processes[name]
        process.send_signal(signal.SIGSTOP)
        time.sleep(STOPPED_S)
        process.send_signal(signal.SIGCONT)
        return time.monotonic()

    return bring


def _wrong_key(rig: FaultRig) -> float:
    rig.start_camera("right", key="5a" * 32)
    time.sleep(2.0)
    rig.start_camera("right")
    return time.monotonic()


def _version(rig: FaultRig) -> float:
    rig.start_camera("right", options=["--wire", str(WIRE_VERSION - 1)])
    time.sleep(2.0)
    rig.start_camera("right")
    return time.monotonic()


def _duplicate(rig: FaultRig) -> float:
    rig.start_camera("left", "second left")
    time.sleep(3.0)
    rig.kill("second left")
    return time.monotonic()
