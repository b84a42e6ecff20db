"""Limit how often something may happen: a token bucket."""


class TokenBucket:
    """Token bucket that bounds how many messages are taken.

    Holds how many may come now, and when it was last asked.
    """

    def __init__(self, per_s: float, at_once: float) -> None:
        """So many a second, of which `at_once` may come together."""
        self._per_s = per_s
        self._most = self._left = at_once
        self._t_ns: int | None = None

    def take(self, t_ns: int) -> bool:
        """Whether a message that came at `t_ns` [ns] is within the rate."""
        elapsed_ns = 0 if self._t_ns is None else max(t_ns - self._t_ns, 0)
        self._t_ns = t_ns
        self._left = min(self._left + self._per_s * elapsed_ns * 1e-9, self._most)
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
