"""A real sensor with optical truth (BROAD): samples in, orientation out; while it moves, right to one degree."""

from pathlib import Path

import pytest

from bench.imu import Errors, Recording, forces_alone, ours, played


@pytest.mark.parametrize("name", ["02_undisturbed_slow_rotation_B", "11_undisturbed_slow_translation_B"])
def test_the_inclination_is_right_to_one_degree_and_the_heading_hardly_drifts(
    name: str, datasets: Path
) -> None:
    recording = Recording.of(datasets / "broad" / f"{name}.npz", every=3)  # 95 Hz
    errors = Errors.of(played(ours(recording.rate_hz), recording), recording)
    assert len(errors.inclination_deg) == recording.moving.sum()
    assert errors.inclination_rms_deg < 1.0
    assert abs(errors.drift_deg_per_min) < 2.0
    alone = Errors.of(played(forces_alone(recording.rate_hz), recording), recording)
    assert alone.inclination_rms_deg > 3.0  # who cannot tell gravity from an arm is seen
