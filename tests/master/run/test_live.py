"""The live master end to end in one process: slaves that send, commands, faults of its solver, and its end."""

import json
from contextlib import ExitStack
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import BusError
from common.messages import Detections, HandPose, WristDetections
from master.estimator.pipeline import SolvedPose
from master.outputs.poses import Poses
from master.rig.setup import RigFiles
from master.run.tuning import LivePipeline
from tests.master.run.live_master import LiveMaster
from tests.network_helpers import detections, until
from tests.wrist_run import exact_cycle, wrist_scene

POISON_US = 250_000.0  # the exposure of the triples that the planted fault cannot stand
TWO_HANDS = ("desk", "wrist-left")
CAMERAS = ("left", "right")
CLOCK = SystemClock()


def send_frames(live: LiveMaster, seq: int) -> int:
    """A frame of each camera, taken now; now [ns]."""
    t_ns = CLOCK.now_ns()
    for name in CAMERAS:
        live.send(detections(name, 1, seq, t_ns))
    return t_ns


def a_cycle(live: LiveMaster) -> WristDetections:
    """What the wrist device sees of its hand."""
    return exact_cycle(live.setups[1], wrist_scene(live.setups[1]).truth(0.5), 0)


def right_hand(counts: dict[str, int]) -> int:
    """Epochs of the hand before the cameras: solved, or left out by a busy master."""
    return counts.get("default-right.poses", 0) + counts.get("default-right.instants_shed", 0)


def test_a_master_tracks_answers_refuses_and_ends(stack: ExitStack, tmp_path: Path, root: Path) -> None:
    live = LiveMaster(stack, RigFiles(root / "calib_json", ("desk",)), CAMERAS, tmp_path)
    for seq in range(40):
        send_frames(live, seq)
        live.stop.wait(0.01)
    report = live.ask("report")
    assert report.source == "master"
    assert report.counts["left.received"] > 30
    with pytest.raises(BusError, match="there are report, stop"):
        live.ask("dance")
    assert not live.stop.is_set()
    live.ask("stop")
    live.ended()
    summary = json.loads((tmp_path / "live.json").read_text())
    assert len(Poses.load(tmp_path / "poses.npz")) == summary["poses"] > 20
    assert summary["lost"] == 0
    assert live.lines[0].startswith("listening on 127.0.0.1:")


def test_a_master_of_two_hands_publishes_each_under_its_name(
    stack: ExitStack, tmp_path: Path, root: Path
) -> None:
    live = LiveMaster(stack, RigFiles(root / "calib_json", TWO_HANDS), (*CAMERAS, "wrist"), tmp_path)
    cycle, published = a_cycle(live), live.bus.subscribe("hand", depth=64)
    live.ask("report")  # who is answered is subscribed
    for seq in range(20):
        t_ns = send_frames(live, seq)
        live.send(cycle, seq=3 * seq, t_ns=t_ns, ready_t_ns=t_ns)
        live.stop.wait(0.01)

    def counted() -> bool:
        counts = live.counts()
        return counts.get("default-left.poses", 0) == 20 and right_hand(counts) > 10

    assert until(counted)
    assert until(lambda: "cameras: left, right, wrist" in live.lines)  # said once a second
    live.end()
    poses = [published.get(0.0) for _ in range(64)]
    assert {pose.hand for pose in poses if isinstance(pose, HandPose)} == {"default-right", "default-left"}
    assert len(Poses.load(tmp_path / "poses-default-left.npz")) == 20
    assert len(Poses.load(tmp_path / "poses.npz")) > 0


def test_a_fault_of_one_hands_solver_costs_its_sender_a_pause_and_the_other_hand_nothing(
    stack: ExitStack, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    push = LivePipeline.push

    def faulty(self: LivePipeline, message: Detections) -> list[SolvedPose]:
        if isinstance(message, WristDetections) and message.exposure_us == POISON_US:
            raise np.linalg.LinAlgError("planted")
        return push(self, message)

    monkeypatch.setattr(LivePipeline, "push", faulty)
    live = LiveMaster(stack, RigFiles(root / "calib_json", TWO_HANDS), (*CAMERAS, "wrist"))
    cycle, seq = a_cycle(live), 0

    def sent(frames: int, exposure_us: float = 0.0) -> dict[str, int]:
        """What the master counts once so many frames of each camera, and every third a triple, were sent."""
        nonlocal seq
        for _ in range(frames):
            seq += 1
            t_ns = send_frames(live, seq)
            if seq % 3 == 0:
                poisoned = msgspec.structs.replace(cycle, exposure_us=exposure_us)
                live.send(poisoned, seq=seq, t_ns=t_ns, ready_t_ns=t_ns)
            live.stop.wait(0.02)
        return live.counts()

    before = sent(12)
    assert "fault.wrist" not in before
    during = sent(12, POISON_US)
    assert during["fault.wrist"] == 1, "the first is a fault, all others of this second are refused"
    assert during["refused.faulty"] >= 1
    assert until(lambda: right_hand(live.counts()) - right_hand(before) >= 6)
    assert not any(name in during for name in ("fault.left", "fault.right"))

    def well() -> bool:
        return sent(3)["default-left.poses"] > during["default-left.poses"]

    assert until(well), "after its pause the wrist device is used again"
