"""Paths of least energy against every path there is, and through corridors of several widths at once."""

from itertools import product

import numpy as np
import pytest

from slave.wrist.seams import FENCE, minimum_cost_paths

STEP_COST = 0.02


def fenced(rng: np.random.Generator, stations: int, width: int) -> np.ndarray:
    energy = rng.uniform(0.0, 1.0, (stations, width)).astype(np.float32)
    energy[:, :2] = energy[:, -2:] = FENCE
    return energy


def energy_of(energy: np.ndarray, path: tuple[int, ...]) -> float:
    steps = np.abs(np.diff(path))
    if (steps > 2).any():
        return np.inf
    return float(energy[np.arange(len(path)), list(path)].sum() + STEP_COST * steps.sum())


@pytest.mark.parametrize("stations", [2, 5, 6])
def test_of_all_paths_it_is_the_cheapest(stations: int) -> None:
    rng = np.random.default_rng(stations)
    for _ in range(10):
        energy = fenced(rng, stations, 8)
        every = product(range(2, 6), repeat=stations)
        least = min(energy_of(energy, path) for path in every)
        (found,) = minimum_cost_paths(energy, (8,))
        assert energy_of(energy, tuple(found.tolist())) == pytest.approx(least, abs=1e-5)


def test_bands_side_by_side_are_as_each_alone() -> None:
    rng = np.random.default_rng(7)
    widths = (20, 9, 33)
    each = [fenced(rng, 15, width) for width in widths]
    together = minimum_cost_paths(np.concatenate(each, axis=1), widths)
    for path, energy, width in zip(together, each, widths, strict=True):
        np.testing.assert_array_equal(path, minimum_cost_paths(energy, (width,))[0])


def test_a_minimum_is_followed_as_steeply_as_two_samples_a_station() -> None:
    energy = np.full((12, 40), 5.0, dtype=np.float32)
    minimum = 6 + 2 * np.arange(12)
    energy[np.arange(12), minimum] = 0.0
    energy[:, :2] = energy[:, -2:] = FENCE
    np.testing.assert_array_equal(minimum_cost_paths(energy, (40,))[0], minimum)
