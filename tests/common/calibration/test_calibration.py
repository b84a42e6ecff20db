"""Calibration files: refused with file and key, saved whole or not at all, and equal after a round trip."""

import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common import calibration
from common.calibration import (
    AffineDisparityCalibration,
    CameraCalibration,
    HandProfile,
    HsvRange,
    ImuCalibration,
    Intrinsics,
    MarkerMount,
    PowerLawCalibration,
    RestJoint,
    RigCalibration,
    compact_numbers,
    load,
    parse,
    save,
)
from common.calibration.object_profile import ObjectProfile
from common.errors import CalibrationError

ROOT = Path(__file__).resolve().parents[3]

names = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
positive = st.floats(0.5, 100.0)
number = st.floats(-0.4, 0.4)
vector3 = st.tuples(number, number, number)
quaternion = st.sampled_from([(1.0, 0.0, 0.0, 0.0), (0.5, 0.5, -0.5, 0.5), (0.6, 0.0, 0.8, 0.0)])
saturation = st.integers(0, 255)


@st.composite
def lenses(draw: st.DrawFn, width: int, height: int) -> Intrinsics:
    share, bent = (
        st.floats(0.0, 1.0),
        [(0.0,) * 5, (0.06, -0.12, 4e-4, -6e-4, 0.03), (-0.148, 0.024, 0.0, 0.0, 0.0)],
    )
    focal = width * draw(st.floats(1.0, 10.0)), width * draw(st.floats(1.0, 10.0))
    centre = width * draw(share), height * draw(share)
    distortion = draw(st.sampled_from(bent)) if height <= width else bent[0]
    return Intrinsics(
        fx_px=focal[0],
        fy_px=focal[1],
        cx_px=centre[0],
        cy_px=centre[1],
        distortion=distortion,  # pyright: ignore[reportArgumentType]
    )


@st.composite
def hsv_ranges(draw: st.DrawFn) -> HsvRange:
    s, v = sorted([draw(saturation), draw(saturation)]), sorted([draw(saturation), draw(saturation)])
    hue = st.integers(0, 179)
    return HsvRange(hsv_low=(draw(hue), s[0], v[0]), hsv_high=(draw(hue), s[1], v[1]))


@st.composite
def cameras(draw: st.DrawFn) -> CameraCalibration:
    width, height = draw(st.integers(16, 16384)), draw(st.integers(16, 16384))
    return CameraCalibration(
        version=1,
        name=draw(names),
        width_px=width,
        height_px=height,
        frame_rate_hz=draw(positive),
        exposure_us=draw(positive),
        analogue_gain=draw(positive),
        colour_gains=(draw(positive), draw(positive)),
        row_time_us=draw(st.floats(0.0, 1e5)),
        intrinsics=draw(st.none() | lenses(width, height)),
        markers=draw(st.none() | st.dictionaries(names, hsv_ranges(), max_size=8)),
    )


@st.composite
def hands(draw: st.DrawFn) -> HandProfile:
    joints = draw(st.lists(st.text(max_size=9), max_size=8, unique=True))
    places = {name: (0.01 * i, draw(number), draw(number)) for i, name in enumerate(joints)}
    mounts = st.builds(MarkerMount, joint=st.text(max_size=9), offset_m=vector3)
    return HandProfile(
        version=1,
        name=draw(names),
        side=draw(st.sampled_from(["left", "right"])),
        rest_joints={
            name: RestJoint(position_m=place, orientation_wxyz=draw(quaternion))
            for name, place in places.items()
        },
        markers=draw(st.dictionaries(names, mounts)),
        radius_m=draw(st.none() | st.dictionaries(st.text(max_size=9), st.floats(5e-4, 0.2))),
    )


IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
SHIFTED = ((1.0, 0.0, 0.0, 0.075), *IDENTITY[1:])
CAMERA: dict[str, Any] = {
    "version": 1,
    "name": "left",
    "width_px": 640,
    "height_px": 480,
    "frame_rate_hz": 90.0,
    "exposure_us": 6000,
    "analogue_gain": 1.25,
    "colour_gains": [0.83, 1.24],
    "row_time_us": 20.6,
    "intrinsics": {
        "fx_px": 503.0,
        "fy_px": 503.0,
        "cx_px": 319.5,
        "cy_px": 239.5,
        "distortion": [0.1, -0.2, 0, 0, 0],
    },
    "markers": {"thumb": {"hsv_low": [85, 90, 40], "hsv_high": [98, 255, 255]}},
}
RIG: dict[str, Any] = {
    "version": 1,
    "name": "desk",
    "kind": "markers",
    "cameras": ["left", "right"],
    "markers": ["thumb", "index"],
    "T_rig_camera": {"left": IDENTITY, "right": SHIFTED},
    "depth_model": "power_law",
    "power_law": {"k_m": 45.433, "z": -1.035},
    "hand": "default-right",
}
HAND: dict[str, Any] = {
    "version": 1,
    "name": "me",
    "side": "right",
    "rest_joints": {"wrist": {"position_m": [0, 0, 0], "orientation_wxyz": [1, 0, 0, 0]}},
    "markers": {"thumb": {"joint": "thumb-tip", "offset_m": [0, 0, -0.01]}},
}
SAMPLES: dict[type[msgspec.Struct], dict[str, Any]] = {
    CameraCalibration: CAMERA,
    RigCalibration: RIG,
    HandProfile: HAND,
}


def changed(content: dict[str, Any], path: str, value: object) -> bytes:
    """`content` as JSON with the value at the dotted `path` replaced, or added."""
    copy = msgspec.json.decode(msgspec.json.encode(content))
    *parents, last = path.split(".")
    inner = copy
    for key in parents:
        inner = inner[key]
    if value is ...:
        del inner[last]
    else:
        inner[last] = value
    return msgspec.json.encode(copy)


@given(value=cameras() | hands())
def test_what_is_saved_is_loaded_equal(value: CameraCalibration | HandProfile, tmp_path_factory: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "value.json"
    save(path, value)
    assert load(path, type(value)) == value


imus = st.builds(
    ImuCalibration,
    name=names,
    rate_hz=positive,
    q_palm_imu=st.none() | st.sampled_from([(1.0, 0.0, 0.0, 0.0), (0.5, 0.5, -0.5, 0.5)]),
    q_rig_world=st.none() | st.just((0.6, 0.0, 0.8, 0.0)),
    orientation_sigma_rad=st.floats(1e-6, 6.0),
    heading_sigma_rad=st.none() | st.floats(1e-6, 6.0),
    heading_drift_rad_s=st.floats(0.0, 10.0),
).filter(lambda imu: imu.name not in ("left", "right"))


def test_an_imu_of_which_nothing_is_known_is_an_empty_map() -> None:
    content = msgspec.to_builtins(SAMPLES[RigCalibration]) | {"imu": {}}
    rig = parse(msgspec.json.encode(content), RigCalibration, "sample")
    # Neither mounting nor heading is assumed.
    assert rig.imu == ImuCalibration(q_palm_imu=None, q_rig_world=None, heading_sigma_rad=None)


@given(number, st.floats(1e-3, 1e3), st.floats(-3.0, -0.1), st.none() | imus)
def test_a_rig_is_loaded_equal(x0: float, k: float, z: float, imu: ImuCalibration | None) -> None:
    rig = RigCalibration(
        version=1,
        name="desk",
        kind="markers",
        cameras=("left", "right"),
        hand="me",
        T_rig_camera={"left": IDENTITY, "right": SHIFTED},
        depth_model="affine_disparity",
        power_law=PowerLawCalibration(k_m=k, z=z),
        affine_disparity=AffineDisparityCalibration(a_m_px=k, x0_px=x0),
        imu=imu,
    )
    assert parse(compact_numbers(msgspec.json.encode(rig).decode()).encode(), RigCalibration, "memory") == rig


@pytest.mark.parametrize("kind", SAMPLES, ids=lambda kind: kind.__name__)
def test_the_samples_of_this_file_are_valid(kind: type[msgspec.Struct]) -> None:
    parse(msgspec.json.encode(SAMPLES[kind]), kind, "sample")


@pytest.mark.parametrize(
    ("kind", "path", "value", "output"),
    [
        (RigCalibration, "imu", {"q_palm_imu": [1, 1, 0, 0]}, r"imu\.q_palm_imu: length 1\.414"),
        (RigCalibration, "imu", {"q_rig_world": [1, 0, 0]}, r"\$\.imu\.q_rig_world"),
        (RigCalibration, "imu", {"name": "left"}, r"imu\.name: 'left' is a camera"),
        (RigCalibration, "imu", {"drift": 1}, r"`drift`.*\$\.imu"),
        (CameraCalibration, "exposure_ms", 6, "exposure_ms"),
        (CameraCalibration, "intrinsics.fx", 503.0, r"`fx`.*\$\.intrinsics"),
        (CameraCalibration, "markers.thumb.hsv", [1, 2, 3], "`hsv`"),
        (CameraCalibration, "version", 2, "version"),
        (CameraCalibration, "version", ..., "version"),
        (CameraCalibration, "name", "a/b", "name"),
        (CameraCalibration, "name", "left\n", "name"),
        (CameraCalibration, "width_px", 640.5, "width_px"),
        (CameraCalibration, "width_px", 0, "width_px"),
        (CameraCalibration, "exposure_us", "6000", "exposure_us"),
        (CameraCalibration, "exposure_us", None, "exposure_us"),
        (CameraCalibration, "exposure_us", 0, "exposure_us"),
        (CameraCalibration, "intrinsics.fx_px", -503.0, "intrinsics.fx_px"),
        (CameraCalibration, "intrinsics.distortion", [0, 0, 0, 0], "distortion"),
        (CameraCalibration, "markers.thumb.hsv_low", [180, 0, 0], "hsv_low"),
        (CameraCalibration, "markers.thumb.hsv_low", [85, 200, 40], None),
        (CameraCalibration, "markers.thumb.hsv_high", [98, 89, 255], r"markers\.thumb: S of hsv_low"),
        (CameraCalibration, "markers.thumb.hsv_high", [98, 255, 39], r"markers\.thumb: V of hsv_low"),
        (CameraCalibration, "markers.thumb.hsv_low", [170, 90, 40], None),  # red wraps through 0
        (RigCalibration, "power_law.k", 3.0, "`k`"),
        (RigCalibration, "power_law", ..., "power_law"),
        (RigCalibration, "depth_model", "guess", "depth_model"),
        (RigCalibration, "depth_model", "affine_disparity", "affine_disparity"),
        (RigCalibration, "depth_model", "stereo", None),
        (RigCalibration, "cameras", [], "cameras"),
        (RigCalibration, "cameras", ["left", "left"], "cameras: a name stands twice"),
        (RigCalibration, "markers", ["thumb", "thumb"], "markers: a name stands twice"),
        (RigCalibration, "T_rig_camera.right", ..., "T_rig_camera: camera 'right' is missing"),
        (
            RigCalibration,
            "T_rig_camera.right",
            [[2, 0, 0, 0], *IDENTITY[1:]],
            r"T_rig_camera\.right: .*rotation",
        ),
        (
            RigCalibration,
            "T_rig_camera.right",
            [[-1, 0, 0, 0], *IDENTITY[1:]],
            r"T_rig_camera\.right: .*rotation",
        ),
        (
            RigCalibration,
            "T_rig_camera.right",
            [*IDENTITY[:3], [0, 0, 1, 1]],
            r"T_rig_camera\.right: last row",
        ),
        (HandProfile, "side", "both", "side"),
        (HandProfile, "rest_joints.wrist.position", [0, 0, 0], "position"),
        (HandProfile, "rest_joints.wrist.orientation_wxyz", [1, 0, 0], "orientation_wxyz|rest_joints"),
        (HandProfile, "couplings", {"dip": 1.0}, "dip"),
    ],
)
def test_a_wrong_key_or_value_is_refused_with_file_and_key(
    kind: type[msgspec.Struct], path: str, value: object, output: str | None, tmp_path: Path
) -> None:
    file = tmp_path / "some.json"
    file.write_bytes(changed(SAMPLES[kind], path, value))
    if output is None:
        load(file, kind)
        return
    with pytest.raises(CalibrationError, match=output) as caught:
        load(file, kind)
    assert str(caught.value).startswith(str(file))


@pytest.mark.parametrize(
    "text", [b"", b"{", b"[]", b"null", b"NaN", b'{"version": NaN}', b"\xff\xfe", b"[" * 100_000]
)
def test_broken_json_is_refused_with_its_file(text: bytes, tmp_path: Path) -> None:
    file = tmp_path / "broken.json"
    file.write_bytes(text)
    with pytest.raises(CalibrationError, match=r"broken\.json"):
        load(file, CameraCalibration)


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity", "1e999", "1e10"])
def test_numbers_that_are_none_are_refused(text: str) -> None:
    raw = msgspec.json.encode(CAMERA).decode().replace("20.6", text)
    with pytest.raises(CalibrationError):
        parse(raw.encode(), CameraCalibration, "camera")


def test_a_missing_file_and_a_folder_say_so(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"none\.json: cannot read: No such file"):
        load(tmp_path / "none.json", CameraCalibration)
    with pytest.raises(CalibrationError, match="cannot read: Is a directory"):
        load(tmp_path, CameraCalibration)


def sample_camera() -> CameraCalibration:
    return parse(msgspec.json.encode(CAMERA), CameraCalibration, "sample")


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_a_value_that_would_not_load_is_not_saved(value: float, tmp_path: Path) -> None:
    path = tmp_path / "left.json"
    save(path, sample_camera())
    before = path.read_bytes()
    with pytest.raises(CalibrationError, match=r"left\.json"):
        save(path, msgspec.structs.replace(sample_camera(), row_time_us=value))
    assert path.read_bytes() == before


def test_a_nan_in_an_optional_place_does_not_become_absent(tmp_path: Path) -> None:
    rig = parse(msgspec.json.encode(RIG), RigCalibration, "sample")
    laser = calibration.Laser(fan_rad=float("nan"))
    with pytest.raises(CalibrationError, match="NaN"):
        save(tmp_path / "rig.json", msgspec.structs.replace(rig, laser=laser))


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "left.json"
    save(path, sample_camera())
    before = path.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    owner: object = os if step == "fsync" else Path
    monkeypatch.setattr(owner, step, fail)
    with pytest.raises(CalibrationError, match=r"left\.json: cannot write: No space left"):
        save(path, msgspec.structs.replace(sample_camera(), exposure_us=1.0))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["left.json"]


def test_a_missing_folder_is_said(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot write: No such file"):
        save(tmp_path / "none" / "left.json", sample_camera())


def test_numbers_stand_on_one_line_and_strings_stay_as_they_are() -> None:
    text = compact_numbers('{\n "a": [\n  1,\n  -2.5e-3\n ],\n "note": "[1   2]",\n "quote": "\\"[1   2]"\n}')
    assert text == '{\n "a": [1, -2.5e-3],\n "note": "[1   2]",\n "quote": "\\"[1   2]"\n}'


def test_no_input_at_all_takes_down_the_parser() -> None:
    rng = np.random.default_rng(7)
    good = msgspec.json.encode(RIG)
    refused = 0
    for _ in range(3000):
        data = bytearray(good)
        for _ in range(int(rng.integers(1, 4))):
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        try:
            parse(bytes(data), RigCalibration, "fuzz")
        except CalibrationError:
            refused += 1
    assert 1000 < refused < 3000


FOLDERS = {
    "cameras": CameraCalibration,
    "rigs": RigCalibration,
    "hands": HandProfile,
    "objects": ObjectProfile,
}


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_files_of_the_project_load_and_are_called_what_they_are(folder: str) -> None:
    files = sorted((ROOT / "calib_json" / folder).glob("*.json"))
    assert files
    for file in files:
        assert load(file, FOLDERS[folder]).name == file.stem


def test_the_rigs_of_the_project_name_cameras_and_hands_that_exist() -> None:
    for file in (ROOT / "calib_json" / "rigs").glob("*.json"):
        rig = load(file, RigCalibration)
        for camera in rig.cameras:
            assert (ROOT / "calib_json" / "cameras" / f"{camera}.json").is_file()
        assert (ROOT / "calib_json" / "hands" / f"{rig.hand}.json").is_file()
        for name in rig.objects:
            profile = load(ROOT / "calib_json" / "objects" / f"{name}.json", ObjectProfile)
            assert set(profile.markers) <= set(rig.free_markers)


def test_hands_of_the_data_sets_load(datasets: Path) -> None:
    files = sorted((datasets / "hands").glob("*.json"))
    assert files
    for file in files:
        hand = load(file, HandProfile)
        assert len(hand.rest_joints) == 25
        norms = [np.linalg.norm(joint.orientation_wxyz) for joint in hand.rest_joints.values()]
        np.testing.assert_allclose(norms, 1.0, atol=1e-3)


def test_a_rig_that_is_still_to_be_measured_has_no_places_and_says_what_measures_them() -> None:
    rig = msgspec.structs.replace(
        load(ROOT / "calib_json" / "rigs" / "desk.json", RigCalibration), T_rig_camera={}
    )
    calibration.check(rig, "desk.json")
    with pytest.raises(CalibrationError, match="calibrate cameras stereo"):
        rig.camera_pose("left")
