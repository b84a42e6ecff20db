"""The loop of a wrist device's slave: one message per triple, what is counted, which frames are shown."""

import threading
from pathlib import Path

import numpy as np
import pytest

from common.hand.model import FINGERS
from common.messages import WristDetections
from slave.__main__ import main
from slave.report import DetectionCounters
from slave.sender import DARK_AFTER, WristPipeline, run
from slave.sources import Frame
from slave.wrist.detector import WristDetector, WristFound
from slave.wrist.fingertips import Fingertips
from slave.wrist.laser import LaserLines
from slave.wrist.strobe import StrobeCycle
from tests.slave.stand_ins import Listed, Wire
from tests.slave.wrist.wrist_frames import CAMERA, ROOT, VIEW, strobed

NAMES = tuple(f"{what}.{finger}" for what in ("laser", "tip") for finger in FINGERS)
GREY = np.zeros((4, 4), np.uint8)


class ByNumber:
    """Takes frames 3k, 3k + 1, 3k + 2 for a triple, and sees the laser on the index from the second triple on."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def push(self, frame: Frame) -> WristFound | None:
        self.frames = [*self.frames[-2:], frame]
        if frame.seq % 3 != 2 or len(self.frames) < 3:
            return None
        nothing, uv = np.full(5, np.nan), np.full((5, 2), np.nan)
        sigma = nothing.copy()
        if frame.seq > 2:
            uv[1], sigma[1] = (3.0, 4.0), 0.5
        nowhere = Fingertips(np.full((5, 2), np.nan), nothing, nothing)
        return WristFound(StrobeCycle(*self.frames), LaserLines(uv, sigma, sigma), nowhere)


def frames(numbers: list[int]) -> list[Frame]:
    return [Frame(seq, 11_000_000 * seq, 11_000_000 * seq + 5, GREY) for seq in numbers]


def test_every_cycle_is_sent_the_empty_ones_too_and_all_frames_are_counted() -> None:
    wire, counters, shown = (
        Wire(WristDetections),
        DetectionCounters(NAMES, lambda: {"strobe.cycles": 3}),
        list[int](),
    )
    source = Listed(frames([0, 1, 2, 3, 4, 5, 9, 10, 11]))
    run(
        source,
        WristPipeline(
            "wrist", wire.session, wire.send, ByNumber().push, counters, lambda frame: shown.append(frame.seq)
        ),
        threading.Event(),
    )
    assert [(m.camera, m.session, m.seq, m.ready_t_ns) for m in wire.sent] == [
        ("wrist", 77, 1, 22_000_005),
        ("wrist", 77, 4, 55_000_005),
        ("wrist", 77, 10, 121_000_005),
    ]
    counts = counters.counts()
    assert (counts["frames"], counts["dropped"], counts["empty"]) == (9, 3, 1)
    assert (counts["seen.laser.index"], counts["seen.laser.thumb"], counts["seen.tip.index"]) == (2, 0, 0)
    assert counts["strobe.cycles"] == 3
    assert shown == [2, 5, 11]  # those under the LEDs
    assert counters.metrics()["detect_us"] > 0.0


def test_while_there_are_no_cycles_every_frame_is_shown_and_nothing_is_sent() -> None:
    wire, counters, shown = Wire(WristDetections), DetectionCounters(()), list[int]()
    run(
        Listed(frames(list(range(30)))),
        WristPipeline(
            "wrist",
            wire.session,
            wire.send,
            lambda _frame: None,
            counters,
            lambda frame: shown.append(frame.seq),
        ),
        threading.Event(),
    )
    assert wire.sent == []
    assert shown == list(range(DARK_AFTER, 30))
    assert (counters.counts()["frames"], counters.counts()["empty"]) == (30, 0)


def test_the_time_of_a_cycle_is_that_of_its_three_frames_however_long_there_was_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ticks = iter(range(0, 10**9, 1_000_000))  # every look at the clock a millisecond later
    monkeypatch.setattr("slave.sender.time.perf_counter_ns", lambda: next(ticks))
    counters = DetectionCounters(NAMES)
    # 300 frames of which none is the last of a triple: nobody before the device.
    source = Listed(frames([*(3 * k for k in range(300)), 900, 901, 902]))
    run(
        source,
        WristPipeline("wrist", 77, Wire(WristDetections).send, ByNumber().push, counters),
        threading.Event(),
    )
    metrics = counters.metrics()
    assert (metrics["detect_us"], metrics["detect_worst_us"]) == (3000.0, 3000.0)


def test_real_frames_go_through_the_loop_into_messages() -> None:
    wire, counters = Wire(WristDetections), DetectionCounters(NAMES)
    detector = WristDetector(VIEW, CAMERA.frame_rate_hz)
    run(
        Listed(strobed("curl", 6)),
        WristPipeline("wrist", wire.session, wire.send, detector.push, counters),
        threading.Event(),
    )
    assert len(wire.sent) == detector.counts["cycles"] >= 4
    counts = counters.counts()
    assert counts["frames"] == 18
    assert counts["seen.laser.middle"] == np.isfinite([m.laser_uv[2, 0] for m in wire.sent]).sum() >= 4


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        (
            ["--camera", "v4l2:/dev/there-is-none", "--lights", "camera"],
            "camera 'wrist' (v4l2:/dev/there-is-none): cannot be opened",
        ),
        (["--camera", "synthetic", "--luma"], "--luma is an option of --camera picamera2 and v4l2"),
        (["--camera", "synthetic", "--scene", "lights"], "for a wrist rig there are standard"),
    ],
)
def test_what_a_wrist_device_cannot_have_is_said_at_the_start(
    option: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("PHALANX_RIG_KEY", "00" * 32)
    monkeypatch.chdir(tmp_path)
    command = ["run", "--name", "wrist", "--rig", "wrist", "--calibration", str(ROOT / "calib_json")]
    assert main([*command, *option, "--bind", "127.0.0.1"]) == 1
    assert expected in capsys.readouterr().err
