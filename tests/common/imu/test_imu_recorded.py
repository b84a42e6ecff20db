"""A real sensor with optical truth (BROAD): samples in, orientation out; an arm swung fast is no exception."""

from pathlib import Path

import pytest

from bench.imu import Errors, Recording, forces_alone, played, stated, tilt_errors


@pytest.mark.parametrize(
    ("name", "within_deg", "drift_deg_per_min"),
    [
        ("11_undisturbed_slow_translation_B", 0.6, 2.0),
        ("21_undisturbed_fast_combined", 2.5, 12.0),
    ],
)
def test_the_inclination_is_right_and_its_sigma_holds(
    name: str, within_deg: float, drift_deg_per_min: float, datasets: Path
) -> None:
    recording = Recording.of(datasets / "broad" / f"{name}.npz", every=3)  # 95 Hz
    found, sigma_rad = stated(recording)
    tilt = tilt_errors(found, sigma_rad, recording)
    assert len(tilt.sigma_rad) == recording.moving.sum()
    assert tilt.rms_deg < within_deg  # 1.5 times VQF's
    assert tilt.within > 0.95
    assert tilt.stated_deg < 4.0 * tilt.rms_deg
    errors = Errors.of(found, recording)
    assert errors.inclination_rms_deg == pytest.approx(tilt.rms_deg, rel=1e-3)
    assert abs(errors.drift_deg_per_min) < drift_deg_per_min


def test_who_cannot_distinguish_gravity_from_an_arm_is_seen(datasets: Path) -> None:
    recording = Recording.of(datasets / "broad" / "11_undisturbed_slow_translation_B.npz", every=3)
    alone = Errors.of(played(forces_alone(recording.rate_hz), recording), recording)
    assert alone.inclination_rms_deg > 3.0
