"""Tests of tracks carried to an instant: what a hand can do is followed, noise is not blown up, sigma covers the error.

Where a slave named two places, no line leads from one thing to another.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Float
from master.stereo.tracks import SIGHTINGS, Carried, Sighting
from master.stereo.tracks import carry as carry_all

MS = 1e6
PX_M = 1000.0
NOWHERE = np.array([np.nan, np.nan])
PAST = (5.0, -11.0, -27.0, -43.0)  # [ms] from the instant: one sighting after it
AHEAD = (-8.0, -24.0, -40.0, -56.0)  # predicted by half a period
HELD_PX_S = PX_M * np.sqrt(
    (2 * 1.0**2 + 0.01**2) / 3
)  # one sighting says nothing of the speed: RMS of all vigours


def marker(t_ms: float) -> Float:
    """A marker on its way at 600 px/s."""
    return np.array([300.0 + 0.6 * t_ms, 200.0])


def mug(t_ms: float) -> Float:
    """A thing at rest 60 px away: nearer than a leap of 16 ms."""
    return np.array([300.0, 260.0]) + 0.0 * t_ms


def sighting(t_ms: float, first: Float, second: Float | None = None, sigma_px: float = 0.1) -> Sighting:
    """Two markers: one with the places given, one that is always clear and never moves."""

    def marks(*places: Float) -> Float:
        return np.array([[*place, t_ms * MS, sigma_px] for place in places])

    return Sighting(
        centre_ns=round(t_ms * MS),
        marks=marks(first, np.array([10.0, 20.0])),
        area=np.full(2, 100.0),
        ready_t_ns=0,
        rivals=None if second is None else marks(second, NOWHERE),
    )


def carry(near: list[Sighting]) -> Carried:
    """To time 0, of one camera, whose axis is then taken off."""
    found = carry_all([near], 0.0, np.array([PX_M]))
    rivals = found.rival_uv, found.rival_sigma_px
    return Carried(found.uv[0], found.sigma_px[0], *(None if r is None else r[0] for r in rivals))


def test_without_a_rival_there_are_none() -> None:
    found = carry([sighting(5, marker(5)), sighting(-11, marker(-11)), sighting(-27, marker(-27))])
    assert found.rival_uv is None
    assert found.rival_sigma_px is None
    np.testing.assert_allclose(found.uv, np.array([marker(0), (10.0, 20.0)]), atol=0.02)


@pytest.mark.parametrize("swapped", [(), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_two_things_that_change_their_roles_keep_their_own_paths(swapped: tuple[int, ...]) -> None:
    near: list[Sighting] = []
    for i, t in enumerate((5.0, -11.0, -27.0)):
        first, second = (mug, marker) if i in swapped else (marker, mug)
        near.append(sighting(t, first(t), second(t)))
    found = carry(near)
    assert found.rival_uv is not None
    # Which of the two is called the marker is what the nearest sighting says.
    first, second = (mug, marker) if 0 in swapped else (marker, mug)
    np.testing.assert_allclose(found.uv[0], first(0.0), atol=0.02)
    np.testing.assert_allclose(found.rival_uv[0], second(0.0), atol=0.02)
    assert np.isnan(found.rival_uv[1]).all()
    np.testing.assert_allclose(found.uv[1], [10.0, 20.0])


def test_a_rival_seen_in_the_nearest_frame_alone_is_held_there_with_a_larger_sigma() -> None:
    near = [sighting(5, marker(5), mug(5)), sighting(-11, marker(-11)), sighting(-27, marker(-27))]
    found = carry(near)
    assert found.rival_uv is not None
    assert found.rival_sigma_px is not None
    np.testing.assert_allclose(found.uv[0], marker(0.0), atol=0.02)
    np.testing.assert_allclose(found.rival_uv[0], mug(5.0))
    assert found.rival_sigma_px[0] == pytest.approx(np.hypot(0.1, HELD_PX_S * 0.005), rel=2e-3)
    assert found.sigma_px[0] < 0.3


def test_a_rival_of_the_oldest_frame_alone_changes_nothing() -> None:
    """The marker moves 9.6 px a frame, and no place of it is given to a track that has not begun."""
    near = [sighting(5, marker(5)), sighting(-11, marker(-11)), sighting(-27, mug(-27), marker(-27))]
    found = carry(near)
    clear = carry([sighting(t, marker(t)) for t in (5.0, -11.0, -27.0)])
    np.testing.assert_array_equal(found.uv, clear.uv)
    np.testing.assert_array_equal(found.sigma_px, clear.sigma_px)


def test_a_rival_of_an_older_frame_is_no_rival_now_but_does_not_lead_the_marker_astray() -> None:
    near = [sighting(5, marker(5)), sighting(-11, mug(-11), marker(-11)), sighting(-27, mug(-27))]
    found = carry(near)
    assert found.rival_uv is not None
    assert np.isnan(found.rival_uv[0]).all()
    # A line through two sightings; the third is the mug.
    np.testing.assert_allclose(found.uv[0], marker(0.0), atol=0.05)


def test_what_is_a_leap_away_is_another_thing() -> None:
    far = np.array([500.0, 200.0])
    near = [sighting(5, marker(5), mug(5)), sighting(-11, far), sighting(-27, far)]
    found = carry(near)
    np.testing.assert_allclose(found.uv[0], marker(5.0))  # held: the others are not its past
    assert found.sigma_px[0] == pytest.approx(np.hypot(0.1, HELD_PX_S * 0.005), rel=2e-3)


# -- one marker, no doubt who it is ----------------------------------------------------------------------------------


def seen(times_ms: tuple[float, ...], places: Float, sigma_px: float = 0.1) -> list[Sighting]:
    """Sightings of many markers at once: places (N, M, 2) [px]."""
    count = places.shape[1]
    return [
        Sighting(
            centre_ns=round(t * MS),
            marks=np.column_stack([uv, np.full(count, t * MS), np.full(count, sigma_px)]),
            area=np.full(count, 100.0),
            ready_t_ns=0,
        )
        for t, uv in zip(times_ms, places, strict=True)
    ]


@pytest.mark.parametrize("times", [PAST, AHEAD])
def test_without_noise_a_cubic_is_met(times: tuple[float, ...]) -> None:
    """1 m/s, 10 m/s^2, 200 m/s^3: a brisk hand."""
    t = np.array(times)[:, None, None] * 1e-3
    places = 300.0 + PX_M * (t * [1.0, -0.5] + t**2 * [-5.0, 3.0] + t**3 * [33.0, 20.0])
    found = carry(seen(times, places, sigma_px=1e-3))
    np.testing.assert_allclose(found.uv, [[300.0, 300.0]], atol=0.1)
    straight = carry(seen(times[:2], places[:2], sigma_px=1e-3))
    assert np.abs(straight.uv - 300.0).max() > 0.15  # two sightings do not know the turn


@pytest.mark.parametrize(("times", "most_px"), [(PAST, 0.08), (AHEAD, 0.11)])
def test_a_marker_at_rest_is_no_less_steady_than_its_sightings(
    times: tuple[float, ...], most_px: float
) -> None:
    rng = np.random.default_rng(2)
    noise = rng.normal(0.0, 0.1, (SIGHTINGS, 4000, 2))
    found = carry(seen(times, 300.0 + noise))
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
    found = carry(seen(times, place(t) + rng.normal(0.0, 0.1, (SIGHTINGS, 2000, 2))))
    error = np.abs(found.uv - place(0.0)) / found.sigma_px[:, None]
    assert 0.9 < (error < 1.96).mean() < 0.995
    assert np.median(found.sigma_px) < (0.25 if times is PAST else 1.6)  # and says something


@given(st.integers(0, 10_000), st.floats(-500.0, 500.0), st.floats(1.0, 25.0))
@settings(max_examples=30)
def test_a_shifted_picture_or_a_clock_that_began_elsewhere_changes_nothing(
    seed: int, shift: float, late_ms: float
) -> None:
    rng = np.random.default_rng(seed)
    places = 300.0 + rng.normal(0.0, 3.0, (SIGHTINGS, 5, 2))
    plain = carry(seen(PAST, places))
    shifted = carry(seen(PAST, places + shift))
    np.testing.assert_allclose(shifted.uv, plain.uv + shift, atol=1e-8)
    np.testing.assert_allclose(shifted.sigma_px, plain.sigma_px)
    later = carry_all([seen(tuple(t + late_ms for t in PAST), places)], late_ms * MS, np.array([PX_M]))
    np.testing.assert_allclose(later.uv[0], plain.uv, atol=1e-6)


def test_what_time_is_uncertain_by_adds_with_the_speed() -> None:
    t = np.array(PAST)[:, None, None] * 1e-3
    places = np.concatenate([300.0 + t * [900.0, 0.0], 300.0 + 0.0 * t * [1.0, 1.0]], axis=1)
    exact = carry(seen(PAST, places))
    unsure = carry([replace(s, t_sigma_ns=0.5 * MS) for s in seen(PAST, places)])
    np.testing.assert_array_equal(unsure.uv, exact.uv)
    added = np.sqrt(unsure.sigma_px**2 - exact.sigma_px**2)
    assert added[0] == pytest.approx(np.sqrt(0.75) * 0.45, rel=0.03)
    assert added[1] < 0.01


def test_a_jump_farther_than_a_hand_goes_is_another_thing_also_without_a_rival() -> None:
    places = np.full((SIGHTINGS, 1, 2), 300.0)
    jumped = places.copy()
    jumped[1:] += 200.0
    held = carry(seen(PAST[:1], places[:1]))
    found = carry(seen(PAST, jumped))
    np.testing.assert_allclose(found.uv, held.uv)
    np.testing.assert_allclose(found.sigma_px, held.sigma_px)


def test_a_sighting_that_missed_the_marker_leaves_a_gap_and_no_more() -> None:
    t = np.array(PAST)[:, None, None] * 1e-3
    places = 300.0 + t * [600.0, -200.0]
    gap = places.copy()
    gap[1] = np.nan
    found, whole = carry(seen(PAST, gap)), carry(seen(PAST, places))
    np.testing.assert_allclose(found.uv, [[300.0, 300.0]], atol=0.3)
    assert found.sigma_px[0] > whole.sigma_px[0]
    gap[0] = np.nan
    assert np.isnan(carry(seen(PAST, gap)).uv).all()  # what the nearest frame does not hold is not seen
    assert np.isnan(carry(seen(PAST, gap)).sigma_px).all()


def test_cameras_are_carried_each_by_itself() -> None:
    rng = np.random.default_rng(4)
    places = 300.0 + rng.normal(0.0, 2.0, (2, SIGHTINGS, 3, 2))
    views = [seen(PAST, places[0]), seen(AHEAD[:2], places[1][:2]), []]
    scale = np.array([1000.0, 700.0, 900.0])
    together = carry_all(views, 0.0, scale)
    for c in range(2):
        alone = carry_all([views[c]], 0.0, scale[c : c + 1])
        np.testing.assert_allclose(together.uv[c], alone.uv[0])
        np.testing.assert_allclose(together.sigma_px[c], alone.sigma_px[0])
    assert np.isnan(together.uv[2]).all()
    assert np.isnan(together.sigma_px[2]).all()
