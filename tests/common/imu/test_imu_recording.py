"""imu.csv: what is written is read back, and what is broken is refused with file, line and column."""

from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.imu.csv_table import HEADERS, read_imu, write_imu
from common.messages import ImuSample

FULL = "t_ns,gx,gy,gz,ax,ay,az,mx,my,mz,qw,qx,qy,qz"
ROW = "1000,0.1,0.2,0.3,0,0,9.81,20,0,-40,1,0,0,0"


def samples(count: int = 20) -> list[ImuSample]:
    rng = np.random.default_rng(3)
    nothing, rotations = np.full(3, np.nan), rng.normal(size=(count, 4))
    return [
        ImuSample("imu", 0, k, 10**9 + 8_333_333 * k, gyro, accel, nothing, q, np.nan if k < 5 else 0.1 * k)
        for k, (gyro, accel, q) in enumerate(
            zip(
                *rng.normal(size=(2, count, 3)),
                rotations / np.linalg.norm(rotations, axis=1)[:, None],
                strict=True,
            )
        )
    ]


def test_what_is_written_is_read_back_to_the_last_bit(tmp_path: Path) -> None:
    written = samples()
    write_imu(tmp_path, written)
    read = read_imu(tmp_path, "imu")
    assert len(read) == len(written)
    for a, b in zip(read, written, strict=True):
        assert (a.source, a.seq, a.t_ns) == (b.source, b.seq, b.t_ns)
        for field in ("gyro_rad_s", "accel_m_s2", "mag_ut", "orientation_wxyz", "heading_sigma_rad"):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))


def test_a_recording_without_an_imu_has_no_sample(tmp_path: Path) -> None:
    assert read_imu(tmp_path, "imu") == ()


@pytest.mark.parametrize("header", HEADERS, ids=",".join)
def test_field_and_orientation_may_be_left_out(header: tuple[str, ...], tmp_path: Path) -> None:
    row = ["5", *("0.5" if name.startswith("q") else str(float(k)) for k, name in enumerate(header[1:], 1))]
    (tmp_path / "imu.csv").write_text(f"{','.join(header)}\n{','.join(row)}\n")
    (one,) = read_imu(tmp_path, "palm-imu")
    assert (one.source, one.t_ns) == ("palm-imu", 5)
    np.testing.assert_array_equal(one.gyro_rad_s, [1, 2, 3])
    np.testing.assert_array_equal(one.accel_m_s2, [4, 5, 6])
    assert np.isfinite(one.mag_ut).all() == ("mx" in header)
    assert np.isfinite(one.orientation_wxyz).all() == ("qw" in header)
    assert np.isfinite(one.heading_sigma_rad) == ("heading_sigma" in header)


@pytest.mark.parametrize(
    ("text", "output"),
    [
        ("t_ns,gx,gy\n", r"imu\.csv: header t_ns,gx,gy: must be t_ns,gx"),
        ("", r"imu\.csv: header : must be"),
        (f"{FULL}\n{ROW}\n1,2,3\n", r"imu\.csv: line 3: 3 columns, the header has 14"),
        (f"{FULL}\n{ROW.replace('1000', '1.5e3')}\n", r"line 2: t_ns: '1\.5e3' is not an integer"),
        (f"{FULL}\n{ROW.replace('0.2', 'fast')}\n", r"line 2: gy: 'fast' is not a number"),
        (f"{FULL}\n{ROW.replace('9.81', 'inf')}\n", r"line 2: az: 'inf' is not a finite number"),
        (f"{FULL}\n{ROW.replace('0.2', '300')}\n", r"line 2: gyro_rad_s: 300 is not within -200 \.\.\. 200"),
        (f"{FULL}\n{ROW.replace('1,0,0,0', '2,0,0,0')}\n", r"line 2: orientation_wxyz: 2 is not within"),
        (f"{FULL},heading_sigma\n{ROW},-0.1\n", r"line 2: heading_sigma: -0\.1 is below 0"),
        (f"{FULL}\n{ROW}\n{ROW}\n", r"line 3: t_ns: 1000 is not after 1000"),
    ],
)
def test_a_broken_table_is_refused_with_file_line_and_column(text: str, output: str, tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text(text)
    with pytest.raises(RecordingError, match=output) as caught:
        read_imu(tmp_path, "imu")
    assert str(tmp_path) in str(caught.value)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match="not a table of text"):
        read_imu(tmp_path, "imu")


def test_a_cut_last_line_is_left_out_and_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "imu.csv").write_text(f"{FULL}\n{ROW}\n2000,0.1,0.")
    assert [one.t_ns for one in read_imu(tmp_path, "imu")] == [1000]
    assert "the last line is cut" in caplog.text


def test_a_value_that_the_sensor_did_not_give_is_nan(tmp_path: Path) -> None:
    (tmp_path / "imu.csv").write_text(f"{FULL}\n{ROW.replace('1,0,0,0', 'nan,nan,nan,nan')}\n")
    (one,) = read_imu(tmp_path, "imu")
    assert np.isnan(one.orientation_wxyz).all()
    assert np.isfinite(one.gyro_rad_s).all()
