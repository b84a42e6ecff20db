"""What the occlusion bench counts, on cases worked out by hand."""

import numpy as np
import pytest

from bench.cameras.occlusion import Unseen, pair_at
from bench.report import CALIBRATION
from common.calibration import RigCalibration, load

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
