"""Tests of one hand over time: a lost finger is held and its doubt grows, and nothing jumps when it returns."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from common.hand_model import CHAINS, METACARPALS, PALM, TIPS
from common.messages import Source
from master.ik.palm import Orientation
from master.ik.tracker import HandTracker, TrackedHand, pose_of
from tests.hand_helpers import FACING, MARKERS, RIGHT, natural_angles, palm, small_cov, within

STEP_NS = 16_666_667
INDEX, MARKER_INDEX = 1, 1


def bent(t_s: float, speed_deg_s: float = 120.0) -> Float:
    """A fist that closes: PIP from 20 deg on."""
    pip = np.radians(20.0 + speed_deg_s * t_s)
    angles = np.zeros((5, 4))
    angles[0] = np.radians([8.0, 8.0, 12.0, 12.0])
    angles[1:] = [0.0, 0.54 * pip, pip, pip * 2 / 3]
    return angles


def points_of(angles: Float, gone: tuple[int, ...] = ()) -> Float:
    points = RIGHT.marker_points(RIGHT.forward(palm(), angles), MARKERS)
    points[list(gone)] = np.nan
    return points


def run(
    tracker: HandTracker, frames: range, gone: tuple[int, ...] = (), speed_deg_s: float = 120.0
) -> list[TrackedHand]:
    return [
        tracker.push(k * STEP_NS, points_of(bent(k / 60.0, speed_deg_s), gone), small_cov(), FACING)
        for k in frames
    ]


def pip_deg(hand: TrackedHand, finger: int = INDEX) -> float:
    assert hand.solution is not None
    return float(np.degrees(hand.solution.angles_rad[finger, 2]))


def sigma_m(hand: TrackedHand, joint: int) -> float:
    assert hand.solution is not None
    return float(np.sqrt(np.trace(hand.solution.cov_m2[joint])))


def test_a_seen_hand_is_tracked_and_its_tips_are_measured() -> None:
    hand = run(HandTracker(RIGHT, MARKERS), range(3))[-1]
    assert hand.valid.all()
    assert hand.tracked.all()
    assert (hand.source[TIPS] == Source.MEASURED).all()
    assert (np.delete(hand.source, TIPS) == Source.SOLVED).all()


def test_a_lost_marker_holds_its_finger_and_never_opens_it() -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    before = run(tracker, range(15))[-1]
    lost = run(tracker, range(15, 40), gone=(MARKER_INDEX,), speed_deg_s=0.0)
    for hand in lost:
        assert hand.valid.all()
        assert not hand.tracked[CHAINS[INDEX]].any()
        assert (hand.source[CHAINS[INDEX]] == Source.HELD).all()
        others = np.delete(CHAINS, INDEX, axis=0).ravel()
        assert hand.tracked[others].all()
        assert hand.solution is not None
        assert within(RIGHT, hand.solution.angles_rad)
    assert pip_deg(lost[-1]) > 30.0
    assert pip_deg(before) > 40.0


@pytest.mark.parametrize("speed", [90.0, 200.0, 600.0])
def test_a_finger_that_is_lost_alone_goes_on_with_the_others(speed: float) -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    frames = 8
    run(tracker, range(frames), speed_deg_s=speed)
    lost = run(tracker, range(frames, frames + 18), gone=(MARKER_INDEX,), speed_deg_s=speed)
    truth = [min(20.0 + speed * k / 60.0, 110.0) for k in range(frames, frames + 18)]
    course = [pip_deg(hand) for hand in lost]
    assert max(course) <= 110.0 + 1e-9
    moved = truth[-1] - truth[0]
    # It is the first finger, and follows the second by 0.7 of its way; what it did itself before adds to that.
    assert abs(course[-1] - truth[-1]) < 0.45 * moved + 3.0


@pytest.mark.parametrize("speed", [90.0, 200.0, 600.0])
def test_a_hand_that_is_lost_goes_on_a_little_and_stays_inside_its_limits(speed: float) -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    frames = 8
    before = run(tracker, range(frames), speed_deg_s=speed)[-1]
    lost = run(tracker, range(frames, frames + 20), gone=tuple(range(6)), speed_deg_s=speed)
    course = np.array([pip_deg(before)] + [pip_deg(hand) for hand in lost])
    assert course[4] > course[0] + 1.0
    assert course.max() <= 110.0 + 1e-9
    # The motion fades with 0.12 s: it ends at most about that much of the speed farther on.
    assert course[-1] - course[0] < 0.12 * speed + 12.0


def test_doubt_grows_while_a_finger_is_lost() -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    seen = run(tracker, range(15))[-1]
    lost = run(tracker, range(15, 45), gone=(MARKER_INDEX,), speed_deg_s=60.0)
    course = [sigma_m(hand, TIPS[INDEX]) for hand in (seen, lost[0], lost[8], lost[25])]
    assert course[0] < course[1] < course[2] < course[3]
    assert sigma_m(lost[25], TIPS[2]) < 1.5 * sigma_m(seen, TIPS[2])


@pytest.mark.parametrize("gap", [3, 10, 25])
def test_a_returning_marker_is_believed_at_once(gap: int) -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    run(tracker, range(10), speed_deg_s=60.0)
    held = run(tracker, range(10, 10 + gap), gone=(MARKER_INDEX,), speed_deg_s=60.0)[-1]
    back = run(tracker, range(10 + gap, 12 + gap), speed_deg_s=60.0)
    for k, hand in enumerate(back, 10 + gap):
        truth = RIGHT.forward(palm(), bent(k / 60.0, 60.0)).position_m
        assert hand.solution is not None
        assert hand.tracked.all()
        error = np.linalg.norm(hand.solution.joints.position_m - truth, axis=1)
        assert error[CHAINS[INDEX]].max() < 4e-3
    assert held.solution is not None
    assert back[0].solution is not None
    # The jump of the tip is no longer than the way from where it was held to where it is.
    truth = RIGHT.forward(palm(), bent((10 + gap) / 60.0, 60.0)).position_m[TIPS[INDEX]]
    jump = np.linalg.norm(back[0].solution.joints.position_m - held.solution.joints.position_m, axis=1)[
        TIPS[INDEX]
    ]
    assert jump <= np.linalg.norm(held.solution.joints.position_m[TIPS[INDEX]] - truth) + 2e-3


def test_a_hand_that_nobody_sees_is_held_half_a_second_and_then_not_valid() -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    run(tracker, range(10), speed_deg_s=0.0)
    hidden = run(tracker, range(10, 60), gone=(0, 1, 2, 3, 4, 5), speed_deg_s=0.0)
    gone_s = np.arange(1, 51) * STEP_NS * 1e-9
    assert [bool(hand.valid.all()) for hand in hidden] == list(gone_s <= 0.5)
    assert not any(hand.tracked.any() for hand in hidden)
    assert all(pip_deg(hand) > 15.0 for hand in hidden)
    again = run(tracker, range(60, 62), speed_deg_s=0.0)[-1]
    assert again.tracked.all()


@pytest.mark.parametrize(
    ("seen", "palm"), [((5,), False), ((1,), False), ((1, 2), False), ((1, 5), True), ((0, 2, 4), True)]
)
def test_a_palm_is_tracked_only_where_markers_tell_its_turn_as_well(
    seen: tuple[int, ...], palm: bool
) -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    run(tracker, range(6), speed_deg_s=0.0)
    gone = tuple(m for m in range(6) if m not in seen)
    hand = run(tracker, range(6, 10), gone, speed_deg_s=0.0)[-1]
    assert hand.valid.all()
    palm_joints = [0, 1, *METACARPALS]
    assert hand.tracked[palm_joints].all() == hand.tracked[palm_joints].any() == palm
    assert (hand.source[palm_joints] == (Source.SOLVED if palm else Source.HELD)).all()
    for f in set(seen) - {5}:
        # With a palm that is not told, a marker tells its own place and nothing else of the finger.
        assert hand.tracked[TIPS[f]]
        assert hand.tracked[CHAINS[f]].all() == palm


def test_unrelated_frames_remember_nothing() -> None:
    tracker = HandTracker(RIGHT, MARKERS, continuous=False)
    rng = np.random.default_rng(0)
    first, second = points_of(natural_angles(rng)), points_of(natural_angles(rng), (2,))
    tracker.push(0, first, small_cov(), FACING)
    after = tracker.push(STEP_NS, second, small_cov(), FACING)
    alone = HandTracker(RIGHT, MARKERS, continuous=False).push(STEP_NS, second, small_cov(), FACING)
    assert after.solution is not None
    assert alone.solution is not None
    np.testing.assert_array_equal(after.solution.angles_rad, alone.solution.angles_rad)
    assert (after.source[CHAINS[2]] == Source.SOLVED).all()
    assert not after.tracked[CHAINS[2]].any()


@pytest.mark.parametrize("step_ns", [0, -1, -10 * 10**9, -(10**15), 10**15])
def test_time_that_stands_still_or_leaps_starts_afresh(step_ns: int) -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    run(tracker, range(6), gone=())
    run(tracker, range(6, 9), gone=(MARKER_INDEX,))
    t_ns = 8 * STEP_NS + step_ns
    points = points_of(bent(0.1), (MARKER_INDEX,))
    fresh = HandTracker(RIGHT, MARKERS).push(t_ns, points, small_cov(), FACING)
    hand = tracker.push(t_ns, points, small_cov(), FACING)
    assert hand.solution is not None
    assert fresh.solution is not None
    np.testing.assert_array_equal(hand.solution.angles_rad, fresh.solution.angles_rad)
    after = tracker.push(t_ns + STEP_NS, points, small_cov(), FACING)
    assert after.solution is not None
    assert within(RIGHT, after.solution.angles_rad)


def test_nothing_seen_yet_is_no_hand() -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    hand = tracker.push(0, np.full((6, 3), np.nan), np.full((6, 3, 3), np.nan), FACING)
    assert hand.solution is None
    assert not hand.valid.any()
    unseen = np.full((6, 3), np.nan)
    pose = pose_of(hand, RIGHT, 5, unseen, unseen, np.full((6, 3, 3), np.nan))
    assert pose.t_ns == 5
    assert np.isnan(pose.position_m).all()
    assert np.isnan(pose.angles_rad).all()
    assert (pose.source == Source.NONE).all()


def test_a_marker_without_covariance_does_not_count_as_seen() -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    run(tracker, range(5))
    cov = small_cov()
    cov[MARKER_INDEX] = np.nan
    hand = tracker.push(5 * STEP_NS, points_of(bent(5 / 60)), cov, FACING)
    assert not hand.tracked[CHAINS[INDEX]].any()
    assert (hand.source[CHAINS[INDEX]] == Source.HELD).all()


def test_the_message_holds_the_solution() -> None:
    tracker = HandTracker(RIGHT, MARKERS)
    hand = run(tracker, range(2))[-1]
    points = points_of(bent(1 / 60))
    pose = pose_of(hand, RIGHT, STEP_NS, points, points + 1e-3, small_cov())
    assert hand.solution is not None
    np.testing.assert_array_equal(pose.position_m, hand.solution.joints.position_m)
    np.testing.assert_allclose(np.linalg.norm(pose.orientation_wxyz, axis=1), 1.0)
    np.testing.assert_array_equal(pose.markers_raw_m, points + 1e-3)
    np.testing.assert_array_equal(pose.markers_cov_m2, small_cov())
    assert pose.hand == "made-right"
    assert pose.valid[pose.tracked].all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=8)
def test_a_hand_of_random_markers_never_leaves_its_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracker, t_ns = HandTracker(RIGHT, MARKERS), 0
    for _ in range(8):
        t_ns += int(rng.choice([STEP_NS, STEP_NS, STEP_NS, 0, -STEP_NS, 10 * STEP_NS, 10**10]))
        points = points_of(natural_angles(rng)) + rng.normal(0.0, 1.0, (6, 3)) * rng.choice(
            [1e-4, 0.02, 1.0, 1e6]
        )
        points[rng.random(6) < 0.3] = np.nan
        hand = tracker.push(t_ns, points, small_cov(), FACING)
        if hand.solution is not None:
            assert within(RIGHT, hand.solution.angles_rad)
            assert np.isfinite(hand.solution.joints.position_m).all()


def test_a_hand_that_comes_back_elsewhere_is_as_good_as_one_that_is_new() -> None:
    """What was known of it before it was lost is as old as that, not as old as the last frame."""
    off: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        moved = palm(rng.uniform(-30.0, 30.0, 3)), natural_angles(rng)
        noise = rng.normal(0.0, 1e-3, (6, 3))
        for known in (True, False):
            tracker, last = HandTracker(RIGHT, MARKERS), 50
            if known:
                run(tracker, range(20))
                run(tracker, range(20, last), tuple(range(6)))
            true = RIGHT.forward(*moved)
            points = RIGHT.marker_points(true, MARKERS) + noise
            hand = tracker.push(last * STEP_NS, points, small_cov(1e-3), FACING)
            assert hand.solution is not None
            error = np.linalg.norm(hand.solution.joints.position_m - true.position_m, axis=1)
            off[known].append(1e3 * float(error.mean()))
    assert np.mean(off[True]) < 1.3 * np.mean(off[False])


@pytest.mark.parametrize("shown", [(MARKER_INDEX,), (0, MARKER_INDEX)])
def test_a_leap_of_markers_that_are_no_hand_by_themselves_leaves_no_gap(shown: tuple[int, ...]) -> None:
    """Another solver's hand explains them better, but without the last one there is none."""
    tracker = HandTracker(RIGHT, MARKERS)
    last = run(tracker, range(5))[-1].solution
    assert last is not None
    leap = np.array([0.2, 0.0, 0.1])
    T = last.T_rig_palm.copy()
    T[:3, 3] += leap
    there = replace(last, T_rig_palm=T, joints=RIGHT.forward(T, last.angles_rad))
    points = points_of(bent(5 / 60.0), tuple(m for m in range(6) if m not in shown)) + leap
    hand = tracker.push(5 * STEP_NS, points, small_cov(), FACING, start=there)
    assert hand.solution is not None
    assert hand.valid.all()
    assert np.isfinite(hand.solution.joints.position_m).all()


@pytest.mark.parametrize(("heading_rad", "told"), [(0.03, True), (10.0, False)])
def test_an_orientation_without_heading_does_not_tell_the_palm_by_one_finger(
    heading_rad: float, told: bool
) -> None:
    tracker, up = HandTracker(RIGHT, MARKERS), np.array([0.0, -1.0, 0.0])
    run(tracker, range(5))
    cov = 0.03**2 * np.eye(3) + (heading_rad**2 - 0.03**2) * np.outer(up, up)
    points = points_of(bent(5 / 60.0), tuple(m for m in range(6) if m != MARKER_INDEX))
    orientation = Orientation(palm()[:3, :3], cov)
    hand = tracker.push(5 * STEP_NS, points, small_cov(), FACING, orientation=orientation)
    assert hand.tracked[TIPS[INDEX]]
    assert hand.tracked[PALM] == told
