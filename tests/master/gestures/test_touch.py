"""Gaps between skins, and how sure they are: by hand calculation."""

import msgspec
import numpy as np

from common.arrays import Float
from common.hand.model import CHAINS
from master.gestures.features import FeatureExtractor, ThumbTouch, thumb_touch
from tests.hand_helpers import RIGHT
from tests.master.gestures.shown_hands import PINCH, posture, shown


def touch(cov_thumb_m2: Float, cov_index_m2: Float) -> ThumbTouch:
    pose = shown(posture(PINCH))
    cov = pose.cov_m2.copy()
    cov[CHAINS[0]], cov[CHAINS[1]] = cov_thumb_m2, cov_index_m2
    seen = FeatureExtractor(RIGHT).of(msgspec.structs.replace(pose, cov_m2=cov))
    assert seen is not None
    return thumb_touch(seen, RIGHT.radius_m)


def test_the_sigma_of_a_gap_is_that_of_both_surfaces() -> None:
    found = touch(9e-6 * np.eye(3), 16e-6 * np.eye(3))
    np.testing.assert_allclose(found.sigma_m[0], 5e-3, rtol=1e-9)
    np.testing.assert_allclose(found.key_sigma_m[0], 5e-3, rtol=1e-9)


def test_what_is_not_known_across_the_way_does_not_matter() -> None:
    squares = [
        touch(1e-6 * np.eye(3) + 4e-4 * np.outer(axis, axis), 1e-6 * np.eye(3)).sigma_m[0] ** 2 - 2e-6
        for axis in np.eye(3)
    ]
    # Of three directions at right angles the way takes shares that add up to one.
    np.testing.assert_allclose(sum(squares), 4e-4, rtol=1e-9)


def test_the_sigma_of_how_pads_face_is_that_of_the_ends_over_the_length() -> None:
    found = touch(1e-6 * np.eye(3), 4e-6 * np.eye(3))
    seen = FeatureExtractor(RIGHT).of(shown(posture(PINCH)))
    assert seen is not None
    length = np.linalg.norm(np.diff(seen.joints_m[CHAINS[:2, 2:]], axis=1)[:, 0], axis=1)
    want = np.hypot(np.sqrt(2e-6) / length[0], np.sqrt(8e-6) / length[1])
    np.testing.assert_allclose(found.opening_sigma_rad[0], want, rtol=1e-9)
