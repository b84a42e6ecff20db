"""A dial gesture is a grip about something round, and its rotation.

Palm and fingers both turn a knob, and the caps of the tips, turned as one in the room, have the sum of both; they are
also what is measured best. A tip that is not seen goes with the palm, and counts less. The angle is against the
grip's beginning, not summed up from step to step, so that neither noise nor a moment of loss adds up. The rotation
goes on over as many grips as it takes. The axis begins as that of the tips' circle; a turn constrains its own axis
the better the farther it goes, and what is known of it is the mean of both (`_rotate`).

Fingers that let go of a knob go apart, and not alike: taken for a turn it is some degrees. They are quick, so that a
grip that is suddenly wider than it was is loosening, or the epoch is a bad one; a grip that slowly gets wider, as the
picture of a hand that turns does, is not. While it loosens (`GripHistory`) the angle goes on as it went, ever less: a
hand that rests before it lets go stands still, and a bad epoch in a quick turn is led over.

Tips that stand still to each other are a grip where most epochs of the hold have its shape: which way the palm lies
decides some of that, and cameras that see no more than fingertips are uncertain of it from epoch to epoch. Where all
that sees is worn on the arm (no markers, and the palm stands still in the camera's frame) it is the palm in the world
of the IMU that turns.
"""

from collections import deque
from dataclasses import dataclass
from math import atan2, cos, exp, pi, radians, sin, sqrt
from statistics import median

from common.arrays import Float
from common.calibration.gesture_settings import DialSettings
from common.messages import Gesture, Phase
from master.gestures.actions import ActionMonitor
from master.gestures.features import HandFeatures
from master.gestures.grip import Tips, axis_of, is_grip, may_grip, rotation_between, spread_m, widened_m


class GripHistory:
    """Width [m] and angle [rad] of a grip of late, and since when it loosens."""

    def __init__(self, quick_m: float) -> None:
        """`quick_m`: a grip that is wider or narrower by so much than it was loosens [m]."""
        self._quick_m = quick_m
        self._late: deque[tuple[int, float, float]] = deque()
        self._since_ns: int | None = None

    @property
    def loosens(self) -> bool:
        """Return whether the grip was loosening at the last epoch."""
        return self._since_ns is not None

    def sound(self, t_ns: int, wide_m: float, most_m: float) -> bool:
        """Whether fingers that are `wide_m` wider than when they closed rotate the knob.

        A grip that is wider than `most_m` is loose, however long it has been so.
        """
        if not self._late:
            good = abs(wide_m) <= most_m
        else:
            typical = median(wide for _, wide, _ in self._late)
            hold_s = 0.15  # a grip that is wider for so long is just wider
            lasts = self._since_ns is not None and (t_ns - self._since_ns) * 1e-9 > hold_s
            good = abs(wide_m) <= most_m and (lasts or abs(wide_m - typical) <= self._quick_m)
            if good and lasts:
                self._late.clear()
        if good:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = t_ns
        return good

    def push(self, t_ns: int, wide_m: float, angle_rad: float) -> None:
        """Take width and angle of a sound epoch."""
        self._late.append((t_ns, wide_m, angle_rad))
        late_s = 0.1  # what counts as of late
        while len(self._late) > 2 and (t_ns - self._late[0][0]) * 1e-9 > late_s:
            self._late.popleft()

    def ahead_rad(self, t_ns: int) -> float | None:
        """Extrapolate the angle to an epoch after the last sound one; None: no such.

        Only epochs at which nothing had begun to loosen yet are used.
        """
        if not self._late:
            return None
        typical = median(wide for _, wide, _ in self._late)
        firm = len(self._late)
        # of what is quick: from there on the last epochs before it may be of it
        while firm > 1 and abs(self._late[firm - 1][1] - typical) > 0.3 * self._quick_m:
            firm -= 1
        kept = list(self._late)[:firm]
        times = [(t - kept[-1][0]) * 1e-9 for t, _, _ in kept]
        middle = sum(times) / len(times)
        off = [t - middle for t in times]
        rate = sum(t * angle for t, (_, _, angle) in zip(off, kept, strict=True))
        rate = rate / max(sum(t * t for t in off), 1e-12) if len(times) > 2 else 0.0
        gone = (t_ns - kept[-1][0]) * 1e-9
        fade_s = 0.06  # in which a turn that nobody sees fades
        return kept[-1][2] + rate * fade_s * (1.0 - exp(-gone / fade_s))


_AXIS_RAD = radians(15.0)  # how well the circle of the tips constrains the axis of the knob
_SWAY_RAD = radians(4.0)  # about other axes, by which a hand sways while it turns a knob


@dataclass(slots=True, eq=False)
class _Grip:
    """One grip of the dial.

    Attributes:
        tips: As they were when it closed.
        circle_axis: (3,) of the circle of the tips.
        base_rad: By how much the dial had been turned then.
        farthest_rad: Of its largest turn so far.
        axis: (3,) of the knob, by both.
    """

    tips: Tips
    circle_axis: Float
    base_rad: float
    history: GripHistory
    farthest_rad: float
    axis: Float


class DialMonitor(ActionMonitor):
    """Detector of dial gestures; holds the dial's grip, its angle, a grip to be.

    A dial has begun while it is gripped, or about to be gripped again.
    """

    def __init__(self, settings: DialSettings) -> None:
        super().__init__()
        self._settings = settings
        self._grip: _Grip | None = None
        self._maybe: deque[tuple[int, Tips, bool]] = deque()  # since when tips are as they are now; a grip's?
        self._angle = 0.0
        self._before: Tips | None = None  # those of the grip that was let go
        self._closed_ns = self._known_ns = 0  # when the dial was gripped, and tips were known, last

    def push(
        self, seen: HandFeatures, across_m: float, *, may_begin: bool, wrist_device_only: bool = False
    ) -> list[Gesture]:
        """Return the messages at the epoch of the features.

        Args:
            across_m: Between the skins of the thumb and the finger next to it [m].
            may_begin: Whether a dial may begin.
            wrist_device_only: All that sees the hand is worn on its arm: the rig frame goes with it.
        """
        own, dial = self._settings, self._last
        if dial is None and not may_begin:
            self._maybe.clear()
            return []
        grips = dial is None and may_grip(seen, across_m, own)
        if dial is None and not grips and not self._maybe:
            return []
        tips = Tips.of(seen, own.sigma_most_m, wrist_device_only=wrist_device_only)
        if dial is None:
            grips = grips and is_grip(seen, tips, own)
            axis = self._held(seen.t_ns, tips, own.hold_s, grips=grips)
            if axis is None:
                return []
            self._angle = 0.0
            self._take(tips, axis)
            self._closed_ns = self._known_ns = seen.t_ns
            dial = Gesture(seen.hand, seen.t_ns, "dial", "dial", "begin", seen.t_ns, 1.0)
            return self._turned(dial, "begin", seen, tips)
        self._follow(seen.t_ns, tips)
        opened = self._grip is None and (seen.t_ns - self._closed_ns) * 1e-9 > own.regrip_s
        if opened or (seen.t_ns - self._known_ns) * 1e-9 > own.lost_s:
            return self._turned(dial, "end", seen, tips)
        return self._turned(dial, "update", seen, tips)

    def lost(self, t_ns: int) -> list[Gesture]:
        """Return the messages at an epoch at which there is no hand."""
        self._maybe.clear()
        if self._last is None or (t_ns - self._known_ns) * 1e-9 <= self._settings.lost_s:
            return []
        self._grip = None
        return self._send(self._last, "end", t_ns, 0.0, angle_rad=self._angle)

    def _held(self, t_ns: int, tips: Tips, hold_s: float, *, grips: bool) -> Float | None:
        """The axis of the tips, if they are still, and mostly a grip, so long."""
        while self._maybe and spread_m(tips, self._maybe[0][1]) > self._settings.still_m:
            self._maybe.popleft()
        if not grips and not self._maybe:
            return None
        self._maybe.append((t_ns, tips, grips))
        while len(self._maybe) > 1 and (t_ns - self._maybe[1][0]) * 1e-9 >= hold_s:
            self._maybe.popleft()
        if (t_ns - self._maybe[0][0]) * 1e-9 < hold_s:
            return None
        most = 0.6  # of the epochs of a hold have the shape of a grip
        if sum(shape for _, _, shape in self._maybe) < most * len(self._maybe):
            return None
        return tips.axis()

    def _take(self, tips: Tips, axis: Float) -> None:
        """A grip closes."""
        self._grip = _Grip(tips, axis, self._angle, GripHistory(self._settings.quick_m), 0.0, axis)
        self._maybe.clear()

    def _follow(self, t_ns: int, tips: Tips) -> None:
        """Turn the dial, let it go, or grip it again."""
        own, grip = self._settings, self._grip
        if tips.known.sum() >= 3:
            self._known_ns = t_ns
        if grip is None:
            before = self._before  # a hand that let go and grips as wide as before: the same knob
            again = before is not None and abs(widened_m(tips, before)) <= own.still_m
            axis = self._held(t_ns, tips, own.again_s, grips=again)
            if axis is not None:
                self._take(tips, axis)
                self._closed_ns = t_ns
            return
        wide = widened_m(tips, grip.tips)
        loosened = grip.history.loosens
        if grip.history.sound(t_ns, wide, own.loose_m):
            self._rotate(t_ns, tips, grip, wide)
        elif (ahead := grip.history.ahead_rad(t_ns)) is not None:
            self._angle = ahead
        if not abs(wide) > own.open_m:
            self._closed_ns = t_ns
        elif loosened:
            self._grip, self._before = None, grip.tips

    def _rotate(self, t_ns: int, tips: Tips, grip: _Grip, wide_m: float) -> None:
        """The angle of tips that turn the knob.

        Its axis is that of most weight: that of the tips' circle as sure as it is, that of the turn as sure as it is
        far. A turn r sways by `_SWAY_RAD` about other axes, so it gives its axis to `_SWAY_RAD` / |r|: the weights of
        the two directions go with one over the square. The angle is the twist about it (Dobrowolski, 2015).
        """
        rotation = rotation_between(tips, grip.tips)
        far = sqrt(rotation @ rotation)
        if far > grip.farthest_rad:
            grip.farthest_rad = far
            grip.axis = axis_of(grip.circle_axis, (_SWAY_RAD / _AXIS_RAD) ** 2, rotation)
        along = float(rotation @ grip.axis) / max(far, 1e-12)
        twist = 2.0 * atan2(along * sin(0.5 * far), cos(0.5 * far)) + grip.base_rad
        self._angle = twist + 2.0 * pi * round((self._angle - twist) / (2.0 * pi))
        grip.history.push(t_ns, wide_m, self._angle)

    def _turned(self, dial: Gesture, phase: Phase, seen: HandFeatures, tips: Tips) -> list[Gesture]:
        """Return the message with the angle of an epoch."""
        grip = self._grip
        origin = 0.5 * seen.tips_m[0] + 0.5 * seen.tips_m[1:].mean(axis=0)
        way = seen.palmar if grip is None else tips.T_still_rig.T @ grip.axis
        confidence = float(tips.known.mean()) * (0.5 if grip is None else 1.0)
        if phase == "end":
            self._grip = None
            self._maybe.clear()
        return self._send(
            dial, phase, seen.t_ns, confidence, angle_rad=self._angle, origin_m=origin, direction=way
        )
