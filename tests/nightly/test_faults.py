"""Faults that take long or need root: a full disk, a million hostile datagrams, strangers at the console."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.report import ROOT
from bench.rigs.local import end, free_port, until
from tests.faults.links import FaultRig
from tests.hostile_datagrams import Capture, Watch, assault, flood, hostile, memory_mb, targets
from tests.nightly import wall_clock
from tests.programs import needs

MILLION = 1_000_000
DISK_MB, RESERVE_MB = 203, 200


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    needs("mount")
    if os.geteuid() != 0:
        pytest.skip("a small disk is a tmpfs, which only root may mount")
    folder = tmp_path / "disk"
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}000000", "tmpfs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk_ends_the_recording_and_nothing_else(tmp_path: Path, small_disk: Path) -> None:
    """It ends with what was complete where less than the reserve would be left, and the master says so."""
    rig = FaultRig(tmp_path / "rig", ["--record", str(small_disk / "run.mcap")])
    try:
        log, began = tmp_path / "rig" / "master.log", time.monotonic()
        (small_disk / "other").write_bytes(
            bytes((DISK_MB - RESERVE_MB) * 1_000_000)
        )  # somebody else fills it
        ended = time.monotonic()
        assert until(
            lambda: "the recording is not whole" in log.read_text() or "stay free" in log.read_text(), 15.0
        )
        recovery_s = rig.steady_after(ended)
        assert recovery_s is not None
        assert recovery_s < 2.0
        received = rig.poses.since(began)
        assert not any(one.false for one in received)
        assert rig.processes["master"].poll() is None
    finally:
        rig.close()
    assert (small_disk / "run.mcap").stat().st_size > 10_000


def test_a_wall_clock_that_jumps_is_not_noticed(tmp_path: Path) -> None:
    """Of a slave and of the master, ten seconds ahead and back, while the hand is tracked."""
    needs("cc")  # for wall_clock.c
    for runs in wall_clock.measure(tmp_path, 2).values():
        assert not any(one.rise[name] for one in runs for name in one.rise)
        assert max(one.share for one in runs) > wall_clock.LEAST_SHARE


def test_a_million_hostile_datagrams_cost_nothing_that_lasts(tmp_path: Path) -> None:
    rig = FaultRig(tmp_path / "rig")
    try:
        capture = Capture(rig)
        time.sleep(2.0)
        capture.end()
        pool = hostile(capture.to_master[:300] + capture.to_slaves[:300], bytes.fromhex(rig.key))
        watch = Watch(rig)
        time.sleep(3.0)
        before, memory = watch.end(), memory_mb(rig)
        watch = Watch(rig)
        flood(pool, targets(rig), MILLION, per_s=50_000.0)
        ended, during = time.monotonic(), watch.end()
        assert rig.steady_after(ended) is not None
        watch = Watch(rig)
        time.sleep(3.0)
        after = watch.end()
        assert not any(one.false for one in during.poses)
        assert during.lost < 0.5
        assert after.master_cpu < 1.3 * before.master_cpu + 0.05
        assert after.slave_cpu < 1.3 * before.slave_cpu + 0.05
        assert max(b - a for a, b in zip(memory, memory_mb(rig), strict=True)) < 10.0
    finally:
        rig.close()


def test_strangers_at_the_console_do_not_reach_the_hand(tmp_path: Path) -> None:
    rig = FaultRig(tmp_path / "rig")
    port = free_port(socket.SOCK_STREAM)
    command = [sys.executable, "-m", "master", "console", "--bus", rig.endpoint, "--port", str(port)]
    with (tmp_path / "console.log").open("wb") as log:
        console = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, text=True
        )

    def up() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    try:
        assert until(up, 60.0)
        began = time.monotonic()
        became = assault(("127.0.0.1", port), 300, 100, 6.0)
        ended = time.monotonic()
        assert became["open"] > 100
        assert until(up, 2.0)
        assert console.poll() is None
        assert rig.steady_after(ended) is not None
        assert not any(one.false for one in rig.poses.since(began))
    finally:
        end(console)
        rig.close()
