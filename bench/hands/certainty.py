"""Do the covariances of joints hold? Exact motions, markers with the claimed noise, fingers hidden, hands lost.

A joint is *visible* while its finger's marker is seen (of the palm: while three markers are), *hidden* for the first
300 ms without, *lost* after half a second; a hand is *gone* while no marker is seen and it is valid.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import msgspec
import numpy as np

from bench.hands.draws import BACK, EDGE_ON, MARKERS, TOWARDS, PointHand
from bench.played import HeldPoses, solve, times_of, times_of_poses, watch
from bench.report import CALIBRATION, Row, chi_squares, datasets, inside, joined, rms, skipped
from common.arrays import Bool, Float
from common.calibration import Couplings, HandProfile, load
from common.hand.model import CHAINS, TIPS, HandModel
from common.sim.motion import HandMotion, ScriptedMotion, StudyPoses
from common.sim.people import load_leap
from common.sim.scenes import scene_by_name
from master.rig.setup import RigSetup, load_setup

HAND = CALIBRATION / "hands/default-right.json"
NOISE_M = {"1 mm": (1e-3, 1e-3, 1e-3), "depth 4.5 mm": (0.3e-3, 0.3e-3, 4.5e-3)}
SEEDS = (11, 12, 13, 14, 15, 16)  # what was decided by looking, was decided by 1 to 8
_CENTRE = np.array([0.0, 0.0, 0.5])
_RATE_HZ = 60.0
_SETTLED_S = 0.5
# Knuckles and the thumb's root move with the palm.
_PALM_JOINTS = np.setdiff1d(np.arange(1, 26), CHAINS[:, 1:])
_DIP_OFF = np.radians(8.0)
_TURN = np.radians(45.0)


def random_poses(model: HandModel, centre_m: Float, seed: int) -> HeldPoses:
    """Independent random joints, DIPs off their coupling, the palm turned every way; each held, then on to the next."""
    rng = np.random.default_rng([seed, 7])
    low, high = model.limits_rad[..., 0], model.limits_rad[..., 1]
    held: list[tuple[Float, Float, Float]] = []
    for _ in range(32):
        angles = rng.uniform(low, high)
        if model.dip_per_pip is not None:
            angles[1:, 3] = model.dip_per_pip * angles[1:, 2] + rng.uniform(-_DIP_OFF, _DIP_OFF, 4)
        at = centre_m + rng.uniform(-0.05, 0.05, 3)
        held.append((at, rng.uniform(-_TURN, _TURN, 3), np.clip(angles, low, high)))
    return HeldPoses(model, held)


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Joints (N,) with what was claimed of them."""

    chi_2: Float  # by the claimed covariance; 95 % lie below 7.8
    error_m: Float
    sigma_m: Float  # claimed: root of the mean variance
    hidden_s: Float  # 0: visible
    gone: Float  # whether the whole hand was
    joint: Float

    def only(self, which: Bool) -> "Coverage":
        """Those of the joints that `which` (N,) marks."""
        return Coverage(*(getattr(self, f.name)[which] for f in fields(self)))

    @property
    def inside(self) -> float:
        """Share inside the 95 % region [%]."""
        return inside(self.chi_2)


def motions(profile: HandProfile, seed: int) -> Iterator[tuple[str, HandModel, HandMotion]]:
    """The motions of a seed by name, and whose they are; those of recordings where they are present."""
    model = HandModel.of(profile)
    yield "standard scene", model, ScriptedMotion(model, _CENTRE, seed)
    yield "study poses", model, StudyPoses(model, _CENTRE, seed)
    yield "random poses", model, random_poses(model, _CENTRE, seed)
    if recordings := leap_recordings():
        leap = HandModel.of(msgspec.structs.replace(profile, couplings=Couplings(dip_per_pip=1.0)))
        yield "recorded motion", leap, load_leap(recordings[seed % len(recordings)], leap, _CENTRE)


def leap_recordings() -> list[Path]:
    """The recorded motions, none where they are absent."""
    return sorted((datasets() / "leapjs").glob("*.npz"))


def seen_by(seed: int, times_s: Float) -> Bool:
    """(T, M) which markers are seen: each cycle hides one to three fingers briefly, others for long, and then all."""
    rng = np.random.default_rng([seed, 5])
    seen = np.ones((len(times_s), len(MARKERS)), dtype=bool)
    cycle_s = 4.0
    for start in np.arange(0.5, times_s[-1], cycle_s):
        for after_s, lasts_s, count in ((0.0, 0.4, 3), (0.9, 1.2, 3), (2.7, 0.5, 0)):
            begin = start + after_s + rng.uniform(0.0, 0.4)
            hidden = np.arange(len(MARKERS))
            if count:
                hidden = rng.choice(5, int(rng.integers(1, count + 1)), replace=False)
            now = np.flatnonzero((times_s >= begin) & (times_s < begin + lasts_s))
            seen[np.ix_(now, hidden)] = False
    return seen


def compared(model: HandModel, motion: HandMotion, sigma_m: tuple[float, ...], seed: int) -> Coverage:
    """One motion pushed through the estimator, against its truth."""
    rng = np.random.default_rng([seed, 6])
    seconds = 16.0
    times = np.arange(round(seconds * _RATE_HZ)) / _RATE_HZ
    begin_s = float(rng.uniform(0.0, min(motion.period_s, 60.0)))
    seen = seen_by(seed, times)
    cov = np.repeat(np.diag(np.square(sigma_m))[None], len(MARKERS), axis=0)
    solver, since = PointHand(model, MARKERS), np.zeros(5)
    parts: list[Coverage] = []
    for k, t in enumerate(times.tolist()):
        now = motion.at(begin_s + t)
        truth = model.forward(now.T_rig_palm, now.angles_rad)
        points = model.marker_points(truth, MARKERS) + rng.normal(size=(len(MARKERS), 3)) * sigma_m
        if now.T_rig_palm[:3, 1] @ TOWARDS < EDGE_ON:  # its back is turned away
            seen[k, BACK] = False
        points[~seen[k]] = np.nan
        hand = solver.push(round(t * 1e9), points, cov)
        since = np.where(seen[k, :5], 0.0, since + 1.0 / _RATE_HZ)
        if hand.solution is None or not hand.valid.all() or t < _SETTLED_S:
            continue
        gone = not seen[k].any()
        place, claimed = hand.solution.joints.position_m, hand.solution.cov_m2
        parts.append(_judged(place - truth.position_m, claimed, since, gone))
    return joined(parts)


def rendered(setup: RigSetup, profile: HandProfile, seed: int) -> Coverage:
    """The six study poses before one pair of cameras: drawn, detected and solved by the whole line."""
    scene = scene_by_name("poses", setup.rig, setup.cameras, profile, seed)
    rendered_s = 12.0
    watched = [
        watch(scene, name, times_of(scene, name, rendered_s, setup.cameras[name].frame_rate_hz))
        for name in setup.rig.cameras
    ]
    poses, _ = solve(setup, watched)
    since, parts = np.zeros(5), list[Coverage]()
    for before, pose, t in zip(poses, poses[1:], times_of_poses(poses[1:]).tolist(), strict=False):
        shown = pose.tracked[TIPS]
        since = np.where(shown, 0.0, since + (pose.t_ns - before.t_ns) * 1e-9)
        if pose.valid.all() and t > _SETTLED_S:
            off = pose.position_m - scene.truth(t).joints.position_m
            parts.append(_judged(off, pose.cov_m2, since, not pose.tracked.any()))
    return joined(parts)


def _judged(off_m: Float, cov_m2: Float, since_s: Float, gone: bool) -> Coverage:
    """Errors (26, 3) by covariances (26, 3, 3), of fingers hidden for (5,) [s]."""
    hidden = np.zeros(26)
    hidden[CHAINS[:, 1:]] = since_s[:, None]
    if gone:
        hidden[:] = since_s.min()
    off, claimed = off_m[1:], cov_m2[1:]
    return Coverage(
        chi_squares(off, claimed),
        np.linalg.norm(off, axis=1),
        np.sqrt(np.trace(claimed, axis1=1, axis2=2) / 3.0),
        hidden[1:],
        np.full(25, float(gone)),
        np.arange(1.0, 26.0),
    )


def kinds(found: Coverage) -> Iterator[tuple[str, Coverage]]:
    """The joints of a run by how they are seen."""
    here, step = found.gone == 0.0, 0.5 / _RATE_HZ
    palm, visible = np.isin(found.joint, _PALM_JOINTS), found.hidden_s == 0.0
    yield "visible", found.only(here & visible)
    yield "  of these the fingers'", found.only(here & visible & ~palm)
    short_s, long_s = 0.3, 0.5
    yield "hidden up to 300 ms", found.only(here & ~visible & (found.hidden_s <= short_s + step))
    yield "hidden for 300 ms", found.only(here & (np.abs(found.hidden_s - short_s) < step))
    yield "lost for longer than 0.5 s", found.only(here & (found.hidden_s > long_s + step))
    yield "whole hand gone, up to 0.5 s", found.only(~here)


def rows() -> Iterator[Row]:
    """Coverage by motion and noise, of rendered hands, and of all motions together."""
    profile = load(HAND, HandProfile)
    everything: list[Coverage] = []
    for noise, sigma_m in NOISE_M.items():
        for played in zip(*(motions(profile, seed) for seed in SEEDS), strict=True):
            given = zip(played, SEEDS, strict=True)
            parts = [compared(model, motion, sigma_m, seed) for (_, model, motion), seed in given]
            yield from _group(f"{played[0][0]}, {noise}", parts)
            everything += parts
    if not leap_recordings():
        yield skipped("recorded motion", datasets())
    setup = load_setup(CALIBRATION, "desk")
    yield from _group("study poses, rendered", [rendered(setup, profile, seed) for seed in SEEDS])
    yield from _group("all motions but the rendered", everything)


def _group(title: str, parts: list[Coverage]) -> Iterator[Row]:
    yield Row(title, len(parts), "runs", "")
    for name, part in kinds(joined(parts)):
        if len(part.chi_2):
            error, claimed = rms(1e3 * part.error_m), np.sqrt(3.0) * rms(1e3 * part.sigma_m)
            yield Row(
                f"  {name}: inside 95 %", part.inside, "%", f"RMS {error:.1f} mm, claimed {claimed:.1f}"
            )
