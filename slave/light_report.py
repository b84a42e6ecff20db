"""Report of how the light affects the colours.

Counts, metrics, and a log line before it costs a marker.
"""

import logging
from collections.abc import Callable

import numpy as np

from slave.markers.colour_monitor import ColourWarning
from slave.markers.reloadable import ReloadableDetector
from slave.sources import Frame, Reporting

ALL = "light"  # the subject of what concerns every marker
_LOG = logging.getLogger(__name__)


class LightReport:
    """Counts warnings and logs them, and adds the light to what `others` report.

    Holds the subjects warned of in the last frame, how often each was, and when each was last logged. The loop
    writes, the health thread reads.
    """

    def __init__(
        self,
        name: str,
        detector: ReloadableDetector,
        others: Reporting,
        markers: tuple[str, ...],
        show: Callable[[Frame], None] = lambda _frame: None,
    ) -> None:
        """Report on the `detector` of camera `name`; every frame is handed on to `show`."""
        self._name, self._detector, self._others, self._show = name, detector, others, show
        self._warned = dict.fromkeys((ALL, *markers), 0)
        self._now: set[str] = set()
        self._logged_ns: dict[str, int] = {}

    def offer(self, frame: Frame) -> None:
        """Take note after a frame, and hand it on."""
        self._show(frame)
        warnings = self._detector.warnings
        if not warnings and not self._now:
            return
        now = {ALL if warning.marker is None else warning.marker for warning in warnings}
        for subject in now - self._now:
            self._warned[subject] += 1
        self._now = now
        for warning in warnings:
            subject = ALL if warning.marker is None else warning.marker
            last_ns = self._logged_ns.get(subject)
            if last_ns is None or frame.t_ns - last_ns >= 10_000_000_000:  # the same one no more often
                self._logged_ns[subject] = frame.t_ns
                _LOG.warning("%s: %s", self._name, warning.text)

    def counts(self) -> dict[str, int]:
        """Return the counts of the other reports and of the light.

        The light's are warnings.light, warnings.<marker>, refused.light, colour_tables.
        """
        warned = {f"warnings.{subject}": count for subject, count in self._warned.items()}
        own = {"refused.light": self._detector.refused, "colour_tables": self._detector.tables}
        return {**self._others.counts(), **warned, **own}

    def metrics(self) -> dict[str, float]:
        """Return the metrics of the other reports and of the light.

        While the light is followed, its metrics compare it with calibration.

        That is red and blue relative to green, and green. Of markers that look alike
        alike.<one>..<other>, the hues between them.
        """
        if not self._detector.adapts:
            return dict(self._others.metrics())
        blue, green, red = np.exp(self._detector.log_gains).tolist()
        light = {"light_red": red / green, "light_blue": blue / green, "light_exposure": green}
        return {**self._others.metrics(), **light, **_ambiguous(self._detector.warnings)}


def _ambiguous(warnings: list[ColourWarning]) -> dict[str, float]:
    # A name in `Health` has 64 characters
    return {
        f"alike.{one.marker}..{one.ambiguous}"[:64]: one.hues for one in warnings if one.ambiguous is not None
    }
