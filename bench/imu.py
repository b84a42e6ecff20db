"""Orientation by rates and forces alone, beside VQF fed the same samples in the same run; its stated sigmas; its drift.

Recorded: recordings of BROAD (D. Laidig et al. 2021, CC BY 4.0) with optical truth, of which only what moves is scored.
All that lie in the folder `broad` of PHALANX_DATASETS are taken. Inclination is the angle between true and found
vertical, and is held against VQF's; 95 % of it should lie within the stated sigmas. The heading of such a filter begins
anywhere: its error is that against its first moment of the motion, its drift the slope of a line through it.

Simulated: a forearm that gestures, with parts of two data sheets, at rest for three seconds before it moves or never at
rest; the drift there is held against what `heading_sigma_rad` says of it.
"""

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bench.report import Row, datasets, rms, skipped
from common.arrays import Bool, Float
from common.calibration import ImuCalibration
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, quaternion_to_matrix, rigid
from common.imu.fusion import OrientationFilter, TiltErrors
from common.messages import ImuSample
from common.sim.motion import HandState
from common.sim.sensors import ICM20948, LSM6DSO, InertialPart, SimulatedImu

_NOTHING, _NO_QUATERNION = np.full(3, np.nan), np.full(4, np.nan)
_PARTS: dict[str, InertialPart] = {"LSM6DSO": LSM6DSO, "ICM-20948": ICM20948}
_SEEDS = range(8)
_STATED_DEG = (0.0, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0, 6.0)
_LEVEL = ImuCalibration(
    q_palm_imu=(1.0, 0.0, 0.0, 0.0), q_rig_world=(1.0, 0.0, 0.0, 0.0), orientation_sigma_rad=1e-9
)
Push = Callable[[ImuSample], Float]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Samples of an IMU, how it truly lay (T, 4) wxyz, NaN where that is not known, and what of it is scored (T,)."""

    samples: list[ImuSample]
    rate_hz: float
    truth_wxyz: Float
    moving: Bool

    @classmethod
    def of(cls, path: Path, every: int = 1) -> "Recording":
        """A file of BROAD, of which only every so-manieth sample is heard."""
        with np.load(path) as data:
            gyro, accel = (data[name][::every].astype(np.float64) for name in ("gyr_rads", "acc_ms2"))
            rate_hz = float(data["fs"]) / every
            truth, moving = (
                data["opt_quat_wxyz"][::every].astype(np.float64),
                data["movement"][::every].astype(np.bool_),
            )
        samples = [
            ImuSample("broad", 0, k, round(k * 1e9 / rate_hz), gyro[k], accel[k], _NOTHING, _NO_QUATERNION)
            for k in range(len(gyro))
        ]
        return cls(samples, rate_hz, truth, moving & np.isfinite(truth).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Of what moved: inclination [deg] (T,), heading [deg] (T,) against its first moment, and time [s] (T,)."""

    inclination_deg: Float
    heading_deg: Float
    t_s: Float

    @classmethod
    def of(cls, found_wxyz: Float, recording: Recording) -> "Errors":
        """Of orientations (T, 4); NaN, one not known, is not scored."""
        rows = np.flatnonzero(recording.moving & np.isfinite(found_wxyz).all(axis=1))
        found, truth = (quaternion_to_matrix(q[rows]) for q in (found_wxyz, recording.truth_wxyz))
        off = found @ np.swapaxes(truth, 1, 2)
        heading = np.unwrap(np.arctan2(off[:, 1, 0] - off[:, 0, 1], off[:, 0, 0] + off[:, 1, 1]))
        t_s = np.array([recording.samples[row].t_ns for row in rows]) * 1e-9
        return cls(
            np.degrees(np.arccos(np.clip(off[:, 2, 2], -1.0, 1.0))), np.degrees(heading - heading[0]), t_s
        )

    @property
    def inclination_rms_deg(self) -> float:
        """Root mean square."""
        return rms(self.inclination_deg)

    @property
    def drift_deg_per_min(self) -> float:
        """Slope of the heading's error."""
        t = self.t_s - self.t_s.mean()
        return 60.0 * float(t @ self.heading_deg / (t @ t))


def recorded() -> dict[str, Recording]:
    """Those of BROAD in PHALANX_DATASETS, by name; none where they are absent."""
    return recordings(datasets() / "broad")


def recordings(folder: Path, every: int = 1) -> dict[str, Recording]:
    """Those of BROAD in a folder, by name."""
    return {path.stem: Recording.of(path, every) for path in sorted(folder.glob("*.npz"))}


def stated(recording: Recording) -> tuple[Float, Float]:
    """Return orientation (T, 4) and its tilt's standard deviation (T,) [rad] of every sample by our filter."""
    fusion = OrientationFilter(recording.rate_hz)
    found: list[Float] = []
    sigma_rad: list[float] = []
    for sample in recording.samples:
        found.append(fusion.push(sample).orientation_wxyz)
        sigma_rad.append(fusion.tilt_sigma_rad)
    return np.array(found), np.array(sigma_rad)


def tilt_errors(found_wxyz: Float, sigma_rad: Float, recording: Recording) -> TiltErrors:
    """Of what moved."""
    rows = recording.moving
    return TiltErrors.of(found_wxyz[rows], recording.truth_wxyz[rows], sigma_rad[rows])


def played(push: Push, recording: Recording) -> Float:
    """Return the orientation of every sample (T, 4) by a filter."""
    return np.array([push(sample) for sample in recording.samples])


def rows() -> Iterator[Row]:
    """Measure; one row per figure."""
    found = recorded()
    if not found:
        yield skipped("recorded", datasets() / "broad")
    pooled: list[TiltErrors] = []
    for name, recording in found.items():
        yield from _recorded(name.replace("undisturbed_", "").replace("_", " "), recording, pooled)
    yield from _reliability("recorded", pooled)
    pooled = []
    for part in _PARTS:
        for rest_s in (3.0, 0.0):
            yield from _simulated(part, rest_s, pooled)
    yield from _reliability("simulated", pooled)


def _recorded(what: str, recording: Recording, pooled: list[TiltErrors]) -> Iterator[Row]:
    """One recording by both filters."""
    found, sigma_rad = stated(recording)
    tilt = tilt_errors(found, sigma_rad, recording)
    pooled.append(tilt)
    other = vqf(recording.rate_hz)
    theirs = None if other is None else Errors.of(played(other, recording), recording)
    against = "VQF is not installed" if theirs is None else (
        f"{tilt.rms_deg / theirs.inclination_rms_deg:.2f} of VQF's {theirs.inclination_rms_deg:.2f}"
    )  # fmt: skip
    stated_text = f"stated {tilt.stated_deg:.2f}, {100 * tilt.within:.0f} % within 95 %"
    yield Row(f"{what}: inclination", tilt.rms_deg, "deg rms", f"{against}; {stated_text}")
    errors = Errors.of(found, recording)
    note = f"{rms(errors.heading_deg):.2f} deg rms against its begin"
    if theirs is not None:
        note += f"; VQF {theirs.drift_deg_per_min:.2f} deg/min, {rms(theirs.heading_deg):.2f} deg"
    yield Row(f"{what}: heading", errors.drift_deg_per_min, "deg/min", note)


def _reliability(what: str, pooled: list[TiltErrors]) -> Iterator[Row]:
    """Found error by stated sigma, of all samples together."""
    if not pooled:
        return
    errors = TiltErrors(
        *(np.concatenate([getattr(one, name) for one in pooled]) for name in ("error_rad", "sigma_rad"))
    )
    sigma_deg = np.degrees(errors.sigma_rad)
    for low, high in pairwise(_STATED_DEG):
        some = errors.where((sigma_deg >= low) & (sigma_deg < high))
        if len(some.sigma_rad):
            note = f"stated {some.stated_deg:.2f}, {100 * some.within:.1f} % within 95 %, {len(some.sigma_rad)} samples"
            name = f"{what}, stated {low:g} to {high:g} deg per axis: inclination"
            yield Row(name, some.rms_deg, "deg rms", note)


def forces_alone(rate_hz: float) -> Push:
    """Where the force of every sample points is up; no heading at all."""
    return lambda sample: _level(sample.accel_m_s2)


def vqf(rate_hz: float) -> Push | None:
    """VQF (Laidig, Seel 2023), if it is installed: a filter of the same kind by others, six axes."""
    try:
        other: Any = importlib.import_module("vqf").VQF(1.0 / rate_hz)
    except ImportError:
        return None

    def push(sample: ImuSample) -> Float:
        other.update(sample.gyro_rad_s.copy(), sample.accel_m_s2.copy())
        return other.getQuat6D()

    return push


class Gestures:
    """A forearm that turns and moves about all axes, at 1 m/s^2, from `rest_s` [s] on."""

    period_s = 1e9

    def __init__(self, seed: int, rest_s: float) -> None:
        rng = np.random.default_rng([seed, 5])
        self.rest_s = rest_s
        self._amplitude = rng.uniform(0.2, 0.5, 6)
        self._rate, self._phase = rng.uniform(1.5, 6.0, 6), rng.uniform(0.0, 6.3, 6)

    def at(self, t_s: float) -> HandState:
        """Its pose; the fingers do not matter."""
        t = max(t_s - self.rest_s, 0.0)
        swing = self._grown(t) * self._amplitude * np.sin(self._rate * t + self._phase)
        rotation = axis_rotation(2, 2.0 * swing[0]) @ axis_rotation(1, swing[1]) @ axis_rotation(0, swing[2])
        return HandState(rigid(rotation, 0.15 * swing[3:]), np.zeros((5, 4)))

    @staticmethod
    def _grown(t: float) -> float:
        """It begins gently: 0...1, without a jerk."""
        u = min(t, 1.0)
        return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def _simulated(part: str, rest_s: float, pooled: list[TiltErrors]) -> Iterator[Row]:
    """A minute of gestures of every seed."""
    tilt: list[TiltErrors] = []
    theirs: list[float] = []
    drift: list[float] = []
    joint_chi2: list[float] = []
    for seed in _SEEDS:
        motion, fusion = Gestures(seed, rest_s), OrientationFilter(_LEVEL.rate_hz)
        sensor = SimulatedImu(motion, _LEVEL, seed, _PARTS[part])
        said: list[tuple[Float, float, float]] = []
        samples: list[ImuSample] = []
        for sample in sensor.around(0.0, rest_s + 62.0):
            samples.append(sample)
            said.append(
                (fusion.push(sample).orientation_wxyz, fusion.heading_sigma_rad, fusion.tilt_sigma_rad)
            )
        truth = np.array([_lies(motion, sample.seq / _LEVEL.rate_hz) for sample in samples])
        moving = np.array([sample.t_ns for sample in samples]) > (rest_s + 2.0) * 1e9
        recording = Recording(samples, _LEVEL.rate_hz, truth, moving)
        found = np.array([q for q, _, _ in said])
        tilt.append(tilt_errors(found, np.array([sigma for _, _, sigma in said]), recording))
        if (other := vqf(_LEVEL.rate_hz)) is not None:
            theirs.append(Errors.of(played(other, recording), recording).inclination_rms_deg)
        errors = Errors.of(found, recording)
        begun = said[int(np.argmax(moving))][1]
        drift.append(errors.drift_deg_per_min)
        joint_chi2.append(
            errors.heading_deg[-1] / np.degrees(np.sqrt(max(said[-1][1] ** 2 - begun**2, 1e-12)))
        )
    pooled += tilt
    name = f"simulated {part}, {'rested' if rest_s else 'never at rest'}"
    found_deg, within = rms([one.rms_deg for one in tilt]), np.mean([one.within for one in tilt])
    against = f"VQF {rms(theirs):.2f}" if theirs else "VQF is not installed"
    stated_text = f"stated {rms([one.stated_deg for one in tilt]):.2f}, {100 * within:.0f} % within 95 %"
    yield Row(
        f"{name}: inclination",
        found_deg,
        "deg rms",
        f"{len(_SEEDS)} arms, a minute each; {against}; {stated_text}",
    )
    note = f"{rms(joint_chi2):.1f} of what heading_sigma_rad says (rms)"
    yield Row(f"{name}: heading", rms(drift), "deg/min", note)


def _lies(motion: Gestures, t_s: float) -> Float:
    """Quaternion (4,) of the sensor in its world."""
    return matrix_to_quaternion(motion.at(t_s).T_rig_palm[:3, :3])


def _level(force: Float) -> Float:
    """The quaternion (4,) of the shortest turn that brings a force (3,) up."""
    x, y, z = (force / np.linalg.norm(force)).tolist()
    q = np.array([1.0 + z, y, -x, 0.0])
    return q / np.linalg.norm(q)
