"""Time window of a source that is exported.

It goes from and to a time, in seconds after the source's beginning.
"""

from dataclasses import dataclass, fields, replace
from math import isfinite
from typing import Any, TypeVar

import numpy as np

from common.arrays import Bool, Int
from common.errors import PhalanxError
from master.outputs.poses import Poses
from master.outputs.result_files import Contacts, ObjectPoses

_Table = TypeVar("_Table", Poses, ObjectPoses, Contacts)


@dataclass(frozen=True, slots=True)
class Window:
    """A part of time.

    Attributes:
        from_s, to_s: Seconds after the source's beginning, both included; None: from there on, until its end.
    """

    from_s: float | None = None
    to_s: float | None = None

    def __post_init__(self) -> None:
        """Refuse what holds nothing.

        Raises:
            PhalanxError: Its end is before its beginning, or one of them is no number.
        """
        for option, value in (("--from", self.from_s), ("--until", self.to_s)):
            if value is not None and not isfinite(value):
                raise PhalanxError(f"{option} {value}: give seconds, or leave it out")
        if self.from_s is not None and self.to_s is not None and self.to_s < self.from_s:
            raise PhalanxError(f"--until {self.to_s:g} is before --from {self.from_s:g}")

    def span_ns(self, begin_t_ns: int) -> tuple[int | None, int | None]:
        """First and last time [ns]."""
        first, last = (
            None if one is None else begin_t_ns + round(one * 1e9) for one in (self.from_s, self.to_s)
        )
        return first, last

    def inside(self, t_ns: Int, begin_t_ns: int) -> Bool:
        """Which times (T,) [ns] are in it."""
        first, last = self.span_ns(begin_t_ns)
        good = np.ones(len(t_ns), np.bool_)
        if first is not None:
            good &= t_ns >= first
        if last is not None:
            good &= t_ns <= last
        return good

    def of(self, table: _Table, begin_t_ns: int) -> _Table:
        """The rows of a table that are in it."""
        good = self.inside(table.t_ns, begin_t_ns)
        if good.all():
            return table
        arrays: dict[str, Any] = {
            one.name: getattr(table, one.name)[good]
            for one in fields(table)
            if one.name not in ("hand", "object")
        }
        return replace(table, **arrays)
