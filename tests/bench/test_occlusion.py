"""What the sections occlusion and volume count, on cases worked out by hand."""

import numpy as np
import pytest

from bench.mounts import pair_at
from bench.occlusion import CALIBRATION, Unseen
from bench.volume import SWAY_M, Tour
from common.calibration import HandProfile, RigCalibration, load
from common.hand.model import HandModel

RIG = load(CALIBRATION / "rigs" / "desk4.json", RigCalibration)


def test_a_tip_is_unseen_where_fewer_than_two_cameras_see_it() -> None:
    cameras = np.array([[2, 2, 2, 2, 2], [0, 1, 2, 3, 4], [4, 1, 4, 4, 4], [2, 4, 3, 2, 2]])
    assert Unseen.of(cameras) == Unseen(tips=3 / 20, moments=2 / 4, none=1 / 20, one=2 / 20)


def test_the_second_pair_of_the_rig_stands_where_the_map_says() -> None:
    for name, pose in zip(("left2", "right2"), pair_at(RIG, 110.0, 45.0), strict=True):
        np.testing.assert_allclose(RIG.camera_pose(name), pose, atol=1e-6)
    aside = pair_at(RIG, 110.0, 45.0)
    for a, b in zip(aside, (RIG.camera_pose("left"), RIG.camera_pose("right")), strict=True):
        assert np.degrees(np.arccos(a[:3, 2] @ b[:3, 2])) == pytest.approx(110.0, abs=1.5)  # the bar's toe-in


def test_the_tip_is_taken_to_every_place_and_stays_there() -> None:
    model = HandModel.of(load(CALIBRATION / "hands" / "default-right.json", HandProfile))
    places = np.array([[0.0, 0.1, 0.5], [0.1, -0.1, 0.6], [-0.1, 0.0, 0.8]])
    tour = Tour(model, "index", places)
    t = np.arange(0.0, tour.period_s, 0.05)
    number, stays = tour.stays(t)
    assert set(number[stays]) == {0, 1, 2}
    for k in np.flatnonzero(stays):
        state = tour.at(float(t[k]))
        tip = model.marker_points(model.forward(state.T_rig_palm, state.angles_rad), ("index",))[0]
        assert np.abs(tip - places[int(number[k])]).max() < 1.01 * SWAY_M
