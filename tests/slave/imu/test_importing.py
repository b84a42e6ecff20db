"""A foreign IMU recording by the command: what it says, the imu.csv it writes, and a real one against optical truth."""

from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.geometry.transforms import axis_rotation, matrix_to_quaternion
from common.imu.csv_table import read_csv, read_imu
from slave.__main__ import main
from slave.imu.recording import import_table

HEADER = (
    "Packet;Timestamp (ms);Accelerometer X (g);Accelerometer Y (g);Accelerometer Z (g);gx_dps;gy_dps;gz_dps"
)
TRUTH = "opt_qw;opt_qx;opt_qy;opt_qz"


def rested(path: Path, seconds: float = 5.0, tilt_deg: float = 30.0, off_deg: float = 0.0) -> Path:
    """A sensor that lies tilted, with a bias of 1 deg/s, and a truth that is off by so much; a gap, and one NaN."""
    lies = axis_rotation(0, np.radians(tilt_deg))
    up = lies[2]
    q = matrix_to_quaternion(axis_rotation(0, np.radians(tilt_deg + off_deg)))
    rows = [
        ";".join(map(str, [k, 10 * k, *up.tolist(), "nan" if k == 40 else 1.0, 0, 0, *q.tolist()]))
        for k in range(round(100 * seconds))
        if not 200 <= k < 205
    ]
    path.write_text("\n".join([f"{HEADER};{TRUTH}", *rows, ""]))
    return path


def test_it_says_what_is_in_it_and_writes_our_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rested(tmp_path / "foreign.csv", off_deg=1.0)
    assert main(["record", "--imu-csv", str(path), "-o", str(tmp_path / "taken"), "--name", "device"]) == 0
    output = capsys.readouterr().out
    assert "Timestamp (ms) in ms (header)" in output
    assert "gx_dps, gy_dps, gz_dps in deg/s (header)" in output
    assert (
        "495 in 4.99 s, 100.0 Hz; 1 gaps, the longest 0.060 s; 1 rows with NaN, 0 not after the last"
        in output
    )
    against = next(line for line in output.splitlines() if line.startswith("inclination"))
    assert "deg rms against opt_qw, opt_qx, opt_qy, opt_qz, taken for true" in against
    assert float(against.split()[1]) == pytest.approx(1.0, abs=0.1)
    samples = read_imu(tmp_path / "taken", "device")
    assert len(samples) == 495
    np.testing.assert_allclose(samples[0].gyro_rad_s, [np.radians(1.0), 0.0, 0.0])
    found = samples[-1].orientation_wxyz
    np.testing.assert_allclose(found[1], np.sin(np.radians(15.0)), atol=1e-3)
    assert np.isnan(samples[40].gyro_rad_s[0])


def test_what_is_there_is_not_written_over(tmp_path: Path) -> None:
    table = read_csv(rested(tmp_path / "foreign.csv", 2.0))
    import_table(table, "imu", tmp_path / "taken", lambda _: None)
    with pytest.raises(RecordingError, match=r"imu\.csv: is there already"):
        import_table(table, "imu", tmp_path / "taken", lambda _: None)


def test_it_is_a_device_or_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["record", "--imu-csv", "a.csv", "--camera", "synthetic"])
    assert main(["record", "--imu-csv", str(tmp_path / "none.csv")]) == 1
    assert "none.csv: there is no such file" in capsys.readouterr().err


def test_a_real_recording_in_a_foreign_layout(datasets: Path, tmp_path: Path) -> None:
    with np.load(datasets / "broad" / "07_undisturbed_fast_rotation_B.npz") as data:
        rows = slice(8000, 24000, 3)  # of a fast rotation, 95 Hz
        rate_hz = float(data["fs"]) / 3
        gyro, accel, truth = (data[name][rows] for name in ("gyr_rads", "acc_ms2", "opt_quat_wxyz"))
    t_us = np.arange(len(gyro)) * 1e6 / rate_hz
    columns = np.column_stack((truth, np.degrees(gyro), t_us, accel / 9.80665))
    rates = [f"gyro_{axis} (deg/s)" for axis in "xyz"]
    header = "\t".join(
        ["ref_q0", "ref_q1", "ref_q2", "ref_q3", *rates, "time_us", "acc_x_g", "acc_y_g", "acc_z_g"]
    )
    path = tmp_path / "swung.csv"
    np.savetxt(path, columns, fmt="%.6f", delimiter="\t", header=header, comments="")
    output: list[str] = []
    import_table(read_csv(path), "imu", None, output.append)
    line = next(one for one in output if one.startswith("inclination"))
    assert float(line.split()[1]) < 1.5
    assert float(line.split("stated ")[1].split("%")[0].split(",")[1]) > 95.0
