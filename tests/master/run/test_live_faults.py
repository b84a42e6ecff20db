"""A fault of the solver in a live master: its sender pauses, the other hand is tracked on, and both are after it."""

import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.bus.keys import new_key
from common.bus.zenoh_bus import ZenohBus
from common.clock import SystemClock
from common.messages import Command, Detections, WristDetections
from master.estimator.pipeline import SolvedPose
from master.rig.setup import RigFiles
from master.run.live import LiveSettings, run_live
from master.run.tuning import LivePipeline
from slave.uplink import Uplink
from tests.master.run.test_live import free_tcp_port
from tests.network_helpers import detections, free_udp_port, until
from tests.wrist_run import exact_cycle, wrist_scene

POISON_US = 250_000.0  # the exposure of the triples that the planted fault cannot stand


def test_a_fault_of_one_hands_solver_costs_its_sender_a_pause_and_the_other_hand_nothing(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push = LivePipeline.push

    def faulty(self: LivePipeline, message: Detections) -> list[SolvedPose]:
        if isinstance(message, WristDetections) and message.exposure_us == POISON_US:
            raise np.linalg.LinAlgError("planted")
        return push(self, message)

    monkeypatch.setattr(LivePipeline, "push", faulty)
    key, clock, bus = bytes.fromhex(new_key()), SystemClock(), f"tcp/127.0.0.1:{free_tcp_port()}"
    files = RigFiles(root / "calib_json", ("desk", "wrist-left"))
    settings = LiveSettings(("127.255.255.255", beacon := free_udp_port()), ("127.0.0.1", 0), bus, files)
    setups = files.load()
    cycle = exact_cycle(setups[1], wrist_scene(setups[1]).truth(0.5), 0)
    stop = threading.Event()
    master = threading.Thread(target=run_live, args=(setups, key, settings, stop, list[str]().append))
    master.start()
    ends = {name: Uplink(name, key, clock, beacon, "127.0.0.1") for name in ("left", "right", "wrist")}
    asker = ZenohBus(None, bus)
    seq = 0

    def sent(frames: int, exposure_us: float = 0.0) -> dict[str, int]:
        """What the master counts once so many frames of each camera, and every third a triple, were sent."""
        nonlocal seq
        for _ in range(frames):
            seq, t_ns = seq + 1, clock.now_ns()
            for name in ("left", "right"):
                ends[name].send(detections(name, ends[name].session, seq, t_ns))
            changes = {"session": ends["wrist"].session, "seq": seq, "t_ns": t_ns, "ready_t_ns": t_ns}
            if seq % 3 == 0:
                ends["wrist"].send(msgspec.structs.replace(cycle, exposure_us=exposure_us, **changes))
            stop.wait(0.02)
        return counts()

    def counts() -> dict[str, int]:
        return asker.ask(Command("master", "report"), 5.0).counts

    def right_hand(found: dict[str, int]) -> int:
        """Instants of the other hand: solved, or left out by a busy master."""
        return found["default-right.poses"] + found.get("default-right.instants_shed", 0)

    try:
        assert all(end.wait_for_start(60.0) for end in ends.values())
        before = sent(12)
        assert "fault.wrist" not in before
        during = sent(12, POISON_US)
        assert during["fault.wrist"] == 1, "the first is a fault, all others of this second are refused"
        assert during["refused.faulty"] >= 1
        assert until(lambda: right_hand(counts()) - right_hand(before) >= 6)
        assert not any(name in during for name in ("fault.left", "fault.right"))

        def well() -> bool:
            return sent(3)["default-left.poses"] > during["default-left.poses"]

        assert until(well), "after its pause the wrist device is used again"
    finally:
        stop.set()
        master.join(60.0)
        for end in (*ends.values(), asker):
            end.close()
    assert not master.is_alive()
