"""Reports of a slave about itself.

Its last reports, and what happened between two of them.
"""

from collections.abc import Mapping

from common.messages import Health


class SlaveReports:
    """Push machine over the reports of one process.

    Holds the newest report, and the one that it is compared with.

    Attributes:
        number: How many comparisons there were: a rule looks at each once.
    """

    def __init__(self) -> None:
        """Start with no report received."""
        self._now: Health | None = None
        self._before: Health | None = None
        self._came_ns = 0
        self.number = 0

    def push(self, health: Health, t_ns: int) -> None:
        """Take a report that came at `t_ns` [ns]."""
        now = self._now
        self._came_ns = t_ns
        # between two reports that are compared: an answer to a command may come just after one
        least_ns = 400_000_000
        if now is None or health.session != now.session:
            self._before = None
        elif health.t_ns - now.t_ns < least_ns:
            return
        else:
            self._before = now
            self.number += 1
        self._now = health

    def is_recent(self, t_ns: int) -> bool:
        """Return true if the newest report is recent."""
        stale_ns = 3_000_000_000  # reports come twice a second; of an older one nothing is concluded
        return self._now is not None and t_ns - self._came_ns < stale_ns

    @property
    def session(self) -> int | None:
        """Return the session of the process that sent the newest report."""
        return None if self._now is None else self._now.session

    @property
    def t_ns(self) -> int:
        """When the newest report was made, on the slave's clock [ns]; 0: there is none."""
        return 0 if self._now is None else self._now.t_ns

    @property
    def metrics(self) -> Mapping[str, float]:
        """Quantity -> value, of the newest report."""
        return {} if self._now is None else self._now.metrics

    @property
    def counts(self) -> Mapping[str, int]:
        """Event -> how often, of the newest report."""
        return {} if self._now is None else self._now.counts

    def increase(self, event: str) -> int | None:
        """Return how often an event happened between the last two reports.

        None: it is not reported, or there are no two.
        """
        if self._now is None or self._before is None or event not in self._now.counts:
            return None
        return max(self._now.counts[event] - self._before.counts.get(event, 0), 0)

    @property
    def seconds(self) -> float:
        """Between the last two reports, on the slave's clock [s]; 0: there are no two."""
        return (
            0.0 if self._now is None or self._before is None else 1e-9 * (self._now.t_ns - self._before.t_ns)
        )
