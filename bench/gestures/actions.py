"""Pinch, dial, taps and pointing of the scene `gestures`, and false ones of hands that make none; exact truth.

Rendered frames of a marker rig go through the slaves' detectors and the master to the recogniser. The truth is the
geometry of the true hand alone, by the thresholds and holds of the settings: gaps between skins, tips that stand about
a knob, bends. An event is late by how long after the truth's it is recognised, in frames of 60 Hz; one that nobody made
is false. The recordings `leapjs` make no gesture; they are played by our hand, as they are and before a wrist device.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bench.both.scene import Both, shown_of, watched
from bench.both.scene import solve as solve_both
from bench.gestures.poses import pose_of
from bench.played import START_NS, solve, times_of, watch
from bench.report import CALIBRATION, Row, datasets
from common.arrays import Bool, Float
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import CHAINS, FINGERS, TIPS, HandModel
from common.hand.skin import finger_segments, gaps_between
from common.messages import Gesture, HandPose
from common.sim.gestures import Annotation, Gestures
from common.sim.motion import HandMotion
from common.sim.scenes import scene_by_name
from master.gestures.poses import GestureRecogniser
from master.rig.setup import RigSetup, load_setup

_FINE_HZ = 240.0


@dataclass(frozen=True, slots=True)
class TrueEvent:
    """One true event: kind and name as of a Gesture, and when it begins and ends [s]."""

    kind: str
    name: str
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True, eq=False)
class GestureTruth:
    """The true hand over T moments."""

    motion: Gestures  # the scene's
    t_s: Float  # (T,) [s]
    joints_m: Float  # (T, 26, 3) [m]
    pinch_m: Float  # (T, 4) [m] between the last segments of the thumb and each finger
    key_m: Float  # (T, 4) [m] between the last segment of the thumb and the nearest of each finger
    events: tuple[TrueEvent, ...]  # all within these times

    @classmethod
    def of(
        cls, motion: Gestures, model: HandModel, settings: GestureSettings, seconds: float
    ) -> "GestureTruth":
        """The first `seconds` of a scene."""
        t = np.arange(round(seconds * _FINE_HZ)) / _FINE_HZ
        states = [motion.at(float(s)) for s in t]
        palms, angles = (
            np.stack(each) for each in zip(*((s.T_rig_palm, s.angles_rad) for s in states), strict=True)
        )
        joints = model.forward(palms, angles).position_m
        capsules = finger_segments(joints, model.radius_m)
        gap = gaps_between(capsules.of(slice(0, 1), slice(2, 3)), capsules.of(slice(1, 5), slice(0, 3))).gap_m
        seen = cls(motion, t, joints, gap[..., 2], gap.min(axis=-1), ())
        made = [seen._event(one, settings) for one in motion.annotations if one.stop_s < seconds - 1.0]
        return replace(seen, events=tuple(one for one in made if one is not None))

    def pinch_at(self, t_s: float, finger: str) -> float:
        """The true gap [m] of a pinch of a finger."""
        return float(np.interp(t_s, self.t_s, self.pinch_m[:, FINGERS.index(finger) - 1]))

    def ray_at(self, t_s: float) -> Float:
        """The true direction (3,) from the knuckle to the tip of the index finger."""
        joints = self.joints_m[min(round(t_s * _FINE_HZ), len(self.t_s) - 1)]
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
            bent = (bend[:, 1:] >= own.bent_rad - slack).all(axis=1)
            return (bend[:, 0] <= own.stretched_rad + slack) & bent

        return shape(0.0), shape(own.slack_rad)


RATE_HZ = 60.0
_SILENT = ("wave", "HandSplay-110fps", "rollAndPitchWithEntry", "three-claps", "confidence-demo")
_KINDS = ("pinch", "dial", "tap", "point")


@dataclass(slots=True)
class Score:
    """Recognised gestures of one scene or several: late [frames] by kind and phase, errors, counts by kind."""

    late: dict[str, list[float]] = field(default_factory=lambda: dict[str, list[float]]())
    made: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    missed: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    false: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    pinch_mm: list[float] = field(default_factory=lambda: list[float]())
    dial_deg: list[float] = field(default_factory=lambda: list[float]())
    ray_deg: list[float] = field(default_factory=lambda: list[float]())

    def add(self, found: Sequence[Gesture], truth: GestureTruth) -> None:
        """Compare recognised gestures with the truth."""
        free = [one for one in found if one.phase == "begin" or one.kind == "tap"]
        for event in truth.events:
            self.made[event.kind] += 1
            at_s = event.end_s if event.kind == "tap" else event.begin_s
            same = [one for one in free if (one.kind, one.name) == (event.kind, event.name)]
            first = min(same, key=lambda one: abs(_s(one.t_ns) - at_s), default=None)
            if first is None or abs(_s(first.t_ns) - at_s) > 0.3:  # farther away it is another
                self.missed[event.kind] += 1
                continue
            free.remove(first)
            self._late("tap" if event.kind == "tap" else f"{event.kind} begin", _s(first.t_ns) - at_s)
            if event.kind == "tap":
                continue
            course = [one for one in found if (one.kind, one.began_t_ns) == (first.kind, first.began_t_ns)]
            if course[-1].phase == "end":
                self._late(f"{event.kind} end", _s(course[-1].t_ns) - event.end_s)
            self._values(course, truth, event.end_s)
        # A gesture at the very end is in no event, and is not false either.
        last_s = float(truth.t_s[-1]) - 1.0
        cut_s = min((one.start_s for one in truth.motion.annotations if one.stop_s >= last_s), default=last_s)
        for one in free:
            self.false[one.kind] += _s(one.t_ns) < min(cut_s, last_s)

    def add_silent(self, found: Iterable[Gesture]) -> None:
        """Count false gestures of a hand that makes none."""
        for one in found:
            self.false[one.kind] += one.phase == "begin" or one.kind == "tap"

    def _late(self, what: str, seconds: float) -> None:
        self.late.setdefault(what, []).append(seconds * RATE_HZ)

    def _values(self, course: Sequence[Gesture], truth: GestureTruth, end_s: float) -> None:
        first_s = _s(course[0].t_ns)
        for one in course:
            t_s = _s(one.t_ns)
            if t_s > end_s:
                break
            if one.kind == "pinch":
                self.pinch_mm.append(1e3 * (one.distance_m - truth.pinch_at(t_s, one.name)))
            elif one.kind == "dial":
                rotated = truth.motion.dial_rad(t_s) - truth.motion.dial_rad(first_s)
                self.dial_deg.append(float(np.degrees(one.angle_rad - rotated)))
            elif one.kind == "point":
                off = one.direction - truth.ray_at(t_s)
                self.ray_deg.append(float(np.degrees(np.linalg.norm(off))))

    def rows(self, name: str) -> Iterator[Row]:
        """Return the rows of this score."""
        for kind in _KINDS:
            note = f"made {self.made[kind]}, missed {self.missed[kind]}"
            yield Row(f"{name}: {kind}, recognised and not made", float(self.false[kind]), "", note)
        lists = [(f"{what}, late", "frame", values) for what, values in sorted(self.late.items())]
        lists += [
            ("pinch distance, error", "mm", self.pinch_mm),
            ("dial, error", "deg", self.dial_deg),
            ("ray, error", "deg", self.ray_deg),
        ]
        for what, unit, values in lists:
            if values:
                size = np.array(values) if unit == "frame" else np.abs(np.array(values))
                middle, high, most = np.percentile(size, [50.0, 95.0, 100.0])
                note = f"95 %: {high:.2f}, most {most:.2f}, of {len(values)}"
                yield Row(f"{name}: {what}", float(middle), unit, note)


def rows() -> Iterator[Row]:
    """Measure two marker rigs, the fused hand, and the silent recordings, true and before a wrist device."""
    for marked in ("desk-back3", "desk4"):
        yield from scored(marked, None, 1, 75.0).rows(marked)
    yield from scored("desk-back3", "wrist-back3", 7, 29.0).rows("desk-back3+wrist-back3")
    yield from silent(_SILENT, worn=False, seconds=60.0).rows("silent, true hands")
    yield from silent(_SILENT, worn=True, seconds=25.0).rows("silent, wrist device alone")


def scored(marked: str, worn: str | None, seed: int, seconds: float) -> Score:
    """Score the scene before a marker rig, and a wrist device if there is one."""
    settings, score, setup = default_gestures(), Score(), load_setup(CALIBRATION, marked)
    scene = scene_by_name("gestures", setup.rig, setup.cameras, setup.hand.profile, seed)
    assert isinstance(scene.motion, Gestures)
    truth = GestureTruth.of(scene.motion, scene.model, settings, min(seconds, scene.period_s))
    if worn is not None:
        shown = watched(Both.of("gestures", seed, rigs=(marked, worn)), seconds)
        poses = solve_both(shown.both.fused, shown.messages)
    else:
        poses = seen_poses(setup, "gestures", seed, seconds)
    score.add(recognised(poses, scene.model, settings), truth)
    return score


def silent(names: Sequence[str], *, worn: bool, seconds: float) -> Score:
    """Score recorded hands that make no gesture, each for so long: as they truly are, or before a wrist device."""
    settings, score, setup = default_gestures(), Score(), load_setup(CALIBRATION, "desk-back3")
    for name in names:
        scene = f"leap:{datasets() / 'leapjs' / name}.npz"
        made = scene_by_name(scene, setup.rig, setup.cameras, setup.hand.profile, 1)
        poses: Iterable[HandPose] = true_poses(made.motion, made.model, seconds)
        if worn:
            shown = shown_of(Both.of(scene, 1), seconds)
            poses = solve_both(shown.both.wrist, shown.messages)
        score.add_silent(recognised(poses, made.model, settings))
    return score


def recognised(poses: Iterable[HandPose], model: HandModel, settings: GestureSettings) -> list[Gesture]:
    """Return the gestures of poses, but for the shapes that the hand is held in."""
    recogniser = GestureRecogniser(settings, model)
    return [one for pose in poses for one in recogniser.push(pose) if one.kind != "pose"]


def seen_poses(setup: RigSetup, name: str, seed: int, seconds: float) -> list[HandPose]:
    """Return the poses of a scene through rendered frames, detectors and master."""
    scene = scene_by_name(name, setup.rig, setup.cameras, setup.hand.profile, seed)
    return solve(setup, [watch(scene, c, times_of(scene, c, seconds, RATE_HZ)) for c in setup.rig.cameras])[0]


def true_poses(motion: HandMotion, model: HandModel, seconds: float) -> Iterator[HandPose]:
    """Yield the true hand at every frame, known to a millimetre."""
    for k in range(round(seconds * RATE_HZ)):
        state = motion.at(k / RATE_HZ)
        joints = model.forward(state.T_rig_palm, state.angles_rad)
        place, rotated = joints.position_m, matrix_to_quaternion(joints.rotation)
        yield pose_of(model, START_NS + round(k / RATE_HZ * 1e9), place, rotated, state.angles_rad, 1e-3)


def _s(t_ns: int) -> float:
    return (t_ns - START_NS) * 1e-9
