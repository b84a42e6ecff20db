"""Counter increments over the last second or so.

The counters only rise; the increments show what happens now, not since the start.
"""

from collections import deque


class Window:
    """Push machine that holds recent snapshots of counters.

    It keeps the snapshots of the last `span_ns` and one before.
    """

    def __init__(self, span_ns: int) -> None:
        """Look back so far [ns]."""
        self._span_ns = span_ns
        self._looks: deque[tuple[int, tuple[int, ...]]] = deque()

    def push(self, t_ns: int, *counters: int) -> None:
        """Add a snapshot of the counters.

        A counter that has fallen belongs to another process, so the window then starts again.
        """
        if self._looks and any(now < old for now, old in zip(counters, self._looks[-1][1], strict=True)):
            self._looks.clear()
        self._looks.append((t_ns, counters))
        while len(self._looks) > 2 and t_ns - self._looks[1][0] >= self._span_ns:
            self._looks.popleft()

    def clear(self) -> None:
        """Forget: what comes next has nothing to do with it."""
        self._looks.clear()

    @property
    def full(self) -> bool:
        """Whether it reaches back as far as it is to."""
        return bool(self._looks) and self._looks[-1][0] - self._looks[0][0] >= self._span_ns

    @property
    def seconds(self) -> float:
        """How far it reaches back [s]."""
        return 1e-9 * (self._looks[-1][0] - self._looks[0][0]) if self._looks else 0.0

    def increase(self) -> tuple[int, ...]:
        """By how much each counter rose in it; () before the first look."""
        if not self._looks:
            return ()
        return tuple(now - old for now, old in zip(self._looks[-1][1], self._looks[0][1], strict=True))

    @property
    def moved(self) -> bool:
        """Whether the first counter rose since the look before."""
        return len(self._looks) > 1 and self._looks[-1][1][0] > self._looks[-2][1][0]
