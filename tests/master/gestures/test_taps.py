"""The keys of a hand: each of the twelve is told by a thumb that comes down on it, and by little else."""

from collections.abc import Callable, Iterable

import msgspec
import numpy as np
import pytest

from common.arrays import Float
from common.calibration.gesture_settings import TapSettings, default_gestures
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import CHAINS
from common.messages import Gesture, HandPose
from common.sim.motion import angles_of
from master.gestures.actions import ThumbTapMonitor
from master.gestures.features import FeatureExtractor, thumb_touch
from tests.hand_helpers import RIGHT, palm
from tests.master.gestures.shown_hands import FRAME_NS, shown

# As on a telephone whose top row is the index finger and whose left column the tips (docs/gestures.md).
TELEPHONE = (("1", "2", "3"), ("4", "5", "6"), ("7", "8", "9"), ("star", "0", "hash"))
PAD = angles_of(RIGHT, np.array([[18.0, 8.0, 14.0], *[[0.0, 60.0, 30.0]] * 4]), np.zeros((5, 4)))
UP_M, DOWN_M = 0.020, -0.0005
TAPS = default_gestures().tap


def over(
    k: int, places: Iterable[tuple[int, int]], gap_m: float, sigma_m: float = 1e-3, *, dorsal: bool = False
) -> HandPose:
    """A thumb of its own, straight down on the middle of segments (finger 1 ... 4, 0 ... 2 from the knuckle).

    The thumb of the model reaches few keys; this one comes from outside the hand.
    """
    hand = shown(PAD, k * FRAME_NS, sigma_m=np.full(5, sigma_m))
    joints = RIGHT.forward(palm(), PAD)
    ends = np.array([[CHAINS[f, s], CHAINS[f, s + 1]] for f, s in places])
    middle = joints.position_m[ends].mean(axis=(0, 1))
    out = -joints.rotation[ends[0, 0], :, 1] * (-1.0 if dorsal else 1.0)
    surface_m = RIGHT.radius_m[ends].mean() + RIGHT.radius_m[CHAINS[0, 3]]
    position, wxyz = hand.position_m.copy(), hand.orientation_wxyz.copy()
    position[CHAINS[0]] = middle + out * (surface_m + gap_m + np.array([0.10, 0.065, 0.03, 0.0])[:, None])
    across = joints.rotation[ends[0, 0], :, 0]
    wxyz[CHAINS[0]] = matrix_to_quaternion(np.column_stack([across, np.cross(out, across), out]))
    return msgspec.structs.replace(hand, position_m=position, orientation_wxyz=wxyz)


def gap_at(k: int, down: int = 5, pace: int = 8) -> float:
    """The gap [m] of a thumb that comes at frame 20, stays down, and goes."""
    knots = np.cumsum([20, pace, down, pace])
    return float(np.interp(k, knots, [UP_M, DOWN_M, DOWN_M, UP_M]))


def recognised_in(
    pose: Callable[[int], HandPose], frames: int = 80, settings: TapSettings = TAPS
) -> list[Gesture]:
    watch, out = ThumbTapMonitor(settings), list[Gesture]()
    for k in range(frames):
        seen = FeatureExtractor(RIGHT).of(pose(k))
        assert seen is not None
        out += watch.push(seen, thumb_touch(seen, RIGHT.radius_m), may_begin=True)
    return out


@pytest.mark.parametrize("finger", range(1, 5))
@pytest.mark.parametrize("column", range(3))
def test_each_of_twelve_keys_is_reported_by_its_name_as_the_thumb_leaves(finger: int, column: int) -> None:
    place = [(finger, 2 - column)]
    gestures = recognised_in(lambda k: over(k, place, gap_at(k)))
    assert [(one.kind, one.name, one.phase) for one in gestures] == [
        ("tap", TELEPHONE[finger - 1][column], "end")
    ]
    left = next(k for k in range(33, 80) if gap_at(k) > default_gestures().tap.touch_gap_m)
    assert 0 <= gestures[0].t_ns // FRAME_NS - left <= 1
    assert gestures[0].confidence > 0.9
    assert gestures[0].distance_m == pytest.approx(DOWN_M, abs=1e-3)
    segment = RIGHT.forward(palm(), PAD).position_m[CHAINS[finger, 2 - column : 4 - column]].mean(axis=0)
    assert float(np.linalg.norm(gestures[0].origin_m - segment)) < 0.02


def test_taps_one_after_another_are_all_reported() -> None:
    def pose(k: int) -> HandPose:
        which = [(1, 2), (2, 1), (4, 0)][min(k // 50, 2)]
        return over(k, [which], gap_at(k % 50))

    assert [one.name for one in recognised_in(pose, 150)] == ["1", "5", "hash"]


NO_TAPS: tuple[tuple[str, Callable[[int], HandPose]], ...] = (
    ("its gap is not known", lambda k: over(k, [(2, 1)], gap_at(k), 8e-3)),
    ("it is on the back of the finger", lambda k: over(k, [(2, 1)], gap_at(k), dorsal=True)),
    ("it rests there", lambda k: over(k, [(2, 1)], gap_at(k, down=45))),
    ("it comes too slowly", lambda k: over(k, [(2, 1)], gap_at(k, pace=90))),
    ("it passes without touching", lambda k: over(k, [(2, 1)], gap_at(k) + 0.004)),
    ("it goes in deeper than flesh gives way", lambda k: over(k, [(2, 1)], gap_at(k) - 0.009)),
)


@pytest.mark.parametrize(("why", "pose"), NO_TAPS)
def test_a_thumb_taps_nothing_where(why: str, pose: Callable[[int], HandPose]) -> None:
    assert not recognised_in(pose, 240), why


def test_two_fingers_too_alike_in_their_gaps_determine_nothing() -> None:
    # Fingers lie side by side, some 20 mm apart: no touch is nearer to one of them by three times that.
    assert recognised_in(lambda k: over(k, [(2, 1)], gap_at(k)))
    unsure = msgspec.structs.replace(default_gestures().tap, nearer_m=0.06)
    assert not recognised_in(lambda k: over(k, [(2, 1)], gap_at(k)), settings=unsure)


def test_a_finger_whose_bones_may_be_anywhere_has_no_keys() -> None:
    def pose(k: int) -> HandPose:
        seen = over(k, [(2, 2)], gap_at(k))
        cov: Float = seen.cov_m2.copy()
        cov[CHAINS[2, :2]] = np.square(0.015) * np.eye(3)
        return msgspec.structs.replace(seen, cov_m2=cov)

    assert not recognised_in(pose)


def test_a_thumb_that_is_known_worst_while_it_is_down_is_judged_as_it_leaves() -> None:
    # A cap that fingers hide in part seems farther to the side: here on the next finger, while it is down.
    def pose(k: int) -> HandPose:
        gap, down = gap_at(k), gap_at(k) < 0.002
        seen = over(k, [(3, 1)] if down else [(2, 1)], gap)
        cov: Float = seen.cov_m2.copy()
        cov[CHAINS[0, 2:]] = np.square(5e-3 if down else 5e-4) * np.eye(3)
        return msgspec.structs.replace(seen, cov_m2=cov)

    assert [one.name for one in recognised_in(pose)] == ["5"]
