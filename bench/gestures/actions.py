"""Pinch, dial, taps and pointing of the scene `gestures`, and false ones of hands that make none; exact truth.

Rendered frames of a marker rig go through the slaves' detectors and the master to the recogniser; `--exact` leaves out
all of that and gives it the true hand, so that only the recogniser's own errors remain. An event is late by how long
after the truth's (`bench.gestures.truth`) it is recognised, in frames of 60 Hz; one that nobody made is false. The
recordings `leapjs` make no gesture; they are the truth, played by our hand. MARKER_RIG+WRIST_RIG is the fused hand.

    python -m bench gestures --rigs desk-back3 desk4 --seeds 1 2 --seconds 75
    python -m bench gestures --rigs desk-back3+wrist-back3 --seeds 7 --seconds 29
    python -m bench gestures --exact --leap wave three-claps
    python -m bench gestures --rigs wrist --seeds --leap wave three-claps    a wrist device alone, messages of truth
"""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.both.scene import Both
from bench.both.shown import shown_of
from bench.both.solved import solve as solve_both
from bench.both.watched import watched
from bench.gestures.recognised import pose_of
from bench.gestures.truth import GestureTruth
from bench.played import START_NS, solve, times_of, watch
from bench.report import CALIBRATION, Row, datasets, show
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandModel
from common.messages import Gesture, HandPose
from common.sim.gestures import Gestures
from common.sim.motion import HandMotion
from common.sim.scenes import scene_by_name
from master.gestures.poses import GestureRecogniser
from master.rig.setup import RigSetup, load_setup

RATE_HZ = 60.0
_FUSED, _WRIST_PEOPLE = "desk-back3+wrist-back3", "wrist"
_SILENT = ("wave", "HandSplay-110fps", "rollAndPitchWithEntry", "three-claps", "confidence-demo")
_NEAR_S = 0.3  # a recognised event farther from a true one is another
_KINDS = ("pinch", "dial", "tap", "point")


@dataclass(slots=True)
class Score:
    """Recognised gestures of one scene, or of several: late [frames] by kind and phase, errors, counts by kind.

    `jitter_deg`: of the pointing ray from pose to pose, against the truth's.
    """

    late: dict[str, list[float]] = field(default_factory=lambda: dict[str, list[float]]())
    made: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    missed: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    false: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    pinch_mm: list[float] = field(default_factory=lambda: list[float]())
    dial_deg: list[float] = field(default_factory=lambda: list[float]())
    ray_deg: list[float] = field(default_factory=lambda: list[float]())
    jitter_deg: list[float] = field(default_factory=lambda: list[float]())

    def add(self, found: Sequence[Gesture], truth: GestureTruth) -> None:
        """Compare recognised gestures with the truth."""
        free = [one for one in found if one.phase == "begin" or one.kind == "tap"]
        for event in truth.events:
            self.made[event.kind] += 1
            at_s = event.end_s if event.kind == "tap" else event.begin_s
            same = [one for one in free if (one.kind, one.name) == (event.kind, event.name)]
            first = min(same, key=lambda one: abs(_s(one.t_ns) - at_s), default=None)
            if first is None or abs(_s(first.t_ns) - at_s) > _NEAR_S:
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
        first_s, before = _s(course[0].t_ns), None
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
                if before is not None:
                    self.jitter_deg.append(float(np.degrees(np.linalg.norm(off - before))))
                before = off

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
            ("ray from pose to pose, error", "deg", self.jitter_deg),
        ]
        for what, unit, values in lists:
            if values:
                size = np.array(values) if unit == "frame" else np.abs(np.array(values))
                middle, high, most = np.percentile(size, [50.0, 95.0, 100.0])
                note = f"95 %: {high:.2f}, most {most:.2f}, of {len(values)}"
                yield Row(f"{name}: {what}", float(middle), unit, note)


def rows() -> Iterator[Row]:
    """Measure two marker rigs, the fused hand, and the silent recordings, true and before a wrist device."""
    for rig in ("desk-back3", "desk4"):
        yield from scored(rig, (1,), 75.0, exact=False).rows(rig)
    yield from scored(_FUSED, (7,), 29.0, exact=False).rows(_FUSED)
    yield from silent(_SILENT, None, 60.0).rows("silent, true hands")
    yield from silent(_SILENT, _WRIST_PEOPLE, 25.0).rows("silent, wrist device alone")


def scored(rig: str, seeds: Sequence[int], seconds: float, *, exact: bool) -> Score:
    """Score the scene of several seeds before a marker rig, or MARKER_RIG+WRIST_RIG."""
    settings, score = default_gestures(), Score()
    for seed in seeds:
        marked, _, worn = rig.partition("+")
        setup = load_setup(CALIBRATION, marked)
        scene = scene_by_name("gestures", setup.rig, setup.cameras, setup.hand.profile, seed)
        assert isinstance(scene.motion, Gestures)
        truth = GestureTruth.of(scene.motion, scene.model, settings, min(seconds, scene.period_s))
        if exact:
            poses: Iterable[HandPose] = true_poses(scene.motion, scene.model, seconds)
        elif worn:
            shown = watched(Both.of("gestures", seed, rigs=(marked, worn)), seconds)
            poses = solve_both(shown.both.fused, shown.messages)
        else:
            poses = seen_poses(setup, "gestures", seed, seconds)
        score.add(recognised(poses, scene.model, settings), truth)
    return score


def silent(names: Sequence[str], rig: str | None, seconds: float) -> Score:
    """Score recorded hands that make no gesture, each for so long: as they truly are, or before a rig."""
    settings, score = default_gestures(), Score()
    for name in names:
        setup = load_setup(CALIBRATION, "desk-back3" if rig in (None, _WRIST_PEOPLE) else rig)
        scene = f"leap:{datasets() / 'leapjs' / name}.npz"
        made = scene_by_name(scene, setup.rig, setup.cameras, setup.hand.profile, 1)
        if rig is None:
            poses: Iterable[HandPose] = true_poses(made.motion, made.model, seconds)
        elif rig == _WRIST_PEOPLE:
            shown = shown_of(Both.of(scene, 1), seconds)
            poses = solve_both(shown.both.wrist, shown.messages)
        else:
            poses = seen_poses(setup, scene, 1, seconds)
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


def main(arguments: Sequence[str]) -> None:
    """Print the rows of some rigs and recordings."""
    keep = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m bench gestures", description=__doc__, formatter_class=keep)
    parser.add_argument("--rigs", nargs="*", default=["desk-back3"], metavar="RIG")
    parser.add_argument("--seeds", nargs="*", type=int, default=[1], metavar="N")
    parser.add_argument("--seconds", type=float, default=75.0)
    parser.add_argument("--exact", action="store_true", help="the true hand instead of rendered frames")
    parser.add_argument(
        "--leap", nargs="*", default=[], metavar="NAME", help="recordings that make no gesture"
    )
    options = parser.parse_args(arguments)
    for rig in options.rigs:
        if options.seeds:
            show(scored(rig, options.seeds, options.seconds, exact=options.exact).rows(rig))
        if options.leap:
            found = silent(options.leap, None if options.exact else rig, options.seconds)
            show(found.rows(f"{rig}, silent"))
