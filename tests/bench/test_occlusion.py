"""What the occlusion bench counts, on cases worked out by hand."""

import numpy as np

from bench.cameras.occlusion import Unseen


def test_a_tip_is_unseen_where_fewer_than_two_cameras_see_it() -> None:
    cameras = np.array([[2, 2, 2, 2, 2], [0, 1, 2, 3, 4], [4, 1, 4, 4, 4], [2, 4, 3, 2, 2]])
    assert Unseen.of(cameras) == Unseen(tips=3 / 20, moments=2 / 4, none=1 / 20, one=2 / 20)
