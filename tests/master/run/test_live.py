"""The live master end to end in one process: a slave that sends, a command that asks, a command that ends it."""

import json
import socket
import threading
from pathlib import Path

import msgspec
import pytest

from common.bus.keys import new_key
from common.bus.zenoh_bus import ZenohBus
from common.clock import SystemClock
from common.errors import BusError
from common.messages import Command, HandPose
from master.outputs.poses import Poses
from master.rig.setup import RigFiles, load_setup, load_setups
from master.run.live import LiveSettings, run_live
from slave.uplink import Uplink
from tests.network_helpers import detections, free_udp_port, until
from tests.wrist_run import exact_cycle, wrist_scene


def free_tcp_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_master_tracks_answers_refuses_and_ends(tmp_path: Path, root: Path) -> None:
    key = bytes.fromhex(new_key())
    beacon, bus = free_udp_port(), f"tcp/127.0.0.1:{free_tcp_port()}"
    poses_file, summary_file = tmp_path / "poses.npz", tmp_path / "live.json"
    settings = LiveSettings(
        ("127.255.255.255", beacon),
        ("127.0.0.1", 0),
        bus,
        RigFiles(root / "calib_json", ("desk",)),
        2.0,
        poses_file,
        summary_file,
    )
    setup = load_setup(root / "calib_json", "desk")
    lines: list[str] = []
    stop = threading.Event()
    master = threading.Thread(target=run_live, args=((setup,), key, settings, stop, lines.append))
    master.start()
    clock = SystemClock()
    left, right = (Uplink(name, key, clock, beacon, "127.0.0.1") for name in ("left", "right"))
    asker = ZenohBus(None, bus)
    try:
        assert left.wait_for_start(60.0)
        assert right.wait_for_start(60.0)
        for seq in range(40):
            t_ns = clock.now_ns()
            left.send(detections("left", left.session, seq, t_ns))
            right.send(detections("right", right.session, seq, t_ns))
            stop.wait(0.01)
        report = asker.ask(Command("master", "report"), 5.0)
        assert report.source == "master"
        assert report.counts["left.received"] > 30
        with pytest.raises(BusError, match="there are report, stop"):
            asker.ask(Command("master", "dance"), 5.0)
        assert not stop.is_set()
        asker.ask(Command("master", "stop"), 5.0)
        master.join(60.0)
        assert not master.is_alive()
    finally:
        stop.set()
        master.join(60.0)
        for end in (left, right, asker):
            end.close()
    summary = json.loads(summary_file.read_text())
    poses = Poses.load(poses_file)
    assert len(poses) == summary["poses"] > 20
    assert summary["lost"] == 0
    assert lines[0].startswith("listening on 127.0.0.1:")


def test_a_master_of_two_hands_publishes_each_under_its_name(tmp_path: Path, root: Path) -> None:
    key, clock = bytes.fromhex(new_key()), SystemClock()
    beacon, bus = free_udp_port(), f"tcp/127.0.0.1:{free_tcp_port()}"
    settings = LiveSettings(
        ("127.255.255.255", beacon),
        ("127.0.0.1", 0),
        bus,
        RigFiles(root / "calib_json", ("desk", "wrist-left")),
        5.0,
        tmp_path / "poses.npz",
        tmp_path / "live.json",
    )
    setups = load_setups(root / "calib_json", ("desk", "wrist-left"))
    cycle = exact_cycle(setups[1], wrist_scene(setups[1]).truth(0.5), 0)
    stop, lines = threading.Event(), list[str]()
    master = threading.Thread(target=run_live, args=(setups, key, settings, stop, lines.append))
    master.start()
    ends = {name: Uplink(name, key, clock, beacon, "127.0.0.1") for name in ("left", "right", "wrist")}
    asker = ZenohBus(None, bus)
    published = asker.subscribe("hand")
    try:
        assert all(end.wait_for_start(60.0) for end in ends.values())
        asker.ask(Command("master", "report"), 5.0)  # who is answered is subscribed
        for seq in range(20):
            t_ns = clock.now_ns()
            for name in ("left", "right"):
                ends[name].send(detections(name, ends[name].session, seq, t_ns))
            changes = {"session": ends["wrist"].session, "seq": 3 * seq, "t_ns": t_ns, "ready_t_ns": t_ns}
            ends["wrist"].send(msgspec.structs.replace(cycle, **changes))
            stop.wait(0.01)

        def counted() -> bool:
            counts = asker.ask(Command("master", "report"), 5.0).counts
            # What a busy machine leaves out is counted.
            right = counts.get("default-right.poses", 0) + counts.get("default-right.instants_shed", 0)
            return counts.get("default-left.poses", 0) == 20 and right > 10

        assert until(counted)
        assert until(lambda: "cameras: left, right, wrist" in lines)  # said once a second
    finally:
        stop.set()
        master.join(60.0)
        poses = [published.get(0.0) for _ in range(64)]
        for end in (*ends.values(), asker):
            end.close()
    assert {pose.hand for pose in poses if isinstance(pose, HandPose)} == {"default-right", "default-left"}
    assert len(Poses.load(tmp_path / "poses-default-left.npz")) == 20
    assert len(Poses.load(tmp_path / "poses.npz")) > 0
