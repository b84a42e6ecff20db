"""Three markers on the back of the hand determine how the palm is turned; one alone does not, an IMU does."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.hand.fitting import with_three_back_markers
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from tests.hand_helpers import MARKERS, natural_angles, palm
from tests.master.estimator.fitted import fit, forgetful, orientation_of, palm_deg

MODELS = {
    side: HandModel.of(with_three_back_markers(generated_profile("made", side), "made-back3"))
    for side in ("left", "right")
}
EIGHT = (*MARKERS, "back2", "back3")
NOISE_M, POSES, IMU_RAD = 1e-3, 60, np.radians(2.0)


def palm_errors_deg(side: str, names: tuple[str, ...], *, imu: bool = False) -> Float:
    """Rotation (N,) of the solved palm against the truth [deg]; the same poses and noise for all sets of markers."""
    model, rng = MODELS[side], np.random.default_rng(12)
    machine, cov = forgetful(model, names), np.tile(NOISE_M**2 * np.eye(3), (len(names), 1, 1))
    errors: list[float] = []
    for _ in range(POSES):
        T = palm(rng.uniform(-35.0, 35.0, 3))
        joints = model.forward(T, natural_angles(rng))
        noise, tilt = rng.normal(0.0, NOISE_M, (len(EIGHT), 3)), rng.normal(0.0, IMU_RAD, 3)
        points = model.marker_points(joints, EIGHT) + noise
        seen = points[[EIGHT.index(name) for name in names]]
        orientation = orientation_of(
            Rotation.from_rotvec(tilt).as_matrix() @ T[:3, :3], IMU_RAD**2 * np.eye(3)
        )
        errors.append(palm_deg(fit(seen, cov, by=machine, orientation=orientation if imu else None), T))
    return np.array(errors)


@pytest.mark.parametrize("side", ["left", "right"])
def test_three_turn_the_palm_several_times_as_well_as_one(side: str) -> None:
    one, three = palm_errors_deg(side, MARKERS), palm_errors_deg(side, EIGHT)
    assert three.mean() < 0.5 * one.mean()
    assert three.mean() < 3.0  # 1 mm on a triangle of 4 to 5 cm


def test_order_and_number_of_those_on_the_back_do_not_matter() -> None:
    three = palm_errors_deg("right", EIGHT)
    mixed = palm_errors_deg("right", ("back3", "little", "back", "thumb", "ring", "back2", "index", "middle"))
    np.testing.assert_allclose(mixed, three, atol=0.2)
    assert three.mean() < palm_errors_deg("right", (*MARKERS, "back3")).mean()


def test_an_imu_determines_it_with_one_marker_and_adds_to_three() -> None:
    assert palm_errors_deg("right", MARKERS, imu=True).mean() < 0.6 * palm_errors_deg("right", MARKERS).mean()
    assert palm_errors_deg("right", EIGHT, imu=True).mean() < palm_errors_deg("right", EIGHT).mean()
