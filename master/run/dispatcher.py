"""Dispatcher derives the poses of hands and objects from messages.

First the poses that a message completes, of every hand, because these are waited for; then those of objects,
then contact and gestures. `push` is a generator: what it gave is out before the next is worked out. Objects
belong to the marker rig that names them; a hand measured by markers has the same frame, so contact is made
for each of those and every object. A wrist device alone has a frame of its own: its hand touches nothing that
we know. Cameras measure an object in the rig's frame, a tracker on it through its registration. While cameras
track it their poses are output, and the tracker's elsewhere; what cameras hold is not output while the
tracker knows better.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import inf

import msgspec

from common.messages import (
    Contact,
    Gesture,
    HandPose,
    ImuSample,
    MarkerDetections,
    TagDetections,
    TrackerPose,
    WristDetections,
)
from master.estimator.pipeline import SolvedPose
from master.fabrik.solver import Stage
from master.gestures.poses import GestureRecogniser
from master.objects.contact import ContactMonitor
from master.objects.line import ObjectLine, SolvedObject
from master.objects.tracker import TrackerLine, registered
from master.rig.alike import AlikeHands
from master.rig.pipeline import Pipeline, pipeline_of
from master.rig.setup import RigSetup
from master.run.app import Solved, StageTimes
from master.run.link_senders import SensorMessage

_PREFERRED_NS = 100_000_000  # so long after a pose of one the other waits
_NAME = 64  # characters of a name in `Health`


class TrackedObject:
    """Push machine that merges one object's camera and tracker poses in time."""

    def __init__(self, setup: RigSetup, name: str, counts: Counter[str]) -> None:
        """Build the lines of one of the setup's objects, which count into `counts`.

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
        """Take the detections of one camera; return the resulting poses, oldest first."""
        if self._line is None:
            return []
        if isinstance(message, MarkerDetections):
            own = self._setup.own(message)
            assert isinstance(own, MarkerDetections), "of markers come markers"
            message = own
        return self._of_cameras(self._line.push(message))

    def push_tracker(self, message: TrackerPose) -> list[SolvedObject]:
        """Take a pose of the object's tracker; return the resulting poses, oldest first."""
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


_FRAMES = MarkerDetections, WristDetections


@dataclass(frozen=True, slots=True, eq=False)
class _Auxiliary:
    """What is made beside the hands with one state of the files.

    Attributes:
        shown: Camera -> the objects that it may see.
        trackers: Tracker -> the object that it sits on.
        contacts, gestures: Hand -> what detects that of it.
        alike: What tells the markers of hands apart that are painted alike; None: there are none.
    """

    objects: tuple[TrackedObject, ...]
    shown: dict[str, list[TrackedObject]]
    trackers: dict[str, TrackedObject]
    contacts: dict[str, ContactMonitor]
    gestures: dict[str, GestureRecogniser]
    alike: AlikeHands | None

    @classmethod
    def of(cls, setups: Sequence[RigSetup], counts: Counter[str], *, gestures: bool) -> "_Auxiliary":
        """Build all of it; a CalibrationError where an object does not fit its rig."""
        objects: list[TrackedObject] = []
        shown: dict[str, list[TrackedObject]] = {}
        for setup in setups:
            own = [TrackedObject(setup, one.name, counts) for one in setup.objects]
            objects += own
            for camera in setup.models if own else ():
                shown.setdefault(camera, []).extend(own)
        profiles = [one for setup in setups for one in setup.objects]
        hands = {setup.hand.profile.name: setup for setup in setups}
        return cls(
            tuple(objects),
            shown,
            {one.tracker: one for one in objects if one.tracker is not None},
            {
                name: ContactMonitor(setup.hand, profiles)
                for name, setup in hands.items()
                if profiles and setup.has_markers
            },
            {name: GestureRecogniser(setup.gestures, setup.hand) for name, setup in hands.items()}
            if gestures
            else {},
            AlikeHands.of(setups, counts),
        )


class Dispatcher:
    """Push machine over all messages: the line of each hand, and what is beside them."""

    def __init__(
        self, setups: Sequence[RigSetup], lines: Sequence[Pipeline], stage: Stage, *, gestures: bool = True
    ) -> None:
        """Join each hand's setup with its solver line and build what is beside the hands.

        `gestures` False: poses are unrelated, as of single pictures; there are no gestures in them.

        Raises:
            CalibrationError: An object does not fit its rig.
        """
        self._stage, self._gesture_begins = stage, gestures
        self._hands = tuple(zip(setups, lines, strict=True))
        self._watching = {
            name: [
                (setup.own if name in setup.rows else None, line)
                for setup, line in self._hands
                if name in setup.cameras
            ]
            for setup in setups
            for name in setup.camera_names
        }
        self._line_of_imu = {name: line for setup, line in self._hands for name in setup.imus}
        self._counts: Counter[str] = Counter()
        self._now = _Auxiliary.of(setups, self._counts, gestures=gestures)
        self._begun: dict[tuple[str, str, str], Gesture] = {}
        # One thread fills it, another empties it.
        self._next: deque[_Auxiliary] = deque(maxlen=1)

    @property
    def counts(self) -> Counter[str]:
        """Event counts since the start; of several hands each under the hand's name.

        Of objects object.NAME.poses, .tracked, .occluded; of gestures gesture.KIND, how many began; of
        trackers tracker.NAME.lost, .leap, .late, .broken, and .unplaced where it is not registered.
        """
        # The loop may add a count meanwhile: a copy is made at once.
        each = [(setup.hand.profile.name, dict(line.counts)) for setup, line in self._hands]
        if len(each) > 1:
            each = [(hand, {f"{hand}.{event}"[:_NAME]: n for event, n in own.items()}) for hand, own in each]
        return Counter({event: n for _, own in each for event, n in own.items()} | dict(self._counts))

    @property
    def auxiliary_counts(self) -> dict[str, int]:
        """Those of objects, gestures and trackers alone."""
        return dict(self._counts)

    @property
    def unplaced(self) -> tuple[TrackedObject, ...]:
        """Objects whose tracker is not registered: what it reports is of no use."""
        return tuple(one for one in self._now.objects if one.unplaced)

    def push(self, message: SensorMessage) -> Iterator[Solved]:
        """Take one message; give what it completes, of each hand and object oldest first."""
        if self._next:
            yield from self._take_over(self._next.popleft())
        if isinstance(message, ImuSample):
            if (line := self._line_of_imu.get(message.source)) is not None:
                line.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
            return
        poses: list[SolvedPose] = []
        alike = self._now.alike
        if alike is not None and isinstance(message, MarkerDetections):
            with self._stage("association"):
                message = alike.push(message)
        if isinstance(message, _FRAMES):
            for own, line in self._watching.get(message.camera, ()):
                poses += line.push(message if own is None else own(message))
            yield from poses
        if alike is not None:
            for one in poses:
                alike.take(one.pose)
        if self._now.objects:
            yield from self._seen(message)
        if self._now.contacts or self._now.gestures:
            for one in poses:
                yield from self._done(one.pose)

    def flush(self) -> Iterator[Solved]:
        """At the end of a recording: what still waits for something."""
        poses = [solved for _, line in self._hands for solved in line.flush()]
        yield from poses
        for one in self._now.objects:
            yield from self._known(one.flush())
        for one in poses:
            yield from self._done(one.pose)

    def prepare(self, setups: Sequence[RigSetup]) -> Callable[[], None]:
        """Build what is beside the hands for changed files; return the switch to it.

        From any thread but the loop's. What was known of objects and gestures begins anew.

        Raises:
            CalibrationError: An object does not fit its rig; nothing has changed.
        """
        new = _Auxiliary.of(setups, self._counts, gestures=self._gesture_begins)
        return lambda: self._next.append(new)

    def _take_over(self, new: _Auxiliary) -> Iterator[Gesture]:
        """The old gestures end: who listens would wait for that for ever."""
        self._now = new
        begun, self._begun = list(self._begun.values()), {}
        for gesture in begun:
            yield msgspec.structs.replace(gesture, phase="end")

    def _seen(self, message: SensorMessage) -> Iterator[SolvedObject]:
        if isinstance(message, TrackerPose):
            if (carried := self._now.trackers.get(message.source)) is not None:
                yield from self._known(carried.push_tracker(message))
        elif isinstance(message, MarkerDetections | TagDetections):
            for one in self._now.shown.get(message.camera, ()):
                with self._stage("objects"):
                    solved = one.push(message)
                yield from self._known(solved)

    def _known(self, solved: list[SolvedObject]) -> list[SolvedObject]:
        """Pass these objects to the contact monitors of the hands; return them."""
        for one in solved:
            for contact in self._now.contacts.values():
                contact.push_object(one.pose)
        return solved

    def _done(self, pose: HandPose) -> Iterator[Contact | Gesture]:
        if (contact := self._now.contacts.get(pose.hand)) is not None:
            with self._stage("contact"):
                near = contact.push(pose)
            yield from near
        if (gestures := self._now.gestures.get(pose.hand)) is not None:
            with self._stage("gestures"):
                messages = gestures.push(pose)
            for gesture in messages:
                self._remember(gesture)
                yield gesture

    def _remember(self, gesture: Gesture) -> None:
        key = gesture.hand, gesture.kind, gesture.name
        if gesture.phase == "begin" or gesture.kind == "tap":
            self._counts[f"gesture.{gesture.kind}"[:_NAME]] += 1
        if gesture.phase == "end":
            self._begun.pop(key, None)
        else:
            self._begun[key] = gesture


def new_dispatcher(setups: Sequence[RigSetup]) -> Dispatcher:
    """A dispatcher of these hands in its first state, of which nothing is measured.

    Raises:
        CalibrationError: As `Dispatcher`.
    """
    stages = StageTimes()
    return Dispatcher(setups, [pipeline_of(setup, stages) for setup in setups], stages)
