"""What an epoch rests on: the rows of its markers, counted."""

from typing import Any

from common.arrays import Bool, Float, Int
from common.kernels import kernel
from common.messages.records import record
from master.estimator.hand_tables import Mounts
from master.estimator.residuals import Observations

ON_MARKERS, ON_OTHERS, BY_MARKERS = 1, 2, 16


class Ground:
    """Counts of one epoch.

    Attributes:
        shown: (5,) fingers that are measured.
        rests: (6,) as of `Fitted`, by markers alone; of the palm where `by_markers`.
        seen: (1,) markers that have a row.
        most: (1,) the most rays of any; a marker that is placed as a point counts as two.
        numbers: (1,) numbers that are measured.
        back: (1,) whether a marker on the palm's back is seen.
        by_markers: (1,) whether they determine where the palm is.
    """

    shown: Bool
    sources: Int
    seen: Int
    most: Int
    numbers: Float
    back: Bool
    by_markers: Bool

    @classmethod
    def empty(cls) -> "Ground":
        """Scratch for one."""
        return record(
            cls,
            shown=("u1", 5),
            sources=("i8", 6),
            seen=("i8", 1),
            most=("i8", 1),
            numbers=1,
            back=("u1", 1),
            by_markers=("u1", 1),
        )


@kernel
def count_rows(mounts: Mounts, observed: Observations, boxed_out: Any) -> None:
    """Count the rows of an epoch.

    Args:
        mounts: The hand's markers.
        observed: Their rows.
        boxed_out: (1,) `Ground`, written.
    """
    out = boxed_out[0]
    out.seen[0], out.most[0], out.numbers[0], out.back[0] = 0, 0, 0.0, False
    for p in range(6):
        out.sources[p] = 0
    for m in range(mounts.finger.shape[0]):
        if not observed.seen[m]:
            continue
        f, rays = mounts.finger[m], observed.rays[m]
        out.seen[0] += 1
        out.most[0] = max(out.most[0], rays)
        out.numbers[0] += 3.0 if rays > 1 else 2.0
        out.back[0] = out.back[0] or mounts.on_back[m]
        if f >= 0:
            out.sources[f] |= ON_MARKERS | (BY_MARKERS if rays > 1 else 0)
        first_marker = 8  # bit
        out.sources[5] |= 1 << (first_marker + m)
    for f in range(5):
        out.shown[f] = out.sources[f] > 0
    back_numbers = 2.0  # a marker on the back measures where that looks, by two angles
    out.numbers[0] += back_numbers if out.back[0] else 0.0
    palm_by = 3  # markers
    out.by_markers[0] = out.seen[0] >= palm_by or (out.seen[0] == palm_by - 1 and out.back[0] > 0)
    if out.by_markers[0]:
        out.sources[5] |= ON_MARKERS | BY_MARKERS
