"""Somebody else's IMU table: columns by name, units said, given or likely, and refusals that name the place."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.imu.csv_table import UNITS, Table, find_columns, read_csv

G = 9.80665


def read(
    tmp_path: Path, text: str, units: Mapping[str, str] | None = None, rate_hz: float | None = None
) -> Table:
    path = tmp_path / "walk.csv"
    path.write_text(text, encoding="utf-8")
    return read_csv(path, units, rate_hz)


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        (
            "t_ns,gx,gy,gz,ax,ay,az",
            ["1000000000,0.1,-0.2,0.3,0,0,9.80665", "1010000000,0.1,-0.2,0.3,0,0,9.80665"],
        ),
        (
            (
                "Packet,Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g),"
                "Accelerometer Y (g),Accelerometer Z (g)"
            ),
            [
                "7,1000000,5.729578,-11.459156,17.188734,0,0,1",
                "8,1010000,5.729578,-11.459156,17.188734,0,0,1",
            ],
        ),
        (
            "az_mg;ay_mg;ax_mg;note;gz;gy;gx;time_ms",
            ["1000;0;0;a,b;0,3;-0,2;0,1;1000", "1000;0;0;;0,3;-0,2;0,1;1010,0"],
        ),
        (
            (
                "# logger 2.1\n#timestamp [ns]\tw_RS_S_x [rad s^-1]\tw_RS_S_y [rad s^-1]\tw_RS_S_z [rad s^-1]\t"
                "a_RS_S_x [m s^-2]\ta_RS_S_y [m s^-2]\ta_RS_S_z [m s^-2]"
            ),
            ["1000000000\t0.1\t-0.2\t0.3\t0\t0\t9.80665", "1010000000\t0.1\t-0.2\t0.3\t0\t0\t9.80665"],
        ),
        (
            "Time (s);IMU Acceleration;;;IMU Gyroscope;;;Vicon Orientation;;;\n;X;Y;Z;X;Y;Z;W;X;Y;Z;",
            ["1.00;0;0;9.80665;0.1;-0.2;0.3;1;0;0;0", "1.01;0;0;9.80665;0.1;-0.2;0.3;1;0;0;0"],
        ),
    ],
    ids=["ours", "units in brackets", "decimal commas", "tabs, EuRoC", "two lines, RepoIMU"],
)
def test_layouts_of_others_say_the_same(header: str, rows: list[str], tmp_path: Path) -> None:
    table = read(tmp_path, "\n".join([header, *rows, ""]))
    np.testing.assert_array_equal(table.t_ns, [1_000_000_000, 1_010_000_000])
    np.testing.assert_allclose(table.gyro_rad_s, [[0.1, -0.2, 0.3]] * 2, rtol=1e-6)
    np.testing.assert_allclose(table.accel_m_s2, [[0.0, 0.0, G]] * 2, rtol=1e-9)
    assert (table.late, table.incomplete) == (0, 0)
    assert np.isfinite(table.truth_wxyz).all() == ("Vicon" in header)


@pytest.mark.parametrize(("unit", "step"), [("s", 0.004), ("ms", 5), ("us", 10_000), ("ns", 2_500_000)])
def test_time_without_a_unit_is_in_the_one_that_fits(unit: str, step: float, tmp_path: Path) -> None:
    rows = [f"{k * step},0,0,0,0,0,1" for k in range(4)]
    table = read(tmp_path, "\n".join(["t,gx,gy,gz,ax,ay,az", *rows]))
    assert np.diff(table.t_ns) == pytest.approx(step * UNITS["time"][unit])
    assert table.units == {
        "time": f"{unit} (not stated)",
        "gyro": "rad/s (not stated)",
        "accel": "g (not stated)",
    }


def test_units_can_be_given_and_a_table_may_lack_time(tmp_path: Path) -> None:
    text = "gyrX,gyrY,gyrZ,accX,accY,accZ,mag_x_uT,mag_y_uT,mag_z_uT\n" + "180,0,0,0,0,1,20,0,-40\n" * 3
    table = read(tmp_path, text, {"gyro": "deg/s", "accel": "g"}, rate_hz=200.0)
    np.testing.assert_array_equal(table.t_ns, [0, 5_000_000, 10_000_000])
    np.testing.assert_allclose(table.gyro_rad_s[0], [np.pi, 0.0, 0.0])
    np.testing.assert_allclose(table.mag_ut[2], [20.0, 0.0, -40.0])
    assert table.units["gyro"] == "deg/s (given)"


def test_what_was_not_measured_is_nan_and_counted_and_late_rows_are_left_out(tmp_path: Path) -> None:
    rows = [
        "0.00,0,0,0,0,0,1",
        "0.01,NaN,0,0,0,0,1",
        "0.01,0,0,0,0,0,1",
        "0.02,0,0,0,,0,1",
        "nan,0,0,0,0,0,1",
        "0.03,0",
    ]
    table = read(tmp_path, "\n".join(["t,gx,gy,gz,ax,ay,az", *rows]))  # the last line is cut
    assert len(table.t_ns) == 3
    assert (table.incomplete, table.late) == (2, 2)
    assert np.isnan(table.gyro_rad_s[1, 0])
    assert np.isnan(table.accel_m_s2[2, 0])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "t,gx,gy,ax,ay,az\n0,0,0,0,0,1\n",
            "walk.csv: line 1: no column for gyro z; the header has t, gx, gy, ax, ay, az",
        ),
        ("gx,gy,gz,ax,ay,az\n0,0,0,0,0,1\n", "no column for time; .*--rate-hz"),
        ("t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,1\n1,0,0,x,0,0,1\n", "line 3: column 'gz': 'x' is not a number"),
        ("t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,1\n1,0,0\n2,0,0,0,0,0,1\n", "line 3: 3 columns"),
        ("t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,1\n", "1 rows below the header of line 1"),
        ("t,gx,gyro_x,gy,gz,ax,ay,az\n0,0,0,0,0,0,0,1\n", "'gx' and 'gyro_x' could both be gyro x"),
        ("t,gx,gy,gz,ax,ay,az\n0,90,0,0,0,0,1\n.01,9,0,0,0,0,1\n", "up to 90 rad/s.*--gyro-unit deg/s"),
        ("t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,0.1\n.01,0,0,0,0,0,0.1\n", "median force is 0.1.*--accel-unit"),
        (
            "t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,1\n1e-4,0,0,0,0,0,1\n",
            "a step of 0.0001 fits no unit: give --time-unit",
        ),
        ("t,gx,gy,gz,ax_g,ay_mg,az_g\n0,0,0,0,0,0,1\n1,0,0,0,0,0,1\n", "accel: its columns say g and mg"),
        ("hello\n", "line 1: no header"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_place(text: str, expected: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=expected):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("acc_z_g", ("accel", "z", "g")),
        ("omega_y_rad_s", ("gyro", "y", "rad/s")),
        ("GyrX [°/s]", ("gyro", "x", "deg/s")),
        ("angular_velocity.x", ("gyro", "x", "")),
        ("linear_acceleration.y", ("accel", "y", "")),
        ("seconds_elapsed", ("time", "", "s")),
        ("temperature", None),
        ("gyro_bias_x", None),
        ("pitch", None),
    ],
)
def test_names(name: str, meant: tuple[str, str, str] | None) -> None:
    found = [(what, axis, column.unit) for (what, axis), column in find_columns([name]).items()]
    assert found == ([] if meant is None else [meant])


def test_of_forces_the_one_with_gravity_is_taken() -> None:
    names = ["linear_acc_x", "acc_x", "linear_acceleration_y"]
    assert {key: column.name for key, column in find_columns(names).items()} == {
        ("accel", "x"): "acc_x",
        ("accel", "y"): "linear_acceleration_y",
    }
