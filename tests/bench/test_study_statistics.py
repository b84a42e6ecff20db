"""Cells and repeatability against published numbers, hand calculation, and what is not reached."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.study.command import cells_of, icc_1_1, repeated
from bench.study.trials import Trial
from common.sim.motion import POSES

# Shrout & Fleiss, Psychological Bulletin 86 (1979), table 2: four judges rate six targets. Table 4: ICC(1,1) = .17.
SHROUT_FLEISS = np.array(
    [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]], float
)


def trial(
    block: int = 1,
    pose: str = "pinch",
    off: float = 0.0,
    *,
    who: str = "a",
    true: float = 40.0,
    tracked: bool = True,
    seen: bool = True,
) -> Trial:
    """A trial in which all fingers are alike."""
    return Trial(
        participant=who,
        block=block,
        pose=pose,
        pip_deg=np.full(5, true + off),
        truth_deg=np.full(5, true),
        tracked=np.full(5, tracked),
        seen=np.full(5, seen),
    )


def test_icc_of_the_published_example() -> None:
    assert icc_1_1(SHROUT_FLEISS) == pytest.approx(0.166, abs=0.0005)


def test_trials_that_agree_are_perfectly_repeatable_and_unrelated_ones_are_not() -> None:
    rng = np.random.default_rng(5)
    targets = rng.normal(0.0, 30.0, 400)
    assert icc_1_1(np.stack([targets, targets], axis=1)) == pytest.approx(1.0)
    assert abs(icc_1_1(rng.normal(size=(4000, 2)))) < 0.05
    # Variances 900 between and 100 within: 900 / 1000.
    noisy = targets[:, None] + rng.normal(0.0, 10.0, (400, 2))
    assert icc_1_1(noisy) == pytest.approx(0.9, abs=0.02)


@given(st.floats(-50.0, 50.0), st.floats(0.1, 9.0))
def test_icc_has_neither_origin_nor_unit(shift: float, scale: float) -> None:
    assert icc_1_1(scale * SHROUT_FLEISS + shift) == pytest.approx(icc_1_1(SHROUT_FLEISS), abs=1e-6)


@pytest.mark.parametrize(
    "ratings", [np.zeros((0, 2)), np.ones((2, 2)), np.full((9, 2), 7.0), SHROUT_FLEISS[:, :1]]
)
def test_too_few_or_equal_ratings_have_no_icc(ratings: np.ndarray) -> None:
    assert np.isnan(icc_1_1(ratings))


def test_a_cell_is_mean_and_sd_of_absolute_errors() -> None:
    found = cells_of(
        [trial(1, off=-3.0), trial(2, off=5.0), trial(3, off=1.0), trial(1, who="b", tracked=False)]
    )
    assert [cell.pose for cell in found] == ["pinch"] * 5
    for cell in found:
        assert (cell.trials, cell.reached, cell.blind) == (4, 3, 0)
        assert cell.is_reached
        assert cell.mean_deg == pytest.approx(3.0)
        assert cell.sd_deg == pytest.approx(2.0)  # of 3, 5, 1 about 3, n - 1


@pytest.mark.parametrize(("tracked", "reached"), [(0, False), (1, False), (2, True), (4, True)])
def test_a_finger_tracked_in_fewer_than_half_of_the_trials_is_not_filled_in(
    tracked: int, reached: bool
) -> None:
    cell = cells_of([trial(k, off=2.0, tracked=k < tracked) for k in range(4)])[0]
    assert cell.is_reached is reached
    assert np.isnan(cell.mean_deg) is not reached
    assert (cell.reached, cell.trials) == (tracked, 4)


def test_a_finger_tracked_though_nothing_of_it_is_seen_is_counted_and_its_error_kept() -> None:
    cell = cells_of([trial(1, off=2.0), trial(2, off=30.0, seen=False)])[0]
    assert (cell.reached, cell.blind) == (2, 1)
    assert cell.mean_deg == pytest.approx(16.0)


def test_angles_that_do_not_exist_spoil_nothing() -> None:
    cell = cells_of([trial(1, off=2.0), trial(2, off=4.0), trial(3, off=np.nan, tracked=False)])[0]
    assert cell.mean_deg == pytest.approx(3.0)


def test_repeatability_is_of_participants_and_poses_and_leaves_out_what_is_not_reached() -> None:
    rng = np.random.default_rng(3)
    trials = [
        trial(block, pose, float(rng.normal(0.0, 1.0)), who=who, true=15.0 * k, tracked=pose != "pointing")
        for who in "abcd"
        for block in (1, 2, 3)
        for k, pose in enumerate(POSES)
    ]
    found = repeated(trials, seed=1)
    assert [(one.targets, one.cells) for one in found] == [(20, 5)] * 5  # pointing is missing
    for one in found:
        assert 0.99 < one.icc < 1.0
        assert one.truth_icc == 1.0
    assert found == repeated(trials, seed=1)
    assert found != repeated(trials, seed=2)


def test_one_block_cannot_be_repeated() -> None:
    found = repeated([trial(1, pose, who=who) for pose in POSES for who in "abc"], seed=1)
    assert all(one.targets == 0 and np.isnan(one.icc) for one in found)
