"""Tests of the choice between a marker and a thing of its colour, on exact geometry with noise."""

import numpy as np

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from master.estimator.sensors import CameraArrays
from master.fabrik.intersection import Association, Prior, among, associate
from master.fabrik.settings import ASSOCIATION
from master.rig.pipeline import line_of
from master.run.app import StageTimes
from tests.hand_helpers import (
    MARKERS,
    RIGHT,
    camera_models,
    natural_angles,
    palm,
    rig_file,
    small_cov,
)
from tests.synthetic_run import setup_of

PAIR = tuple(camera_models(rig_file()).values())
THREE = tuple(camera_models(rig_file(("left", "right", "top"))).values())
SIGMA_PX = 0.1
MARKER = np.array([0.02, 0.01, 0.5])
MUG = np.array([0.12, -0.06, 0.6])  # seen at another row
IN_ROW = np.array([-0.05, 0.012, 0.6])  # seen at the rows of the marker: on its epipolar line
NOWHERE = np.array([np.nan, np.nan])
Spot = tuple[Float | None, float]
"""A place [m], None: nowhere; and how uncertain it is [m]."""
NO_IDEA: Spot = (None, np.nan)


def seen(cameras: tuple[CameraModel, ...], *points: Float | None, seed: int = 0) -> Float:
    """What each camera takes for the one marker (C, 1, 2): the image of its point, with noise; None: nothing."""
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_PX, (len(points), 2))
    places = [NOWHERE if p is None else c.project(p) for c, p in zip(cameras, points, strict=True)]
    return (np.array(places) + noise)[:, None]


def choose(
    cameras: tuple[CameraModel, ...], first: Float, second: Float, past: Spot = NO_IDEA, hand: Spot = NO_IDEA
) -> Association:
    """Associate markers of which each has the same past and prediction."""
    sigmas = [np.where(np.isnan(uv[..., 0]), np.nan, SIGMA_PX) for uv in (first, second)]
    count = first.shape[1]

    def rows(place: Float | None) -> Float:
        return np.tile(np.full(3, np.nan) if place is None else place, (count, 1))

    age_s = np.full(count, (past[1] - ASSOCIATION.place_m) / ASSOCIATION.speed_m_s)
    model = hand[1] ** 2 - ASSOCIATION.model_m**2
    prior = Prior(rows(hand[0]), np.tile(model * np.eye(3), (count, 1, 1)))
    area = np.where(np.isnan(first[..., 0]), np.nan, 400.0)
    pixels = first, sigmas[0], area
    return associate(CameraArrays.of(cameras), pixels, (second, sigmas[1]), prior, (rows(past[0]), age_s))


def near(point: Float, spread_m: float = 0.02) -> Spot:
    return point, spread_m


def test_the_slaves_are_followed_where_their_association_fits() -> None:
    others = (seen(PAIR, None, MUG), seen(PAIR, IN_ROW, None), seen(PAIR, IN_ROW, IN_ROW))
    for seed in range(20):
        first = seen(PAIR, MARKER, MARKER, seed=seed)
        for alternatives in (seen(PAIR, MUG, MUG, seed=seed + 100), *others):
            chosen = choose(PAIR, first, alternatives)
            np.testing.assert_array_equal(chosen.uv, first)
            assert not chosen.taken.any()


def test_a_little_better_is_not_clearly_better() -> None:
    """A fragment of the marker itself, 2 px nearer to the epipolar line: the slave knows best which to take."""
    first = seen(PAIR, MARKER, MARKER)
    first[0, 0, 1] += 2.0
    fragment = seen(PAIR, MARKER, None)
    assert not choose(PAIR, first, fragment).taken.any()
    first[0, 0, 1] += 3.0
    assert choose(PAIR, first, fragment).taken.all()


def test_on_one_epipolar_line_the_last_place_decides() -> None:
    first, second = seen(PAIR, IN_ROW, MARKER), seen(PAIR, MARKER, None)
    assert not choose(PAIR, first, second).taken.any()  # it is ambiguous: the slave's choice stands
    chosen = choose(PAIR, first, second, near(MARKER))
    np.testing.assert_array_equal(chosen.uv[0], second[0])
    assert not choose(PAIR, first, second, near(IN_ROW, 2.0)).taken.any()


def test_each_slave_took_another_thing_and_nobody_knows_better() -> None:
    """Both the marker and the mug are consistent, neither is what the slaves chose: dropped, unless expected."""
    first, second = seen(PAIR, MUG, MARKER), seen(PAIR, MARKER, MUG)
    chosen = choose(PAIR, first, second)
    assert chosen.dropped.all()
    assert np.isnan(chosen.uv).all()
    assert np.isnan(chosen.sigma_px).all()
    np.testing.assert_array_equal(
        choose(PAIR, first, second, near(MARKER)).uv[:, 0], [second[0, 0], first[1, 0]]
    )


def test_what_is_out_of_the_hands_reach_is_dropped_even_where_the_slaves_agree() -> None:
    first, second = seen(PAIR, MUG, MUG), seen(PAIR, IN_ROW, None)
    assert choose(PAIR, first, second, near(MUG), near(MARKER, 0.02)).dropped.all()


def test_a_marker_that_only_one_camera_shows_is_not_made_of_two_things() -> None:
    """The right camera sees the mug alone. Mug and mug meet, but far from where the marker was a frame ago."""
    first, second = seen(PAIR, MARKER, MUG), seen(PAIR, MUG, None)
    assert choose(PAIR, first, second, near(MARKER)).dropped.all()


def test_a_third_camera_needs_no_past() -> None:
    first, second = seen(THREE, IN_ROW, MARKER, MARKER), seen(THREE, MARKER, None, None)
    chosen = choose(THREE, first, second)  # cameras in one row, but the depths of the pairs differ
    np.testing.assert_array_equal(chosen.uv[0], second[0])


def test_one_camera_alone_goes_by_the_expected_place() -> None:
    first, second = seen(PAIR, MUG, None), seen(PAIR, MARKER, None)
    np.testing.assert_array_equal(choose(PAIR, first, second).uv, first)  # no idea: the slave's choice
    np.testing.assert_array_equal(choose(PAIR, first, second, near(MARKER)).uv, second)
    np.testing.assert_array_equal(choose(PAIR, second, first, near(MARKER)).uv, second)
    assert choose(PAIR, first, second, hand=near(np.array([-0.15, 0.1, 0.5]))).dropped.all()


def test_other_markers_are_passed_on_untouched() -> None:
    first = np.concatenate([seen(PAIR, MUG, MARKER), seen(PAIR, MARKER, MUG), seen(PAIR, None, MUG)], axis=1)
    second = np.concatenate([seen(PAIR, MARKER, None), *[np.full((2, 1, 2), np.nan)] * 2], axis=1)
    chosen = choose(PAIR, first, second)
    np.testing.assert_array_equal(chosen.uv[:, 1:], first[:, 1:])
    assert chosen.taken.tolist() == [True, False, False]


def test_many_cameras_with_alternatives_are_associated_from_the_first_five_and_the_rest() -> None:
    names = tuple(f"c{k}" for k in range(9))
    cameras = tuple(camera_models(rig_file(names)).values())
    first = seen(cameras, *[MUG] * 7, MARKER, MARKER)
    second = seen(cameras, *[MARKER] * 7, None, None)
    chosen = choose(cameras, first, second)
    np.testing.assert_array_equal(chosen.uv[:5], second[:5])
    assert np.isnan(chosen.uv[5:7]).all()
    np.testing.assert_array_equal(chosen.uv[7:], first[7:])


# -- where a marker is expected -------------------------------------------------------------------------------------


def test_a_past_that_is_too_old_says_nothing() -> None:
    first, second = seen(PAIR, IN_ROW, MARKER), seen(PAIR, MARKER, None)
    assert choose(PAIR, first, second, near(MARKER, 0.05)).taken.all()
    assert not choose(PAIR, first, second, near(MARKER, ASSOCIATION.forget_s + 0.02)).taken.any()


def test_a_second_place_has_no_area_and_a_first_one_keeps_its_own() -> None:
    chosen = choose(PAIR, seen(PAIR, MUG, MARKER), seen(PAIR, MARKER, None))
    np.testing.assert_array_equal(chosen.area_px2[:, 0], [np.nan, 400.0])


def test_a_prediction_by_the_other_markers_covers_where_the_marker_is() -> None:
    """Natural hands, one finger ambiguous: the prediction with its floor covers it, and is no wider than a hand."""
    rng = np.random.default_rng(3)
    line, squared = line_of(setup_of(rig_file()), StageTimes()), list[float]()
    for trial in range(40):
        m = trial % 6
        true = RIGHT.marker_points(RIGHT.forward(palm(rng.uniform(-20, 20, 3)), natural_angles(rng)), MARKERS)
        clear = true.copy()
        clear[m] = np.nan
        hand = line.solve_once(clear, small_cov(), np.full((2, 6), 100.0))
        assert hand is not None
        joint = RIGHT.mount(MARKERS[m]).joint
        cov = hand.cov_m2[0 if joint is None else joint] + ASSOCIATION.model_m**2 * np.eye(3)
        off = true[m] - RIGHT.marker_points(hand.joints, MARKERS)[m]
        squared.append(float(off @ np.linalg.solve(cov, off)))
        assert np.sqrt(np.trace(cov)) < 0.2
    assert (
        np.median(squared) < 2.4
    )  # the median of chi-square with three degrees: the prior is rather too wide
    assert max(squared) < 30.7


def test_without_a_hand_its_markers_are_expected_together_and_others_nowhere() -> None:
    nowhere = np.full(3, np.nan)
    on_hand = np.array([0, 2])
    assert np.isnan(among(np.array([nowhere, MUG, nowhere]), on_hand).points_m).all()
    prior = among(np.array([MARKER, MUG, nowhere]), on_hand)
    np.testing.assert_array_equal(prior.points_m, [MARKER, nowhere, MARKER])
    np.testing.assert_allclose(prior.cov_m2[0], 0.01 * np.eye(3))
