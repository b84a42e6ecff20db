"""The device's own light in a frame: never below 0, black level gone, nothing told where ambient light saturates."""

import numpy as np
import pytest

from slave.wrist.strobe import lit


def test_the_difference_saturates_at_zero_and_the_black_level_cancels() -> None:
    ambient = np.array([[2, 2, 40, 200]], np.uint8)
    frame = np.array([[2, 90, 30, 255]], np.uint8)
    np.testing.assert_array_equal(lit(frame, ambient), [[0, 88, 0, 55]])


def test_where_ambient_light_saturates_nothing_is_lit() -> None:
    ambient = np.full((4, 6), 255, np.uint8)
    for level in (0, 128, 255):
        assert not lit(np.full((4, 6), level, np.uint8), ambient).any()


def test_the_frames_are_left_as_they_are() -> None:
    ambient, frame = np.full((3, 3), 7, np.uint8), np.full((3, 3), 9, np.uint8)
    ambient.setflags(write=False)
    frame.setflags(write=False)
    assert lit(frame, ambient).dtype == np.uint8
    assert (ambient == 7).all()
    assert (frame == 9).all()


def test_frames_of_two_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(2, 3\).*\(2, 4\)"):
        lit(np.zeros((2, 3), np.uint8), np.zeros((2, 4), np.uint8))
