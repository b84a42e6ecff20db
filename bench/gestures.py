"""Pinch, dial, taps and pointing of the scene `gestures`, and what is told of hands that say nothing; exact truth.

Rendered frames of a marker rig go through the slaves' detectors and the master to the recogniser; `--exact` leaves out
all of that and tells it the true hand, so that what is left is the recogniser's own. An event is late by how long after
the truth's (`gesture_truth`) it is told, in frames of 60 Hz; one that nobody said is false. The recordings `leapjs` say
nothing but where they are named for it; they are the truth, played by our hand.

The fused hand of two rigs stands as MARKER_RIG+WRIST_RIG; what its cameras see is kept in out/fusion, for to draw the
wrist camera takes long.

    python -m bench.gestures --rigs desk-back3 desk4 --seeds 1 2 --seconds 75
    python -m bench.gestures --rigs desk-back3+wrist-back3 --seeds 7 --seconds 29
    python -m bench.gestures --exact --leap wave three-claps
    python -m bench.gestures --rigs wrist --seeds --leap wave three-claps   a wrist device alone, messages made of truth
"""

import argparse
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np

from bench.fusion_kept import observed
from bench.fusion_scene import Both
from bench.fusion_shown import shown_of
from bench.fusion_solved import solve as solve_both
from bench.gesture_truth import GestureTruth
from bench.played import START_NS, solve, times_of, watch
from bench.row import Row
from common.arrays import Float
from common.calibration.gesture_settings import GestureSettings, default_gestures
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import HandModel
from common.messages import Gesture, HandPose
from common.sim.gestures import Gestures
from common.sim.motion import HandMotion
from common.sim.scenes import scene_by_name
from master.gestures.recogniser import GestureRecogniser
from master.rig.files import load_setup
from master.rig.setup import RigSetup

RATE_HZ = 60.0
FUSED = "desk-back3+wrist-back3"
WRIST = "wrist"
SILENT = ("wave", "HandSplay-110fps", "rollAndPitchWithEntry", "three-claps", "confidence-demo")
_CALIBRATION = Path(__file__).parent.parent / "calib_json"
_DATA = Path(os.environ.get("PHALANX_DATASETS", Path(__file__).parent.parent.parent / "shared/datasets"))
_NEAR_S = 0.3  # a told event further from a true one is another
_KINDS = ("pinch", "dial", "tap", "point")


@dataclass(slots=True)
class Score:
    """What was told of one scene, or of several: late [frames] by kind and phase, errors, and counts by kind.

    `jitter_deg`: of the pointing ray from pose to pose, against the truth's.
    """

    late: dict[str, list[float]] = field(default_factory=lambda: dict[str, list[float]]())
    annotations: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    missed: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    false: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_KINDS, 0))
    pinch_mm: list[float] = field(default_factory=lambda: list[float]())
    dial_deg: list[float] = field(default_factory=lambda: list[float]())
    ray_deg: list[float] = field(default_factory=lambda: list[float]())
    jitter_deg: list[float] = field(default_factory=lambda: list[float]())

    def add(self, recognised: Sequence[Gesture], truth: GestureTruth) -> None:
        """Hold what was told against the truth."""
        free = [one for one in recognised if one.phase == "begin" or one.kind == "tap"]
        for event in truth.events:
            self.annotations[event.kind] += 1
            at_s = event.end_s if event.kind == "tap" else event.begin_s
            same = [one for one in free if (one.kind, one.name) == (event.kind, event.name)]
            found = min(same, key=lambda one: abs(_s(one.t_ns) - at_s), default=None)
            if found is None or abs(_s(found.t_ns) - at_s) > _NEAR_S:
                self.missed[event.kind] += 1
                continue
            free.remove(found)
            self._late(f"{event.kind} begin" if event.kind != "tap" else "tap", _s(found.t_ns) - at_s)
            if event.kind == "tap":
                continue
            updates = [
                one for one in recognised if (one.kind, one.began_t_ns) == (found.kind, found.began_t_ns)
            ]
            if updates[-1].phase == "end":
                self._late(f"{event.kind} end", _s(updates[-1].t_ns) - event.end_s)
            self._values(updates, truth, event.end_s)
        # What is said at the very end is in no event, and is not false either.
        last_s = float(truth.t_s[-1]) - 1.0
        cut_s = min((one.start_s for one in truth.motion.annotations if one.stop_s >= last_s), default=last_s)
        for one in free:
            self.false[one.kind] += _s(one.t_ns) < min(cut_s, last_s)

    def add_silent(self, recognised: Iterable[Gesture]) -> None:
        """Of a hand that says nothing."""
        for one in recognised:
            self.false[one.kind] += one.phase == "begin" or one.kind == "tap"

    def _late(self, what: str, seconds: float) -> None:
        self.late.setdefault(what, []).append(seconds * RATE_HZ)

    def _values(self, updates: Sequence[Gesture], truth: GestureTruth, end_s: float) -> None:
        first_s, before = _s(updates[0].t_ns), None
        for one in updates:
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


def rows() -> Iterator[Row]:
    """Two marker rigs over a minute and a quarter of one seed, the first with the wrist device over less, and the
    silent recordings, as they are and before a wrist device."""
    for rig in ("desk-back3", "desk4"):
        yield from table(rig, scored(rig, (1,), 75.0, exact=False))
    yield from table(FUSED, scored(FUSED, (7,), 29.0, exact=False))
    yield from table("silent, true hands", silent(SILENT, None, 60.0))
    yield from table("silent, wrist device alone", silent(SILENT, WRIST, 25.0))


def scored(rig: str, seeds: Sequence[int], seconds: float, *, exact: bool) -> Score:
    """The scene of several seeds before a marker rig, or MARKER_RIG+WRIST_RIG."""
    settings, score = default_gestures(), Score()
    for seed in seeds:
        marked, _, wrist_rig = rig.partition("+")
        setup = load_setup(_CALIBRATION, marked)
        scene = scene_by_name("gestures", setup.rig, setup.cameras, setup.hand.profile, seed)
        if not isinstance(scene.motion, Gestures):
            raise TypeError("the scene `gestures` moves another way")
        truth = GestureTruth.of(scene.motion, scene.model, settings, min(seconds, scene.period_s))
        if exact:
            poses: Iterable[HandPose] = true_poses(scene.motion, scene.model, seconds)
        elif wrist_rig:
            poses = fused_poses((marked, wrist_rig), seed, seconds)
        else:
            poses = seen_poses(setup, "gestures", seed, seconds)
        score.add(recognised_in(poses, scene.model, settings), truth)
    return score


def silent(names: Sequence[str], rig: str | None, seconds: float) -> Score:
    """Recorded hands that say nothing, each for so long: as they truly are, or rendered before a rig."""
    settings, score = default_gestures(), Score()
    for name in names:
        setup = load_setup(_CALIBRATION, "desk-back3" if rig in (None, WRIST) else rig)
        scene = f"leap:{_DATA / 'leapjs' / name}.npz"
        made = scene_by_name(scene, setup.rig, setup.cameras, setup.hand.profile, 1)
        if rig is None:
            poses: Iterable[HandPose] = true_poses(made.motion, made.model, seconds)
        elif rig == WRIST:
            poses = wrist_poses(scene, 1, seconds)
        else:
            poses = seen_poses(setup, scene, 1, seconds)
        score.add_silent(recognised_in(poses, made.model, settings))
    return score


def recognised_in(poses: Iterable[HandPose], model: HandModel, settings: GestureSettings) -> list[Gesture]:
    """What is told of poses, but for the shapes that the hand is held in."""
    recogniser = GestureRecogniser(settings, model)
    return [one for pose in poses for one in recogniser.push(pose) if one.kind != "pose"]


def seen_poses(setup: RigSetup, name: str, seed: int, seconds: float) -> list[HandPose]:
    """The poses of a scene through rendered frames, detectors and master."""
    scene = scene_by_name(name, setup.rig, setup.cameras, setup.hand.profile, seed)
    watched = [
        watch(scene, camera, times_of(scene, camera, seconds, RATE_HZ)) for camera in setup.rig.cameras
    ]
    return solve(setup, watched)[0]


def fused_poses(rigs: tuple[str, str], seed: int, seconds: float) -> list[HandPose]:
    """The poses of the scene that a marker rig and a wrist device see together, rendered and detected."""
    shown = observed("gestures", seconds, seed, rigs=rigs)
    return solve_both(shown.both.fused, shown.messages)


def wrist_poses(name: str, seed: int, seconds: float) -> list[HandPose]:
    """The poses of a scene by the wrist device alone, of messages made of the truth."""
    shown = shown_of(Both.of(name, seed), seconds)
    return solve_both(shown.both.wrist, shown.messages)


def true_poses(motion: HandMotion, model: HandModel, seconds: float) -> Iterator[HandPose]:
    """The true hand at every frame, known to a millimetre."""
    every, nothing = np.ones(26, dtype=bool), np.full((1, 3), np.nan)
    cov = np.tile(1e-6 * np.eye(3), (26, 1, 1))
    for k in range(round(seconds * RATE_HZ)):
        state = motion.at(k / RATE_HZ)
        joints = model.forward(state.T_rig_palm, state.angles_rad)
        yield HandPose(
            hand=model.profile.name,
            t_ns=START_NS + round(k / RATE_HZ * 1e9),
            position_m=joints.position_m,
            orientation_wxyz=matrix_to_quaternion(joints.rotation),
            radius_m=model.radius_m,
            valid=every,
            tracked=every,
            cov_m2=cov,
            source=np.full(26, 2, dtype=np.uint8),
            angles_rad=state.angles_rad,
            markers_m=nothing,
            markers_raw_m=nothing,
            markers_cov_m2=np.full((1, 3, 3), np.nan),
            inside_volume=every,
        )


def table(name: str, score: Score) -> Iterator[Row]:
    """The rows of one score."""
    for kind in _KINDS:
        note = f"said {score.annotations[kind]}, missed {score.missed[kind]}"
        yield Row(f"{name}: {kind}, told and not said", float(score.false[kind]), "", note)
    for what, late in sorted(score.late.items()):
        yield Row(f"{name}: {what}, late", *_most(np.array(late), "frame"))
    for what, unit, values in (
        ("pinch distance", "mm", score.pinch_mm),
        ("dial", "deg", score.dial_deg),
        ("ray", "deg", score.ray_deg),
        ("ray from pose to pose", "deg", score.jitter_deg),
    ):
        if values:
            yield Row(f"{name}: {what}, error", *_most(np.abs(np.array(values)), unit))


def _most(values: Float, unit: str) -> tuple[float, str, str]:
    middle, high, most = np.percentile(values, [50.0, 95.0, 100.0])
    return float(middle), unit, f"95 %: {high:.2f}, most {most:.2f}, of {len(values)}"


def _s(t_ns: int) -> float:
    return (t_ns - START_NS) * 1e-9


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the rows of some rigs and recordings; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.gestures", description=__doc__)
    parser.add_argument("--rigs", nargs="*", default=["desk-back3"], metavar="RIG")
    parser.add_argument("--seeds", nargs="*", type=int, default=[1], metavar="N")
    parser.add_argument("--seconds", type=float, default=75.0)
    parser.add_argument("--exact", action="store_true", help="the true hand instead of rendered frames")
    parser.add_argument("--leap", nargs="*", default=[], metavar="NAME", help="recordings that say nothing")
    options = parser.parse_args(arguments)
    exact, seconds = cast(bool, options.exact), cast(float, options.seconds)
    for rig in cast(list[str], options.rigs):
        if options.seeds:
            score = scored(rig, cast(list[int], options.seeds), seconds, exact=exact)
            _print(table(rig, score))
        if options.leap:
            score = silent(cast(list[str], options.leap), None if exact else rig, seconds)
            _print(table(f"{rig}, silent", score))
    return 0


def _print(rows: Iterable[Row]) -> None:
    for row in rows:
        print(f"{row.name:52s} {row.value:8.3g} {row.unit:6s} {row.note}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
