"""Count what the loop of an IMU does, for `Health`, beside what the IMU and the filter of its orientation tell."""

from collections.abc import Mapping
from math import isfinite
from typing import Protocol

from common.arrays import Float
from common.messages import ImuSample
from slave.counters import Counters
from slave.sources import Reporting


class Orientation(Protocol):
    """What gives samples their orientation; an `OrientationFilter`."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Samples that gave none, by reason."""
        ...

    @property
    def at_rest(self) -> bool:
        """Whether the sensor lies still."""
        ...

    @property
    def bias_rad_s(self) -> Float:
        """What the gyroscope says at rest (3,)."""
        ...

    @property
    def heading_sigma_rad(self) -> float:
        """How far the heading has drifted."""
        ...

    def push(self, sample: ImuSample, /) -> ImuSample:
        """The same sample with its orientation."""
        ...


class SampleCounters:
    """Counts samples, and those left out, for `Health`. Holds the counters, one sample like one frame."""

    def __init__(self, source: object = None, orientation: Orientation | None = None) -> None:
        """Count from nothing, beside what the IMU and the filter of its orientation tell, if they tell anything."""
        self._counters = Counters(())
        self._source = source if isinstance(source, Reporting) else None
        self._orientation = orientation

    def sample(self, seq: int) -> None:
        """Count one sample; a gap in their numbers counts as left out."""
        self._counters.part(seq)

    def failed(self, seq: int, error: Exception) -> None:
        """Count one sample that was left out because of an error.

        The error is logged now and then.
        """
        self._counters.failed(seq, error)

    def counts(self) -> dict[str, int]:
        """Event -> how often since the start.

        samples, skipped, failed; `lost` … of a real IMU; `fusion.`...
        """
        counts = self._counters.counts()
        found = {"samples": counts["frames"], "skipped": counts["dropped"], "failed": counts["failed"]}
        if self._source is not None:
            found.update(self._source.counts())
        if self._orientation is not None:
            found.update(self._orientation.counts)
        return found

    def metrics(self) -> dict[str, float]:
        """rate_hz since the last call; bias, at_rest (1: yes) and heading_sigma of the filter; those of the IMU."""
        metrics = {"rate_hz": self._counters.metrics()["rate_hz"]}
        if self._source is not None:
            metrics.update(self._source.metrics())
        if self._orientation is not None:
            bias = self._orientation.bias_rad_s.tolist()
            metrics |= {f"bias_{axis}_rad_s": value for axis, value in zip("xyz", bias, strict=True)}
            metrics["heading_sigma_rad"] = self._orientation.heading_sigma_rad
            metrics["at_rest"] = float(self._orientation.at_rest)
        return {name: value for name, value in metrics.items() if isfinite(value)}
