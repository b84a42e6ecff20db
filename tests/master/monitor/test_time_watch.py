"""What the master tells of time: gauges, a warning for stamps that lie, a line when cameras fall in step or out."""

from collections.abc import Callable

import pytest

from common.link.clock_offset import ClockEstimate
from common.messages import Health, MarkerDetections, decode, encode
from master.monitor.clocks import ClockMonitor
from master.monitor.rates import CameraPhases
from master.rig.setup import RigSetup
from tests import timing_scenes as scenes
from tests.hand_helpers import RIGHT, camera_file, detections, rig_file
from tests.timing_scenes import Motion, cameras, recorded

S = 1_000_000_000
NOTHING = scenes.SHAPE[:, :2] * 0.0 + 100.0


def setup_of(**changes: object) -> RigSetup:
    rig = rig_file(**changes)  # pyright: ignore[reportArgumentType]
    return RigSetup.of(
        rig, {name: camera_file(name, 60.0, scenes.ROW_TIME_US) for name in rig.cameras}, RIGHT
    )


def watched(watch: ClockMonitor, messages: list[MarkerDetections]) -> list[str]:
    """All lines of a run, looked at once a second."""
    lines: list[str] = []
    next_ns = messages[0].t_ns + S
    for message in messages:
        watch.push(message)
        if message.t_ns >= next_ns:
            next_ns += S
            lines += watch.look()
    return lines


def messages_of(
    motion: Callable[[int], Motion], late_ms: float, seconds: float = 14.0
) -> list[MarkerDetections]:
    return recorded(cameras(), motion(3), 60.0, seconds, {"right": late_ms}, 3)


def stepping(phase_ms: float, seconds: float, ppm: float = 0.0) -> list[MarkerDetections]:
    """Empty frames of two cameras at 60 Hz, the right one `phase_ms` later and `ppm` slower."""
    out: list[MarkerDetections] = []
    for k in range(int(60 * seconds)):
        t_s = k / 60.0
        out.append(detections("left", k, S + round(t_s * 1e9), NOTHING))
        late_s = 1e-3 * phase_ms + t_s * ppm * 1e-6
        out.append(detections("right", k, S + round((t_s + late_s) * 1e9), NOTHING))
    return sorted(out, key=lambda message: message.t_ns)


@pytest.mark.parametrize("motion", [scenes.sideways, scenes.natural])
def test_a_stamp_that_lies_is_named_once_with_what_to_do(motion: Callable[[int], Motion]) -> None:
    lines = watched(ClockMonitor([setup_of()]), messages_of(motion, 8.0))
    warnings = [line for line in lines if "stamps" in line]
    assert len(warnings) == 1
    assert "camera right: its frames are " in warnings[0]
    assert "later than its stamps say" in warnings[0]
    assert "calibrate cameras time" in warnings[0]


@pytest.mark.parametrize("motion", [scenes.sideways, scenes.natural, scenes.circling, scenes.resting])
def test_true_stamps_are_never_named(motion: Callable[[int], Motion]) -> None:
    assert not [
        line for line in watched(ClockMonitor([setup_of()]), messages_of(motion, 0.0)) if "stamps" in line
    ]


def test_an_offset_of_the_rig_file_is_taken_into_account_and_followed() -> None:
    messages = messages_of(scenes.natural, 8.0)
    corrected = setup_of(stamp_offset_us={"right": 8000.0})
    assert not [line for line in watched(ClockMonitor([corrected]), messages) if "stamps" in line]
    watch = ClockMonitor([setup_of()])
    for message in messages:
        watch.push(message)
    watch.look()
    assert watch.metrics(lambda _name: None)["right.residual_offset_us"] > 7000.0
    watch.follow([corrected])
    for message in messages:
        watch.push(message)
    watch.look()
    assert abs(watch.metrics(lambda _name: None)["right.residual_offset_us"]) < 500.0


def test_gauges_report_clocks_phases_and_residuals_and_fit_a_report() -> None:
    long = "camera-" + "x" * 57
    watch = ClockMonitor([setup_of(cameras=("left", "right", long))])
    estimate = ClockEstimate(t_ns=S, offset_ns=-7 * S, drift_ppm=12.3456, sigma_ns=3_000.0, bound_ns=100_000)
    for message in messages_of(scenes.natural, 0.0):
        watch.push(message)
    watch.look()
    metrics = watch.metrics(lambda name: None if name == "left" else estimate)
    assert metrics["right.clock_offset_us"] == -7e6
    assert metrics["right.clock_drift_ppm"] == 12.346
    assert 57.0 < metrics["right.clock_sigma_us"] < 59.0  # 100 us / sqrt 3, and the scatter
    assert abs(metrics["right.residual_offset_us"]) < 1000.0
    assert 0.0 < metrics["right.residual_sigma_us"] < 1000.0
    assert abs(metrics["right.phase_us"]) <= 8_334.0
    assert not [name for name in metrics if name.startswith("left.")]
    assert any(name.endswith("xxx.clock_drift_ppm") for name in metrics)
    assert decode(encode(Health("master", 1, 2, {}, metrics))).metrics == metrics  # pyright: ignore[reportAttributeAccessIssue]
    assert all(len(name) <= 64 for name in metrics)


def test_cameras_in_step_and_out_of_it_are_reported_on_change_only() -> None:
    lines = watched(ClockMonitor([setup_of()]), stepping(0.04, 30.0))
    assert len(lines) == 1
    assert "camera right: in step with left, +0.04 ms" in lines[0]
    lines = watched(ClockMonitor([setup_of()]), stepping(5.0, 30.0))
    assert len(lines) == 1
    assert "camera right: free of left, +5.00 ms" in lines[0]
    drifting = stepping(-0.2, 60.0, ppm=20.0)  # leaves the band after 35 s
    lines = watched(ClockMonitor([setup_of()]), drifting)
    assert [line.split(",")[0] for line in lines] == [
        "camera right: in step with left",
        "camera right: free of left",
    ]


@pytest.mark.parametrize("phase_ms", [-8.3, -3.0, 0.0, 8.3])
def test_a_phase_is_within_half_a_period_and_has_no_seam(phase_ms: float) -> None:
    phases = CameraPhases({"left": 60.0, "right": 60.0})
    for message in stepping(phase_ms % (1e3 / 60.0), 3.0):
        phases.push(message)
    [right] = phases.phases().values()
    assert right.phase_us == pytest.approx(1e3 * phase_ms, abs=0.1)
    assert right.spread_us < 0.1
