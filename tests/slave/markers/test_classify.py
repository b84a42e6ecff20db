import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.calibration import HsvRange
from common.errors import CalibrationError
from slave.markers.classify import SKIN, ColourTable, in_range, table_of
from tests.slave.painted import NAMES, RANGES

WRAPPED = HsvRange(hsv_low=(170, 60, 50), hsv_high=(8, 255, 255))
PLAIN = HsvRange(hsv_low=(40, 30, 20), hsv_high=(90, 200, 240))
TABLE = ColourTable([WRAPPED, PLAIN])


def by_opencv(image: np.ndarray, colour: HsvRange) -> np.ndarray:
    """cvtColor + inRange, the published way, with hue wrapping done as two ranges."""
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    low, high = colour.hsv_low, colour.hsv_high
    if low[0] <= high[0]:
        return cv2.inRange(hsv, low, high) != 0
    upper = cv2.inRange(hsv, low, (179, *high[1:]))
    lower = cv2.inRange(hsv, (0, *low[1:]), high)
    return np.asarray(cv2.bitwise_or(upper, lower)) != 0


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40))
def test_codes_equal_in_range_on_random_pixels(seed: int, height: int, width: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    codes = TABLE.codes(image)
    np.testing.assert_array_equal((codes & 1) != 0, by_opencv(image, WRAPPED))
    np.testing.assert_array_equal((codes & 2) != 0, by_opencv(image, PLAIN))


def test_every_one_of_the_65536_colours_of_a_plane_is_classified_as_in_range_does() -> None:
    image = np.zeros((256, 256, 3), np.uint8)
    image[..., 0], image[..., 1], image[..., 2] = np.arange(256)[None, :], np.arange(256)[:, None], 131
    for bit, colour in ((1, WRAPPED), (2, PLAIN)):
        expected = by_opencv(image, colour)
        assert expected.any()
        np.testing.assert_array_equal((TABLE.codes(image) & bit) != 0, expected)


@given(st.integers(0, 2**32 - 1), st.integers(4, 33), st.integers(4, 33), st.sampled_from([2, 4]), st.data())
def test_the_scan_sees_its_grid_in_colours_of_eight_levels(
    seed: int, height: int, width: int, step: int, data: st.DataObject
) -> None:
    dx, dy = data.draw(st.integers(0, step - 1)), data.draw(st.integers(0, step - 1))
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)
    rows, columns = dy + step * np.arange(height // step), dx + step * np.arange(width // step)
    expected = TABLE.codes(np.ascontiguousarray(image[rows][:, columns] & np.uint8(0xF8)))
    np.testing.assert_array_equal(TABLE.scan(image, step, dx, dy), expected)


def test_the_bit_after_the_last_marker_is_skin() -> None:
    image = np.random.default_rng(5).integers(0, 256, (200, 200, 3), np.uint8)
    assert TABLE.skin == 4
    np.testing.assert_array_equal((TABLE.codes(image) & TABLE.skin) != 0, by_opencv(image, SKIN))


def test_own_range_test_equals_opencv_at_the_wrap() -> None:
    image = np.random.default_rng(3).integers(0, 256, (200, 200, 3), np.uint8)
    hsv = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2HSV), dtype=np.uint8)
    np.testing.assert_array_equal(in_range(hsv, WRAPPED), by_opencv(image, WRAPPED))


def test_markers_of_one_paint_share_a_bit() -> None:
    table = ColourTable([PLAIN, WRAPPED, PLAIN])
    assert table.bits == (1, 2, 1)
    assert table.skin == 4


def test_more_than_eight_markers_get_wider_codes_and_keep_their_bits() -> None:
    ranges = [msgspec.structs.replace(PLAIN, hsv_low=(*PLAIN.hsv_low[:2], k)) for k in range(11)] + [WRAPPED]
    table = ColourTable(ranges)
    image = np.random.default_rng(4).integers(0, 256, (30, 30, 3), np.uint8)
    codes = table.codes(image)
    assert table.bits[11] == 1 << 11
    np.testing.assert_array_equal(
        (codes & np.array(table.bits[11], codes.dtype)) != 0, by_opencv(image, WRAPPED)
    )
    np.testing.assert_array_equal(
        (codes & np.array(table.bits[10], codes.dtype)) != 0, by_opencv(image, PLAIN)
    )


def test_a_missing_range_names_the_marker_and_the_command_that_makes_it() -> None:
    with pytest.raises(CalibrationError, match=r"camera 'left'.*little.*phalanx-slave colours"):
        table_of(NAMES, {n: r for n, r in RANGES.items() if n != "little"}, "camera 'left'")
    with pytest.raises(CalibrationError, match="thumb"):
        table_of(NAMES, None, "camera 'left'")


def test_no_range_and_too_many_ranges_are_refused() -> None:
    with pytest.raises(ValueError, match="0 colour ranges"):
        ColourTable([])
    with pytest.raises(ValueError, match="64 colour ranges"):
        ColourTable([PLAIN] * 64)
