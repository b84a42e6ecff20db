"""Tests of one hand over time: a lost finger is held and its covariance grows, and nothing jumps when it returns."""

from dataclasses import replace

import numpy as np
import pytest

from common.arrays import Float
from common.hand.model import CHAINS, METACARPALS, PALM, TIPS
from common.messages import Source
from common.records import boxed
from master.estimator.epoch import Fitted, MarkerPositions
from master.estimator.settings import DEFAULT
from tests.hand_helpers import MARKERS, RIGHT, natural_angles, palm, small_cov, within
from tests.master.estimator.fitted import (
    STEP_NS,
    bent,
    bent_points,
    estimator,
    orientation_of,
    places,
    push,
    region_m,
    run,
    seen,
    sure,
)

INDEX, MARKER_INDEX = 1, 1


def pip_deg(hand: Fitted, finger: int = INDEX) -> float:
    assert hand.solution is not None
    return float(np.degrees(hand.solution.angles_rad[finger, 2]))


def positions(points: Float, cov: Float) -> MarkerPositions:
    none = np.zeros(6, np.bool_)
    return MarkerPositions(points, cov, cov, none, none[None])


def sigma_m(hand: Fitted, joint: int) -> float:
    assert hand.solution is not None
    return float(np.sqrt(np.trace(hand.solution.cov_m2[joint])))


def test_a_seen_hand_is_tracked_and_its_tips_are_measured() -> None:
    hand = run(estimator(), range(3))[-1]
    assert hand.valid.all()
    np.testing.assert_array_equal(hand.tracked, sure(hand))
    assert hand.tracked[[PALM, *TIPS, *METACARPALS]].all()
    assert (hand.source[TIPS] == Source.MEASURED).all()
    assert (np.delete(hand.source, TIPS) == Source.SOLVED).all()


def test_a_lost_marker_holds_its_finger_and_never_opens_it() -> None:
    machine = estimator()
    before = run(machine, range(15))[-1]
    lost = run(machine, range(15, 40), gone=(MARKER_INDEX,), speed_deg_s=0.0)
    for k, hand in enumerate(lost, 1):
        assert hand.valid.all()
        assert k * STEP_NS * 1e-9 <= DEFAULT.tracked_age_s or not hand.tracked[CHAINS[INDEX]].any()
        assert (hand.source[CHAINS[INDEX]] == Source.HELD).all()
        others = np.delete(CHAINS, INDEX, axis=0).ravel()
        np.testing.assert_array_equal(hand.tracked[others], sure(hand)[others])
        assert hand.tracked[np.delete(TIPS, INDEX)].all()
        assert hand.solution is not None
        assert within(RIGHT, hand.solution.angles_rad)
    assert pip_deg(lost[-1]) > 30.0
    assert pip_deg(before) > 40.0


@pytest.mark.parametrize("speed", [90.0, 200.0, 600.0])
def test_a_finger_that_is_lost_alone_goes_on_with_the_others(speed: float) -> None:
    machine = estimator()
    frames = 8
    run(machine, range(frames), speed_deg_s=speed)
    lost = run(machine, range(frames, frames + 18), gone=(MARKER_INDEX,), speed_deg_s=speed)
    truth = [min(20.0 + speed * k / 60.0, 110.0) for k in range(frames, frames + 18)]
    history = [pip_deg(hand) for hand in lost]
    assert max(history) <= 110.0 + 1e-9
    moved = truth[-1] - truth[0]
    # It is the first finger, and follows the second by 0.7 of its way; what it did itself before adds to that.
    assert abs(history[-1] - truth[-1]) < 0.45 * moved + 3.0


@pytest.mark.parametrize("speed", [90.0, 200.0, 600.0])
def test_a_hand_that_is_lost_goes_on_a_little_and_stays_inside_its_limits(speed: float) -> None:
    machine = estimator()
    frames = 8
    before = run(machine, range(frames), speed_deg_s=speed)[-1]
    lost = run(machine, range(frames, frames + 20), gone=tuple(range(6)), speed_deg_s=speed)
    history = np.array([pip_deg(before)] + [pip_deg(hand) for hand in lost])
    assert history[4] > history[0] + 1.0
    assert history.max() <= 110.0 + 1e-9
    # The motion fades: it ends at most about 0.12 s of its speed farther on.
    assert history[-1] - history[0] < 0.12 * speed + 12.0


@pytest.mark.parametrize("gap", [3, 10, 25])
def test_a_returning_marker_is_accepted_at_once(gap: int) -> None:
    machine = estimator()
    run(machine, range(10), speed_deg_s=60.0)
    held = run(machine, range(10, 10 + gap), gone=(MARKER_INDEX,), speed_deg_s=60.0)[-1]
    back = run(machine, range(10 + gap, 12 + gap), speed_deg_s=60.0)
    for k, hand in enumerate(back, 10 + gap):
        truth = RIGHT.forward(palm(), bent(k / 60.0, 60.0)).position_m
        assert hand.solution is not None
        assert hand.tracked[TIPS].all()
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


@pytest.mark.parametrize("gap", [5, 10, 25])
def test_a_finger_that_shows_once_goes_on_as_fast_as_it_moved_since_it_was_seen_last(gap: int) -> None:
    """How far it is from where it was predicted is no motion of one frame."""
    machine = estimator()
    stop = 10 + gap
    run(machine, range(10), speed_deg_s=60.0)
    run(machine, range(10, stop), gone=(MARKER_INDEX,), speed_deg_s=60.0)
    run(machine, range(stop, stop + 1), speed_deg_s=60.0)
    lost = run(machine, range(stop + 1, stop + 11), gone=(0, MARKER_INDEX, 2, 3, 4), speed_deg_s=60.0)
    truth = [min(20.0 + k, 110.0) for k in range(stop + 1, stop + 11)]
    off = np.array([pip_deg(hand) for hand in lost]) - truth
    assert off.max() < 1.0  # it is not thrown ahead,
    assert off.min() > -8.0  # and no farther behind than a motion that fades leaves it


def test_a_hand_that_nobody_sees_is_held_half_a_second_and_then_not_valid() -> None:
    machine = estimator()
    run(machine, range(10), speed_deg_s=0.0)
    hidden = run(machine, range(10, 60), gone=(0, 1, 2, 3, 4, 5), speed_deg_s=0.0)
    gone_s = np.arange(1, 51) * STEP_NS * 1e-9
    assert [bool(hand.valid.all()) for hand in hidden] == list(gone_s <= 0.5)
    stale = gone_s > DEFAULT.tracked_age_s
    assert not any(hand.tracked.any() for hand, old in zip(hidden, stale, strict=True) if old)
    assert all(pip_deg(hand) > 15.0 for hand in hidden)
    again = run(machine, range(60, 62), speed_deg_s=0.0)[-1]
    assert again.tracked[[PALM, *TIPS]].all()


@pytest.mark.parametrize(
    ("seen", "palm"), [((5,), False), ((1,), False), ((1, 2), False), ((1, 5), True), ((0, 2, 4), True)]
)
def test_a_palm_is_tracked_only_where_markers_constrain_its_rotation_as_well(
    seen: tuple[int, ...], palm: bool
) -> None:
    machine = estimator()
    run(machine, range(6), speed_deg_s=0.0)
    gone = tuple(m for m in range(6) if m not in seen)
    hand = run(machine, range(6, 10), gone, speed_deg_s=0.0)[-1]
    assert hand.valid.all()
    palm_joints = [0, 1, *METACARPALS]
    np.testing.assert_array_equal(hand.tracked[palm_joints], sure(hand)[palm_joints] & palm)
    assert (hand.source[palm_joints] == (Source.SOLVED if palm else Source.HELD)).all()
    for f in set(seen) - {5}:
        assert region_m(hand)[TIPS[f]] < DEFAULT.tracked_m
        np.testing.assert_array_equal(hand.tracked[CHAINS[f]], sure(hand)[CHAINS[f]])


@pytest.mark.parametrize("continuous", [False, True])
def test_nothing_is_remembered_of_another_hand(continuous: bool) -> None:
    machine, t_ns = estimator(continuous=continuous), 2 * STEP_NS
    for k in range(2):
        push(machine, k * STEP_NS, bent_points(bent(0.1)))
    if continuous:
        t_ns = 0  # the clock was set back: nothing is known
    second = bent_points(natural_angles(np.random.default_rng(0)), (2,))
    hand, alone = push(machine, t_ns, second), push(estimator(continuous=continuous), t_ns, second)
    np.testing.assert_array_equal(hand.tracked, alone.tracked)
    assert hand.solution is not None
    assert alone.solution is not None
    np.testing.assert_array_equal(hand.solution.angles_rad, alone.solution.angles_rad)


def test_a_finger_never_seen_is_held_by_the_posture_prior_and_not_tracked() -> None:
    hand = push(estimator(continuous=False), 0, bent_points(bent(0.1), (2,)))
    assert hand.valid.all()
    assert (hand.source[CHAINS[2]] == Source.HELD).all()
    assert not hand.tracked[CHAINS[2]].any()


@pytest.mark.parametrize("step_ns", [0, -1, -10 * 10**9, -(10**15), 10**15])
def test_time_that_stands_still_or_leaps_starts_anew(step_ns: int) -> None:
    machine = estimator()
    run(machine, range(6), gone=())
    run(machine, range(6, 9), gone=(MARKER_INDEX,))
    t_ns = 8 * STEP_NS + step_ns
    points = bent_points(bent(0.1), (MARKER_INDEX,))
    fresh = push(estimator(), t_ns, points)
    hand = push(machine, t_ns, points)
    assert hand.solution is not None
    assert fresh.solution is not None
    np.testing.assert_array_equal(hand.solution.angles_rad, fresh.solution.angles_rad)
    after = push(machine, t_ns + STEP_NS, points)
    assert after.solution is not None
    assert within(RIGHT, after.solution.angles_rad)


def test_a_hand_that_comes_back_elsewhere_is_as_good_as_one_that_is_new() -> None:
    """What was known of it before it was lost is as old as that, not as old as the last frame."""
    off: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        moved = palm(rng.uniform(-30.0, 30.0, 3)), natural_angles(rng)
        noise = rng.normal(0.0, 1e-3, (6, 3))
        for known in (True, False):
            machine, last = estimator(), 50
            if known:
                run(machine, range(20))
                run(machine, range(20, last), tuple(range(6)))
            true = RIGHT.forward(*moved)
            points = RIGHT.marker_points(true, MARKERS) + noise
            hand = push(machine, last * STEP_NS, points, small_cov(1e-3))
            assert hand.solution is not None
            error = np.linalg.norm(hand.solution.joints.position_m - true.position_m, axis=1)
            off[known].append(1e3 * float(error.mean()))
    assert np.mean(off[True]) < 1.3 * np.mean(off[False])


@pytest.mark.parametrize("shown", [(MARKER_INDEX,), (0, MARKER_INDEX)])
def test_a_leap_of_markers_that_are_no_hand_by_themselves_leaves_no_gap(shown: tuple[int, ...]) -> None:
    """Another solver's hand explains them better, but without the last one there is none."""
    machine = estimator()
    last = run(machine, range(5))[-1].solution
    assert last is not None
    leap = np.array([0.2, 0.0, 0.1])
    T = last.T_rig_palm.copy()
    T[:3, 3] += leap
    there = replace(last, T_rig_palm=T, joints=RIGHT.forward(T, last.angles_rad))
    points = bent_points(bent(5 / 60.0), tuple(m for m in range(6) if m not in shown)) + leap
    hand = push(machine, 5 * STEP_NS, points, start=there)
    assert hand.solution is not None
    assert hand.valid.all()
    assert np.isfinite(hand.solution.joints.position_m).all()


@pytest.mark.parametrize(("heading_rad", "is_sure"), [(0.03, True), (10.0, False)])
def test_an_orientation_without_heading_does_not_determine_the_palm_by_one_finger(
    heading_rad: float, is_sure: bool
) -> None:
    machine, up = estimator(), np.array([0.0, -1.0, 0.0])
    run(machine, range(5))
    cov = 0.03**2 * np.eye(3) + (heading_rad**2 - 0.03**2) * np.outer(up, up)
    points = bent_points(bent(5 / 60.0), tuple(m for m in range(6) if m != MARKER_INDEX))
    output = orientation_of(palm()[:3, :3], cov, sure=is_sure)
    hand = [push(machine, k * STEP_NS, points, orientation=output) for k in range(5, 10)][-1]
    assert region_m(hand)[TIPS[INDEX]] < DEFAULT.tracked_m
    assert (hand.sources[5] > 0) == is_sure
    assert hand.source[PALM] == (Source.SOLVED if is_sure else Source.HELD)
    assert hand.tracked[PALM] == (is_sure and sure(hand)[PALM])


# -- tracked, as it is defined ----------------------------------------------------------------------------------


@pytest.mark.parametrize("tracked_m", [0.005, 0.012, DEFAULT.tracked_m])
def test_tracked_is_what_is_fresh_and_sure(tracked_m: float) -> None:
    """A joint is tracked while its region is smaller than `tracked_m` and its finger was measured just now."""
    settings = DEFAULT.changed("tracked_m", tracked_m).changed("tracked_pip_rad", 1.0)
    rng, machine = np.random.default_rng(4), estimator(settings=settings)
    measured_ns, kept = np.full(6, -(10**12)), 0
    for k in range(60):
        gone = rng.random(6) < 0.4
        hand = push(machine, k * STEP_NS, bent_points(bent(k / 60.0, 30.0), np.flatnonzero(gone).tolist()))
        if hand.solution is None:
            continue
        measured_ns[:5][~gone[:5]] = k * STEP_NS
        if (~gone).sum() >= 3 - (not gone[5]):
            measured_ns[5] = k * STEP_NS
        part = np.full(26, 5)
        for f, chain in enumerate(CHAINS):
            part[chain] = f
        fresh = (k * STEP_NS - measured_ns[part]) * 1e-9 <= DEFAULT.tracked_age_s
        np.testing.assert_array_equal(hand.tracked, fresh & sure(hand, tracked_m))
        kept += int(hand.tracked.sum())
    assert 40 < kept < 60 * 26


def test_a_finger_whose_bend_is_open_is_not_tracked() -> None:
    last = run(estimator(), range(20), speed_deg_s=0.0)[-1]
    strict = run(estimator(settings=DEFAULT.changed("tracked_pip_rad", 0.02)), range(20), speed_deg_s=0.0)[-1]
    assert last.tracked[CHAINS[1:]].all()
    assert not strict.tracked[CHAINS[1:]].any()
    np.testing.assert_array_equal(strict.tracked[CHAINS[0]], last.tracked[CHAINS[0]])
    assert strict.tracked[0]


@pytest.mark.parametrize("age_s", [0.0, 0.03, 0.2])
def test_a_finger_that_is_lost_is_tracked_no_longer_than_its_measurement_is_fresh(age_s: float) -> None:
    wide = DEFAULT.changed("tracked_age_s", age_s).changed("tracked_m", 0.1)
    machine = estimator(settings=wide)
    run(machine, range(10), speed_deg_s=0.0)
    lost = run(machine, range(10, 40), gone=(MARKER_INDEX,), speed_deg_s=0.0)
    for k, hand in enumerate(lost, 1):
        fresh = k * STEP_NS * 1e-9 <= age_s
        np.testing.assert_array_equal(hand.tracked[CHAINS[INDEX]], sure(hand, 0.1)[CHAINS[INDEX]] & fresh)


# -- the hand of a moment ago was wrong -------------------------------------------------------------------------


def test_a_hand_by_the_posture_prior_is_reinitialised_where_the_last_does_not_fit_a_leap() -> None:
    machine, angles = estimator(natural=True), natural_angles(np.random.default_rng(4))
    push(machine, 0, places(palm(), angles))
    there = palm(np.array([5.0, 5.0, 120.0]), np.array([0.1, 0.0, 0.65]))
    hand = push(machine, STEP_NS, places(there, angles))
    assert hand.solution is not None
    assert hand.solution.marker_chi2.max() < DEFAULT.marker_gate
    assert np.linalg.norm(hand.solution.T_rig_palm[:3, 3] - there[:3, 3]) < 0.02


# -- one memory -------------------------------------------------------------------------------------------------


def test_a_copied_state_goes_on_with_the_same_bytes() -> None:
    """`HandState` is all that the estimator remembers of points or pixels."""
    rng, machine = np.random.default_rng(6), estimator()
    frames = [
        seen(palm(rng.normal(0.0, 0.3, 3)), bent(k / 60.0)).epoch(
            k * STEP_NS, gone=np.flatnonzero(rng.random(6) < 0.25).tolist(), cameras=(0, 1) if k % 7 else (0,)
        )
        for k in range(60)
    ]
    for epoch in frames[:30]:
        machine.push(epoch)
    other = estimator()
    boxed(other.state)[:] = boxed(machine.state)
    for epoch in frames[30:]:
        one, same = machine.push(epoch), other.push(epoch)
        assert boxed(machine.state).tobytes() == boxed(other.state).tobytes()
        assert one.solution is not None
        assert same.solution is not None
        for name in ("T_rig_palm", "angles_rad", "cov_m2", "tilt_cov_rad2", "measurement_cov", "marker_chi2"):
            np.testing.assert_array_equal(getattr(one.solution, name), getattr(same.solution, name))
        np.testing.assert_array_equal(one.tracked, same.tracked)
        np.testing.assert_array_equal(one.sources, same.sources)
