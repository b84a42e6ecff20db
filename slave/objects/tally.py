"""Count what the loop of a tracker does, for `Health`, beside what the tracker itself tells."""

import numpy as np

from common.messages import TrackerPose
from slave.imu.source import Telling
from slave.tally import Tally


class PoseTally:
    """Counts poses for `Health`. Holds the counters, and whether the newest pose was one."""

    def __init__(self, source: object = None) -> None:
        """Count from nothing, beside what the source tells, if it tells anything."""
        self._tally = Tally(())
        self._source = source if isinstance(source, Telling) else None
        self._nowhere = 0
        self._tracked = False

    def pose(self, pose: TrackerPose) -> None:
        """Count one pose."""
        self._tracked = bool(np.isfinite(pose.position_m).all())
        self._nowhere += not self._tracked
        self._tally.part(pose.seq)

    def counts(self) -> dict[str, int]:
        """Event -> how often: poses; skipped; nowhere, those of NaN; lost, back and what else the source counts."""
        counts = self._tally.counts()
        found = {"poses": counts["frames"], "skipped": counts["dropped"], "nowhere": self._nowhere}
        return found if self._source is None else found | dict(self._source.counts())

    def gauges(self) -> dict[str, float]:
        """rate_hz since the last call; tracked (1: yes); those of the source."""
        gauges = {"rate_hz": self._tally.gauges()["rate_hz"], "tracked": float(self._tracked)}
        return gauges if self._source is None else gauges | dict(self._source.gauges())
