"""The whole hand on a moving hand: ours warm and afresh, and others on the same caps; what a fixed palm costs.

A hand bends its fingers while its palm turns by 20 degrees, 60 frames a second, caps with the noise of good centroids.
Ours, scipy and mink weigh the same caps and the same habits of natural hands and keep the same limits, but mink weighs
all directions alike and takes each habit for itself, and neither of the two knows the last frame but as a start.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np

from bench import peers_mink, peers_scipy
from bench.hand_draws import FACING_ROTATION, MARKERS, Draw, Noise, bench_model, posed
from bench.hand_score import Score, score
from bench.peers_paper import Fingers, PaperFingers, closed_form, finger_solvers, fixed_palm, tips_in_palm
from bench.row import Row
from bench.solved_hand import PointHand
from common.arrays import Float
from common.geometry.transforms import rigid, rotation_vector_to_matrix
from common.hand.model import HandModel
from master.estimator.parameters import HandParameters
from master.estimator.priors import posture_prior_of
from master.estimator.settings import DEFAULT

FRAMES = 240
_PERIOD_S = 1 / 60
NOISE = Noise((0.15e-3, 0.15e-3, 1.0e-3))
_SEED = 7
_ROTATION_RAD = np.radians(20.0)
_SLOW = {"scipy": 20, "mink": 4, "papers' way": 2}  # one frame in so many
WARM = "whole hand, warm"

Hand = tuple[Float, Float]  # palm (4, 4), angles (5, 4) [rad]
Way = Callable[[Float], Hand]  # caps (M, 3) [m] -> hand


def rows(frames: int = FRAMES) -> list[Row]:
    """Time per hand and errors of every way that is there."""
    model = bench_model()
    truth = motion(model, frames)
    rng = np.random.default_rng(_SEED)
    points = truth.caps_m + rng.normal(size=truth.caps_m.shape) * NOISE.place_m
    out: list[Row] = []
    us: dict[str, float] = {}
    for name, way in ways(model).items():
        step = _SLOW.get(name, 1)
        found, us[name], spread = timed(model, way, truth.every(step), points[::step])
        out += way_rows(name, found, us[name], spread)
    if not peers_mink.installed():
        out.append(Row("mink: skipped", 0.0, "", peers_mink.INSTALL))
    return [*out, Row(f"{WARM}: times faster than scipy", us["scipy"] / us[WARM], "x", "")]


def motion(model: HandModel, frames: int) -> Draw:
    """A hand that bends its fingers, each in its own phase, while the palm turns about all axes."""
    rng = np.random.default_rng(_SEED)
    t = _PERIOD_S * np.arange(frames)
    rotation = _ROTATION_RAD * np.stack(
        [np.sin(1.1 * t), np.sin(0.8 * t + 1.0), np.sin(0.9 * t + 2.0)], axis=1
    )
    place = np.array([0.03, 0.08, 0.5])
    poses = np.stack([rigid(rotation_vector_to_matrix(v) @ FACING_ROTATION, place) for v in rotation])
    angles = np.zeros((frames, 5, 4))
    bend = 0.5 + 0.4 * np.sin(2.0 * t[:, None] + rng.uniform(0, 2 * np.pi, 5))
    angles[:, :, 2] = bend
    angles[:, 1:, 1] = 0.6 * bend[:, 1:] + 0.1 * np.sin(1.3 * t)[:, None]
    angles[:, 1:, 3] = (model.dip_per_pip or 0.0) * bend[:, 1:]
    thumb = bend[:, 0]
    angles[:, 0] = np.stack([0.2 + 0 * t, 0.2 + 0.1 * thumb, 0.3 * thumb, 0.4 * thumb], axis=1)
    return posed(model, poses, angles)


def ways(model: HandModel) -> dict[str, Way]:
    """Every solver that is there, by name; each begins afresh."""
    fingers = finger_solvers(model)
    posture_prior = _PosturePrior.of(model)
    out: dict[str, Way] = {
        WARM: ours(model, warm=True),
        "whole hand, afresh": ours(model, warm=False),
        "papers' way": _with_fixed_palm(model, PaperFingers(fingers).push),
        "closed form, fixed palm": _with_fixed_palm(model, lambda tips: closed_form(fingers, tips)),
    }
    scipy = peers_scipy.WholeHand.of(model, NOISE)
    out["scipy"] = lambda points: scipy.solve(points, fixed_palm(model, points), posture_prior.mean)
    if peers_mink.installed():
        sigma = np.sqrt(np.square(NOISE.place_m) + DEFAULT.bones_m**2)
        mink = peers_mink.MinkHand(
            model, weight=1.0 / sigma, posture=(posture_prior.mean, posture_prior.per_sigma)
        )
        mink.begin(rigid(FACING_ROTATION, np.array([0.0, 0.0, 0.5])), posture_prior.mean)
        out["mink"] = mink.push
    return out


def ours(model: HandModel, *, warm: bool) -> Way:
    """The estimator on caps; `warm`: it goes on from the last hand."""
    solver, clock = PointHand(model, MARKERS, continuous=warm, faces=False), count(1)

    def way(points_m: Float) -> Hand:
        found = solver.push(round(1e9 * _PERIOD_S * next(clock)), points_m, NOISE.cov_m2).solution
        if found is None:
            return np.full((4, 4), np.nan), np.full((5, 4), np.nan)
        return found.T_rig_palm, found.angles_rad

    return way


@dataclass(frozen=True, slots=True, eq=False)
class _PosturePrior:
    """Natural angles (5, 4) [rad], and one per sigma (5, 4) [1/rad] of each by itself; 0 for a coupled DIP."""

    mean: Float
    per_sigma: Float

    @classmethod
    def of(cls, model: HandModel) -> "_PosturePrior":
        parameters = HandParameters.of(model)
        posture_prior = posture_prior_of(model, parameters).natural_component()
        cov: Float = np.asarray(np.linalg.inv(posture_prior.normal[0]), np.float64)
        per_sigma = np.zeros(20)
        per_sigma[parameters.free] = 1.0 / np.sqrt(np.diagonal(cov))
        return cls(model.clamp(parameters.angles(cov @ posture_prior.pull[0])), per_sigma.reshape(5, 4))


def _with_fixed_palm(model: HandModel, fingers: Fingers) -> Way:
    def way(points_m: Float) -> Hand:
        palm = fixed_palm(model, points_m)
        return palm, np.array(fingers(tips_in_palm(palm, points_m)))

    return way


def timed(model: HandModel, way: Way, truth: Draw, points_m: Float) -> tuple[Score, float, float]:
    """Errors of a way, its median processor time per hand, and half the distance of the quartiles [us]."""
    found: list[Hand] = []
    times: list[float] = []
    for points in points_m:
        start = time.thread_time()
        found.append(way(points))
        times.append(1e6 * (time.thread_time() - start))
    low, middle, high = np.percentile(times, (25, 50, 75)).tolist()
    palms, angles = (np.array(part) for part in zip(*found, strict=True))
    return score(model, truth, palms, angles, points_m), middle, (high - low) / 2


def way_rows(name: str, found: Score, us: float, spread_us: float) -> Sequence[Row]:
    """Time, joints, PIP; tips missed and limits passed as notes."""
    ours = name.startswith("whole hand")
    legal = f"limit violations {found.violations}, not found {found.not_finite}"
    pip = f"{found.pip_rms_deg:.2g} RMS; {found.missed_percent:.3g} % of tips > 1 mm off"
    return [
        Row(f"{name}: hand", us, "us", f"± {spread_us:.3g}{'; goal 1500' if name == WARM else ''}; {legal}"),
        Row(f"{name}: joints", float(found.joints_mm.mean()), "mm", "goal 6" if ours else ""),
        Row(f"{name}: PIP", float(found.pip_deg.mean()), "deg", f"goal 7.5; {pip}" if ours else pip),
    ]
