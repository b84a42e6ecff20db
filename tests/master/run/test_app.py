"""Tests of the live loop with a source, a clock and sinks of the test's own."""

import threading
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration import ImuCalibration
from common.clock import Clock
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, quaternion_to_matrix
from common.hand.model import WRIST
from common.messages import HandPose, ImuSample, MarkerDetections, ResultMessage
from master.monitor.report import cameras_line
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigSetup
from master.run.app import AuxiliaryMessage, RunFigures, StageTimes, health, observed, run
from master.run.dispatcher import Dispatcher
from tests.hand_helpers import detections
from tests.synthetic_run import SyntheticRun, hand_at, setup_of, synthetic_run


class ScriptedSource:
    """Gives messages in turn, with pauses (None), then sets `stop`."""

    def __init__(
        self, messages: Sequence[MarkerDetections | AuxiliaryMessage | None], stop: threading.Event
    ) -> None:
        self._messages, self._stop = iter(messages), stop

    def get(self, timeout_s: float) -> MarkerDetections | AuxiliaryMessage | None:
        assert timeout_s > 0
        try:
            return next(self._messages)
        except StopIteration:
            self._stop.set()
            return None


class ScriptedClock(Clock):
    """The time is whatever the last message said, and 3 ms."""

    t_ns = 0

    def now_ns(self) -> int:
        return self.t_ns


class Collector:
    def __init__(self) -> None:
        self.poses: list[HandPose] = []
        self.others: list[ResultMessage] = []

    def write(self, message: ResultMessage) -> None:
        if isinstance(message, HandPose):
            self.poses.append(message)
        else:
            self.others.append(message)

    def close(self) -> None:
        raise AssertionError("the loop does not own its sinks")


def world_of(*setups: RigSetup) -> Dispatcher:
    return Dispatcher(setups, [pipeline_of(setup, StageTimes()) for setup in setups], StageTimes())


@pytest.fixture(scope="module")
def short_run() -> SyntheticRun:
    return synthetic_run(6)


def test_every_pose_reaches_every_sink_with_its_latency(short_run: SyntheticRun) -> None:
    stop, clock, figures = threading.Event(), ScriptedClock(), RunFigures()
    sinks = [Collector(), Collector()]
    script: list[MarkerDetections | ImuSample | None] = [
        m for pair in zip(short_run.messages, strict=True) for m in (*pair, None)
    ]
    source = ScriptedSource(script, stop)
    clock.t_ns = short_run.messages[-1].t_ns + 3_000_000
    run(source.get, world_of(short_run.setup).push, sinks, clock, figures, stop)
    assert figures.poses == len(sinks[0].poses) >= 5
    assert [p.t_ns for p in sinks[0].poses] == [p.t_ns for p in sinks[1].poses]
    last = sinks[0].poses[-1]
    assert last.latency_ns == 1_000_000  # handed over 2 ms after its capture, published after 3 ms


def rotated(t_ns: int, rotation: Float) -> ImuSample:
    """A sample of an IMU whose axes are the palm's and whose world is the rig's, `rotation` (3, 3) off the truth."""
    q = matrix_to_quaternion(rotation @ hand_at(t_ns * 1e-9).T_rig_palm[:3, :3])
    return ImuSample("imu", 1, t_ns // 8_000_000, t_ns, np.zeros(3), np.zeros(3), np.full(3, np.nan), q)


def test_samples_of_an_imu_turn_the_palm_and_are_no_frames(short_run: SyntheticRun) -> None:
    same = (1.0, 0.0, 0.0, 0.0)
    imu = ImuCalibration(
        q_palm_imu=same, q_rig_world=same, orientation_sigma_rad=1e-3, heading_sigma_rad=1e-3
    )
    setup, off = setup_of(msgspec.structs.replace(short_run.setup.rig, imu=imu)), axis_rotation(0, 0.1)
    first, last = short_run.messages[0].t_ns, short_run.messages[-1].t_ns
    samples = [rotated(t_ns, off) for t_ns in range(first, last, 8_000_000)]
    script = sorted([*short_run.messages, *samples], key=lambda message: message.t_ns)
    stop, sink, figures = threading.Event(), Collector(), RunFigures()
    hands, watched = world_of(setup), list[MarkerDetections]()
    push = observed(hands.push, figures.rates, watched.append)
    run(ScriptedSource([*script], stop).get, push, [sink], ScriptedClock(), figures, stop)
    assert watched == short_run.messages
    assert set(figures.rates.camera_hz) == {"left", "right"}
    assert hands.counts["orientation.used"] == len(sink.poses) >= 5
    for pose in sink.poses:  # so narrow a belief outweighs the markers: where it is wrong, the palm follows
        truth = off @ hand_at(pose.t_ns * 1e-9).rotation[WRIST]
        found = quaternion_to_matrix(pose.orientation_wxyz[WRIST])
        assert np.degrees(np.arccos((np.trace(found @ truth.T) - 1.0) / 2.0)) < 1.5


def test_samples_of_an_imu_that_has_no_place_are_counted(short_run: SyntheticRun) -> None:
    unplaced = setup_of(msgspec.structs.replace(short_run.setup.rig, imu=ImuCalibration()))
    stop, hands = threading.Event(), world_of(unplaced)
    run(
        ScriptedSource([rotated(0, np.eye(3))], stop).get, hands.push, [], ScriptedClock(), RunFigures(), stop
    )
    assert hands.counts == {"orientation.unplaced": 1}


def test_a_stopped_loop_does_nothing(short_run: SyntheticRun) -> None:
    stop = threading.Event()
    stop.set()
    sink = Collector()
    source = ScriptedSource(list(short_run.messages), stop)
    run(source.get, world_of(short_run.setup).push, [sink], ScriptedClock(), RunFigures(), stop)
    assert sink.poses == []


def test_figures_are_rate_and_quantiles() -> None:
    figures = RunFigures()
    assert figures.summary() == {"poses": 0.0}
    for k in range(101):
        figures.add(1_000_000_000 + k * 20_000_000, k * 1_000_000)
    assert figures.summary() == {
        "poses": 101.0,
        "poses_per_s": 50.0,
        "latency_p50_ms": 50.0,
        "latency_p99_ms": 99.0,
    }


def test_one_pose_has_no_rate() -> None:
    figures = RunFigures()
    figures.add(0, 4_000_000)
    assert figures.summary() == {"poses": 1.0, "latency_p50_ms": 4.0, "latency_p99_ms": 4.0}


def test_health_carries_counts_and_gauges() -> None:
    figures, clock = RunFigures(), ScriptedClock()
    figures.add(0, 4_000_000)
    clock.t_ns = 77
    for seq in (3, 6):  # two of three frames were not searched
        figures.rates.push(detections("left", seq, 1_000_000_000 + seq * 20_000_000, np.full((6, 2), 100.0)))
    report = health(5, clock, figures, {"left received": 9})
    assert (report.source, report.session, report.t_ns) == ("master", 5, 77)
    assert report.counts == {"poses": 1, "left received": 9}
    assert report.metrics == {"latency_p50_ms": 4.0, "latency_p99_ms": 4.0, "camera_hz.left": 50.0}


def test_stages_are_means_and_survive_an_error() -> None:
    stages = StageTimes()
    with pytest.raises(ZeroDivisionError), stages("hand"):
        raise ZeroDivisionError
    with stages("filter"):
        pass
    assert list(stages.mean_us()) == ["hand", "filter"]
    assert all(value >= 0 for value in stages.mean_us().values())


@pytest.mark.parametrize(
    ("connected", "output"),
    [
        ([], "cameras: none yet; waiting for left, right"),
        (["right"], "cameras: right; waiting for left"),
        (["right", "left"], "cameras: left, right"),
    ],
)
def test_who_is_waited_for_is_said(connected: list[str], output: str) -> None:
    assert cameras_line(("left", "right"), frozenset(connected)) == output
