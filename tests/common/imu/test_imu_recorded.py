"""A real sensor with optical truth (BROAD): samples in, orientation out; an arm swung fast is no exception."""

from pathlib import Path

import numpy as np
import pytest

from bench.imu import Recording, played, stated, tilt_errors
from common.arrays import Float
from common.geometry.transforms import quaternion_to_matrix
from common.messages import ImuSample


def drift_deg_per_min(found_wxyz: Float, recording: Recording) -> float:
    """Slope of the heading's error of orientations (T, 4) while it moves."""
    rows = np.flatnonzero(recording.moving)
    found, truth = (quaternion_to_matrix(q[rows]) for q in (found_wxyz, recording.truth_wxyz))
    off = found @ np.swapaxes(truth, 1, 2)
    heading = np.unwrap(np.arctan2(off[:, 1, 0] - off[:, 0, 1], off[:, 0, 0] + off[:, 1, 1]))
    t_s = 1e-9 * np.array([recording.samples[row].t_ns for row in rows])
    return 60.0 * float(np.degrees(np.polyfit(t_s, heading, 1)[0]))


def forces_alone(sample: ImuSample) -> Float:
    """Where the force of a sample points is up; no heading at all."""
    x, y, z = (sample.accel_m_s2 / np.linalg.norm(sample.accel_m_s2)).tolist()
    q = np.array([1.0 + z, y, -x, 0.0])  # the shortest turn that brings the force up
    return q / np.linalg.norm(q)


@pytest.mark.parametrize(
    ("name", "within_deg", "most_drift"),
    [
        ("11_undisturbed_slow_translation_B", 0.6, 2.0),
        ("21_undisturbed_fast_combined", 2.5, 12.0),
    ],
)
def test_the_inclination_is_right_and_its_sigma_holds(
    name: str, within_deg: float, most_drift: float, datasets: Path
) -> None:
    recording = Recording.of(datasets / "broad" / f"{name}.npz", every=3)  # 95 Hz
    found, sigma_rad = stated(recording)
    tilt = tilt_errors(found, sigma_rad, recording)
    assert len(tilt.sigma_rad) == recording.moving.sum()
    assert tilt.rms_deg < within_deg  # 1.5 times VQF's
    assert tilt.within > 0.95
    assert tilt.stated_deg < 4.0 * tilt.rms_deg
    assert abs(drift_deg_per_min(found, recording)) < most_drift


def test_who_cannot_distinguish_gravity_from_an_arm_is_seen(datasets: Path) -> None:
    recording = Recording.of(datasets / "broad" / "11_undisturbed_slow_translation_B.npz", every=3)
    found = played(forces_alone, recording)
    assert tilt_errors(found, np.zeros(len(found)), recording).rms_deg > 3.0
