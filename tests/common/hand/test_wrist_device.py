"""A wrist device and its hand: files that do not fit are refused by rig and key, by slave and master alike."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load, parse
from common.calibration.rig import Laser, LaserPlane
from common.errors import CalibrationError
from common.hand.model import HandModel
from common.hand.wrist import WristDevice
from master.rig.setup import WristSetup
from slave.wrist.led_image import WristView

ROOT = Path(__file__).parents[3] / "calib_json"
RIG = load(ROOT / "rigs/wrist.json", RigCalibration)
CAMERA = load(ROOT / "cameras/wrist.json", CameraCalibration)
HAND = load(ROOT / f"hands/{RIG.hand}.json", HandProfile)
SIDES: dict[str, Callable[[RigCalibration, CameraCalibration], WristDevice]] = {
    "slave": lambda rig, camera: WristView.of(rig, camera, HAND),
    "master": lambda rig, camera: WristSetup.of(rig, camera, HandModel.of(HAND)),
}
FAR = ((1.0, 0, 0, 0), (0, 1.0, 0, 31.0), (0, 0, 1.0, 92.0), (0, 0, 0, 1.0))  # millimetres
BEHIND = ((1.0, 0, 0, 0), (0, 1.0, 0, 0.09), (0, 0, 1.0, -0.3), (0, 0, 0, 1.0))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"kind": "markers"}, "kind is 'markers'"),
        ({"cameras": ("other",)}, "cameras: other"),
        ({"laser_plane": None}, "laser_plane is missing, .*calibrate wrist laser-plane"),
        ({"T_camera_palm": None}, "T_camera_palm is missing, .*calibrate wrist palm"),
        (
            {"laser_plane": LaserPlane(normal=(0.0, 1.0, 0.0), offset_m=0.0)},
            "laser_plane: .*must cross the fingers",
        ),
        (
            {"laser_plane": LaserPlane(normal=(0.0, 1.0, 0.0), offset_m=-0.03)},
            "laser_plane: .*must cross the fingers",
        ),
        (
            {"laser_plane": LaserPlane(normal=(1.0, 0.0, 0.0), offset_m=0.03)},
            "laser_plane: .*must cross the fingers",
        ),
        (
            {"laser_plane": LaserPlane(normal=(0.0, 0.0, 1.0), offset_m=0.03)},
            "laser_plane: .*must cross the fingers",
        ),
    ],
)
def test_a_rig_that_does_not_fit_is_refused_alike(
    side: str, change: dict[str, object], expected: str
) -> None:
    with pytest.raises(CalibrationError, match=f"rig 'wrist': .*{expected}"):
        SIDES[side](replace(RIG, **change), CAMERA)


@pytest.mark.parametrize("side", SIDES)
def test_a_camera_without_intrinsics_is_refused(side: str) -> None:
    with pytest.raises(CalibrationError, match="intrinsics"):
        SIDES[side](RIG, replace(CAMERA, intrinsics=None))


def test_slave_and_master_place_the_same_plane_and_palm_also_where_the_file_is_rounded() -> None:
    assert RIG.laser_plane is not None
    assert RIG.T_camera_palm is not None
    rotated = tuple(tuple(round(number, 3) for number in row) for row in RIG.T_camera_palm)
    normal = tuple(-1.005 * number for number in RIG.laser_plane.normal)  # and seen from its other side
    plane = LaserPlane(normal=(normal[0], normal[1], normal[2]), offset_m=-1.005 * RIG.laser_plane.offset_m)
    rig = replace(RIG, T_camera_palm=rotated, laser_plane=plane)
    slave, master = (make(rig, CAMERA) for make in SIDES.values())
    assert slave.T_camera_palm.tolist() == master.T_camera_palm.tolist() == [list(row) for row in rotated]
    assert slave.normal.tolist() == master.normal.tolist()
    assert slave.offset_m == master.offset_m
    assert abs(slave.offset_m + RIG.laser_plane.offset_m) < 1e-6
    uv = slave.optics.project(slave.T_camera_palm[:3, 3] + slave.T_camera_palm[:3, 2] * 0.09)
    assert slave.on_plane(uv).tolist() == master.on_plane(uv).tolist()


@pytest.mark.parametrize(
    ("laser", "expected"),
    [
        (Laser(forward=(0.0, 0.0, 0.0)), "laser.forward: length 0, not 1"),
        (Laser(forward=(0.0, 0.0, 1000.0)), r"Expected `float` <= 1.01 - at `\$.laser.forward\[2\]`"),
        (Laser(right=(0.0, 0.0, 0.5)), "laser.right: length 0.5, not 1"),
        (Laser(forward=(0.0, 1.0, 0.0)), "laser.forward: leaves laser_plane"),
    ],
)
def test_a_laser_whose_light_goes_nowhere_or_out_of_its_plane_is_refused(laser: Laser, expected: str) -> None:
    data = msgspec.json.encode(replace(RIG, laser=laser))
    with pytest.raises(CalibrationError, match=f"rig.json: {expected}"):
        parse(data, RigCalibration, "rig.json")
