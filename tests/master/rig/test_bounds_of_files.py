"""What loads can be triangulated with and turned into depth, also where a value stands at its bound."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, RigCalibration, parse
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from master.estimator.sensors import CameraArrays
from master.fabrik.depth import depth_law
from master.fabrik.intersection import triangulate
from tests.common.file_values import bounds_of, edited

TREE = Path(__file__).resolve().parents[3] / "calib_json"
CAMERA: dict[str, Any] = json.loads((TREE / "cameras/left.json").read_text()) | {"markers": None}
RIG: dict[str, Any] = json.loads((TREE / "rigs/desk.json").read_text()) | {
    "power_law": {"k_m": 45.4, "z": -1.03},
    "affine_disparity": {"a_m_px": 37.7, "x0_px": 2.5},
}


def use(rig: RigCalibration, camera: CameraCalibration) -> None:
    """Triangulate points over the picture; numpy raises where something overflows or is divided by nothing."""
    models = [CameraModel.of(camera, rig.camera_pose(name)) for name in rig.cameras]
    w, h = camera.width_px, camera.height_px
    u, v = np.meshgrid(np.linspace(-w, 2 * w, 7), np.linspace(-h, 2 * h, 7))  # one picture beyond each border
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)
    with np.errstate(all="raise", under="ignore"):
        triangulate(CameraArrays.of(models), np.stack([uv, uv - (10.0, 0.0)]))
        triangulate(CameraArrays.of(models * 3), np.stack([uv, uv - (10.0, 0.0)] * 3))
        for model in ("power_law", "affine_disparity"):
            try:
                law = depth_law(msgspec.structs.replace(rig, depth_model=model), models)
            except CalibrationError:  # said, where they are not a parallel pair any more
                continue
            assert law is not None
            depth = law.depth(np.array([-20.0, 0.0, 1e-3, 10.0, 600.0, np.nan]))
            assert np.isnan(depth[-1])


@pytest.mark.parametrize("what", ["camera", "rig"])
def test_files_with_a_value_at_its_bound_can_be_computed_with(what: str) -> None:
    document, kind = (CAMERA, CameraCalibration) if what == "camera" else (RIG, RigCalibration)
    good = {
        "camera": parse(_bytes(CAMERA), CameraCalibration, "c"),
        "rig": parse(_bytes(RIG), RigCalibration, "r"),
    }
    loaded = 0
    for path, low, high in bounds_of(document, kind):
        for value in (low, high):
            with suppress(CalibrationError):  # that bound contradicts another value of the file
                good[what] = parse(_bytes(edited(document, path, value)), kind, "x")
                use(**good)  # pyright: ignore[reportArgumentType]
                loaded += 1
    assert loaded > 10


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fx_px", 32.0),
        ("fy_px", 32.0),
        ("fx_px", 640e3),
        ("fy_px", 640e3),
        ("cx_px", -640.0),
        ("cy_px", 960.0),
    ],
)
def test_lenses_at_the_bounds_that_the_picture_sets_can_be_computed_with(key: str, value: float) -> None:
    plain = edited(CAMERA, ("intrinsics", "distortion"), [0.0] * 5)
    camera = parse(_bytes(edited(plain, ("intrinsics", key), value)), CameraCalibration, "c")
    use(parse(_bytes(RIG), RigCalibration, "r"), camera)


def _bytes(document: dict[str, Any]) -> bytes:
    return msgspec.json.encode(document)
