"""How often a slave may look for tags: so that markers are hardly ever late for them, and tags never forgotten."""

SHARE = 0.8  # of the time between two frames that markers and tags together may take
LEARNING = 0.2  # weight of the newest search in what one is expected to take
LONGEST_NS = 250_000_000  # without a search: half of what an object is held for without its tags


class Pace:
    """Grants searches out of the time that frames leave. Holds what is left [ns], what a search takes [ns], and the
    times of the last frame and the last search.

    What a frame leaves of its share of the time since the frame before is saved until a search fits into it, and no
    more than one search is saved up: so a machine that is too slow for tags in every frame looks at every second or
    fifth. One whose markers take all the time there is looks four times a second all the same.
    """

    def __init__(self, rate_hz: float) -> None:
        """For a camera of this rate."""
        self._period_ns = 1e9 / rate_hz
        self._left_ns = 0.0
        self._takes_ns = 0.0
        self._frame_ns: int | None = None
        self._sought_ns: int | None = None

    @property
    def takes_ns(self) -> float:
        """What a search takes of late [ns]."""
        return self._takes_ns

    def grants(self, t_ns: int, spent_ns: int) -> bool:
        """Whether tags may be sought in a frame of time `t_ns`, whose markers took `spent_ns`."""
        since_ns = (
            self._period_ns if self._frame_ns is None else max(float(t_ns - self._frame_ns), self._period_ns)
        )
        self._frame_ns = t_ns
        most = max(self._takes_ns, SHARE * self._period_ns)
        self._left_ns = min(max(self._left_ns + SHARE * since_ns - spent_ns, -most), most)
        late = self._sought_ns is None or t_ns - self._sought_ns >= LONGEST_NS
        granted = late or self._left_ns >= self._takes_ns
        if granted:
            self._sought_ns = t_ns
        return granted

    def took(self, spent_ns: int) -> None:
        """A search took so long."""
        self._left_ns -= spent_ns
        known = self._takes_ns > 0.0
        self._takes_ns += (spent_ns - self._takes_ns) * (LEARNING if known else 1.0)
