"""Files that parse but cannot be are refused with file and key; what loads can be computed with."""

import contextlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common import calibration
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.calibration.gesture_settings import GestureSettings
from common.calibration.object_profile import ObjectProfile
from common.calibration.output_settings import OutputSettings
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.hand.model import HandModel
from common.recording.frame_recording import Manifest, check_manifest
from master.rig.setup import load_setup
from tests.common.file_values import bounds_of, edited, edits, numbers_without_bounds

ROOT = Path(__file__).resolve().parents[3]
TREE = ROOT / "calib_json"
KINDS: dict[str, type[msgspec.Struct]] = {
    "cameras/left.json": CameraCalibration,
    "cameras/wrist.json": CameraCalibration,
    "rigs/desk.json": RigCalibration,
    "rigs/wrist.json": RigCalibration,
    "hands/default-right.json": HandProfile,
    "objects/cube-tracker.json": ObjectProfile,
    "objects/wand.json": ObjectProfile,
    "gestures/default.json": GestureSettings,
    "outputs/default.json": OutputSettings,
}
DOCUMENTS: dict[str, Any] = {name: json.loads((TREE / name).read_text()) for name in KINDS}


def refused(name: str, document: Any) -> str:
    with pytest.raises(CalibrationError) as caught:
        calibration.parse(msgspec.json.encode(document), KINDS[name], name)
    text = str(caught.value)
    assert text.startswith(f"{name}: ")
    return text


RIGHT = "T_rig_camera", "right"
INTRINSICS = ("intrinsics",)
TABLE: list[tuple[str, tuple[str | int, ...], object, str]] = [
    ("rigs/desk.json", RIGHT, DOCUMENTS["rigs/desk.json"]["T_rig_camera"]["left"],
        r"T_rig_camera\.right: 0 mm from camera 'left'; two cameras are at least 1 mm apart"),
    ("rigs/desk.json", (*RIGHT, 0, 3), 101.0, r"<= 100\.0 - at `\$\.T_rig_camera\.right\[0\]\[3\]`"),
    ("rigs/desk.json", (*RIGHT, 0, 0), 0.5, r"T_rig_camera\.right: upper left 3x3 is not a rotation"),
    ("rigs/desk.json", (*RIGHT, 3, 3), 0.0, r"T_rig_camera\.right: last row"),
    ("rigs/desk.json", ("T_world_rig",), [[0, 0, 0, 0]] * 4, "T_world_rig: upper left 3x3"),
    ("rigs/desk.json", ("power_law",), {"k_m": 1e-300, "z": -1}, r"\$\.power_law\.k_m"),
    ("rigs/desk.json", ("power_law",), {"k_m": 45.0, "z": -1e-300}, r"\$\.power_law\.z"),
    ("rigs/desk.json", ("affine_disparity",), {"a_m_px": 1e300, "x0_px": 0}, r"\$\.affine_disparity\.a_m_px"),
    ("rigs/desk.json", ("affine_disparity",), {"a_m_px": 37, "x0_px": 1e6}, r"\$\.affine_disparity\.x0_px"),
    ("rigs/desk.json", ("stamp_offset_us",), {"left": 1e7}, r"\$\.stamp_offset_us\.left"),
    ("rigs/desk.json", ("filter", "min_cutoff_hz"), 1e-300, r">= 0\.001 - at `\$\.filter\.min_cutoff_hz`"),
    ("rigs/desk.json", ("volume", "high_m", 1), 1e300, r"\$\.volume\.high_m\[1\]"),
    ("rigs/wrist.json", ("imu", "rate_hz"), 1e-300, r">= 0\.1 - at `\$\.imu\.rate_hz`"),
    ("rigs/wrist.json", ("imu", "q_palm_imu", 0), 1e300, r"\$\.imu\.q_palm_imu\[0\]"),
    ("rigs/wrist.json", ("laser_plane", "offset_m"), 0.0, r"laser_plane\.offset_m: 0, the plane runs through"),
    ("rigs/wrist.json", ("laser_plane", "normal", 1), 1e300, r"\$\.laser_plane\.normal\[1\]"),
    ("rigs/wrist.json", ("laser", "fan_rad"), 1e-300, r"\$\.laser\.fan_rad"),
    ("rigs/wrist.json", ("T_camera_palm", 0, 0), 0.5, "T_camera_palm: upper left 3x3 is not a rotation"),
    ("rigs/wrist.json", ("strobe", "led", "emitter_m"), 1e-300, r"\$\.strobe\.led\.emitter_m"),
    ("rigs/wrist.json", ("strobe", "max_pulse_us"), 1e-300, r"\$\.strobe\.max_pulse_us"),
    ("cameras/left.json", (*INTRINSICS, "fx_px"), 1e-300, r">= 1\.0 - at `\$\.intrinsics\.fx_px`"),
    ("cameras/left.json", (*INTRINSICS, "fx_px"), 5.0, r"intrinsics\.fx_px: 5, of a picture 640 px wide it is 32 "),
    ("cameras/left.json", (*INTRINSICS, "fy_px"), 9e5, r"intrinsics\.fy_px: 900000, of a picture 640 px wide"),
    ("cameras/left.json", (*INTRINSICS, "cx_px"), -641.0, r"intrinsics\.cx_px: -641, more than one picture outside"),
    ("cameras/left.json", (*INTRINSICS, "cy_px"), 961.0, r"intrinsics\.cy_px: 961, more than one picture outside"),
    ("cameras/left.json", (*INTRINSICS, "distortion"), [-0.9, 0, 0, 0, 0],
        r"intrinsics\.distortion: the lens folds 202 px from its principal .* at pixel \(\d+, \d+\)"),
    ("cameras/left.json", (*INTRINSICS, "distortion", 2), 0.4, r"intrinsics\.distortion: the lens folds"),
    ("cameras/left.json", (*INTRINSICS, "distortion", 0), 1e300, r"\$\.intrinsics\.distortion\[0\]"),
    ("cameras/left.json", ("frame_rate_hz",), 1e-300, r">= 0\.1 - at `\$\.frame_rate_hz`"),
    ("cameras/left.json", ("frame_rate_hz",), 20_000, r"<= 10000\.0 - at `\$\.frame_rate_hz`"),
    ("cameras/left.json", ("exposure_us",), 1e-300, r"\$\.exposure_us"),
    ("cameras/left.json", ("analogue_gain",), 1e-300, r"\$\.analogue_gain"),
    ("cameras/left.json", ("colour_gains", 1), 1e300, r"\$\.colour_gains\[1\]"),
    ("cameras/left.json", ("row_time_us",), 1e9, r"\$\.row_time_us"),
    ("cameras/left.json", ("width_px",), 17_000, r"\$\.width_px"),
    ("cameras/left.json", ("markers", "thumb", "reference_bgr_linear", 0), 1e-300,
        r"\$\.markers\.thumb\.reference_bgr_linear\[0\]"),
    ("hands/default-right.json", ("rest_joints", "index-finger-tip", "position_m", 0), 1e300,
        r"<= 0\.5 - at `\$\.rest_joints\.index-finger-tip\.position_m\[0\]`"),
    ("hands/default-right.json", ("rest_joints", "index-finger-tip", "position_m"),
        DOCUMENTS["hands/default-right.json"]["rest_joints"]["index-finger-phalanx-distal"]["position_m"],
        r"rest_joints\.index-finger-tip\.position_m: where index-finger-phalanx-distal is"),
    ("hands/default-right.json", ("rest_joints", "wrist", "orientation_wxyz"), [0, 0, 0, 0],
        r"rest_joints\.wrist\.orientation_wxyz: length 0, a rotation"),
    ("hands/default-right.json", ("radius_m",), {"wrist": 1e-300}, r"\$\.radius_m\.wrist"),
    ("hands/default-right.json", ("markers", "thumb", "painted_m"), 5.0, r"\$\.markers\.thumb\.painted_m"),
    ("objects/wand.json", ("markers", "wand1", "radius_m"), 1e-300, r"\$\.markers\.wand1\.radius_m"),
    ("objects/cube-tracker.json", ("T_object_tracker",), [[1e300] * 4] * 4, r"\$\.T_object_tracker\[0\]\[0\]"),
    ("gestures/default.json", ("poses", "pinch", "weight"), 1e-300, r"\$\.poses\.pinch\.weight"),
    ("gestures/default.json", ("hold", "begin_s"), 1e300, r"\$\.hold\.begin_s"),
    ("outputs/default.json", ("vmc", "forearm_m"), 1e-300, r"\$\.vmc\.forearm_m"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "path", "value", "expected"),
    TABLE,
    ids=[f"{t[0]}-{'.'.join(map(str, t[1]))}-{t[2]}"[:80] for t in TABLE],
)
def test_a_file_that_cannot_be_is_refused_with_file_and_key(
    name: str, path: tuple[str | int, ...], value: object, expected: str
) -> None:
    assert re.search(expected, refused(name, edited(DOCUMENTS[name], path, value)))


@pytest.mark.parametrize("name", KINDS)
def test_a_key_that_stands_twice_is_refused(name: str) -> None:
    raw = (TREE / name).read_bytes().replace(b'"version": 1,', b'"version": 1, "version": 1,', 1)
    with pytest.raises(CalibrationError, match=rf"{name}: duplicate key - at `\$\.version`"):
        calibration.parse(raw, KINDS[name], name)


@pytest.mark.parametrize("kind", [*dict.fromkeys(KINDS.values()), Manifest], ids=lambda kind: kind.__name__)
def test_every_number_of_a_file_has_bounds(kind: type[msgspec.Struct]) -> None:
    assert not list(numbers_without_bounds(msgspec.inspect.type_info(kind)))


def test_a_number_without_bounds_is_found() -> None:
    class Loose(msgspec.Struct):
        parts: dict[str, tuple[float, ...]] = {}

    assert list(numbers_without_bounds(msgspec.inspect.type_info(Loose))) == ["$.parts[][]"]


@settings(max_examples=200)
@given(st.data())
def test_hostile_values_load_or_are_refused(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(KINDS)))
    document = DOCUMENTS[name]
    for _ in range(data.draw(st.integers(1, 3))):
        path, value = data.draw(edits(document))
        document = edited(document, path, value)
        if not document:
            break
    with contextlib.suppress(CalibrationError):
        usable(calibration.parse(json.dumps(document).encode(), KINDS[name], name))


def usable(value: msgspec.Struct) -> None:
    """Compute with what was loaded; numpy raises where something overflows or is divided by nothing."""
    with np.errstate(all="raise", under="ignore"):
        if isinstance(value, CameraCalibration) and value.intrinsics is not None:
            use_camera(value)
        elif isinstance(value, HandProfile):
            model = HandModel.of(value)
            assert np.isfinite(model.forward(np.eye(4), np.zeros((5, 4))).position_m).all()


def use_camera(file: CameraCalibration) -> None:
    model = CameraModel.of(file, np.eye(4))
    w, h = file.width_px, file.height_px
    uv = np.stack(np.meshgrid(np.linspace(-0.5, w - 0.5, 9), np.linspace(-0.5, h - 0.5, 9)), axis=-1)
    assert np.isfinite(model.distort(model.undistort(uv))).all()
    for far in (1e-3, 1.0, 100.0):
        assert np.isfinite(model.project(far * model.ray(uv))).all()


@pytest.mark.parametrize("name", KINDS)
def test_values_at_the_bounds_can_be_computed_with(name: str) -> None:
    loaded = 0
    for path, low, high in bounds_of(DOCUMENTS[name], KINDS[name]):
        for value in (low, high):
            try:
                usable(
                    calibration.parse(
                        msgspec.json.encode(edited(DOCUMENTS[name], path, value)), KINDS[name], name
                    )
                )
                loaded += 1
            except CalibrationError:
                pass  # that bound contradicts another value of the file
    assert loaded


def test_files_inside_the_manifest_of_a_recording_are_checked_too() -> None:
    camera, rig = DOCUMENTS["cameras/left.json"], DOCUMENTS["rigs/desk.json"]
    good = {"version": 1, "kind": "markers", "cameras": {"left": camera, "right": camera}, "rig": rig}
    folded = edited(good, ("cameras", "right", "intrinsics", "distortion"), [-0.9, 0, 0, 0, 0])
    one_place = edited(good, ("rig", "T_rig_camera", "right"), rig["T_rig_camera"]["left"])
    clicked = edited(good, ("clicks",), {"left": {"thumb": [1e300, 0]}})
    check_manifest(msgspec.convert(good, Manifest), "recording.json")
    for bad, expected in (
        (folded, r"cameras\.right: intrinsics\.distortion"),
        (one_place, "T_rig_camera.right: 0 mm"),
    ):
        with pytest.raises(CalibrationError, match=f"recording.json: .*{expected}"):
            check_manifest(msgspec.convert(bad, Manifest), "recording.json")
    with pytest.raises(CalibrationError, match=r"recording\.json: .*\$\.clicks\.left\.thumb\[0\]"):
        calibration.parse(msgspec.json.encode(clicked), Manifest, "recording.json")


def tree_with(folder: Path, name: str, old: str, new: str) -> Path:
    """A copy of the calibration tree with one file changed."""
    shutil.copytree(TREE, folder)
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))
    return folder


@pytest.mark.parametrize(
    ("name", "old", "new", "expected"),
    [
        ("rigs/desk.json", '"version": 1,', '"version": 1, "kind": "markers",', "duplicate key - at `$.kind`"),
        ("rigs/desk.json", "0.075]", "0.0]", "T_rig_camera.right: 0.72 mm from camera 'left'"),
        ("cameras/right.json", '"distortion": [', '"distortion": [-0.9, 0, 0, 0, 0], "was": [', "unknown field `was`"),
        ("cameras/left.json", '"frame_rate_hz": 60.0', '"frame_rate_hz": 1e-300', "at `$.frame_rate_hz`"),
        ("cameras/left.json", "{", "[" * 100_000 + "{", "levels deep"),
        ("cameras/left.json", "{", " " * (4 << 20) + "{", "larger than 4 MiB"),
    ],
)  # fmt: skip
def test_a_rig_is_refused_with_the_file_that_is_wrong(
    name: str, old: str, new: str, expected: str, tmp_path: Path
) -> None:
    tree = tree_with(tmp_path / "tree", name, old, new)
    with pytest.raises(CalibrationError) as caught:
        load_setup(tree, "desk")
    assert str(caught.value).startswith(f"{tree / name}: ")
    assert expected in str(caught.value)


def test_a_master_names_the_wrong_file_and_ends(tmp_path: Path) -> None:
    name = "rigs/desk.json"
    tree = tree_with(tmp_path / "tree", name, '"version": 1,', '"version": 1, "kind": "markers",')
    command = [sys.executable, "-m", "master", "run", "--calibration", str(tree), "--rig", "desk"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    output = done.stdout + done.stderr
    assert "Traceback" not in output
    assert f"{tree / name}: " in output
    assert "duplicate key - at `$.kind`" in output
