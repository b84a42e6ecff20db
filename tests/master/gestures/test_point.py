"""Pointing where the ray is known, and where it is not."""

import msgspec
import numpy as np

from common.calibration.gesture_settings import default_gestures
from common.hand.model import CHAINS
from common.messages import Gesture
from master.gestures.actions import PointMonitor
from master.gestures.features import FeatureExtractor
from tests.hand_helpers import RIGHT
from tests.master.gestures.shown_hands import FRAME_NS, POINT, posture, shown


def recognised_in(knuckle_sigma_m: list[float]) -> list[Gesture]:
    watch, out = PointMonitor(default_gestures().point), list[Gesture]()
    for k, sigma in enumerate(knuckle_sigma_m):
        pose = shown(posture(POINT), k * FRAME_NS)
        cov = pose.cov_m2.copy()
        cov[CHAINS[1, 0]] = sigma**2 * np.eye(3)
        seen = FeatureExtractor(RIGHT).of(msgspec.structs.replace(pose, cov_m2=cov))
        assert seen is not None
        out += watch.push(seen, may_begin=True)
    return out


def test_a_ray_from_a_knuckle_that_may_be_anywhere_is_withheld() -> None:
    # 20 mm across some 85 mm are 13 degrees, 4 mm not three.
    assert not recognised_in([0.020] * 60)
    assert recognised_in([0.004] * 20)[0].phase == "begin"


def test_one_unsure_instant_neither_delays_nor_ends_it() -> None:
    gestures = recognised_in([0.004, 0.004, 0.03, *[0.004] * 20, 0.03, *[0.004] * 10])
    first = next(k for k in range(60) if k * FRAME_NS * 1e-9 >= default_gestures().point.hold_s)
    assert gestures[0].t_ns == first * FRAME_NS
    assert {one.phase for one in gestures[1:]} == {"update"}


def test_one_that_stays_unsure_ends() -> None:
    gestures = recognised_in([*[0.004] * 20, *[0.03] * 20])
    assert gestures[-1].phase == "end"
    assert gestures[-1].t_ns <= (21 + round(default_gestures().point.hold_s * 60)) * FRAME_NS
