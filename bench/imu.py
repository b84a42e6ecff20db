"""Orientation by rates and forces alone: inclination, stated sigmas; baseline: VQF, fed the same samples.

All recordings of BROAD (D. Laidig et al. 2021, CC BY 4.0) in the folder `broad` of PHALANX_DATASETS, with optical
truth; only what moves is scored. Inclination is the angle between true and found vertical;
95 % of it should lie within the stated sigmas.
"""

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.report import Row, datasets, skipped
from common.arrays import Bool, Float
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
        theirs_deg = tilt_errors(played(other, recording), np.zeros(len(found)), recording).rms_deg
        against = f"{tilt.rms_deg / theirs_deg:.2f} of VQF's {theirs_deg:.2f}"
    stated_text = f"stated {tilt.stated_deg:.2f}, {100 * tilt.within:.0f} % within 95 %"
    return Row(f"{what}: inclination", tilt.rms_deg, "deg rms", f"{against}; {stated_text}")


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
