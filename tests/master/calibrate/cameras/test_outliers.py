"""The limit finds wrong views, and hardly ever blames good ones."""

import numpy as np
import pytest

from master.calibrate.cameras.outliers import FALSE_ALARM, GOOD_PX, limit


@pytest.mark.parametrize("views", [6, 12, 30])
def test_sets_of_good_views_seldom_lose_one(views: int) -> None:
    rng = np.random.default_rng(views)
    sets, lost = 2000, 0
    for _ in range(sets):
        errors = 0.3 * np.exp(rng.normal(0.0, 0.25, views))
        lost += bool((errors > limit(errors, np.full(views, 100.0))).any())
    # Twice the level: the spread is itself estimated, by a median.
    assert lost < 2 * FALSE_ALARM * sets * (2.0 if views < 10 else 1.0)


@pytest.mark.parametrize(("good", "bad"), [(5, 2), (9, 4), (16, 8), (31, 15)])
def test_wrong_views_are_found_even_if_many(good: int, bad: int) -> None:
    rng = np.random.default_rng(good)
    for _ in range(100):
        errors = np.concatenate([0.2 * np.exp(rng.normal(0.0, 0.15, good)), rng.uniform(6.0, 20.0, bad)])
        assert limit(errors, np.full(good + bad, 100.0)) < 6.0


def test_few_views_are_not_judged_and_very_good_ones_never_blamed() -> None:
    assert limit(np.array([0.1, 0.1, 50.0]), np.full(3, 100.0)) == np.inf
    assert limit(np.full(12, 0.01), np.full(12, 100.0)) == GOOD_PX
