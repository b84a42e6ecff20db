"""The slave of an IMU as a process: its samples over sealed UDP, on the master's clock, and how it is told things."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from common.bus.keys import new_key
from common.bus.zenoh_bus import ZenohBus
from common.calibration import RigCalibration, load
from common.clock import SystemClock
from common.messages import Command, Health, ImuSample
from common.sim.scene import Scene
from common.sim.sensors import SimulatedImu
from master.run.ingest import Ingest
from slave.commands.simulated import scene_of
from slave.uplink import Uplink
from tests.network_helpers import PATIENCE_S, clock_known, free_endpoint, free_udp_port, until
from tests.slave.imu.fake_ximu3 import FakeXimu3

ROOT = Path(__file__).resolve().parents[2]
APART_NS = 20_000_000  # of clocks that are seconds apart: what a busy machine makes of an echo


def calibration(folder: Path) -> Path:
    """A calib_json tree whose rig `desk-imu` is a desk with an IMU on the back of the hand."""
    files = folder / "calib"
    (files / "rigs").mkdir(parents=True)
    for kept in ("hands", "cameras"):
        (files / kept).symlink_to(ROOT / "calib_json" / kept)
    rig = json.loads((ROOT / "calib_json/rigs/desk.json").read_text())
    imu = {"name": "palm-imu", "q_palm_imu": [0.5, 0.5, -0.5, 0.5], "q_rig_world": [0.6, 0.8, 0.0, 0.0]}
    (files / "rigs/desk-imu.json").write_text(json.dumps(rig | {"name": "desk-imu", "imu": imu}))
    return files


def simulated(files: Path, rig: RigCalibration, seed: int) -> SimulatedImu:
    scene = scene_of(files, rig, "standard", seed)
    assert isinstance(scene, Scene)
    return SimulatedImu.of(scene)


@contextmanager
def process(
    files: Path, log: Path, key: str, port: int, *more: str, imu: str = "synthetic"
) -> Generator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "slave", "run", "--name", "palm-imu", "--rig", "desk-imu"]
    command += ["--imu", imu, "--calibration", str(files), "--seed", "5", "--bind", "127.0.0.1"]
    with log.open("w") as out:
        slave = subprocess.Popen(
            [*command, "--beacon-port", str(port), *more],
            cwd=ROOT,
            env=os.environ | {"PHALANX_RIG_KEY": key},
            stdout=out,
            stderr=subprocess.STDOUT,
        )
    try:
        yield slave
    finally:
        slave.kill()
        slave.wait(PATIENCE_S)


def master(
    stack: ExitStack, key: bytes, beacon: tuple[str, int], here: tuple[str, int], endpoint: str
) -> tuple[ZenohBus, Ingest]:
    """The master's ends of bus and link, and the two cameras that its start waits for."""
    bus, clock = ZenohBus(endpoint, None), SystemClock()
    stack.callback(bus.close)
    ingest = Ingest(("left", "right"), key, clock, beacon, here, endpoint, imus=("palm-imu",))
    stack.callback(ingest.close)
    for name in ("left", "right"):
        stack.callback(Uplink(name, key, clock, beacon[1], "127.0.0.1").close)
    return bus, ingest


def take(ingest: Ingest, got: list[ImuSample]) -> int:
    """Take one more sample, if there is one; how many there are."""
    message = ingest.get(0.1)
    assert message is None or isinstance(message, ImuSample)
    got.extend([] if message is None else [message])
    return len(got)


def test_its_samples_are_those_of_the_scene_on_the_masters_clock(tmp_path: Path) -> None:
    files, log = calibration(tmp_path), tmp_path / "imu.log"
    key, port, endpoint, clock = new_key(), free_udp_port(), free_endpoint(), SystemClock()
    raw, beacon, here = bytes.fromhex(key), ("127.255.255.255", port), ("127.0.0.1", 0)
    epoch_ns = clock.now_ns() - 10_000_000_000  # it joins a scene that has run for a while
    skew = ["--scene-epoch-ns", str(epoch_ns), "--clock-offset-ms", "4000", "--clock-ppm", "80"]
    with ExitStack() as stack:
        bus, ingest = master(stack, raw, beacon, here, endpoint)
        slave = stack.enter_context(process(files, log, key, port, *skew))
        assert clock_known(ingest, "palm-imu"), log.read_text()
        while ingest.get(0.0) is not None:  # by a clock that was not known so well
            pass
        got: list[ImuSample] = []
        assert until(lambda: take(ingest, got) >= 150), log.read_text()
        assert until(lambda: "palm-imu" in bus.alive()), log.read_text()
        health = bus.ask(Command("palm-imu", "report", ""), PATIENCE_S)
        assert health.counts["sent"] >= 60
        assert health.counts["samples"] > 50  # counted a moment after it is sent
        assert "skipped" in health.counts
        bus.ask(Command("palm-imu", "stop", ""), PATIENCE_S)
        assert slave.wait(PATIENCE_S) == 0, log.read_text()
    assert "samples, sent" in log.read_text()
    assert {one.source for one in got} == {"palm-imu"}
    assert len({one.session for one in got}) == 1
    assert got[0].session == health.session != 0
    assert (np.diff([one.seq for one in got]) > 0).all()
    assert got[0].seq > 1000
    rig = load(files / "rigs/desk-imu.json", RigCalibration)
    ours, other = simulated(files, rig, 5), simulated(files, rig, 6)
    for one in got:
        t_s = one.seq / 120.0 / (1.0 + 80e-6)
        assert abs(one.t_ns - epoch_ns - t_s * 1e9) < APART_NS
        has_secrets = [
            np.abs(one.gyro_rad_s - imu.sample(one.seq, t_s, 0).gyro_rad_s).max() for imu in (ours, other)
        ]
        assert has_secrets[0] < 1e-4
        assert has_secrets[1] > 5e-3
    known = [one for one in got if np.isfinite(one.orientation_wxyz).all()]
    assert known[-1] is got[-1], "it is the filter's, which needs a second"


def test_an_ximu3_is_read_lost_and_back(tmp_path: Path) -> None:
    files, log, link = calibration(tmp_path), tmp_path / "imu.log", tmp_path / "ttyACM0"
    key, port, endpoint = new_key(), free_udp_port(), free_endpoint()
    device = FakeXimu3(link, streams=True)
    with ExitStack() as stack:
        bus, ingest = master(stack, bytes.fromhex(key), ("127.255.255.255", port), ("127.0.0.1", 0), endpoint)
        slave = stack.enter_context(process(files, log, key, port, imu=f"ximu3:{link}"))
        got: list[ImuSample] = []
        assert until(lambda: take(ingest, got) >= 150), log.read_text()
        assert until(lambda: "palm-imu" in bus.alive()), log.read_text()
        device.unplug()
        assert until(lambda: health(bus).counts["lost"] == 1), log.read_text()
        assert health(bus).counts["back"] == 0
        while (late := ingest.get(0.0)) is not None:  # what was on its way
            assert isinstance(late, ImuSample)
            got.append(late)
        device = FakeXimu3(link, streams=True, begins_us=0)  # it has begun anew
        stack.callback(device.unplug)
        again: list[ImuSample] = []
        assert until(lambda: take(ingest, again) >= 30), log.read_text()
        counts = health(bus).counts
        assert (counts["lost"], counts["back"], counts["broken"]) == (1, 1, 0)
        assert until(lambda: health(bus).metrics["away_s"] == 0.0), "it is there, however late it was read"
        metrics = health(bus).metrics
        assert {"rate_hz", "bias_x_rad_s", "heading_sigma_rad", "at_rest"} <= set(metrics)
        slave.send_signal(signal.SIGINT)
        assert slave.wait(PATIENCE_S) == 0, log.read_text()
    for run in (got, again):
        seq, t_ns = np.array([one.seq for one in run]), np.array([one.t_ns for one in run])
        assert np.median(np.diff(t_ns) / np.diff(seq)) == pytest.approx(7.5e6, rel=0.01)
        np.testing.assert_allclose(run[0].gyro_rad_s, np.radians([5.0, 0.0, -3.0]), rtol=1e-6)
        np.testing.assert_allclose(run[0].accel_m_s2, [0.0, 0.0, 9.80665], rtol=1e-6)
        assert np.isnan(run[0].mag_ut).all()
    assert again[0].t_ns > got[-1].t_ns
    assert again[0].seq > got[-1].seq + 1, "the absence is a gap"
    assert np.isfinite(got[-1].orientation_wxyz).all(), "a filter knows its tilt after a second"
    assert again[-1].t_ns < SystemClock().now_ns()


def health(bus: ZenohBus) -> Health:
    return bus.ask(Command("palm-imu", "report", ""), PATIENCE_S)


def test_a_number_that_no_report_can_carry_does_not_silence_it(tmp_path: Path) -> None:
    """What a broken sensor says of its temperature is its own text."""
    files, log, link = calibration(tmp_path), tmp_path / "imu.log", tmp_path / "ttyACM0"
    key, port, endpoint = new_key(), free_udp_port(), free_endpoint()
    device = FakeXimu3(link, streams=True)
    with ExitStack() as stack:
        stack.callback(device.unplug)
        bus, ingest = master(stack, bytes.fromhex(key), ("127.255.255.255", port), ("127.0.0.1", 0), endpoint)
        stack.enter_context(process(files, log, key, port, imu=f"ximu3:{link}"))
        got: list[ImuSample] = []
        assert until(lambda: take(ingest, got) >= 10), log.read_text()
        assert until(lambda: "palm-imu" in bus.alive()), log.read_text()
        reports = bus.subscribe("health", "palm-imu")
        for line in ("T,{},1e300", "B,{},1e300,1e300,2", "T,{},nan"):
            device.write(line.format(device.now_us).encode() + b"\r\n")
            for _ in range(2):  # what it measured is in one of the next two
                least = len(got) + 10
                assert until(lambda n=least: take(ingest, got) >= n)
                assert isinstance(reports.get(PATIENCE_S), Health), line
