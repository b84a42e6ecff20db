"""The palm by an IMU on the forearm while markers tell, and after: heading, bend, orientation; exact truth.

An arm turns and moves about all axes, and its wrist goes from posture to posture, within half a second, and wavers
between. The raw samples of a simulated IMU go through the filter of its slave; its world lies anywhere. Three markers
on the back of the hand are told at 60 Hz for ten seconds, to a millimetre per axis; then none for five. Their error is
plain noise, or one that stays for a second or two, as that of rendered hands does.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import atan2, pi, radians, remainder
from time import perf_counter_ns
from typing import Literal, NamedTuple

import numpy as np

from bench.fusion_scene import CALIBRATION
from bench.imu import Gestures
from bench.row import Row
from bench.solved_hand import NO_RAY, TOWARDS
from common.arrays import Float
from common.calibration import ImuCalibration
from common.geometry.transforms import (
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rigid,
    rotation_vector_to_matrix,
)
from common.hand.wrist_joint import STRAIGHT, forearm_palm
from common.imu.fusion import OrientationFilter
from common.messages import ImuSample
from common.sim.imu import SimulatedImu
from common.sim.motion import HandState, smooth_step
from master.estimator.cycle_reader import CycleReader
from master.estimator.epoch import Epoch, Fitted
from master.estimator.estimator import Estimator
from master.estimator.fused import WristSide
from master.estimator.wrist_device import HEADING, WRIST_ANGLES
from master.estimator.wrist_model import WristModel, loosened
from master.rig.files import load_setup
from master.rig.setup import RigSetup
from master.rig.wrist import WristSetup

# Cameras that look down on a desk: the vertical is 30 degrees off the rig's -y.
_WORLD = (float(np.cos(np.radians(60.0))), float(np.sin(np.radians(60.0))), 0.0, 0.0)
IMU = ImuCalibration(q_palm_imu=(0.5, 0.5, -0.5, 0.5), q_rig_world=_WORLD, heading_drift_rad_s=radians(1.0))
_SEEDS = range(201, 213)
_SIGMA_M = 1e-3
_REST_S, _VISIBLE_S, _GONE_S, _ROUNDS, _SETTLED_S = 3.0, 10.0, 5.0, 3, 3.0
_AFTER_S = (0.0, 0.5, 1.0, 2.0, 5.0)
_FRAME_S = 1.0 / 60.0
_REGION = np.array([3.841, 5.991, 7.815])  # chi square, 95 %: heading, bend, palm
Kind = Literal["plain", "staying"]
KINDS: tuple[Kind, ...] = ("plain", "staying")


class FlexedWrist:
    """A wrist that goes from one posture to the next, and wavers. Pure in time: holds its script."""

    def __init__(self, seed: int) -> None:
        """Postures about a habit of its own, each kept for a while."""
        rng = np.random.default_rng([seed, 6])
        self._mean_posture = np.radians(rng.normal(size=2) * [9.0, 6.0])
        self._begin_s = np.cumsum(rng.uniform(0.4, 2.0, 200))
        self._move_s = rng.uniform(0.3, 0.6, 200)
        self._posture = np.radians(rng.normal(size=(201, 2)) * [9.0, 7.0])
        self._rate = 2.0 * pi * rng.uniform(0.2, 1.5, (3, 2))
        self._phase = rng.uniform(0.0, 2.0 * pi, (3, 2))

    def at(self, t_s: float) -> Float:
        """The bend (2,) [rad]."""
        k = int(np.searchsorted(self._begin_s, t_s))
        share = 1.0 if k == 0 else smooth_step((t_s - self._begin_s[k - 1]) / self._move_s[k])
        before = self._posture[max(k - 1, 0)]
        waver = radians(2.0) * np.sin(self._rate * t_s + self._phase).sum(axis=0)
        return self._mean_posture + before + share * (self._posture[k] - before) + waver


class MeasuredMarkers:
    """Markers on the back of a hand, and an error. Holds the error of this recording."""

    def __init__(self, setup: RigSetup, seed: int, kind: Kind) -> None:
        """An error of a millimetre per axis."""
        self._hand, self._rng = setup.hand, np.random.default_rng([seed, 7])
        self._markers = setup.hand_markers
        self._on_back = np.array([self._hand.mount(name).joint is None for name in self._markers])
        self._new = 1.0 if kind == "plain" else 1.0 - float(np.exp(-_FRAME_S / 1.0))
        self._error = self._rng.normal(size=(len(self._markers), 3))

    def of(self, palm: Float) -> Float:
        """Places (M, 3) [m] of the markers of a hand whose palm is turned so (3, 3); NaN: on a finger."""
        keep = 1.0 - self._new
        self._error = keep * self._error + np.sqrt(1.0 - keep**2) * self._rng.normal(size=self._error.shape)
        joints = self._hand.forward(rigid(palm, np.zeros(3)), np.zeros((5, 4)))
        points = self._hand.marker_points(joints, self._markers) + _SIGMA_M * self._error
        return np.where(self._on_back[:, None], points, np.nan)


class Line:
    """Push machine. Holds the estimator of a hand with a device on its forearm, and the device's side."""

    def __init__(self, markers: RigSetup, wrist: WristSetup) -> None:
        """Join them as a fused rig does."""
        self._names = markers.hand_markers
        model = WristModel.of(wrist, loose=True)
        self.estimator = Estimator(
            [NO_RAY], loosened(markers.hand), self._names, self._names, continuous=True, wrist=model
        )
        counts = Counter[str]()
        self.side = WristSide(wrist, CycleReader(wrist, None, counts), counts, continuous=True)

    def push(self, t_ns: int, points_m: Float) -> Fitted:
        """Fit one epoch with markers (M, 3) [m], which may be NaN."""
        orientation = self.side.orientation_at(t_ns, self.estimator)
        cov = np.tile(_SIGMA_M**2 * np.eye(3), (len(points_m), 1, 1))
        hand = self.estimator.push(Epoch(t_ns, points_m, TOWARDS, cov_m2=cov, orientation=orientation))
        self.side.solved(t_ns, hand, self.estimator, oriented=orientation is not None)
        return hand


class RotatedArm(Gestures):
    """Those gestures of a forearm that lies any way. Pure in time: holds how."""

    def __init__(self, seed: int) -> None:
        """Rest first, as a subject is asked to."""
        super().__init__(seed, _REST_S)
        self._lies = rotation_vector_to_matrix(np.random.default_rng([seed, 8]).normal(size=3))

    def at(self, t_s: float) -> HandState:
        """The forearm's pose, as that of the palm: the IMU is simulated on what is straight."""
        return HandState(rigid(self._lies, np.zeros(3)) @ super().at(t_s).T_rig_palm, np.zeros((5, 4)))


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """One recording: who moves how, and the samples of its IMU with the filter's orientation."""

    seed: int
    forearm: RotatedArm
    wrist: FlexedWrist
    samples: list[ImuSample]

    @classmethod
    def of(cls, seed: int, imu: ImuCalibration, seconds: float) -> "Arm":
        """Simulate."""
        forearm, fusion = RotatedArm(seed), OrientationFilter(imu.rate_hz)
        samples = [fusion.push(one) for one in SimulatedImu(forearm, imu, seed).around(0.0, seconds)]
        return cls(seed, forearm, FlexedWrist(seed), samples)

    def lies(self, t_s: float) -> Float:
        """The forearm (3, 3) in the rig."""
        return self.forearm.at(t_s).T_rig_palm[:3, :3]

    def palm(self, t_s: float) -> Float:
        """The palm (3, 3) in the rig."""
        return self.lies(t_s) @ forearm_palm(self.wrist.at(t_s))

    def heading(self, sample: ImuSample) -> float:
        """The heading [rad] of the filter's world against the rig, at a sample."""
        dispatcher = (
            quaternion_to_matrix(sample.orientation_wxyz) @ quaternion_to_matrix(np.array(IMU.q_palm_imu)).T
        )
        off = quaternion_to_matrix(np.array(_WORLD)).T @ self.lies(sample.seq / IMU.rate_hz) @ dispatcher.T
        return atan2(off[1, 0] - off[0, 1], off[0, 0] + off[1, 1])


class Moment(NamedTuple):
    """What was believed at one instant, against the truth.

    Attributes:
        after_s: Since markers told last; 0: they tell.
        off_deg: (5,) errors: heading, bend, palm; bend if it is believed as it was, bend if it is believed straight.
            Each is the length of its vector.
        surprise: (3,) squares of the first three in sigmas.
    """

    after_s: float
    off_deg: Float
    joint_chi2: Float


def moments(arm: Arm, kind: Kind, rigs: tuple[RigSetup, WristSetup]) -> Iterator[Moment]:
    """Play a recording; now and then while markers are told, and at the given times after the last ones, look."""
    line, markers, last = Line(*rigs), MeasuredMarkers(rigs[0], arm.seed, kind), STRAIGHT
    unseen = np.full((len(rigs[0].hand_markers), 3), np.nan)
    frame = 0
    for sample in arm.samples:
        assert line.side.forearm is not None
        line.side.forearm.push(sample.t_ns, sample.orientation_wxyz, sample.heading_sigma_rad)
        t_s = sample.seq / IMU.rate_hz
        if sample.seq % 2 == 0 or t_s < _REST_S:
            continue
        since_s = (t_s - _REST_S) % (_VISIBLE_S + _GONE_S)
        frame += 1
        shown = since_s <= _VISIBLE_S
        hand = line.push(sample.t_ns, markers.of(arm.palm(t_s)) if shown else unseen)
        if shown:
            last = line.estimator.extras[WRIST_ANGLES : WRIST_ANGLES + 2].copy()
        looked = [s for s in _AFTER_S[1:] if abs(since_s - _VISIBLE_S - s) < 0.5 * _FRAME_S]
        if _SETTLED_S < since_s <= _VISIBLE_S and frame % 15 == 0:
            looked = [0.0]
        if looked:
            yield _moment(arm, line.estimator, hand, sample, looked[0], last)


def _moment(
    arm: Arm, estimator: Estimator, hand: Fitted, sample: ImuSample, after_s: float, last: Float
) -> Moment:
    t_s = sample.seq / IMU.rate_hz
    if hand.solution is None:
        return Moment(after_s, np.full(5, 180.0), np.full(3, np.inf))
    z, cov, truth = estimator.extras, estimator.extras_cov, arm.wrist.at(t_s)
    heading = remainder(z[HEADING] - arm.heading(sample), 2.0 * pi)
    bent = z[WRIST_ANGLES : WRIST_ANGLES + 2] - truth
    palm = matrix_to_rotation_vector(arm.palm(t_s) @ hand.solution.T_rig_palm[:3, :3].T)
    joint_chi2 = (
        heading**2 / cov[HEADING, HEADING],
        bent @ np.linalg.solve(cov[WRIST_ANGLES : WRIST_ANGLES + 2, WRIST_ANGLES : WRIST_ANGLES + 2], bent),
        palm @ np.linalg.solve(hand.solution.measurement_cov[:3, :3], palm),
    )
    off = [float(np.linalg.norm(one)) for one in (heading, bent, palm, last - truth, truth)]
    return Moment(after_s, np.degrees(off), np.array(joint_chi2))


def rows() -> Iterator[Row]:
    """Measure; one row per figure."""
    seconds = _REST_S + _ROUNDS * (_VISIBLE_S + _GONE_S)
    arms = [Arm.of(seed, IMU, seconds) for seed in _SEEDS]
    rigs = _rigs()
    for kind in KINDS:
        found = [one for arm in arms for one in moments(arm, kind, rigs)]
        for after_s in _AFTER_S:
            group = [one for one in found if one.after_s == after_s]
            off = _rms(np.array([one.off_deg for one in group]))
            inside = 100.0 * (np.array([one.joint_chi2 for one in group]) < _REGION).mean(axis=0)
            when = "visible" if after_s == 0.0 else f"{after_s:g} s after"
            notes = "", f"; kept as it was {off[3]:.1f}, believed straight {off[4]:.1f}", ""
            for k, what in enumerate(("heading", "bend", "palm")):
                note = f"{inside[k]:.0f} % of {len(group)} inside 95 %{notes[k]}"
                yield Row(f"{kind} error, {when}: {what}", float(off[k]), "deg rms", note)
    yield _cost(arms[0], rigs)


def _rigs() -> tuple[RigSetup, WristSetup]:
    """Three markers on the back, and the device with this IMU."""
    markers, wrist_setup = load_setup(CALIBRATION, "desk-back3"), load_setup(CALIBRATION, "wrist-back3")
    assert wrist_setup.wrist is not None
    return markers, replace(wrist_setup.wrist, imu=IMU)


def _cost(arm: Arm, rigs: tuple[RigSetup, WristSetup]) -> Row:
    """Microseconds that an epoch with markers and IMU costs."""
    line, markers = Line(*rigs), MeasuredMarkers(rigs[0], arm.seed, "plain")
    assert line.side.forearm is not None
    spent: list[float] = []
    for sample in arm.samples[:1200]:
        line.side.forearm.push(sample.t_ns, sample.orientation_wxyz, sample.heading_sigma_rad)
        points = markers.of(arm.palm(sample.seq / IMU.rate_hz))
        start = perf_counter_ns()
        line.push(sample.t_ns, points)
        spent.append((perf_counter_ns() - start) * 1e-3)
    middle = float(np.median(spent))
    return Row("cost of an epoch", middle, "us", f"{60e-4 * middle:.1f} % of a core at 60 Hz")


def _rms(values: Float) -> Float:
    return np.sqrt(np.mean(np.square(values), axis=0))
