"""Where the laser's fan meets the skin of fingers: against a mirror, and against hands that a renderer has cut."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.hand.model import HandModel
from master.calibrate.laser_intersection import LaserIntersection
from master.estimator.priors import FlexionSynergy
from master.estimator.sensors import PlaneAxes
from master.rig.setup import WristSetup
from tests.wrist_run import mirrored_setup, wrist_setup


@pytest.fixture(scope="module")
def setup(root: Path) -> WristSetup:
    wrist = wrist_setup(root).wrist
    assert wrist is not None
    return wrist


def test_the_left_hand_is_the_right_one_mirrored(setup: WristSetup) -> None:
    straight = replace(setup.optics, distortion=np.zeros(5))
    right = replace(setup, optics=straight)
    angles = FlexionSynergy.of(right.model).angles(
        np.radians(np.array([[10.0, 20.0, 40.0, 60.0, 80.0]])), np.radians([[5.0, 4.0, -3.0, 2.0, -6.0]])
    )[:, None]
    there, length, _ = LaserIntersection(right)(angles)
    mirror, same, _ = LaserIntersection(mirrored_setup(right))(angles)
    np.testing.assert_allclose(
        mirror, there * [-1.0, 1.0], atol=2e-4
    )  # the fan's rays go the other way round
    np.testing.assert_allclose(same, length, rtol=0.03)


@pytest.mark.parametrize(
    ("name", "side"), [("curl", "right"), ("spread", "right"), ("left_small", "left-small")]
)
def test_rendered_hands_have_their_laser_where_the_cut_says(datasets: Path, name: str, side: str) -> None:
    """Of fingers whose line nobody else covers, at their true angles: within a millimetre and a half, median 0.8."""
    folder = datasets / "wrist" / name
    manifest = msgspec.json.decode((folder / "recording.json").read_bytes())
    rig = msgspec.convert(manifest["rig"], RigCalibration)
    camera = msgspec.convert(manifest["cameras"]["wrist"], CameraCalibration)
    model = HandModel.of(load(datasets / "hands" / f"webxr-{side}.json", HandProfile))
    setup = WristSetup.of(rig, camera, model)
    truth = np.load(folder / "truth.npz")
    angles = np.zeros((len(truth["angles"]), 5, 4))
    heads = model.rest_position_m[[8, 13, 18, 23]] - model.rest_position_m[[7, 12, 17, 22]]
    resting = np.arctan2(model.side_sign * heads[:, 0], heads[:, 2])
    for f in range(4):
        flexion, abduction, pip, dip = truth["angles"][:, 5 + 4 * f : 9 + 4 * f].T
        angles[:, f + 1] = np.stack([abduction - resting[f], flexion, pip, dip], axis=1)
    natural = np.abs(angles[:, 1:, 2]) < np.radians(75.0)
    point = LaserIntersection(setup)(angles[:, None])[0][1:, :, 0].swapaxes(0, 1)
    off = 1e3 * np.linalg.norm(point - PlaneAxes.of(setup).flat(truth["laser_pt"][:, 2:6]), axis=2)
    clear = natural & (truth["laser_len_vis"][:, 2:6] > 0.018)
    assert clear.sum() > 10
    assert np.nanmedian(off[clear]) < 1.1
