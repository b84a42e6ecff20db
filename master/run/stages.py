"""Mean duration of each named stage.

Shows where the time goes; measured from outside the pure code.
"""

import time
from collections.abc import Callable


class StageTimes:
    """Sums durations by stage name."""

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Measure with the clock `now_ns`.

        Time that passes, or `time.thread_time_ns`, the processor time spent.
        """
        self._now_ns = now_ns
        self._stages: dict[str, StageTime] = {}

    def __call__(self, name: str) -> "StageTime":
        """Return what measures passages through stage `name`."""
        stage = self._stages.get(name)
        if stage is None:
            stage = self._stages[name] = StageTime(self._now_ns)
        return stage

    def mean_us(self) -> dict[str, float]:
        """Mean duration by stage [us], in the order of first use."""
        return {
            name: round(one.total_ns / one.count / 1e3, 1) for name, one in self._stages.items() if one.count
        }

    def total_us(self) -> dict[str, float]:
        """All durations of each stage together [us], in the order of first use."""
        return {name: one.total_ns / 1e3 for name, one in self._stages.items() if one.count}


class StageTime:
    """Sums the durations of one stage, which is never entered twice at once."""

    __slots__ = ("_began_ns", "_now_ns", "count", "total_ns")

    def __init__(self, now_ns: Callable[[], int]) -> None:
        """Begin with none."""
        self._now_ns, self._began_ns, self.count, self.total_ns = now_ns, 0, 0, 0

    def __enter__(self) -> None:
        """Begin to measure."""
        self._began_ns = self._now_ns()

    def __exit__(self, *_: object) -> None:
        """Add the time since."""
        self.total_ns += self._now_ns() - self._began_ns
        self.count += 1
