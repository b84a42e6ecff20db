"""Observations made of truth are near it and end where sight does."""

import numpy as np
import pytest

from bench.both.scene import Shown, shown
from bench.played import START_NS
from common.messages import ImuSample, MarkerDetections, WristDetections

SECONDS = 0.5


@pytest.fixture(scope="module")
def made() -> Shown:
    return shown("both-poses", SECONDS, 3)


def test_all_sensors_report_in_order(made: Shown) -> None:
    stamps = [message.t_ns for message in made.messages]
    assert stamps == sorted(stamps)
    count = {
        kind: sum(isinstance(m, kind) for m in made.messages) for kind in (MarkerDetections, WristDetections)
    }
    assert count[MarkerDetections] == 2 * 30
    assert count[WristDetections] == 15
    assert sum(isinstance(m, ImuSample) for m in made.messages) >= 60


def test_markers_are_reported_near_the_truth_and_only_where_paint_is_in_sight(made: Shown) -> None:
    both = made.both
    off: list[float] = []
    for message in made.messages:
        if not isinstance(message, MarkerDetections):
            continue
        truth = both.scene.truth(
            1e-9 * (message.t_ns - START_NS) + 0.005
        )  # its row is exposed a little later
        uv = both.scene.optics[message.camera].project(truth.markers_m)
        seen = np.isfinite(message.uv[:, 0])
        off += np.linalg.norm(message.uv - uv, axis=1)[seen].tolist()
        k = int(
            np.argmin(np.abs(made.visibility.visible_t_s[message.camera] - 1e-9 * (message.t_ns - START_NS)))
        )
        assert (made.visibility.visible_px2[message.camera][k][seen] > 0.0).all()
    assert len(off) > 100
    assert np.median(off) < 5.0  # what is seen of a cap is not its middle
    assert max(off) < 12.0


def test_lines_and_tips_are_reported_only_where_they_are_in_sight(made: Shown) -> None:
    cycles = [message for message in made.messages if isinstance(message, WristDetections)]
    line = np.array([np.isfinite(message.laser_uv[:, 0]) for message in cycles])
    tip = np.array([np.isfinite(message.tip_uv[:, 0]) for message in cycles])
    at_s = [1e-9 * (message.t_ns - START_NS) for message in cycles]
    scene, frame_s = made.both.wrist_scene, 1.0 / made.both.wrist.cameras["wrist"].frame_rate_hz
    length_m = np.array([scene.truth(t).laser_len_vis[1:6] for t in at_s])
    assert line.any()
    assert not (line & (length_m < 2e-3)).any()
    assert not (tip & ~np.array([scene.truth(t + frame_s).tip_visible for t in at_s])).any()
