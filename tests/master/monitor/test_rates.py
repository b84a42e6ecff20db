"""The rate of a camera is not that of the frames that arrive."""

import numpy as np
import pytest

from common.messages import MarkerDetections
from master.monitor.rates import CameraRates

PERIOD_NS = 16_666_667


def frame(camera: str, seq: int, session: int = 1, late_ns: int = 0) -> MarkerDetections:
    nothing = np.full(6, np.nan)
    t_ns = 5_000_000_000 + seq * PERIOD_NS + late_ns
    nowhere = np.full((6, 2), np.nan)
    return MarkerDetections(camera, session, seq, t_ns, t_ns, nowhere, nothing, nothing, nothing, nowhere)


def test_a_slave_that_searches_every_third_frame_has_a_camera_of_full_rate() -> None:
    rates = CameraRates()
    for seq in range(0, 300, 3):
        rates.push(frame("left", seq))
        rates.push(frame("right", seq // 3))
    assert rates.camera_hz == {"left": pytest.approx(60.0), "right": pytest.approx(60.0)}
    assert rates.received_hz == {"left": pytest.approx(20.0), "right": pytest.approx(60.0)}


def test_a_restarted_slave_counts_anew_and_its_absence_is_no_slow_camera() -> None:
    rates = CameraRates()
    for seq in range(60):
        rates.push(frame("left", seq))
    for seq in range(60):
        rates.push(frame("left", seq, session=2, late_ns=7_000_000_000))
    assert rates.camera_hz["left"] == rates.received_hz["left"] == pytest.approx(60.0)


def test_an_older_frame_changes_nothing_and_one_frame_has_no_rate() -> None:
    rates = CameraRates()
    rates.push(frame("left", 9))
    assert rates.camera_hz == {}
    rates.push(frame("left", 10))
    rates.push(frame("left", 4))
    rates.push(frame("left", 10))
    assert rates.camera_hz == {"left": pytest.approx(60.0)}
    assert rates.received_hz == {"left": pytest.approx(60.0)}
