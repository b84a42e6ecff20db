"""The real slave program, emulated, and a master of this machine: datagrams, reports, commands cross architectures."""

import socket
from pathlib import Path

import numpy as np

from bench.rigs.local import free_port
from common.bus.bus import Subscription
from common.bus.zenoh_bus import ZenohBus
from common.clock import SystemClock
from common.messages import Command, Health, MarkerDetections
from master.run.ingest import Ingest
from tests.aarch64.machine import guest_or_skip
from tests.network_helpers import until

KEY = bytes(range(32))
WANTED, REPORTS = 8, 2  # frames, reports
PATIENCE_S = 120.0  # an emulated start takes ten seconds on an idle machine


def test_a_slave_on_aarch64_serves_a_master_here(tmp_path: Path) -> None:
    guest = guest_or_skip()
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    beacon = free_port(socket.SOCK_DGRAM)
    key = tmp_path / "rig.key"
    key.write_text(KEY.hex())
    key.chmod(0o600)
    bus = ZenohBus(endpoint, None)
    health = bus.subscribe("health", "left")
    place = ("127.255.255.255", beacon)
    ingest = Ingest(("left",), KEY, SystemClock(), place, ("127.0.0.1", 0), endpoint)
    options = ["--name", "left", "--rig", "desk", "--camera", "synthetic", "--colours", "fixed"]
    link = ["--bind", "127.0.0.1", "--beacon-port", str(beacon), "--key-file", str(key)]
    slave = guest.start(["-m", "slave", "run", *options, *link])
    try:
        seen = _frames(ingest)
        reports = _reports(health)
        answer = bus.ask(Command("left", "stop"), PATIENCE_S)
        output, errors = slave.communicate(timeout=PATIENCE_S)
    finally:
        slave.kill()
        slave.wait()
        ingest.close()
        bus.close()
    assert len(seen) == WANTED, errors
    assert all(np.isfinite(one.uv).any() for one in seen[2:])
    assert [one.seq for one in seen] == sorted(one.seq for one in seen)
    assert ingest.counts_of("left").received >= WANTED
    assert not ingest.refused
    assert len(reports) == REPORTS
    assert answer.source == "left"
    assert slave.returncode == 0, errors
    assert "frames, sent" in output


def _frames(ingest: Ingest) -> list[MarkerDetections]:
    """The first frames that come."""
    seen: list[MarkerDetections] = []

    def enough() -> bool:
        if isinstance(message := ingest.get(0.1), MarkerDetections):
            seen.append(message)
        return len(seen) == WANTED

    until(enough, PATIENCE_S)
    return seen


def _reports(health: Subscription) -> list[Health]:
    """Reports that count frames; a slow machine sends some before its first frame."""
    reports: list[Health] = []

    def enough() -> bool:
        if isinstance(message := health.get(0.1), Health) and message.counts["frames"] > 0:
            reports.append(message)
        return len(reports) == REPORTS

    until(enough, PATIENCE_S)
    return reports
