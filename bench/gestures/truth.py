"""What the hand of the scene `gestures` truly says: by the geometry of the true hand alone, nothing of a recogniser.

A pinch or a touch is a gap between skins below a threshold; a knob is gripped while no tip is farther in or out than it
may be from where it is when the knob begins to turn; a finger points while its true bends say so. Thresholds and holds
are those of the settings, so that lateness is that of the recogniser and of the line before it.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.calibration.gesture_settings import GestureSettings
from common.hand.model import CHAINS, FINGERS, TIPS, HandModel
from common.hand.skin import TaperedCapsules, gaps_between
from common.sim.gestures import Annotation, Gestures

RATE_HZ = 240.0


@dataclass(frozen=True, slots=True)
class TrueEvent:
    """One thing that was said: kind and name as of a Gesture, and when it begins and ends [s]."""

    kind: str
    name: str
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True, eq=False)
class GestureTruth:
    """The true hand over T instants.

    Attributes:
        motion: The scene's.
        t_s: (T,) [s].
        joints_m: (T, 26, 3) [m].
        pinch_m: (T, 4) [m] between the last segments of the thumb and each finger.
        key_m: (T, 4) [m] between the last segment of the thumb and the nearest of each finger.
        events: All that is said within these instants.
    """

    motion: Gestures
    t_s: Float
    joints_m: Float
    pinch_m: Float
    key_m: Float
    events: tuple[TrueEvent, ...]

    @classmethod
    def of(
        cls, motion: Gestures, model: HandModel, settings: GestureSettings, seconds: float
    ) -> "GestureTruth":
        """The first `seconds` of a scene."""
        t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
        states = [motion.at(float(s)) for s in t]
        joints = model.forward(
            np.stack([state.T_rig_palm for state in states]), np.stack([state.angles_rad for state in states])
        ).position_m
        capsules = TaperedCapsules.of_segments(joints, model.radius_m)
        gap = gaps_between(
            capsules.part(slice(0, 1), slice(2, 3)), capsules.part(slice(1, 5), slice(0, 3))
        ).gap_m
        seen = cls(motion, t, joints, gap[..., 2], gap.min(axis=-1), ())
        annotations = (seen._event(one, settings) for one in motion.annotations if one.stop_s < seconds - 1.0)
        return cls(
            motion, t, joints, seen.pinch_m, seen.key_m, tuple(one for one in annotations if one is not None)
        )

    def pinch_at(self, t_s: float, finger: str) -> float:
        """The true gap [m] of a pinch of a finger."""
        return float(np.interp(t_s, self.t_s, self.pinch_m[:, FINGERS.index(finger) - 1]))

    def ray_at(self, t_s: float) -> Float:
        """The true direction (3,) from the knuckle to the tip of the index finger."""
        joints = self.joints_m[min(round(t_s * RATE_HZ), len(self.t_s) - 1)]
        way = joints[CHAINS[1, 3]] - joints[CHAINS[1, 0]]
        return way / np.linalg.norm(way)

    def _event(self, annotations: Annotation, settings: GestureSettings) -> TrueEvent | None:
        inside = (self.t_s >= annotations.start_s) & (self.t_s <= annotations.stop_s)
        before = after = 0.0
        if annotations.kind == "pinch":
            gap = self.pinch_m[:, FINGERS.index(annotations.name) - 1]
            begun, going = gap <= settings.pinch.begin_gap_m, gap <= settings.pinch.end_gap_m
        elif annotations.kind == "tap":
            begun = going = self.key_m.min(axis=1) <= settings.tap.touch_gap_m
        elif annotations.kind == "dial":
            begun, going = self._gripped(annotations, settings)
            before, after = settings.dial.hold_s, settings.dial.regrip_s
        else:
            begun, going = self._points(settings)
            before = after = settings.point.hold_s
        first, last = np.flatnonzero(begun & inside), np.flatnonzero(going & inside)
        if not len(first) or not len(last):
            return None
        begin_s, end_s = float(self.t_s[first[0]]) + before, float(self.t_s[last[-1]]) + after
        return TrueEvent(annotations.kind, annotations.name, begin_s, end_s)

    def _gripped(self, annotations: Annotation, settings: GestureSettings) -> tuple[Bool, Bool]:
        """Whether the tips are about the knob (T,), and whether they have not let it go (T,)."""
        rotated = np.array([self.motion.dial_rad(float(t)) for t in self.t_s])
        start = int(np.searchsorted(self.t_s, annotations.start_s))
        rotations = start + int(np.argmax(np.abs(rotated[start:] - rotated[start]) > 1e-6))
        tips = self.joints_m[:, TIPS]
        away = np.linalg.norm(tips - tips.mean(axis=1, keepdims=True), axis=-1)
        off = away - away[rotations]
        held = np.abs(off).max(axis=1) <= settings.dial.still_m
        across = np.linalg.norm(tips[:, 0] - tips[:, 1:].mean(axis=1), axis=-1)
        return held, 0.5 * np.abs(across - across[rotations]) <= settings.dial.open_m

    def _points(self, settings: GestureSettings) -> tuple[Bool, Bool]:
        """Whether the index finger points (T,), and with the slack of one that has begun to (T,)."""
        bone = np.diff(self.joints_m[:, CHAINS[1:]], axis=2)
        bone = bone / np.linalg.norm(bone, axis=-1, keepdims=True)
        bend = np.arccos(np.clip(np.vecdot(bone[:, :, :-1], bone[:, :, 1:]), -1.0, 1.0)).sum(axis=-1)
        own = settings.point

        def shape(slack: float) -> Bool:
            return (bend[:, 0] <= own.stretched_rad + slack) & (bend[:, 1:] >= own.bent_rad - slack).all(
                axis=1
            )

        return shape(0.0), shape(own.slack_rad)
