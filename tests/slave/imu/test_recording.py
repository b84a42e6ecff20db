"""A real IMU beside the camera that is recorded: imu.csv on the clock of the frames, in whole rows."""

import csv
import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import ImuCalibration, RigCalibration, load, save
from common.errors import ImuError, RecordingError
from common.imu.csv_table import IMU, read_imu
from common.messages import ImuSample
from common.recording.frame_recording import open_recording
from slave.__main__ import main
from slave.imu.recording import ImuRecorder
from tests.network_helpers import until
from tests.slave.imu.fake_ximu3 import FakeXimu3

ROOT = Path(__file__).resolve().parents[3]


def files(folder: Path) -> Path:
    """A calib_json tree whose desk has an IMU."""
    (folder / "rigs").mkdir(parents=True)
    for kept in ("hands", "cameras"):
        (folder / kept).symlink_to(ROOT / "calib_json" / kept)
    rig = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
    save(folder / "rigs/desk.json", msgspec.structs.replace(rig, imu=ImuCalibration(name="palm")))
    return folder


def command(tmp_path: Path, *more: str) -> int:
    place = ["--name", "left", "--calibration", str(tmp_path / "calib"), "--camera", "synthetic"]
    return main(["record", *place, "--frames", "20", "--reserve-mb", "0", "-o", str(tmp_path / "out"), *more])


def test_the_command_records_it_on_the_clock_of_the_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("slave.imu.ximu3.ANSWER_S", 20.0)
    device = FakeXimu3(tmp_path / "port", streams=True)
    files(tmp_path / "calib")
    assert command(tmp_path, "--imu", f"ximu3:{tmp_path / 'port'}", "--clock-offset-ms", "7000") == 0
    device.unplug()
    frames, samples = open_recording(tmp_path / "out").rows, read_imu(tmp_path / "out", "palm")
    assert len(frames) == 20
    times = np.array([one.t_ns for one in samples])
    assert times[0] < frames[-1].t_ns, "on one clock, however late a busy machine reads either"
    assert times[-1] > frames[0].t_ns
    assert np.median(np.diff(times)) == pytest.approx(7.5e6, rel=0.05)
    np.testing.assert_allclose(
        [one.gyro_rad_s for one in samples], [np.radians([5.0, 0.0, -3.0])] * len(samples)
    )
    assert "lost 0, back 0" in capsys.readouterr().err


def test_without_an_imu_nothing_is_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files(tmp_path / "calib")
    assert command(tmp_path, "--imu", "ximu3:/dev/nowhere") == 1
    assert "there is no such port" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


class Source:
    """An IMU that gives samples until it is stopped, or breaks."""

    def __init__(self, breaks_after: int = 10**9) -> None:
        self.stop, self.closed = threading.Event(), False
        self.given, self.breaks_after = 0, breaks_after

    def read(self) -> ImuSample | None:
        if self.stop.wait(0.001):
            return None
        if self.given >= self.breaks_after:
            raise ImuError("broken for good")
        self.given += 1
        values = np.arange(3.0)
        return ImuSample("palm", 0, self.given, 1000 * self.given, values, values, values, np.full(4, np.nan))

    def close(self) -> None:
        self.closed = True


def test_rows_begin_with_the_recording_and_are_whole_at_any_time(tmp_path: Path) -> None:
    source = Source()
    recorder = ImuRecorder(source, None, source.stop)
    assert until(lambda: source.given > 3)
    recorder.start(tmp_path)
    assert until(lambda: len(read_imu(tmp_path, "palm")) > 5), "while it is still written"
    recorder.keep()
    counts = recorder.close()
    samples = read_imu(tmp_path, "palm")
    assert counts["samples"] == len(samples)
    assert samples[0].t_ns > 3000
    assert recorder.close() == counts
    assert source.closed
    with (tmp_path / IMU).open(newline="") as file:
        assert {len(line) for line in csv.reader(file)} == {15}


def test_what_nobody_keeps_is_removed_and_what_broke_is_reported(tmp_path: Path) -> None:
    source = Source(breaks_after=4)
    recorder = ImuRecorder(source, None, source.stop)
    (tmp_path / "out").mkdir()
    recorder.start(tmp_path / "out")
    assert until(lambda: recorder.failure is not None)
    recorder.close()
    assert str(recorder.failure) == "broken for good"
    assert not (tmp_path / "out").exists()
    source = Source()
    recorder = ImuRecorder(source, None, source.stop)
    with pytest.raises(RecordingError, match=r"imu.csv: cannot write"):
        recorder.start(tmp_path / "nowhere")
    recorder.close()
