"""Tests of what belongs together: blobs as the scan's finer grids report them."""

from slave.markers.classify import Blob
from slave.markers.group import Candidate, candidate, choose, choose_all


def _cap(marker: int, u: float) -> tuple[int, Blob, float]:
    return marker, Blob(u, 100.0, 60.0, int(u) - 5, 95, int(u) + 5, 105), 0.5


def test_a_blob_of_one_column_is_judged_like_any_other() -> None:
    """The finer grid leaves its box as wide as the slack of the usual one."""
    caps = [candidate(*_cap(m, 60.0 + 20.0 * m), fringe=False, bonus=0.0) for m in range(4)]
    line = candidate(4, Blob(136.0, 96.0, 16.0, 135, 91, 138, 101), 0.0, fringe=False, bonus=0.0)
    chosen = choose([*caps, line])
    assert [chosen[m] for m in range(4)] == caps


def test_hands_painted_alike_are_both_chosen_and_one_stray_blob_is_not() -> None:
    def at(marker: int, u: float, v: float) -> Candidate:
        blob = Blob(u, v, 200.0, int(u) - 7, int(v) - 7, int(u) + 8, int(v) + 8)
        return candidate(marker, blob, 0.5, False, 0.0)

    first = [at(m, 100.0 + 25.0 * m, 100.0) for m in range(4)]
    second = [at(m, 400.0 - 25.0 * m, 120.0) for m in range(4)]
    slots = dict.fromkeys(range(4), 2)
    found = choose_all([*first, *second], slots)
    assert sorted((c.marker, c.blob.u) for c in found) == sorted(
        (c.marker, c.blob.u) for c in [*first, *second]
    )
    assert len(choose_all([*first, *second], {})) == 4, "of one hand each marker is one blob"
    assert len(choose_all([*first, at(2, 500.0, 300.0)], slots)) == 4, "a lone blob is no hand"
