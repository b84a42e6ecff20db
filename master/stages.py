"""Where the time goes: mean duration of each named stage, measured from outside the pure code."""

from collections.abc import Generator
from contextlib import contextmanager

from common.clock import now_ns


class StageTimes:
    """Sums durations by stage name."""

    def __init__(self) -> None:
        self._total_ns: dict[str, int] = {}
        self._count: dict[str, int] = {}

    @contextmanager
    def __call__(self, name: str) -> Generator[None]:
        """Measure one passage through stage `name`."""
        start = now_ns()
        try:
            yield
        finally:
            self._total_ns[name] = self._total_ns.get(name, 0) + now_ns() - start
            self._count[name] = self._count.get(name, 0) + 1

    def mean_us(self) -> dict[str, float]:
        """Mean duration by stage [us], in the order of first use."""
        return {name: round(total / self._count[name] / 1e3, 1) for name, total in self._total_ns.items()}
