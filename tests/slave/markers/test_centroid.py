import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.arrays import Image
from slave.markers.centroid import PAD, Measured, measure
from slave.markers.classify import SCALE, Blob, ColourTable, find_blobs, with_fragments
from tests.slave.painted import DESK, RANGES, SKIN, Disc, finger, marker_hsv, render

TABLE = ColourTable(list(RANGES.values()))
FAR = math.inf


def measured(image: Image, marker: int, extent: float = FAR, whole: float = math.nan) -> Measured:
    options = find_blobs(TABLE.scan(image, SCALE), TABLE.bits)[marker]
    blob, _ = with_fragments(options[0], options, extent, whole)
    (result,) = measure(image, TABLE, [TABLE.bits[marker]], [blob], [len(options) == 1])
    assert result is not None
    return result


def assert_each_as_alone(image: Image, blobs: list[Blob], tolerance: float) -> None:
    """Every blob, blob m of marker m, measured in one stack with the others and in a window of its own."""
    together = measure(image, TABLE, TABLE.bits, blobs, [True] * len(blobs))
    for bit, blob, one in zip(TABLE.bits, blobs, together, strict=True):
        (alone,) = measure(image, TABLE, [bit], [blob], [True])
        assert alone is not None
        assert one is not None
        assert (one.u, one.v, one.area) == pytest.approx((alone.u, alone.v, alone.area), abs=tolerance)


@settings(max_examples=40)
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(4.0, 14.0), st.integers(0, 5))
def test_a_disc_on_the_desk_is_found_to_a_twentieth_of_a_pixel(
    du: float, dv: float, r: float, m: int
) -> None:
    seen = measured(render([Disc(marker_hsv(m), 60.0 + du, 50.0 + dv, r)], 120, 100), m)
    assert math.hypot(seen.u - 60.0 - du, seen.v - 50.0 - dv) < 0.05
    assert seen.area == pytest.approx(math.pi * r * r, rel=0.04)


def test_noise_of_two_grey_levels_costs_less_than_a_tenth_of_a_pixel() -> None:
    errors = []
    for k in range(30):
        u, v = 60.0 + 0.03 * k, 50.0 - 0.02 * k
        seen = measured(render([Disc(marker_hsv(k % 6), u, v, 7.0)], 120, 100, noise=2.0, seed=k), k % 6)
        errors.append((seen.u - u, seen.v - v))
    assert np.sqrt(np.mean(np.square(errors))) < 0.1


@pytest.mark.parametrize("m", range(6))
def test_skin_on_one_side_and_table_on_the_other_do_not_move_the_centroid(m: int) -> None:
    seen = measured(render(finger(m, 60.3, 50.4, 8.0), 120, 100), m)
    assert math.hypot(seen.u - 60.3, seen.v - 50.4) < 0.12


def test_a_white_highlight_inside_does_not_move_the_centroid() -> None:
    scene = [Disc(marker_hsv(2), 60.3, 50.4, 10.0), Disc((0, 0, 255), 57.0, 47.0, 1.5)]
    seen = measured(render(scene, 120, 100), 2)
    assert math.hypot(seen.u - 60.3, seen.v - 50.4) < 0.05


def test_something_in_front_splits_the_marker_and_both_parts_count() -> None:
    scene = [Disc(marker_hsv(5), 60.0, 50.0, 14.0)]
    image = render(scene, 120, 100)
    image[:, 58:63] = render([], 120, 100)[:, 58:63]  # a stick of the desk's colour across it
    seen = measured(image, 5, extent=40.0, whole=math.pi * 14.0**2)
    columns = np.r_[46:58, 63:75]
    heights = 2.0 * np.sqrt(np.maximum(14.0**2 - (columns - 60.0) ** 2, 0.0))
    assert seen.u == pytest.approx((columns * heights).sum() / heights.sum(), abs=0.15)
    assert seen.area == pytest.approx(heights.sum(), rel=0.06)


def test_fragments_farther_apart_than_the_marker_is_wide_are_not_joined() -> None:
    scene = [Disc(marker_hsv(5), 50.0, 50.0, 10.0), Disc(marker_hsv(5), 71.0, 50.0, 4.0)]
    image = render(scene, 120, 100)
    assert measured(image, 5, extent=32.0).u == pytest.approx(50.0, abs=0.1)
    assert measured(image, 5, extent=FAR).u > 51.0


def test_another_marker_next_to_it_counts_as_nothing() -> None:
    alone = measured(render([Disc(marker_hsv(2), 60.0, 50.0, 8.0)], 120, 100), 2)
    flanked = measured(
        render([Disc(marker_hsv(2), 60.0, 50.0, 8.0), Disc(marker_hsv(4), 77.0, 50.0, 8.0)], 120, 100), 2
    )
    assert flanked.u == pytest.approx(alone.u, abs=0.1)


def test_the_same_in_a_stack_as_alone() -> None:
    scene = [Disc(marker_hsv(m), 40.0 + 45.0 * m, 50.0, 5.0 + m) for m in range(6)]
    image = render(scene, 320, 100)
    blobs = [b[0] for b in find_blobs(TABLE.scan(image, SCALE), TABLE.bits)]
    assert_each_as_alone(image, blobs, 1e-3)


@pytest.mark.parametrize(("u", "v"), [(2.0, 50.0), (118.0, 50.0), (60.0, 1.0), (60.0, 98.0), (0.0, 0.0)])
def test_at_the_border_the_visible_part_is_measured_and_flagged(u: float, v: float) -> None:
    seen = measured(render([Disc(marker_hsv(1), u, v, 9.0)], 120, 100), 1)
    assert seen.cut
    x, y = np.meshgrid(np.arange(120.0), np.arange(100.0))
    visible = (x - u) ** 2 + (y - v) ** 2 <= 81.0
    assert math.hypot(seen.u - x[visible].mean(), seen.v - y[visible].mean()) < 0.3
    assert not measured(render([Disc(marker_hsv(1), 60.0, 50.0, 9.0)], 120, 100), 1).cut


def test_a_colour_fringe_is_thin_and_has_foreign_neighbours() -> None:
    # Between green and skin the hue runs through the yellow of the back's paint.
    image = render([Disc(SKIN, 60.0, 60.0, 14.0), Disc(marker_hsv(1), 60.0, 50.0, 12.0)], 120, 100)
    image[56:58, 50:70] = render([Disc(marker_hsv(5), 60.0, 57.0, 30.0)], 120, 100)[56:58, 50:70]
    seen = measured(image, 5)
    assert seen.thin
    assert seen.foreign > 0.2


def test_an_empty_window_gives_none() -> None:
    image = render([], 120, 100)
    blob = Blob(60.0, 50.0, 40.0, 56, 46, 64, 54)
    assert measure(image, TABLE, [1], [blob], [True]) == [None]
    assert measure(image, TABLE, [], [], []) == []


def test_a_marker_of_23000_px_at_20_cm_is_measured() -> None:
    image = render([], 640, 480)
    image[150:276, 240:424] = render([Disc(marker_hsv(1), 320.0, 240.0, 300.0)], 640, 480)[150:276, 240:424]
    seen = measured(image, 1)
    assert (seen.u, seen.v) == pytest.approx((331.5, 212.5), abs=0.02)
    assert seen.area == pytest.approx(184 * 126, rel=0.01)


def test_the_desk_is_no_paint() -> None:
    codes = TABLE.codes(render([Disc(DESK, 60.0, 50.0, 20.0), Disc(SKIN, 30.0, 30.0, 10.0)], 120, 100))
    assert set(np.unique(codes)) == {0, TABLE.skin}


def test_specks_at_the_border_of_a_window_do_not_reach_into_the_next() -> None:
    scene = [Disc(marker_hsv(m), 40.0 + 45.0 * m, 50.0, 7.0) for m in range(6)]
    image = render(scene, 320, 100)
    blobs = [b[0] for b in find_blobs(TABLE.scan(image, SCALE), TABLE.bits)]
    for m, blob in enumerate(blobs):
        colour = image[50, 40 + 45 * m]
        image[blob.bottom + PAD - 3 : blob.bottom + PAD, blob.left : blob.right] = colour
        image[blob.top - PAD : blob.top - PAD + 3, blob.left : blob.right] = colour
    assert_each_as_alone(image, blobs, 1e-4)
