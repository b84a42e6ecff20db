"""Tests of what belongs together: blobs as the scan's finer grids report them."""

from slave.markers.classify import Blob
from slave.markers.group import candidate, choose


def _cap(marker: int, u: float) -> tuple[int, Blob, float]:
    return marker, Blob(u, 100.0, 60.0, int(u) - 5, 95, int(u) + 5, 105), 0.5


def test_a_blob_of_one_column_is_judged_like_any_other() -> None:
    """The finer grid leaves its box as wide as the slack of the usual one."""
    caps = [candidate(*_cap(m, 60.0 + 20.0 * m), fringe=False, bonus=0.0) for m in range(4)]
    line = candidate(4, Blob(136.0, 96.0, 16.0, 135, 91, 138, 101), 0.0, fringe=False, bonus=0.0)
    chosen = choose([*caps, line])
    assert [chosen[m] for m in range(4)] == caps
