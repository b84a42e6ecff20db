"""How often a slave may look for tags, so that its markers are never late for them."""

SHARE = 0.8  # of a camera's period that markers and tags together may take
LEARNING = 0.2  # weight of the newest search in what one is expected to take


class Pace:
    """Grants searches out of the time that frames leave. Holds what is left [ns], and what a search takes [ns].

    What a frame leaves of its share of the period is saved until a search fits into it, and no more than one search is
    saved up: so a machine that is too slow for tags in every frame looks at every second or fifth.
    """

    def __init__(self, rate_hz: float) -> None:
        """For a camera of this rate."""
        self._period_ns = 1e9 / rate_hz
        self._left_ns = 0.0
        self._takes_ns = 0.0

    @property
    def takes_ns(self) -> float:
        """What a search takes of late [ns]."""
        return self._takes_ns

    def grants(self, spent_ns: int) -> bool:
        """Whether tags may be sought in a frame whose markers took `spent_ns`."""
        most = max(self._takes_ns, SHARE * self._period_ns)
        self._left_ns = min(self._left_ns + SHARE * self._period_ns - spent_ns, most)
        return self._left_ns >= self._takes_ns

    def took(self, spent_ns: int) -> None:
        """A search took so long."""
        self._left_ns -= spent_ns
        known = self._takes_ns > 0.0
        self._takes_ns += (spent_ns - self._takes_ns) * (LEARNING if known else 1.0)
