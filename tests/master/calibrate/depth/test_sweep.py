"""Sweeps that are unfit are refused, with the points and what to do; sweeps that are fit pass."""

from dataclasses import replace

import numpy as np
import pytest

from common.arrays import Float
from common.errors import FitError
from master.calibrate.depth.fit import fit_depth
from master.calibrate.depth.sweep import Sweep, checked
from master.fabrik.depth import AffineDisparity

CAMERAS = ("left", "right")
SIZE = (640, 480)
RIG = AffineDisparity(37.3, 2.64)
STEPS = np.arange(1.0, 0.19, -0.05)


def table(distance: Float, disparity: Float | None = None) -> Sweep:
    x = RIG.disparity(distance) if disparity is None else disparity
    return Sweep.of_disparity(distance, x, [f"line {i}" for i in range(2, 2 + distance.size)])


def seen(distance: Float) -> Sweep:
    """A card of 75 x 50 mm half way between the cameras."""
    x = RIG.disparity(distance)
    v = np.full_like(x, 239.5)
    uv = np.stack([np.stack([319.5 + side * x, v], axis=-1) for side in (0.5, -0.5)], axis=1)
    area = np.repeat(497.0**2 * 0.075 * 0.05 / distance[:, None] ** 2, 2, axis=1)
    return replace(table(distance), uv=uv, area_px2=area)


def test_the_published_steps_pass_nearest_first() -> None:
    out = checked(seen(STEPS), CAMERAS, SIZE)
    assert out.distance_m.tolist() == sorted(STEPS.tolist())
    assert out.place[0] == "line 18"


def test_repeated_distances_are_averaged() -> None:
    twice = np.concatenate([STEPS, [0.5, 0.2]])
    x = RIG.disparity(twice)
    x[-2] += 0.3
    out = checked(table(twice, x), CAMERAS)
    assert out.size == 17
    i = int(np.argmin(np.abs(out.distance_m - 0.5)))
    assert out.disparity_px[i] == pytest.approx(RIG.disparity(np.array(0.5)) + 0.15)
    assert out.frames[i] == 2
    assert out.place[i] == "mean of line 12, line 19"


def swapped() -> Sweep:
    return table(STEPS, -RIG.disparity(STEPS))


def one_negative() -> Sweep:
    x = RIG.disparity(STEPS)
    x[3] = -5.0
    return table(STEPS, x)


def not_monotone() -> Sweep:
    x = RIG.disparity(STEPS)
    x[[10, 11]] = x[[11, 10]]
    return table(STEPS, x)


def disagreeing() -> Sweep:
    twice = np.concatenate([STEPS, [0.5]])
    x = RIG.disparity(twice)
    x[-1] += 3.0
    return table(twice, x)


def not_in_right() -> Sweep:
    sweep = seen(STEPS)
    sweep.uv[16, 1] = np.nan
    return replace(sweep, disparity_px=sweep.uv[:, 0, 0] - sweep.uv[:, 1, 0])


def cut_by_the_border() -> Sweep:
    sweep = seen(STEPS)
    sweep.uv[16, 1, 0] = 70.0  # half of the card is 93 px
    sweep.area_px2[16, 1] *= 0.75
    return replace(sweep, disparity_px=sweep.uv[:, 0, 0] - sweep.uv[:, 1, 0])


@pytest.mark.parametrize(
    ("sweep", "words"),
    [
        (table(np.array([0.2, 0.6, 1.0])), ["3 usable distances", "17", "0.05 m"]),
        (table(np.empty(0)), ["0 usable distances"]),
        (table(np.linspace(0.6, 1.0, 17)), ["0.6...1 m", "2.5 times"]),
        (table(np.array([*np.linspace(0.2, 0.3, 11), 1.0])), ["one-sided", "1 of 12", "farther", "0.447"]),
        (table(np.array([0.2, *np.linspace(0.6, 1.0, 9)])), ["one-sided", "1 of 10", "nearer"]),
        (not_monotone(), ["not monotone", "0.45 m", "0.5 m"]),
        (table(STEPS, RIG.disparity(STEPS)[::-1].copy()), ["reverse order"]),
        (swapped(), ["left and right are swapped"]),
        (one_negative(), ["0.85 m (line 5)", "not positive"]),
        (disagreeing(), ["0.5 m", "disagree", "line 12", "line 19"]),
        (not_in_right(), ["camera 'right'", "0.2 m (line 18)", "outside"]),
        (cut_by_the_border(), ["partly outside the image of camera 'right'", "0.2 m (line 18)"]),
        (table(STEPS, np.where(STEPS > 0.9, np.nan, RIG.disparity(STEPS))), ["1 m (line 2)", "NaN"]),
        (table(np.where(STEPS > 0.99, -1.0, STEPS), RIG.disparity(STEPS)), ["line 2", "above 0"]),
        (table(100.0 * STEPS, RIG.disparity(STEPS)), ["all places", "not centimetres"]),
    ],
)  # fmt: skip
def test_what_is_unfit_is_refused_with_its_name(sweep: Sweep, words: list[str]) -> None:
    with pytest.raises(FitError) as refused:
        checked(sweep, CAMERAS, SIZE)
    for word in words:
        assert word in str(refused.value)


def test_a_target_near_the_border_but_whole_passes() -> None:
    sweep = cut_by_the_border()
    sweep.area_px2[16, 1] /= 0.75
    assert checked(sweep, CAMERAS, SIZE).size == 17


def test_points_that_fit_no_law_of_the_others_are_refused_when_they_are_many() -> None:
    x = RIG.disparity(STEPS)
    x[::4] *= 1.03
    with pytest.raises(FitError, match=r"5 of 17 distances fit no law.* 1 m \(line 2\)"):
        fit_depth(checked(table(STEPS, x), CAMERAS), {})


def test_too_few_points_without_the_wrong_one_are_refused_with_its_name() -> None:
    distance = np.linspace(0.2, 1.0, 8)
    x = RIG.disparity(distance)
    x[3] *= 1.04
    with pytest.raises(FitError, match=r"7 usable distances.*left out.*0\.5429 m"):
        fit_depth(checked(table(distance, x), CAMERAS), {})
