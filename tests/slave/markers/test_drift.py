"""The light estimated from colours: the law it inverts, its bounds, and what it does where colours tell nothing."""

import tracemalloc

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from common.arrays import Float
from common.calibration import HsvRange
from common.geometry.srgb import gain_tables
from common.sim.light import MARKER_LINEAR_RGB, Light
from slave.markers.classify import ColourTable
from slave.markers.illuminant import (
    LIMIT_BLUE,
    LIMIT_EXPOSURE,
    LIMIT_RED,
    RATE_PER_S,
    ColourDrift,
    at_bound,
    bounded,
    fit_gains,
)
from slave.markers.white_balance import ColourMonitor, hsv
from tests.slave import painted

COLOURS = np.array(list(MARKER_LINEAR_RGB.values()))[:, ::-1] + 0.02  # blue first; no paint is quite black
ONES, CALIBRATED = np.ones(6), np.zeros(3)
SECOND = 1_000_000_000

gains = st.tuples(st.floats(-0.6, 0.6), st.floats(-0.4, 0.4), st.floats(-0.5, 0.5)).map(np.array)
shadings = arrays(np.float64, 6, elements=st.floats(-0.4, 0.4))


def against_green(x: Float) -> Float:
    return x[[0, 2]] - x[1]


@given(gains, shadings)
def test_gains_that_all_markers_share_are_found_whatever_the_shading(x: Float, shading: Float) -> None:
    seen = COLOURS * np.exp(x + shading[:, None])
    fit = fit_gains(np.minimum(seen, 0.89), COLOURS, ONES, CALIBRATED)
    if seen.max() < 0.89:
        # The prior towards what was known takes a little; nothing of the shading gets into the hues.
        np.testing.assert_allclose(
            against_green(fit.log_gains), against_green(x), atol=0.02 + 0.02 * np.abs(x).max()
        )
        assert fit.residual.max() < 2.5


@given(gains, st.integers(0, 5))
def test_one_marker_in_coloured_light_does_not_turn_the_others(x: Float, odd: int) -> None:
    seen = COLOURS * np.exp(0.5 * x)
    seen[odd] *= [3.0, 0.5, 1.5]
    fit = fit_gains(np.minimum(seen, 0.89), COLOURS, ONES, CALIBRATED)
    if seen.max() < 0.89:
        np.testing.assert_allclose(against_green(fit.log_gains), 0.5 * against_green(x), atol=0.15)
        assert int(np.argmax(fit.residual)) == odd


def test_the_shading_spreads_over_markers_not_over_channels() -> None:
    # Half of the light on every marker: exposure, not hue.
    fit = fit_gains(0.5 * COLOURS, COLOURS, ONES, CALIBRATED)
    np.testing.assert_allclose(against_green(fit.log_gains), 0.0, atol=0.02)
    assert fit.log_gains[1] == pytest.approx(np.log(0.5), abs=0.2)


def test_nothing_seen_changes_nothing_and_one_marker_stays_alone() -> None:
    drift = ColourDrift(COLOURS)
    drift.restart(np.array([0.2, 0.1, -0.1]))
    nothing = np.full((6, 3), np.nan)
    for k in range(5):
        fit = drift.push(nothing, np.full(6, np.nan), k * SECOND // 10)
        assert fit is not None
        assert np.isnan(fit.residual).all()
    np.testing.assert_array_equal(drift.log_gains, [0.2, 0.1, -0.1])
    one = nothing.copy()
    one[2] = COLOURS[2]
    fit = fit_gains(one, COLOURS, ONES, CALIBRATED)
    np.testing.assert_array_equal(np.isfinite(fit.residual), [False, False, True, False, False, False])


@pytest.mark.parametrize("single", range(6))
def test_a_lone_marker_of_another_shade_does_not_carry_the_light_away(single: int) -> None:
    drift, seen = ColourDrift(COLOURS), np.full((6, 3), np.nan)
    seen[single] = COLOURS[single] * 1.4 + 0.02  # a flat, bright patch with a sheen
    for k in range(600):
        drift.push(seen, ONES, k * SECOND // 10)
    assert np.abs(against_green(drift.log_gains)).max() < 0.2


def test_a_clipped_channel_measures_no_gain() -> None:
    seen = np.minimum(COLOURS * [3.0, 1.0, 1.0], 1.0)
    assert (seen[:, 0] > 0.9).sum() >= 2
    fit = fit_gains(seen, COLOURS, ONES, CALIBRATED)
    assert fit.log_gains[0] - fit.log_gains[1] == pytest.approx(np.log(3.0), abs=0.12)


@pytest.mark.parametrize("kelvin", [3000.0, 3500.0, 5000.0, 6500.0])
@pytest.mark.parametrize("calibrated", [3000.0, 4300.0, 6500.0])
def test_the_bounds_hold_every_light_of_the_range(kelvin: float, calibrated: float) -> None:
    for exposure in (0.7, 1.0, 1.3):
        x = np.log(Light(kelvin, exposure).gains_bgr(calibrated))
        np.testing.assert_allclose(bounded(x), x)
        assert not at_bound(x)


@given(arrays(np.float64, (20, 6, 3), elements=st.floats(1e-4, 1.0)), st.floats(0.11, 3.0))
@settings(max_examples=30)
def test_no_colours_drive_it_past_its_rate_and_its_bounds(colours: Float, dt_s: float) -> None:
    drift = ColourDrift(COLOURS)
    last = drift.log_gains
    for k, colour in enumerate(colours):
        drift.push(colour, ONES, round(k * dt_s * 1e9))
        now = drift.log_gains
        assert np.isfinite(now).all()
        moved = [*against_green(now - last), now[1] - last[1]]
        assert np.abs(moved).max() <= RATE_PER_S * min(dt_s, 0.5) + 1e-9
        assert abs(now[1]) <= np.log(LIMIT_EXPOSURE) + 1e-9
        assert (np.abs(against_green(now)) <= np.log([LIMIT_BLUE, LIMIT_RED]) + 1e-9).all()
        last = now


def test_it_settles_and_says_when_it_stands_at_a_bound() -> None:
    drift = ColourDrift(COLOURS)
    for k in range(200):
        drift.push(COLOURS * np.exp([-0.3, 0.0, 0.2]), ONES, k * SECOND // 10)
    np.testing.assert_allclose(drift.log_gains, [-0.3, 0.0, 0.2], atol=0.01)
    assert not at_bound(drift.log_gains)
    for k in range(200, 500):
        drift.push(COLOURS * [0.15, 1.0, 1.0], ONES, k * SECOND // 10)
    assert at_bound(drift.log_gains)


def test_following_takes_its_time_constant() -> None:
    drift = ColourDrift(COLOURS)
    for k in range(11):  # the first look only starts the clock
        drift.push(COLOURS * np.exp([0.1, 0.0, 0.0]), ONES, k * SECOND // 10)
    # One second: 1 - 1/e of the way, a little less for what was known before.
    assert against_green(drift.log_gains)[0] == pytest.approx(0.1 * (1.0 - np.exp(-1.0)), abs=0.008)


def test_looks_that_follow_too_closely_are_left_out() -> None:
    drift = ColourDrift(COLOURS)
    looks = [drift.push(COLOURS, ONES, k * 16_666_667) is not None for k in range(7)]
    assert looks == [True, *[False] * 5, True]


@pytest.mark.parametrize(
    "reference", [np.ones((6, 2)), np.zeros((6, 3)), np.full((6, 3), np.nan), np.ones(3)]
)
def test_a_reference_that_is_none_is_refused(reference: Float) -> None:
    with pytest.raises(ValueError, match="reference"):
        ColourDrift(reference)


@given(st.tuples(*[st.floats(0.4, 2.5)] * 3))
@settings(max_examples=8, deadline=None)
def test_a_white_balanced_table_sees_the_picture_as_it_was(factors: tuple[float, float, float]) -> None:
    table = TABLE
    tables = gain_tables(factors)
    image = np.random.default_rng(5).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    before = np.ascontiguousarray(np.stack([tables[k][image[..., k]] for k in range(3)], axis=-1))
    np.testing.assert_array_equal(table.white_balanced(tables).codes(image), table.codes(before))
    assert set(np.unique(table.white_balanced(tables).codes(image))) <= set(np.unique(table.codes(before)))


def test_a_white_balanced_table_scans_the_colours_that_it_has() -> None:
    image = np.random.default_rng(6).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    white_balanced = TABLE.white_balanced(gain_tables((1.3, 0.8, 1.0))).white_balanced(
        gain_tables((0.9, 1.1, 1.2))
    )
    coarse = white_balanced.codes(image & np.uint8(0xF8))
    assert np.count_nonzero(coarse)
    for dx, dy in ((0, 0), (1, 2), (2, 1)):
        np.testing.assert_array_equal(white_balanced.scan(image, 3, dx, dy), coarse[dy::3, dx::3][:13, :20])


def test_a_white_balanced_table_of_a_white_balanced_table_maps_twice() -> None:
    first, second = gain_tables((1.3, 0.8, 1.0)), gain_tables((0.9, 1.1, 1.2))
    image = np.random.default_rng(7).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    before = np.stack([first[k][second[k][image[..., k]]] for k in range(3)], axis=-1)
    np.testing.assert_array_equal(
        TABLE.white_balanced(first).white_balanced(second).codes(image), TABLE.codes(before)
    )


def test_a_light_that_changes_makes_no_second_table() -> None:
    tracemalloc.start()
    try:
        white_balanced = [TABLE.white_balanced(gain_tables((1.0 + 0.1 * k, 1.0, 1.0))) for k in range(4)]
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert all(np.shares_memory(one.entries, TABLE.entries) for one in white_balanced)
    assert (
        most < len(white_balanced) * TABLE.entries.nbytes / 6
    )  # addresses; of the memory, an eighth of that


TABLE = ColourTable([painted.RANGES[name] for name in painted.NAMES])


def test_hues_are_those_of_opencv() -> None:
    colours = np.random.default_rng(3).random((1, 500, 3))
    code = np.where(colours <= 0.0031308, 12.92 * colours, 1.055 * colours ** (1 / 2.4) - 0.055).astype(
        np.float32
    )
    theirs = np.asarray(cv2.cvtColor(code, cv2.COLOR_BGR2HSV), dtype=np.float64) * [0.5, 255.0, 255.0]
    np.testing.assert_allclose(hsv(colours), theirs, atol=0.02)
    np.testing.assert_array_equal(hsv(np.array([0.5, 0.5, 0.5]))[:2], 0.0)


BAND = {
    "a": HsvRange(hsv_low=(60, 80, 60), hsv_high=(80, 255, 255)),
    "b": HsvRange(hsv_low=(170, 80, 60), hsv_high=(10, 255, 255)),  # through 0
}


def of_hsv(*colours: tuple[float, float, float]) -> Float:
    pixels = np.array([[(2.0 * h, s / 255.0, v / 255.0) for h, s, v in colours]], np.float32)
    code = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_HSV2BGR), dtype=np.float64)[0]
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def watched(watch: ColourMonitor, seconds: float, light: Float, begin_s: float = 0.0) -> list[str | None]:
    marks: list[str | None] = []
    for k in range(round(seconds * 20)):
        t_ns = round((begin_s + k / 20) * 1e9)
        marks = [warning.marker for warning in watch.push(light, np.ones(len(light)), t_ns)]
    return marks


def test_room_is_counted_to_the_nearest_border_also_through_zero() -> None:
    watch = ColourMonitor(("a", "b"), BAND)
    assert watched(watch, 1.0, of_hsv((70, 200, 200), (177, 200, 200))) == []
    # a: 10 hues to either side, b: 7 to its low one; the smallest believed spread is 1.5 hues.
    np.testing.assert_allclose(watch.room(), [10.0 / 1.5, 7.0 / 1.5], atol=0.05)


@pytest.mark.parametrize(
    ("colour", "warned"),
    [
        ((70, 200, 200), False),
        ((78, 200, 200), True),
        ((62, 200, 200), True),
        ((70, 92, 200), True),
        ((70, 200, 70), True),
    ],
)
def test_a_colour_near_a_border_is_warned_of_while_it_is_inside(
    colour: tuple[float, float, float], *, warned: bool
) -> None:
    watch = ColourMonitor(("a", "b"), BAND)
    assert watched(watch, 1.0, of_hsv(colour, (0, 200, 200))) == (["a"] if warned else [])
    assert watch.room()[0] > 0.0


def test_a_warning_names_the_marker_and_the_fix_and_ends_only_when_there_is_room_again() -> None:
    watch = ColourMonitor(("a", "b"), BAND)
    other = (0, 200, 200)
    watched(watch, 1.0, of_hsv((77.5, 200, 200), other))
    text = watch.push(of_hsv((77.5, 200, 200), other), np.ones(2), SECOND)[0].text
    assert "marker a" in text
    assert "calibrate the colours" in text
    assert watched(watch, 3.0, of_hsv((76.0, 200, 200), other), 1.1) == ["a"]  # 2.7 spreads
    assert watched(watch, 5.0, of_hsv((70.0, 200, 200), other), 4.2) == []


def test_a_warning_stays_while_the_marker_is_lost() -> None:
    watch = ColourMonitor(("a", "b"), BAND)
    watched(watch, 1.0, of_hsv((78, 200, 200), (0, 200, 200)))
    lost = of_hsv((78, 200, 200), (0, 200, 200))
    lost[0] = np.nan
    assert watched(watch, 2.0, lost, 1.1) == ["a"]


def test_two_paints_that_come_to_look_alike_are_named() -> None:
    near = {"a": BAND["a"], "c": HsvRange(hsv_low=(81, 80, 60), hsv_high=(99, 255, 255))}
    watch = ColourMonitor(("a", "c"), near)
    watched(watch, 1.0, of_hsv((75, 200, 200), (81, 200, 200)))
    texts = [
        warning.text for warning in watch.push(of_hsv((75, 200, 200), (81, 200, 200)), np.ones(2), SECOND)
    ]
    assert any("a and c look alike" in text for text in texts)
    watch = ColourMonitor(("a", "c"), near)
    assert watched(watch, 1.0, of_hsv((70, 200, 200), (90, 200, 200))) == []
