import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slave.markers.classify import FULL, MAX_CANDIDATES, find_blobs


def test_a_rectangle_gives_its_area_centroid_and_box_in_full_pixels() -> None:
    codes = np.zeros((60, 80), np.uint8)
    codes[10:14, 20:26] = 2
    (first, second) = find_blobs(codes, (1, 2), 4, 2, 1)
    assert first == []
    (blob,) = second
    assert (blob.u, blob.v, blob.area) == (2 + 4 * 22.5, 1 + 4 * 11.5, 16.0 * 24)
    # As wide as the grid leaves open: the points before the first and after the last are not of its colour.
    assert (blob.left, blob.top, blob.right, blob.bottom) == (2 + 77, 1 + 37, 2 + 104, 1 + 56)


def test_a_pixel_of_two_colours_belongs_to_both() -> None:
    codes = np.zeros((60, 80), np.uint8)
    codes[10:12, 20:22] = 3
    assert [len(b) for b in find_blobs(codes, (1, 2, 4))] == [1, 1, 0]


def test_colours_that_touch_do_not_join_and_a_fringe_does_not_split() -> None:
    codes = np.zeros((60, 80), np.uint8)
    codes[10:20, 10:20] = 1
    codes[15, 12:18] = 2  # a hue fringe across the blob, of another class
    codes[10:20, 15] = 1
    blobs = find_blobs(codes, (1, 2))
    assert blobs[0][0].area == 16.0 * (100 - 5)


@given(st.integers(0, 2**32 - 1), st.sampled_from([np.uint8, np.uint16, np.uint32]))
def test_total_area_is_the_number_of_set_pixels(seed: int, kind: type[np.unsignedinteger]) -> None:
    rng = np.random.default_rng(seed)
    codes = np.zeros((31, 47), kind)  # not a multiple of the 8-byte words that are skipped
    for _ in range(3):
        y, x = rng.integers(0, 28), rng.integers(0, 44)
        codes[y : y + 3, x : x + 3] = 1
    (blobs,) = find_blobs(codes, (1,))
    assert sum(b.area for b in blobs) == 16.0 * np.count_nonzero(codes)
    assert [b.area for b in blobs] == sorted((b.area for b in blobs), reverse=True)


def test_nothing_gives_nothing_and_specks_are_capped_to_the_largest() -> None:
    assert find_blobs(np.zeros((20, 20), np.uint8), (1, 2)) == [[], []]
    codes = np.zeros((40, 40), np.uint8)
    codes[::4, ::4] = 1
    codes[1, 0] = 1
    (blobs,) = find_blobs(codes, (1,))
    assert len(blobs) == MAX_CANDIDATES
    assert blobs[0].area == 32.0


def test_scattered_points_are_distinguished_and_compact_ones_are_one_blob() -> None:
    codes = np.zeros((60, 80), np.uint8)
    codes[10:13, 10:13] = 1
    codes[10:13, 40:43] = 1
    (apart,) = find_blobs(codes, (1,))
    assert [b.area for b in apart] == [16.0 * 9] * 2
    y, x = np.mgrid[0:60, 0:80]
    disc = (x - 40) ** 2 + (y - 30) ** 2 <= 36
    assert disc.sum() / 13**2 > FULL
    (one,) = find_blobs(disc.astype(np.uint8), (1,))
    assert [(b.u, b.v, b.area) for b in one] == [(160.0, 120.0, 16.0 * disc.sum())]


def test_a_skin_bit_is_no_marker() -> None:
    codes = np.zeros((60, 80), np.uint8)
    codes[10:20, 10:20] = 4
    assert find_blobs(codes, (1, 2)) == [[], []]
