"""Whose pinch it is, and what is no pinch: gaps given, a hand around them."""

import numpy as np
import pytest

from common.calibration.gesture_settings import default_gestures
from master.gestures.actions import PinchMonitor
from master.gestures.features import FeatureExtractor, ThumbTouch, thumb_touch
from tests.hand_helpers import RIGHT
from tests.master.gestures.shown_hands import FRAME_NS, PINCH, posture, shown

PINCHES = default_gestures().pinch


def recognised_in(
    gap_mm: tuple[float, float, float, float],
    sigma_mm: float = 1.0,
    apart_deg: float = 60.0,
    sigma_deg: float = 5.0,
) -> list[str]:
    """Names of the pinches that begin at such gaps to index ... little."""
    seen = FeatureExtractor(RIGHT).of(shown(posture(PINCH), FRAME_NS))
    assert seen is not None
    touch = changed(thumb_touch(seen, RIGHT.radius_m), gap_mm, sigma_mm, apart_deg, sigma_deg)
    return [one.name for one in PinchMonitor(PINCHES).push(seen, touch, may_begin=True)]


def changed(
    touch: ThumbTouch, gap_mm: tuple[float, ...], sigma_mm: float, apart_deg: float, sigma_deg: float
) -> ThumbTouch:
    return touch._replace(
        gap_m=1e-3 * np.array(gap_mm),
        opening_rad=np.full(4, np.radians(apart_deg)),
        opening_sigma_rad=np.full(4, np.radians(sigma_deg)),
        key_sigma_m=np.full((4, 3), 1e-3 * sigma_mm),
    )


@pytest.mark.parametrize(
    ("name", "gap_mm"),
    [
        ("index", (3.0, 18.0, 30.0, 40.0)),
        ("middle", (18.0, 3.0, 18.0, 30.0)),
        ("little", (40.0, 30.0, 18.0, 3.0)),
    ],
)
def test_it_is_of_the_finger_that_the_thumb_meets(
    name: str, gap_mm: tuple[float, float, float, float]
) -> None:
    assert recognised_in(gap_mm) == [name]


def test_a_gap_that_is_not_known_is_no_pinch() -> None:
    assert recognised_in((3.0, 80.0, 80.0, 80.0), 4.0) == ["index"]
    assert not recognised_in((3.0, 80.0, 80.0, 80.0), 8.0)


def test_where_the_others_are_away_no_bend_is_asked_for() -> None:
    assert recognised_in((3.0, 60.0, 70.0, 80.0), apart_deg=150.0, sigma_deg=60.0) == ["index"]


def test_a_closing_fist_whose_bends_are_uncertain_is_withheld() -> None:
    # The thumb comes over the index finger, the others follow at a finger's breadth each.
    fist = (6.0, 13.0, 32.0, 52.0)
    assert recognised_in(fist, apart_deg=80.0, sigma_deg=5.0) == ["index"]
    assert not recognised_in(fist, apart_deg=80.0, sigma_deg=30.0)
    assert not recognised_in(fist, apart_deg=120.0, sigma_deg=1.0)


def test_fingers_in_a_bunch_are_nobodys_pinch() -> None:
    assert not recognised_in((3.0, 5.0, 30.0, 40.0))
