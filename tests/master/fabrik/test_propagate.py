"""Tracks carried to an epoch: motion is followed, noise is not amplified, sigma covers the error.

Where a slave named two places, no line leads from one thing to another.
"""

from dataclasses import dataclass
from dataclasses import replace as changed

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from master.fabrik.settings import NEVER_NS, SYNC
from master.fabrik.sync import FrameSet, Reach, TrackHistory, propagate

MS = 1e6
PX_M = 1000.0
NOWHERE = np.array([np.nan, np.nan])
PAST = (5.0, -11.0, -27.0, -43.0)  # [ms] from the epoch: one frame after it
AHEAD = (-8.0, -24.0, -40.0, -56.0)  # predicted by half a period
HELD_PX_S = PX_M * np.sqrt(
    (2 * 1.0**2 + 0.01**2) / 3
)  # one frame says nothing of the speed: RMS of all vigours
REACH_NS = 25_000_000, 80_000_000, 80_000_000, 80_000_000


@dataclass(frozen=True)
class Frame:
    """What one camera saw at a time: places (M, 2) [px], those of alternatives, sigma [px]."""

    t_ms: float
    uv: Float
    alternatives: Float | None = None
    sigma_px: float = 0.1
    t_sigma_ms: float = 0.0


def history(views: list[list[Frame]], scale: Float, row_time_ns: float = 0.0) -> TrackHistory:
    """As `FrameSync` holds them, in any order."""
    shape, markers = (len(views), SYNC.history), max(len(one.uv) for view in views for one in view)
    times, marks, t_sigma = (
        np.full((*shape, 3), NEVER_NS),
        np.full((*shape, 6, markers), np.nan),
        np.zeros(shape),
    )
    for c, view in enumerate(views):
        for k, one in enumerate(sorted(view, key=lambda one: one.t_ms)):
            times[c, k], t_sigma[c, k] = round(one.t_ms * MS), one.t_sigma_ms * MS
            marks[c, k, :2], marks[c, k, 4], marks[c, k, 5] = one.uv.T, one.sigma_px, 100.0
            if one.alternatives is not None:
                marks[c, k, 2:4] = one.alternatives.T
    count = np.array([len(view) for view in views], np.int64)
    return TrackHistory(count, times, t_sigma, marks, np.full(len(views), row_time_ns), scale)


def carried(held: TrackHistory, t_ns: int = 0, reach_ns: Reach = REACH_NS) -> FrameSet:
    shape = (len(held.total), held.marks.shape[3])
    uv, sigma, area = np.empty((2, *shape, 2)), np.empty((2, *shape)), np.empty(shape)
    missing = np.empty(shape[0], np.bool_)
    ready, alternatives = propagate(held, t_ns, reach_ns, uv, sigma, area, missing)
    return FrameSet(
        t_ns, uv[0], sigma[0], area, ready, missing, *((uv[1], sigma[1]) if alternatives else (None, None))
    )


def propagate_one(frames: list[Frame]) -> FrameSet:
    """To time 0, of one camera, whose axis is then taken off."""
    found = carried(history([frames], np.array([PX_M])))
    named = [None if x is None else x[0] for x in (found.alt_uv, found.alt_sigma_px)]
    return FrameSet(0, found.uv[0], found.sigma_px[0], found.area[0], found.ready_t_ns, found.missing, *named)


def marker(t_ms: float) -> Float:
    """A marker on its way at 600 px/s."""
    return np.array([300.0 + 0.6 * t_ms, 200.0])


def mug(t_ms: float) -> Float:
    """A thing at rest 60 px away: nearer than a leap of 16 ms."""
    return np.array([300.0, 260.0]) + 0.0 * t_ms


def observation(t_ms: float, first: Float, second: Float | None = None) -> Frame:
    """Two markers: one with the places given, one that is always clear and never moves."""
    alternatives = None if second is None else np.stack([second, NOWHERE])
    return Frame(t_ms, np.stack([first, [10.0, 20.0]]), alternatives)


def test_without_an_alternative_there_are_none() -> None:
    found = propagate_one(
        [observation(5, marker(5)), observation(-11, marker(-11)), observation(-27, marker(-27))]
    )
    assert found.alt_uv is None
    assert found.alt_sigma_px is None
    np.testing.assert_allclose(found.uv, np.array([marker(0), (10.0, 20.0)]), atol=0.02)


@pytest.mark.parametrize("swapped", [(), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_two_things_that_change_their_roles_keep_their_own_paths(swapped: tuple[int, ...]) -> None:
    warm_start: list[Frame] = []
    for i, t in enumerate((5.0, -11.0, -27.0)):
        first, second = (mug, marker) if i in swapped else (marker, mug)
        warm_start.append(observation(t, first(t), second(t)))
    found = propagate_one(warm_start)
    assert found.alt_uv is not None
    # Which of the two is called the marker is what the nearest frame names.
    first, second = (mug, marker) if 0 in swapped else (marker, mug)
    np.testing.assert_allclose(found.uv[0], first(0.0), atol=0.02)
    np.testing.assert_allclose(found.alt_uv[0], second(0.0), atol=0.02)
    assert np.isnan(found.alt_uv[1]).all()
    np.testing.assert_allclose(found.uv[1], [10.0, 20.0])


def test_an_alternative_seen_in_the_nearest_frame_alone_is_held_there_with_a_larger_sigma() -> None:
    warm_start = [
        observation(5, marker(5), mug(5)),
        observation(-11, marker(-11)),
        observation(-27, marker(-27)),
    ]
    found = propagate_one(warm_start)
    assert found.alt_uv is not None
    assert found.alt_sigma_px is not None
    np.testing.assert_allclose(found.uv[0], marker(0.0), atol=0.02)
    np.testing.assert_allclose(found.alt_uv[0], mug(5.0))
    assert found.alt_sigma_px[0] == pytest.approx(np.hypot(0.1, HELD_PX_S * 0.005), rel=2e-3)
    assert found.sigma_px[0] < 0.3


def test_an_alternative_of_the_oldest_frame_alone_changes_nothing() -> None:
    """The marker moves 9.6 px a frame, and no place of it is given to a track that has not begun."""
    warm_start = [
        observation(5, marker(5)),
        observation(-11, marker(-11)),
        observation(-27, mug(-27), marker(-27)),
    ]
    found = propagate_one(warm_start)
    clear = propagate_one([observation(t, marker(t)) for t in (5.0, -11.0, -27.0)])
    np.testing.assert_array_equal(found.uv, clear.uv)
    np.testing.assert_array_equal(found.sigma_px, clear.sigma_px)


def test_an_alternative_of_an_older_frame_is_no_alternative_now_but_does_not_lead_the_marker_astray() -> None:
    warm_start = [
        observation(5, marker(5)),
        observation(-11, mug(-11), marker(-11)),
        observation(-27, mug(-27)),
    ]
    found = propagate_one(warm_start)
    assert found.alt_uv is not None
    assert np.isnan(found.alt_uv[0]).all()
    # A line through two observations; the third is the mug.
    np.testing.assert_allclose(found.uv[0], marker(0.0), atol=0.05)


def test_what_is_a_leap_away_is_another_thing() -> None:
    far = np.array([500.0, 200.0])
    warm_start = [observation(5, marker(5), mug(5)), observation(-11, far), observation(-27, far)]
    found = propagate_one(warm_start)
    np.testing.assert_allclose(found.uv[0], marker(5.0))  # held: the others are not its past
    assert found.sigma_px[0] == pytest.approx(np.hypot(0.1, HELD_PX_S * 0.005), rel=2e-3)


# -- one marker, no alternative ----------------------------------------------------------------------------------


def seen(times_ms: tuple[float, ...], places: Float, sigma_px: float = 0.1) -> list[Frame]:
    """Frames of many markers at once: places (N, M, 2) [px]."""
    return [Frame(t, uv, sigma_px=sigma_px) for t, uv in zip(times_ms, places, strict=True)]


@pytest.mark.parametrize("times", [PAST, AHEAD])
def test_without_noise_a_cubic_is_met(times: tuple[float, ...]) -> None:
    """1 m/s, 10 m/s^2, 200 m/s^3: a brisk hand."""
    t = np.array(times)[:, None, None] * 1e-3
    places = 300.0 + PX_M * (t * [1.0, -0.5] + t**2 * [-5.0, 3.0] + t**3 * [33.0, 20.0])
    found = propagate_one(seen(times, places, sigma_px=1e-3))
    np.testing.assert_allclose(found.uv, [[300.0, 300.0]], atol=0.1)
    straight = propagate_one(seen(times[:2], places[:2], sigma_px=1e-3))
    assert np.abs(straight.uv - 300.0).max() > 0.15  # two observations do not know the turn


@pytest.mark.parametrize(("times", "most_px"), [(PAST, 0.08), (AHEAD, 0.11)])
def test_a_marker_at_rest_is_no_less_steady_than_its_observations(
    times: tuple[float, ...], most_px: float
) -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, 0.1, (SYNC.observations, 4000, 2))
    found = propagate_one(seen(times, 300.0 + noise))
    assert (found.uv - 300.0).std() < most_px


@pytest.mark.parametrize("times", [PAST, AHEAD])
@pytest.mark.parametrize("peak_m_s2", [0.0, 1.0, 4.0, 12.0])
def test_sigma_covers_the_error_of_a_swinging_hand(times: tuple[float, ...], peak_m_s2: float) -> None:
    """Swings at 2.5 Hz from any moment on: about 95 % of the errors per axis, and no constant that covers all."""
    rng = np.random.default_rng(3)
    turn = 2.0 * np.pi * 2.5
    phase = rng.uniform(0.0, 2.0 * np.pi, (2000, 2))

    def place(t_s: Float | float) -> Float:
        return 300.0 + PX_M * peak_m_s2 / turn**2 * np.sin(turn * t_s + phase)

    t = np.array(times)[:, None, None] * 1e-3
    found = propagate_one(seen(times, place(t) + rng.normal(0.0, 0.1, (SYNC.observations, 2000, 2))))
    error = np.abs(found.uv - place(0.0)) / found.sigma_px[:, None]
    assert 0.9 < (error < 1.96).mean() < 0.995
    assert np.median(found.sigma_px) < (0.25 if times is PAST else 1.6)  # and says something


@given(st.integers(0, 10_000), st.floats(-500.0, 500.0), st.floats(1.0, 25.0))
@settings(max_examples=30)
def test_a_shifted_picture_or_a_clock_that_began_elsewhere_changes_nothing(
    seed: int, shift: float, late_ms: float
) -> None:
    rng = np.random.default_rng(seed)
    places = 300.0 + rng.normal(0.0, 3.0, (SYNC.observations, 5, 2))
    plain = propagate_one(seen(PAST, places))
    shifted = propagate_one(seen(PAST, places + shift))
    np.testing.assert_allclose(shifted.uv, plain.uv + shift, atol=1e-8)
    np.testing.assert_allclose(shifted.sigma_px, plain.sigma_px)
    later_ms = tuple(t + late_ms for t in PAST)
    later = carried(history([seen(later_ms, places)], np.array([PX_M])), round(late_ms * MS))
    np.testing.assert_allclose(later.uv[0], plain.uv, atol=1e-6)


def test_a_time_error_adds_with_the_speed() -> None:
    t = np.array(PAST)[:, None, None] * 1e-3
    places = np.concatenate([300.0 + t * [900.0, 0.0], 300.0 + 0.0 * t * [1.0, 1.0]], axis=1)
    exact = propagate_one(seen(PAST, places))
    unsure = propagate_one([changed(s, t_sigma_ms=0.5) for s in seen(PAST, places)])
    np.testing.assert_array_equal(unsure.uv, exact.uv)
    added = np.sqrt(unsure.sigma_px**2 - exact.sigma_px**2)
    assert added[0] == pytest.approx(np.sqrt(0.75) * 0.45, rel=0.03)
    assert added[1] < 0.01


def test_a_jump_farther_than_a_hand_goes_is_another_thing_also_without_an_alternative() -> None:
    places = np.full((SYNC.observations, 1, 2), 300.0)
    jumped = places.copy()
    jumped[1:] += 200.0
    held = propagate_one(seen(PAST[:1], places[:1]))
    found = propagate_one(seen(PAST, jumped))
    np.testing.assert_allclose(found.uv, held.uv)
    np.testing.assert_allclose(found.sigma_px, held.sigma_px)


def test_an_observation_that_missed_the_marker_leaves_a_gap_and_no_more() -> None:
    t = np.array(PAST)[:, None, None] * 1e-3
    places = 300.0 + t * [600.0, -200.0]
    gap = places.copy()
    gap[1] = np.nan
    found, whole = propagate_one(seen(PAST, gap)), propagate_one(seen(PAST, places))
    np.testing.assert_allclose(found.uv, [[300.0, 300.0]], atol=0.3)
    assert found.sigma_px[0] > whole.sigma_px[0]
    gap[0] = np.nan
    assert np.isnan(
        propagate_one(seen(PAST, gap)).uv
    ).all()  # what the nearest frame does not hold is not seen
    assert np.isnan(propagate_one(seen(PAST, gap)).sigma_px).all()


def test_cameras_are_carried_each_by_itself() -> None:
    rng = np.random.default_rng(4)
    places = 300.0 + rng.normal(0.0, 2.0, (2, SYNC.observations, 3, 2))
    views = [seen(PAST, places[0]), seen(AHEAD[:2], places[1][:2]), []]
    scale = np.array([1000.0, 700.0, 900.0])
    paired = carried(history(views, scale))
    for c in range(2):
        alone = carried(history([views[c]], scale[c : c + 1]))
        np.testing.assert_allclose(paired.uv[c], alone.uv[0])
        np.testing.assert_allclose(paired.sigma_px[c], alone.sigma_px[0])
    assert np.isnan(paired.uv[2]).all()
    assert np.isnan(paired.sigma_px[2]).all()
    assert paired.missing.tolist() == [False, False, True]


def by_formula(t_s: Float, y: Float, sigma: Float) -> tuple[Float, float]:
    """Mean (2,) and variance of the noise-free place at time 0, by the head of `propagate`, with dense matrices."""
    fresh = np.minimum(0.7 * sigma**2, 0.01)
    tt = np.outer(t_s, t_s)
    one, found = np.ones(len(t_s)), list[tuple[float, Float, float, Float]]()
    for V, A in PX_M * np.array([[0.01, 0.3], [1.0, 1.5], [1.0, 15.0]]):
        rotating = tt**2 / 4.0 + 18.0**2 * tt**3 / 36.0 + 18.0**4 * tt**4 / 576.0
        S = V**2 * tt + A**2 * rotating + np.diag(fresh)
        weights = np.linalg.solve(S, one)
        c = weights.sum()
        x = weights @ y / c
        residual2 = float(np.trace((y - x).T @ np.linalg.solve(S, y - x)))
        found.append(
            (-0.5 * (np.linalg.slogdet(S)[1] + np.log(c) + 0.5 * residual2), x, 1.0 / c, weights / c)
        )
    share = np.exp(np.array([one[0] for one in found]) - max(one[0] for one in found))
    share /= share.sum()
    mean = share @ np.array([one[1] for one in found])
    spread = sum(
        s * (one[2] + 0.5 * ((one[1] - mean) ** 2).sum()) for s, one in zip(share, found, strict=True)
    )
    gain = float(((share @ np.array([one[3] for one in found])) ** 2).sum())
    return mean, spread + (sigma[0] ** 2 - fresh[0]) * max(gain, 1.0)


@given(st.integers(0, 10_000), st.integers(1, SYNC.observations), st.sampled_from([PAST, AHEAD]))
@settings(max_examples=60)
def test_place_and_variance_are_those_of_the_formula(seed: int, count: int, times: tuple[float, ...]) -> None:
    rng = np.random.default_rng(seed)
    y = 300.0 + rng.normal(0.0, rng.choice([0.2, 5.0]), (count, 2))
    sigma = rng.uniform(0.03, 1.0, count)
    frames = [Frame(t, uv[None], sigma_px=s) for t, uv, s in zip(times, y, sigma.tolist(), strict=False)]
    mean, variance = by_formula(1e-3 * np.array(times[:count]), y, sigma)
    found = propagate_one(frames)
    np.testing.assert_allclose(found.uv[0], mean, atol=1e-8)
    np.testing.assert_allclose(found.sigma_px[0] ** 2, variance, rtol=1e-8)


@pytest.mark.parametrize("period_s", [0.1, 1.0, 10.0])
def test_frames_seldom_taken_give_a_finite_place_with_a_wide_sigma(period_s: float) -> None:
    """S is then singular to rounding: the motion's variance exceeds the noise's by 10^15 and more."""
    times = tuple(1e3 * period_s * t for t in (-0.3, -1.3, -2.3, -3.3))
    held = history([seen(times, np.random.default_rng(1).uniform(100.0, 400.0, (4, 3, 2)))], np.array([PX_M]))
    found = carried(held, 0, (2**60, 2**60, 2**60, 2**60))
    assert ((found.uv > 0.0) & (found.uv < 1000.0)).all()
    assert (found.sigma_px > 1.0).all()


def examples() -> list[list[float]]:
    """Places and sigmas of three cameras, with alternatives, gaps and rows at their own times; see `test_plain`."""
    rng, found = np.random.default_rng(5), list[list[float]]()
    for _ in range(40):
        views = list[list[Frame]]()
        for _ in range(3):
            times = np.cumsum(rng.uniform(8.0, 24.0, rng.integers(1, SYNC.history))) - 70.0
            way = rng.uniform(100.0, 300.0, (1, 4, 2)) + times[:, None, None] * rng.normal(0.0, 0.6, (4, 2))
            places = way + rng.normal(0.0, 0.2, way.shape)
            alternatives = places + rng.uniform(-50.0, 50.0, places.shape)
            swap = rng.uniform(size=(*places.shape[:2], 1)) < 0.2
            places, alternatives = np.where(swap, alternatives, places), np.where(swap, places, alternatives)
            places[rng.uniform(size=places.shape[:2]) < 0.1] = np.nan
            alternatives[(rng.uniform(size=places.shape[:2]) < 0.4) | np.isnan(places[..., 0])] = np.nan
            steps = zip(times.tolist(), places, alternatives, strict=True)
            views.append([Frame(t, uv, r, float(rng.uniform(0.05, 0.6)), 0.2) for t, uv, r in steps])
        one = carried(history(views, np.array([1000.0, 800.0, 1200.0]), 20_600.0))
        for array in (one.uv, one.sigma_px, one.alt_uv, one.alt_sigma_px):
            found.append([] if array is None else array.ravel().tolist())
    return found
