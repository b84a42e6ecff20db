"""The inverse model of the wrist device: fingers in any pose, from laser point and fingertip, exact and with noise.

Random poses, each angle anywhere within its limits, of three hands before palms that lie differently: right, left, and
a right one 8 % smaller. Of every finger whose line and tip are in sight the production code gets what the forward
function says. Where one pose alone explains that, it has to be the true one; where another explains as much, the finger
has to be called ambiguous, and the true pose be among the minima.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.markers import Step, interleaved
from bench.row import Row
from bench.wrist_shown import other_palm
from common.arrays import Bool, Float
from common.calibration import CameraCalibration, RigCalibration, load
from common.hand_model import FINGERS, HandModel
from common.hand_profiles import generated_profile
from common.messages import HandPose, Level, WristDetections
from master.wrist.finger_poses import UNKNOWNS, FingerPoses
from master.wrist.forward import ForwardTable
from master.wrist.inverse import InverseModel
from master.wrist.invert import Inverse
from master.wrist.laser_plane import PlaneAxes
from master.wrist.pipeline import WristPipeline
from master.wrist.setup import WristSetup
from master.wrist.sight import SightNoise

_CALIBRATION = Path(__file__).resolve().parents[1] / "calib_json"
_HANDS = (("right", "wrist", 0.19), ("left", "wrist-left", 0.19), ("small", "wrist", 0.175))
_POSES, _NOISY = 1000, 150  # of each hand
_TRIPLE_NS = 33_333_333
_ASIDE_RAD = np.radians(15.0)
_LEAST_PX = 10.0  # of line
_EXACT_PX = 0.02
_FOLDED_RAD = np.radians(75.0)  # from about here the last phalanx can cut the line
_GOAL_RAD = np.radians(0.1)


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """Hands in N poses.

    Attributes:
        setup: Device and hand.
        x_rad: (N, 5, 3).
        laser_uv, tip_uv: (N, 5, 2) [px], without errors; NaN where line or tip are not in sight.
    """

    setup: WristSetup
    x_rad: Float
    laser_uv: Float
    tip_uv: Float

    @property
    def both(self) -> Bool:
        """(N, 5) fingers whose line and tip are in sight."""
        return np.isfinite(self.tip_uv[..., 0])


def rows() -> Iterator[Row]:
    """Rows of exact inputs, of noisy ones, and what a message costs."""
    hands = [_posed(k, *hand) for k, hand in enumerate(_HANDS)]
    models = [InverseModel(hand.setup) for hand in hands]
    tables = [Inverse(ForwardTable.of(hand.setup)) for hand in hands]
    yield from _exact(hands, models, tables)
    for laser_px, tip_px in ((0.3, 2.0), (0.9, 3.0)):
        yield from _noisy(hands, models, tables, laser_px, tip_px)
    yield from _cost(hands[0], models[0], tables[0])


def _posed(number: int, name: str, rig_name: str, hand_length_m: float) -> Posed:
    rng = np.random.default_rng([number, 17])
    rig = other_palm(load(_CALIBRATION / f"rigs/{rig_name}.json", RigCalibration), rng)
    camera = load(_CALIBRATION / f"cameras/{rig.cameras[0]}.json", CameraCalibration)
    side = "left" if name == "left" else "right"
    setup = WristSetup.of(rig, camera, HandModel.of(generated_profile(name, side, hand_length_m)))
    setup = replace(setup, level="ik")
    poses = FingerPoses(setup)
    limits = setup.model.limits_rad[:, :UNKNOWNS]
    x = rng.uniform(limits[..., 0], limits[..., 1], (_POSES, 5, UNKNOWNS))
    x[..., 0] = rng.uniform(-_ASIDE_RAD, _ASIDE_RAD, (_POSES, 5))
    x = setup.model.clamp(poses.angles(x))[..., :UNKNOWNS]  # abduction narrows with flexion
    views = poses.views(x, np.ones((_POSES, 5), np.bool_))
    laser = setup.optics.project(PlaneAxes.of(setup).space(views.seen[..., :2]))
    tip = setup.optics.distort(views.seen[..., 2:])
    size = np.array([setup.optics.width_px, setup.optics.height_px]) - 1.0
    shown = (views.length_px > _LEAST_PX) & poses.tips_shown(x)
    for uv in (laser, tip):
        with np.errstate(invalid="ignore"):
            shown &= (uv > 0.0).all(axis=-1) & (uv < size).all(axis=-1)
    return Posed(setup, x, *(np.where(shown[..., None], uv, np.nan) for uv in (laser, tip)))


def _exact(hands: list[Posed], models: list[InverseModel], tables: list[Inverse]) -> Iterator[Row]:
    off: list[Float] = []
    pip: list[Float] = []
    listed = several = seen = 0
    for hand, model, table in zip(hands, models, tables, strict=True):
        found = _solved(hand, model, table, hand.laser_uv, hand.tip_uv, _EXACT_PX, _EXACT_PX)
        error = np.abs(_angles(found) - hand.x_rad).max(axis=-1)
        ambiguous = np.array([pose.ambiguous for pose in found])
        error[np.array([pose.level for pose in found]) != Level.IK] = np.inf
        off.append(error[hand.both & ~ambiguous])
        pip.append(hand.x_rad[..., 2][hand.both & ~ambiguous])
        seen += int(hand.both.sum())
        several += int((hand.both & ambiguous).sum())
        listed += sum(_listed(hand, model, n, f) for n, f in np.argwhere(hand.both & ambiguous))
    error, bent = np.concatenate(off), np.concatenate(pip) > _FOLDED_RAD
    yield Row("fingers in sight", seen, "", f"of {5 * _POSES * len(hands)} random poses")
    yield Row("  of one pose alone", 100.0 * len(error) / seen, "%", "the others are called ambiguous")
    for name, of in (("PIP to 75 deg", error[~bent]), ("beyond, last phalanx in the light", error[bent])):
        within = 100.0 * float((of < _GOAL_RAD).mean())
        yield Row(f"  these, {name}: within 0.1 deg", within, "%", f"goal 100; of {len(of)}")
        most = float(np.degrees(np.percentile(of, 99.0, method="lower")))
        yield Row("    99 % within", most, "deg", f"median {np.degrees(np.median(of)):.4f}")
    yield Row(
        "  ambiguous, true pose among the minima", 100.0 * listed / max(several, 1), "%", f"of {several}"
    )


def _noisy(
    hands: list[Posed], models: list[InverseModel], tables: list[Inverse], laser_px: float, tip_px: float
) -> Iterator[Row]:
    rng = np.random.default_rng(5)
    error: list[Float] = []
    refused = seen = 0
    for hand, model, table in zip(hands, models, tables, strict=True):
        some = replace(
            hand, x_rad=hand.x_rad[:_NOISY], laser_uv=hand.laser_uv[:_NOISY], tip_uv=hand.tip_uv[:_NOISY]
        )
        laser = some.laser_uv + laser_px * rng.normal(size=some.laser_uv.shape)
        tip = some.tip_uv + tip_px * rng.normal(size=some.tip_uv.shape)
        found = _solved(some, model, table, laser, tip, laser_px, tip_px)
        solved = some.both & (np.array([pose.level for pose in found]) == Level.IK)
        off = (_angles(found) - some.x_rad)[solved]
        refused += int((some.both & ~solved).sum())
        seen += int(some.both.sum())
        error.append(np.abs(off[:, 2]))
    all_off = np.degrees(np.concatenate(error))
    name = f"noise of {laser_px:g} px laser, {tip_px:g} px tip"
    yield Row(f"{name}: PIP, median", float(np.median(all_off)), "deg", f"mean {all_off.mean():.1f}")
    yield Row("  refused", 100.0 * refused / seen, "%", "no tip is false here")


def _cost(hand: Posed, model: InverseModel, table: Inverse) -> Iterator[Row]:
    usual = np.flatnonzero(hand.both.sum(axis=1) >= 4)[:20]
    steps: dict[str, Step] = {}
    for level in ("fk", "auto"):
        pipeline = WristPipeline(
            replace(hand.setup, level=level), continuous=False, inverse=table, model=model
        )
        steps[level] = _pusher(pipeline, hand, usual.tolist())
    took = interleaved(steps)
    fk, auto = (float(np.median(took[level])) for level in ("fk", "auto"))
    yield Row("one message, level fk", fk, "us", "baseline")
    yield Row("the same, level auto, four or five fingers by both", auto, "us", f"{auto / fk:.1f} times fk")
    yield Row("  what the inverse model adds", auto - fk, "us", "goal 600")


def _pusher(pipeline: WristPipeline, hand: Posed, which: list[int]) -> Step:
    messages = [_message(hand.laser_uv[n], hand.tip_uv[n], 0.3, 2.0, 1) for n in which]
    at_ns = 0

    def step() -> None:
        nonlocal at_ns
        at_ns += _TRIPLE_NS
        n = at_ns // _TRIPLE_NS % len(messages)
        pipeline.push(_message(messages[n].laser_uv, messages[n].tip_uv, 0.3, 2.0, at_ns))

    return step


def _listed(hand: Posed, model: InverseModel, n: int, f: int) -> bool:
    """Whether the true pose of finger `f` in pose `n` is among the minima."""
    noise, axes = SightNoise(hand.setup), PlaneAxes.of(hand.setup)
    seen = np.full((5, 4), np.nan)
    views = model.poses.views(hand.x_rad[n][None], np.ones((1, 5), np.bool_))
    seen[f] = views.seen[0, f]
    distance = axes.space(views.seen[0, :, :2])[:, 2]
    cov = np.zeros((5, 4, 4))
    cov[:, :2, :2] = noise.laser_m2(np.zeros((5, 2, 2)), distance, np.ones(5), np.ones(5))
    cov[:, 2:, 2:] = noise.tip(np.full(5, _EXACT_PX), distance)
    cov[np.arange(5) != f] = np.eye(4)
    off = np.abs(model(seen, cov).x_rad[f] - hand.x_rad[n, f]).max(axis=-1)
    return bool((off < 5.0 * _GOAL_RAD).any())


def _solved(
    hand: Posed, model: InverseModel, table: Inverse, laser: Float, tip: Float, laser_px: float, tip_px: float
) -> list[HandPose]:
    pipeline = WristPipeline(hand.setup, continuous=False, inverse=table, model=model)
    out: list[HandPose] = []
    for k, (points, ends) in enumerate(zip(laser, tip, strict=True)):
        message = _message(points, ends, laser_px, tip_px, (k + 1) * _TRIPLE_NS)
        out += [solved.pose for solved in pipeline.push(message)]
    return out


def _angles(poses: list[HandPose]) -> Float:
    return np.array([pose.angles_rad[:, :UNKNOWNS] for pose in poses])


def _message(laser: Float, tip: Float, laser_px: float, tip_px: float, t_ns: int) -> WristDetections:
    return WristDetections(
        camera="wrist",
        session=1,
        seq=t_ns // _TRIPLE_NS,
        t_ns=t_ns,
        ready_t_ns=t_ns,
        laser_uv=laser,
        laser_sigma_px=np.where(np.isnan(laser).any(axis=1), np.nan, laser_px),
        laser_px=np.full(5, np.nan),
        tip_uv=tip,
        tip_sigma_px=np.where(np.isnan(tip).any(axis=1), np.nan, tip_px),
        tip_depth=np.full(len(FINGERS), np.nan),
    )
