"""The loop of an IMU's slave: every sample is sent once, gaps are counted; and what its command refuses."""

import threading
from functools import partial
from pathlib import Path
from typing import cast

import msgspec
import numpy as np
import pytest

from common.calibration import ImuCalibration, RigCalibration, load, save
from common.clock import SystemClock
from common.imu.fusion import OrientationFilter
from common.messages import Command, ImuSample
from slave.__main__ import main
from slave.report import Reporter, imu_counters
from slave.sender import ImuPipeline, run, skip_one, wait_for_start
from slave.sources import Reporting
from slave.uplink import Uplink
from tests.memory_bus import LoopbackBus
from tests.network_helpers import until
from tests.slave.stand_ins import Listed, Wire

ROOT = Path(__file__).resolve().parents[3]


def sample(seq: int) -> ImuSample:
    nothing = np.full(3, np.nan)
    return ImuSample("imu", 0, seq, 8_333_333 * seq, nothing, nothing, nothing, np.full(4, np.nan))


def test_every_sample_is_sent_in_the_name_of_this_process_and_gaps_are_counted() -> None:
    wire, counters = Wire(ImuSample, "there"), imu_counters(None)
    source = Listed([sample(k) for k in (40, 41, 45, 46)])
    run(source, ImuPipeline(77, wire.send, counters), threading.Event())
    assert [(one.source, one.session, one.seq, one.t_ns) for one in wire.sent] == [
        ("imu", 77, seq, 8_333_333 * seq) for seq in (40, 41, 45, 46)
    ]
    assert counters.counts() == {"samples": 4, "skipped": 3, "failed": 0}
    assert counters.metrics()["rate_hz"] > 0.0
    assert set(counters.metrics()) == {"rate_hz"}


class Filter:
    """Stands for the filter of the orientation."""

    at_rest, bias_rad_s, heading_sigma_rad = True, np.array([0.01, 0.0, np.nan]), 0.25

    def __init__(self) -> None:
        self.counts = {"fusion.gap": 2}
        self.pushed = 0

    def push(self, sample: ImuSample, /) -> ImuSample:
        self.pushed += 1
        return msgspec.structs.replace(sample, orientation_wxyz=np.array([1.0, 0.0, 0.0, 0.0]))


class Imu(Listed[ImuSample], Reporting):
    """An IMU that has more to tell."""

    def counts(self) -> dict[str, int]:
        return {"lost": 1, "back": 1, "broken": 0}

    def metrics(self) -> dict[str, float]:
        return {"temperature_c": 30.5, "away_s": 0.0, "battery_percent": np.inf}


def test_the_filters_orientation_is_sent_and_its_counts_and_those_of_the_imu_are_reported() -> None:
    wire, source, orientation = Wire(ImuSample, "there"), Imu([sample(0), sample(1)]), Filter()
    counters = imu_counters(source, cast(OrientationFilter, orientation))
    run(source, ImuPipeline(77, wire.send, counters, orientation.push), threading.Event())
    assert [one.orientation_wxyz.tolist() for one in wire.sent] == [[1.0, 0.0, 0.0, 0.0]] * 2
    assert counters.counts() == {
        "samples": 2,
        "skipped": 0,
        "failed": 0,
        "lost": 1,
        "back": 1,
        "broken": 0,
        "fusion.gap": 2,
    }
    metrics = counters.metrics()
    assert metrics.pop("rate_hz") > 0.0
    assert metrics == {
        "temperature_c": 30.5,
        "away_s": 0.0,
        "bias_x_rad_s": 0.01,
        "bias_y_rad_s": 0.0,
        "heading_sigma_rad": 0.25,
        "at_rest": 1.0,
    }, "only what is a number"


def test_samples_before_the_start_are_read_and_only_the_filter_sees_them() -> None:
    source, orientation, wire = Listed([sample(k) for k in range(5)]), Filter(), Wire(ImuSample, "there")
    pipeline = ImuPipeline(77, wire.send, imu_counters(source), orientation.push)
    waits = iter([False, False, False, True])

    def started(timeout_s: float) -> bool:
        assert timeout_s < 0.01
        return next(waits)

    assert wait_for_start(started, threading.Event(), skip=partial(skip_one, source, pipeline))
    assert (len(source.items), orientation.pushed, len(wire.sent)) == (2, 3, 0)
    assert pipeline.counters.counts()["samples"] == 0


def test_a_sample_that_the_filter_fails_of_is_left_out_before_the_start_and_after() -> None:
    def fail(_sample: ImuSample) -> ImuSample:
        raise IndexError("a fault in the filter")

    source, wire = Listed([sample(k) for k in range(5)]), Wire(ImuSample, "there")
    pipeline = ImuPipeline(77, wire.send, imu_counters(source), fail)
    assert skip_one(source, pipeline)
    run(source, pipeline, threading.Event())
    assert (pipeline.counters.counts()["failed"], wire.sent) == (5, [])


def test_it_reports_and_stops_on_the_bus() -> None:
    bus, stop, counters = LoopbackBus(), threading.Event(), imu_counters(None)
    for seq in (1, 2, 4):
        counters.item(seq)
    reporter = Reporter(
        "imu",
        cast(Uplink, Wire(ImuSample, "there")),
        counters,
        SystemClock(),
        lambda _endpoint: bus,
        stop.set,
        0.01,
    )
    assert until(lambda: "imu" in bus.alive())
    health = bus.ask(Command("imu", "report", ""), 5.0)
    assert (health.source, health.session) == ("imu", 77)
    assert health.counts == {"samples": 3, "skipped": 1, "failed": 0, "sent": 3}
    with pytest.raises(Exception, match="no command 'preview'; there are report, stop"):
        bus.ask(Command("imu", "preview", ""), 5.0)
    bus.ask(Command("imu", "stop", ""), 5.0)
    assert stop.is_set()
    reporter.close()


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        (["--name", "imu", "--rig", "desk"], "rig 'desk' has no IMU 'imu'; it has none"),
        (["--name", "wrist"], "rig 'wrist' has no IMU 'wrist'; its IMU is 'imu'"),
        (["--name", "imu", "--rig", "unplaced"], "rig 'unplaced': imu: q_palm_imu and q_rig_world: missing"),
        (
            ["--name", "imu", "--imu", "serial:/dev/ttyUSB0"],
            "no such driver; there are ximu3:PORT[@BAUD] | lsm6dsox:BUS[:ADDRESS] | synthetic",
        ),
        (["--name", "imu", "--imu", "synthetic:2"], "no such driver"),
        (["--name", "imu", "--scene", "board"], "only a hand before a synthetic camera has one"),
        (["--name", "imu", "--scene", "lights"], "for a wrist rig there are standard"),
        (
            ["--name", "imu", "--imu", "ximu3:/dev/nowhere"],
            "/dev/nowhere cannot be opened: there is no such port",
        ),
        (["--name", "imu", "--imu", "ximu3:/dev/ttyACM0@fast"], "write ximu3:PORT or ximu3:PORT@BAUD"),
        (["--name", "imu", "--imu", "ximu3"], "no such driver"),
        (["--name", "imu", "--imu", "lsm6dsox:99"], "I2C bus 99, address 0x6a: there is no /dev/i2c-99"),
        (["--name", "imu", "--imu", "lsm6dsox:1:zwei"], "write lsm6dsox:BUS or lsm6dsox:BUS:ADDRESS"),
        (["--name", "imu", "--imu", "lsm6dsox:1:0x99"], "write lsm6dsox:BUS or lsm6dsox:BUS:ADDRESS"),
        (["--name", "imu", "--rig", "trusting"], "imu.heading_sigma_rad: 0.1, but an orientation from rates"),
    ],
)
def test_what_it_cannot_be_is_said_at_the_start(
    option: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("PHALANX_RIG_KEY", "00" * 32)
    files = ROOT / "calib_json"
    if (name := option[-1]) in ("unplaced", "trusting"):
        files = tmp_path / "calib"
        (files / "rigs").mkdir(parents=True)
        rig = load(ROOT / "calib_json/rigs/wrist.json", RigCalibration)
        imu = ImuCalibration(heading_sigma_rad=0.1 if name == "trusting" else None)
        save(files / f"rigs/{name}.json", msgspec.structs.replace(rig, name=name, imu=imu))
        for kept in ("hands", "cameras"):
            (files / kept).symlink_to(ROOT / "calib_json" / kept)
    command = ["run", "--rig", "wrist", "--imu", "synthetic", "--calibration", str(files)]
    assert main([*command, *option, "--bind", "127.0.0.1"]) == 1
    assert expected in capsys.readouterr().err
