"""Where the time goes: mean duration of each named stage, measured from outside the pure code."""

from collections.abc import Callable, Generator
from contextlib import contextmanager

from common.clock import now_ns


class StageTimes:
    """Sums durations by stage name."""

    def __init__(self, now_ns: Callable[[], int] = now_ns) -> None:
        """Measure with `now_ns`: time that passes, or `time.thread_time_ns`, what the processor spends."""
        self._now_ns = now_ns
        self._total_ns: dict[str, int] = {}
        self._count: dict[str, int] = {}

    @contextmanager
    def __call__(self, name: str) -> Generator[None]:
        """Measure one passage through stage `name`."""
        start = self._now_ns()
        try:
            yield
        finally:
            self._total_ns[name] = self._total_ns.get(name, 0) + self._now_ns() - start
            self._count[name] = self._count.get(name, 0) + 1

    def mean_us(self) -> dict[str, float]:
        """Mean duration by stage [us], in the order of first use."""
        return {name: round(total / self._count[name] / 1e3, 1) for name, total in self._total_ns.items()}

    def total_us(self) -> dict[str, float]:
        """All durations of each stage together [us], in the order of first use."""
        return {name: total / 1e3 for name, total in self._total_ns.items()}
