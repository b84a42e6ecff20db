"""Count what the loop of a tracker does, for `Health`, beside what the tracker itself tells."""

import numpy as np

from common.messages import TrackerPose
from slave.counters import Counters
from slave.sources import Reporting


class PoseCounters:
    """Counts poses for `Health`. Holds the counters, and whether the newest pose was one."""

    def __init__(self, source: object = None) -> None:
        """Count from nothing, beside what the source tells, if it tells anything."""
        self._counters = Counters(())
        self._source = source if isinstance(source, Reporting) else None
        self._nowhere = 0
        self._tracked = False

    def pose(self, pose: TrackerPose) -> None:
        """Count one pose."""
        self._tracked = bool(np.isfinite(pose.position_m).all())
        self._nowhere += not self._tracked
        self._counters.part(pose.seq)

    def counts(self) -> dict[str, int]:
        """Event -> how often: poses; skipped; nowhere, those of NaN; lost, back and what else the source counts."""
        counts = self._counters.counts()
        found = {"poses": counts["frames"], "skipped": counts["dropped"], "nowhere": self._nowhere}
        return found if self._source is None else found | dict(self._source.counts())

    def metrics(self) -> dict[str, float]:
        """rate_hz since the last call; tracked (1: yes); those of the source."""
        metrics = {"rate_hz": self._counters.metrics()["rate_hz"], "tracked": float(self._tracked)}
        return metrics if self._source is None else metrics | dict(self._source.metrics())
