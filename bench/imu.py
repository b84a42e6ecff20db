"""Orientation by rates and forces alone: inclination, stated sigmas; baseline: VQF, fed the same samples.

All recordings of BROAD (D. Laidig et al. 2021, CC BY 4.0) in the folder `broad` of PHALANX_DATASETS, with optical
truth; only what moves is scored. Inclination is the angle between true and found vertical;
95 % of it should lie within the stated sigmas. A heading begins anywhere: its drift is the slope of its error.
"""

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.report import Row, datasets, rms, skipped
from common.arrays import Bool, Float
from common.geometry.transforms import quaternion_to_matrix
from common.imu.fusion import OrientationFilter, TiltErrors
from common.messages import ImuSample

_NOTHING, _NO_QUATERNION = np.full(3, np.nan), np.full(4, np.nan)
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
        """Read a file of BROAD, every n-th sample."""
        with np.load(path) as data:
            gyro, accel = (data[name][::every].astype(np.float64) for name in ("gyr_rads", "acc_ms2"))
            rate_hz = float(data["fs"]) / every
            truth = data["opt_quat_wxyz"][::every].astype(np.float64)
            moving = data["movement"][::every].astype(np.bool_)
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
    files = sorted((datasets() / "broad").glob("*.npz"))
    if not files:
        yield skipped("recorded", datasets() / "broad")
    for file in files:
        yield _recorded(file.stem.replace("undisturbed_", "").replace("_", " "), Recording.of(file))


def _recorded(what: str, recording: Recording) -> Row:
    """One recording by both filters."""
    found, sigma_rad = stated(recording)
    tilt = tilt_errors(found, sigma_rad, recording)
    against = "VQF is not installed"
    if (other := vqf(recording.rate_hz)) is not None:
        theirs_deg = Errors.of(played(other, recording), recording).inclination_rms_deg
        against = f"{tilt.rms_deg / theirs_deg:.2f} of VQF's {theirs_deg:.2f}"
    stated_text = f"stated {tilt.stated_deg:.2f}, {100 * tilt.within:.0f} % within 95 %"
    return Row(f"{what}: inclination", tilt.rms_deg, "deg rms", f"{against}; {stated_text}")


def forces_alone(rate_hz: float) -> Push:
    """Where the force of every sample points is up; no heading at all."""

    def level(sample: ImuSample) -> Float:
        x, y, z = (sample.accel_m_s2 / np.linalg.norm(sample.accel_m_s2)).tolist()
        q = np.array([1.0 + z, y, -x, 0.0])  # the shortest turn that brings the force up
        return q / np.linalg.norm(q)

    return level


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
