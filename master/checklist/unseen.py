"""Markers of a hand that one camera does not find though it finds the others.

The cause is a wrong marker colour, or a wrong range of colours.

A hand hides its own markers all the time, so what is not seen now means nothing. Three things mean something:

1. It was seen, its colours were changed, and now it is not: that was the change. Reported after `CHANGED_S`.
2. It was never seen since this slave, or these colours, began: a hand that comes shows all of its caps soon. After
   `NEVER_S`.
3. It has not been seen for as long as no pose hides it: `GONE_S`. The cap has come off, or is dirty.

Only time counts in which at least three others (all, of a hand with fewer) are found in half of the frames.
"""

from collections.abc import Iterator

from master.checklist.facts import Verdict
from master.checklist.slave_reports import SlaveReports

GONE_S = 30.0
COLOUR = "colour."  # metrics of the slave: a number that changes with the range of a marker
SEEN = "seen."


class _Marker:
    """What became of one marker."""

    def __init__(self) -> None:
        self.colour: float | None = None
        self.ever = self.before_change = False
        self.without_s = 0.0

    @property
    def limit_s(self) -> float:
        """How long it may be missing."""
        changed_s, never_s = 0.9, 5.0
        return GONE_S if self.ever else changed_s if self.before_change else never_s


class UnseenMarkers:
    """Push machine that times how long each marker of one hand has been missing.

    It reads the reports of one slave.
    """

    def __init__(self, camera: str, markers: tuple[str, ...]) -> None:
        """Watch these markers."""
        self._camera = camera
        self._markers = {name: _Marker() for name in markers}
        self._session: int | None = None

    def push(self, reports: SlaveReports) -> Iterator[Verdict]:
        """Take the newest report."""
        if reports.session != self._session:
            self._session = reports.session
            self._markers = {name: _Marker() for name in self._markers}
        frames = reports.increase("frames")
        if not frames:
            return
        share = {name: (reports.increase(SEEN + name) or 0) / frames for name in self._markers}
        others = 3
        needed = min(others, len(share) - 1)
        for name, one in self._markers.items():
            half = 0.5  # of the frames between two reports
            if self._recoloured(one, reports.metrics.get(COLOUR + name)):
                pass  # of the frames of this report some were looked at with the colours of before
            elif share[name]:
                one.ever, one.without_s = True, 0.0
            elif needed and sum(other >= half for key, other in share.items() if key != name) >= needed:
                one.without_s += reports.seconds
            yield Verdict(
                "marker_unseen",
                f"{self._camera}.{name}",
                one.without_s >= one.limit_s,
                f"Camera {self._camera} does not find marker {name}, {_since(one)}, though it finds others.",
                "Show it to the camera. If it is in the picture: clean or repaint it, or calibrate its colours.",
                (self._camera,),
                (name,),
            )

    @staticmethod
    def _recoloured(one: _Marker, colour: float | None) -> bool:
        """Store the marker's colour number and return whether it has changed.

        After a change the timing starts again.
        """
        changed = one.colour is not None and colour is not None and colour != one.colour
        if changed:
            one.before_change = one.ever or one.before_change
            one.ever, one.without_s = False, 0.0
        one.colour = colour
        return changed


def _since(one: _Marker) -> str:
    if one.ever:
        return f"for {one.without_s:.0f} s"
    return (
        "not once since its colours were changed" if one.before_change else "not once since its slave began"
    )
