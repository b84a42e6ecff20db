"""Tests of tracks carried to an instant where a slave named two places: no line leads from one thing to another."""

import numpy as np
import pytest

from common.arrays import Float
from master.stereo.tracks import Sighting, carry

MS = 1e6
NOWHERE = np.array([np.nan, np.nan])


def marker(t_ms: float) -> Float:
    """A marker on its way at 600 px/s."""
    return np.array([300.0 + 0.6 * t_ms, 200.0])


def mug(t_ms: float) -> Float:
    """A thing at rest 60 px away: nearer than a leap of 16 ms."""
    return np.array([300.0, 260.0]) + 0.0 * t_ms


def sighting(t_ms: float, first: Float, second: Float | None = None, sigma_px: float = 0.1) -> Sighting:
    """Two markers: one with the places given, one that is always clear and never moves."""
    clear = np.array([10.0, 20.0])
    now = np.full(2, t_ms * MS)
    rivals = None if second is None else np.array([second, NOWHERE])
    return Sighting(
        centre_ns=round(t_ms * MS),
        t_ns=now,
        uv=np.array([first, clear]),
        sigma_px=np.full(2, sigma_px),
        area=np.full(2, 100.0),
        ready_t_ns=0,
        rival_uv=rivals,
        rival_t_ns=None if rivals is None else now,
    )


def test_without_a_rival_there_are_none() -> None:
    found = carry([sighting(5, marker(5)), sighting(-11, marker(-11)), sighting(-27, marker(-27))], 0.0)
    assert found.rival_uv is None
    assert found.rival_sigma_px is None
    np.testing.assert_allclose(found.uv, np.array([marker(0), (10.0, 20.0)]), atol=1e-9)


@pytest.mark.parametrize("swapped", [(), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_two_things_that_change_their_roles_keep_their_own_paths(swapped: tuple[int, ...]) -> None:
    near: list[Sighting] = []
    for i, t in enumerate((5.0, -11.0, -27.0)):
        first, second = (mug, marker) if i in swapped else (marker, mug)
        near.append(sighting(t, first(t), second(t)))
    found = carry(near, 0.0)
    assert found.rival_uv is not None
    # Which of the two is called the marker is what the nearest sighting says.
    first, second = (mug, marker) if 0 in swapped else (marker, mug)
    np.testing.assert_allclose(found.uv[0], first(0.0), atol=1e-9)
    np.testing.assert_allclose(found.rival_uv[0], second(0.0), atol=1e-9)
    assert np.isnan(found.rival_uv[1]).all()
    np.testing.assert_allclose(found.uv[1], [10.0, 20.0])


def test_a_rival_seen_in_the_nearest_frame_alone_is_held_there_with_a_larger_sigma() -> None:
    near = [sighting(5, marker(5), mug(5)), sighting(-11, marker(-11)), sighting(-27, marker(-27))]
    found = carry(near, 0.0)
    assert found.rival_uv is not None
    assert found.rival_sigma_px is not None
    np.testing.assert_allclose(found.uv[0], marker(0.0), atol=1e-9)
    np.testing.assert_array_equal(found.rival_uv[0], mug(5.0))
    assert found.rival_sigma_px[0] == pytest.approx(np.hypot(0.1, 500.0 * 0.005))
    assert found.sigma_px[0] < 0.3


def test_a_rival_of_the_oldest_frame_alone_changes_nothing() -> None:
    """The marker moves 9.6 px a frame, and no place of it is given to a track that has not begun."""
    near = [sighting(5, marker(5)), sighting(-11, marker(-11)), sighting(-27, mug(-27), marker(-27))]
    found = carry(near, 0.0)
    clear = carry([sighting(t, marker(t)) for t in (5.0, -11.0, -27.0)], 0.0)
    np.testing.assert_array_equal(found.uv, clear.uv)
    np.testing.assert_array_equal(found.sigma_px, clear.sigma_px)


def test_a_rival_of_an_older_frame_is_no_rival_now_but_does_not_lead_the_marker_astray() -> None:
    near = [sighting(5, marker(5)), sighting(-11, mug(-11), marker(-11)), sighting(-27, mug(-27))]
    found = carry(near, 0.0)
    assert found.rival_uv is not None
    assert np.isnan(found.rival_uv[0]).all()
    np.testing.assert_allclose(
        found.uv[0], marker(0.0), atol=1e-9
    )  # a line through two sightings; the third is the mug


def test_what_is_a_leap_away_is_another_thing() -> None:
    far = np.array([500.0, 200.0])
    near = [sighting(5, marker(5), mug(5)), sighting(-11, far), sighting(-27, far)]
    found = carry(near, 0.0)
    np.testing.assert_array_equal(found.uv[0], marker(5.0))  # held: the others are not its past
    assert found.sigma_px[0] == pytest.approx(np.hypot(0.1, 2.5))
