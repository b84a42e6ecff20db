"""Fusion of all sensors of one object into one stream of poses.

What cameras see of it and a tracker on it become one row of poses.

Cameras measure it in the rig's own frame, a tracker through its registration. So while cameras track it their poses
are output, and the tracker's elsewhere; what cameras hold is not output while the tracker knows better. Time never
goes back.
"""

from collections import Counter
from math import inf

from common.messages import MarkerDetections, TagDetections, TrackerPose
from master.objects.line import ObjectLine, SolvedObject
from master.objects.tracker import TrackerLine, registered
from master.rig.setup import RigSetup

_PREFERRED_NS = 100_000_000  # so long after a pose of one the other waits
_NAME = 64  # characters of a name in `Health`


class TrackedObject:
    """Push machine that merges camera and tracker poses of one object.

    Holds the lines of cameras and tracker, and when each last reported something.
    """

    def __init__(self, setup: RigSetup, name: str, counts: Counter[str]) -> None:
        """Build the lines of one of the setup's objects.

        Their results are counted into `counts`.

        Raises:
            CalibrationError: A bead is none of the rig's markers.
        """
        profile = next(one for one in setup.objects if one.name == name)
        shown = bool(profile.markers) or profile.tags is not None
        self.name, self.tracker = name, profile.tracker
        self._setup, self._counts = setup, counts
        self._line = ObjectLine(profile, setup.rig, setup.models) if shown else None
        self._device = TrackerLine(profile, setup.rig) if registered(profile, setup.rig) else None
        self._seen_ns = self._tracker_ns = self._line_ns = -inf
        self._last_ns = -inf

    @property
    def unplaced(self) -> bool:
        """Whether it has a tracker whose poses mean nothing yet."""
        return self.tracker is not None and self._device is None

    def push(self, message: MarkerDetections | TagDetections) -> list[SolvedObject]:
        """Take the detections of one camera and return the resulting poses.

        They come oldest first.
        """
        if self._line is None:
            return []
        if isinstance(message, MarkerDetections):
            own = self._setup.own(message)
            assert isinstance(own, MarkerDetections), "of markers come markers"
            message = own
        return self._of_cameras(self._line.push(message))

    def push_tracker(self, message: TrackerPose) -> list[SolvedObject]:
        """Take a pose of the object's tracker and return the resulting poses.

        They come oldest first.
        """
        if self._device is None:
            self._counts[f"tracker.{message.source}.unplaced"[:_NAME]] += 1
            return []
        solved = self._device.push(message)
        for event, number in self._device.counts.items():
            self._counts[f"tracker.{message.source}.{event}"[:_NAME]] += number
        self._device.counts.clear()
        out: list[SolvedObject] = []
        for one in solved:
            t_ns = one.pose.t_ns
            if one.pose.tracked:
                self._tracker_ns = t_ns
            waits_for = self._seen_ns if one.pose.tracked else self._line_ns
            if t_ns - waits_for > _PREFERRED_NS:
                out += self._published(one)
        return out

    def flush(self) -> list[SolvedObject]:
        """At the end of a recording: the poses that still wait for a camera."""
        return [] if self._line is None else self._of_cameras(self._line.flush())

    def _of_cameras(self, solved: list[SolvedObject]) -> list[SolvedObject]:
        out: list[SolvedObject] = []
        for one in solved:
            self._line_ns = t_ns = one.pose.t_ns
            if one.pose.tracked:
                self._seen_ns = t_ns
            if one.pose.tracked or t_ns - self._tracker_ns > _PREFERRED_NS:
                out += self._published(one)
        return out

    def _published(self, one: SolvedObject) -> list[SolvedObject]:
        """It, if it is later than the last, and counted."""
        if one.pose.t_ns <= self._last_ns:
            return []
        self._last_ns = one.pose.t_ns
        for event, happened in (
            ("poses", True),
            ("tracked", one.pose.tracked),
            ("occluded", one.pose.occluded),
        ):
            self._counts[f"object.{self.name}.{event}"[:_NAME]] += happened
        return [one]
