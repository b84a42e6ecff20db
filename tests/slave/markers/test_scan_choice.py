"""Whole frames or windows: by name, or by what whole frames cost; told once, and kept while colours change."""

import logging
import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.messages import MarkerDetections
from slave.__main__ import main
from slave.cli.table import PROGRAM
from slave.markers.detector import MarkerDetector
from slave.markers.reloadable import CalibratedDetector, ReloadableDetector
from slave.markers.scan import JUDGED, PROBE_EVERY, PROBES, Scan, ScanChoice
from slave.report import DetectionCounters
from slave.sender import MarkerPipeline, run
from tests.slave.painted import NAMES, RANGES, camera, hand, render
from tests.slave.stand_ins import Listed, Wire
from tests.slave.test_sender import frame

STEP_NS = 16_666_667
PERIOD_MS = 1000.0 / 60.0  # of the camera of `painted`
HAND = render(hand())
DETECTOR = MarkerDetector(camera(), NAMES)


class Machine:
    """A processor on which detection takes so long [ms]: in whole frames, and in windows."""

    def __init__(self, whole_ms: float, windows_ms: float) -> None:
        self.whole_ms, self.windows_ms = whole_ms, windows_ms

    def frames(self, choice: ScanChoice, count: int) -> list[bool]:
        """Which of so many frames were scanned in windows only."""
        modes: list[bool] = []
        for _ in range(count):
            modes.append(choice.windows)
            choice.push(round(1e6 * (self.windows_ms if choice.windows else self.whole_ms)))
        return modes


def test_windows_are_chosen_where_whole_frames_do_not_fit_and_left_where_they_fit_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    choice, machine = ScanChoice("auto", camera()), Machine(1.3 * PERIOD_MS, 0.4 * PERIOD_MS)
    with caplog.at_level(logging.WARNING):
        modes = machine.frames(choice, JUDGED + 5 * PROBE_EVERY)
        assert modes[:JUDGED] == [False] * JUDGED
        assert modes[JUDGED : JUDGED + PROBE_EVERY] == [True] * PROBE_EVERY
        assert modes[JUDGED:].count(False) == 4, "a whole frame now and then: does it fit?"
        assert choice.frames == modes.count(True)
        (output,) = caplog.messages
        assert output.startswith("left: to scan a whole frame takes 21.7 ms of the 16.7 ms of a frame")
        assert "--scan auto" in output
        machine.whole_ms = 0.5 * PERIOD_MS
        modes = machine.frames(choice, (2 * PROBES + 1) * (PROBE_EVERY + 1))
        assert modes[-PROBE_EVERY:] == [False] * PROBE_EVERY
        assert len(caplog.messages) == 2
        assert "again: from now on whole frames are scanned" in caplog.messages[1]


def test_there_is_room_between_the_two_bounds_and_a_single_slow_frame_changes_nothing() -> None:
    for whole in (0.75, 0.85):
        choice = ScanChoice("auto", camera())
        assert not any(Machine(whole * PERIOD_MS, 1.0).frames(choice, 5 * JUDGED))
        slow = ScanChoice("auto", camera())
        Machine(1.1 * PERIOD_MS, 1.0).frames(slow, JUDGED)
        assert slow.windows
        assert Machine(whole * PERIOD_MS, 1.0).frames(slow, 4 * PROBES * PROBE_EVERY)[-1]
    choice, fast, slow_machine = ScanChoice("auto", camera()), Machine(1.0, 1.0), Machine(900.0, 1.0)
    for _ in range(20):
        fast.frames(choice, 9)
        assert slow_machine.frames(choice, 1) == [False]


def test_another_rate_is_another_time_of_a_frame() -> None:
    choice, machine = ScanChoice("auto", camera()), Machine(10.0, 1.0)
    assert not any(machine.frames(choice, 4 * JUDGED))
    choice.tune(msgspec.structs.replace(camera(), frame_rate_hz=120.0))
    assert machine.frames(choice, JUDGED + 1)[-1]


@pytest.mark.parametrize(("scan", "windows"), [("full", False), ("windows", True)])
def test_a_mode_by_name_is_kept_whatever_it_costs(scan: Scan, windows: bool) -> None:
    for machine in (Machine(900.0, 900.0), Machine(0.1, 0.1)):
        assert machine.frames(ScanChoice(scan, camera()), 2 * PROBE_EVERY) == [windows] * (2 * PROBE_EVERY)


def test_a_name_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="scan 'strips', not one of auto, full, windows"):
        ScanChoice("strips", camera())  # pyright: ignore[reportArgumentType]
    with pytest.raises(SystemExit):
        main(["run", "--name", "left", "--camera", "synthetic", "--scan", "strips"])
    assert "argument --scan: invalid choice" in capsys.readouterr().err
    assert PROGRAM.parse(["run", "--name", "left", "--camera", "synthetic"])[1].scan == "auto"


class Clock:
    """The processor time of a thread, by hand."""

    def __init__(self, detector: MarkerDetector, whole_ms: float) -> None:
        self._detector, self._whole_ms, self._now_ns, self._calls = detector, whole_ms, 0, 0

    def __call__(self) -> int:
        self._calls += 1
        if self._calls % 2 == 0:  # the detection is over
            self._now_ns += round(1e6 * (0.1 if self._detector.windows_only else self._whole_ms))
        return self._now_ns


def reloadable(scan: Scan, whole_ms: float = 1.0) -> tuple[ReloadableDetector, MarkerDetector]:
    plain = DETECTOR.fresh()
    return ReloadableDetector(plain, ScanChoice(scan, camera()), Clock(plain, whole_ms)), plain


def test_the_running_slave_measures_and_chooses_and_counts() -> None:
    detector, plain = reloadable("auto", whole_ms=20.0)
    counters = DetectionCounters(
        NAMES, lambda: {"windows": 0 if detector.choice is None else detector.choice.frames}
    )
    wire, count = Wire(MarkerDetections), JUDGED + 20
    frames = [frame(k, HAND) for k in range(count)]
    run(
        Listed(frames),
        MarkerPipeline("left", wire.session, wire.send, detector.push, counters),
        threading.Event(),
    )
    assert plain.windows_only
    counts = counters.counts()
    assert (counts["frames"], counts["windows"], counts["failed"]) == (count, 20, 0)
    for message in wire.sent[1:]:
        np.testing.assert_array_equal(message.uv, wire.sent[0].uv)
    detector, plain = reloadable("auto", whole_ms=2.0)
    run(
        Listed([frame(k, HAND) for k in range(count)]),
        MarkerPipeline("left", wire.session, wire.send, detector.push, counters),
        threading.Event(),
    )
    assert not plain.windows_only


def test_the_picture_that_is_shown_and_picked_from_is_the_whole_frame() -> None:
    detector, _ = reloadable("windows")
    detector.push(HAND, 0)
    found = detector.push(HAND, STEP_NS)
    assert detector.newest is not None
    assert detector.newest[0] is HAND
    np.testing.assert_array_equal(detector.found(STEP_NS), found.uv)


def test_colours_and_margin_change_while_windows_are_scanned_and_the_tracks_go_on() -> None:
    detector, old = reloadable("windows")
    for k in range(3):
        detector.push(HAND, k * STEP_NS)
    wider = {
        name: msgspec.structs.replace(one, hsv_low=(one.hsv_low[0] - 1, 70, 40))
        for name, one in RANGES.items()
    }
    new = MarkerDetector(camera(ranges=wider), NAMES)
    detector.replace(new)
    assert np.isfinite(detector.push(HAND, 3 * STEP_NS).uv[:, 0]).all()
    detector.tune(msgspec.structs.replace(camera(), roi_margin=0.02, exposure_us=3000.0))
    for k in range(4, 7):
        found = detector.push(render(hand(300.0 + 4.0 * (k - 3), 200.0)), k * STEP_NS)
        assert np.isfinite(found.uv[:, 0]).all(), "no frame without its markers"
    assert detector.plain is new
    assert new.windows_only
    assert detector.choice is not None
    assert detector.choice.frames == 7
    assert new._margin == 0.02
    assert old is not new


def test_a_marker_whose_colour_comes_later_is_found_and_without_any_colour_nothing_is_scanned() -> None:
    bare = msgspec.structs.replace(camera(), markers=None)
    choice = ScanChoice("windows", camera())
    detector = ReloadableDetector(CalibratedDetector(bare, NAMES), choice)
    assert np.isnan(detector.push(HAND, 0).uv).all()
    assert choice.frames == 0
    some = {name: RANGES[name] for name in ("index", "back")}
    detector.replace(CalibratedDetector(camera(ranges=some), NAMES))
    assert np.isfinite(detector.push(HAND, STEP_NS).uv[:, 0]).tolist() == [name in some for name in NAMES]
    detector.replace(MarkerDetector(camera(), NAMES))
    assert np.isfinite(detector.push(HAND, 2 * STEP_NS).uv[:, 0]).all()
    assert choice.frames == 2


def test_a_recording_gives_the_same_bytes_in_windows(datasets: Path, colours: Path, tmp_path: Path) -> None:
    command = ["run", "--name", "left", "--camera", f"replay:{datasets / 'stereo/static'}"]
    command += ["--calibration", str(colours)]
    for scan in ("full", "windows"):
        assert main([*command, "-o", str(tmp_path / f"{scan}.npz"), "--scan", scan]) == 0
    assert (tmp_path / "full.npz").read_bytes() == (tmp_path / "windows.npz").read_bytes()


def test_a_wrist_device_has_no_windows_of_markers(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", "--name", "wrist", "--rig", "wrist", "--camera", "synthetic", "--scan", "windows"]
    assert main([*command, "--calibration", str(root / "calib_json")]) == 1
    assert "--scan windows: camera 'wrist' of a wrist device sees no markers" in capsys.readouterr().err
