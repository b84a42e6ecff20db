"""C3D: labelled points written by py-c3d's writer and read back; junk is refused."""

from pathlib import Path
from typing import Any, cast

import c3d
import numpy as np
import pytest

from common.arrays import Float
from common.errors import RecordingError
from common.hand.model import JOINTS
from master.mocap.read import read_motion
from tests.master.mocap.moved import hand_at


def write_c3d(path: Path, joints_m: Float, unit: str = "mm") -> Path:
    """Points in millimetres at 100 Hz; NaN as C3D has it, with a residual of -1."""
    writer = cast(Any, c3d).Writer(point_rate=100.0, point_units=unit.ljust(4))
    for frame in joints_m:
        points = np.zeros((len(frame), 5), np.float32)
        points[:, :3] = np.nan_to_num(1e3 * frame)
        points[:, 3] = np.where(np.isnan(frame).any(axis=1), -1.0, 0.0)
        writer.add_frames([(points, np.zeros((0, 0)))])
    writer.set_point_labels([f"R_{name}" for name in JOINTS])
    with path.open("wb") as file:
        writer.write(file)
    return path


def test_points_are_read_back(tmp_path: Path) -> None:
    exact = hand_at(np.arange(5) / 100.0).position_m
    exact[2, 7] = np.nan
    found = read_motion(write_c3d(tmp_path / "hand.c3d", exact))
    assert found.names == JOINTS
    assert found.side == "right"
    np.testing.assert_allclose(found.position_m, exact, atol=2e-6)
    np.testing.assert_array_equal(np.diff(found.t_ns), 10_000_000)


def test_what_is_no_c3d_is_refused(tmp_path: Path) -> None:
    whole = write_c3d(tmp_path / "hand.c3d", hand_at(np.arange(5) / 100.0).position_m).read_bytes()
    rng = np.random.default_rng(1)
    for junk in (b"", b"HIERARCHY", whole[:100], whole[:600], rng.bytes(2048)):
        (tmp_path / "junk.c3d").write_bytes(junk)
        with pytest.raises(RecordingError, match=r"junk\.c3d: "):
            read_motion(tmp_path / "junk.c3d")
