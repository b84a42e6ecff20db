"""What the set-up writes from an empty folder, and how far it says it is."""

import stat
from pathlib import Path

import pytest
from msgspec.structs import replace

from common.bus.keys import rig_key
from common.calibration import (
    CameraCalibration,
    HandProfile,
    HsvRange,
    Intrinsics,
    RigCalibration,
    load,
    save,
)
from common.errors import CalibrationError, PhalanxError
from common.hand.model import HandModel
from master.calibrate.tree_files import provenance
from master.console.setup.files import (
    KEY_FILE,
    KINDS,
    PLAN,
    CameraPlan,
    Plan,
    key_of,
    load_plan,
    modes_of,
    new_file,
    replace_file,
    write_cameras,
    write_rig,
)
from master.console.setup.session import Done, steps_of

LENS = Intrinsics(fx_px=500.0, fy_px=500.0, cx_px=320.0, cy_px=240.0)
RANGE = HsvRange(hsv_low=(10, 60, 60), hsv_high=(20, 255, 255))


def plan(**more: object) -> Plan:
    cameras = tuple(CameraPlan(name=name, kind="usb", mode="usb-640x480") for name in ("left", "right"))
    return replace(Plan(cameras=cameras), **more)


def states(tree: Path, of: Plan) -> dict[str, Done]:
    return {step.key: step.state for step in steps_of(tree, of)}


def measured(tree: Path) -> None:
    """As a calibration of lenses and places leaves the files."""
    for name in ("left", "right"):
        path = tree / "cameras" / f"{name}.json"
        how = provenance("calibrate cameras stereo", ("views",), {"rms_px": 0.1})
        save(path, replace(load(path, CameraCalibration), intrinsics=LENS, provenance={"intrinsics": how}))
    path = tree / "rigs" / "desk.json"
    places = {
        name: ((1.0, 0.0, 0.0, x), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        for name, x in (("left", 0.0), ("right", 0.07))
    }
    how = provenance("calibrate cameras stereo", ("views",), {"rms_px": 0.1})
    save(path, replace(load(path, RigCalibration), T_rig_camera=places, provenance={"T_rig_camera": how}))


def test_every_mode_makes_a_file_that_validates(tmp_path: Path, root: Path) -> None:
    for kind in KINDS:
        for mode in modes_of(kind):
            file = new_file(kind, mode, "left", root / "calib_json")
            save(tmp_path / "left.json", file)
            back = load(tmp_path / "left.json", CameraCalibration)
            assert (back.intrinsics, back.markers) == (None, None)
            assert back.exposure_us < 1e6 / back.frame_rate_hz
            # All rows are read out before the next frame begins.
            assert back.height_px * back.row_time_us < 1e6 / back.frame_rate_hz
            assert file.sensor is None or back.name == "left"
    assert {kind: len(modes_of(kind)) for kind in KINDS} == {"simulated": 1, "usb": 3, "pi": 11}
    assert not any("OV9281 board" in text for text in modes_of("pi").values()), "it sees no colours"
    assert next(iter(modes_of("pi"))) == "ov5647-1296x972"


def test_from_an_empty_folder_each_step_is_done_by_its_files_alone(tmp_path: Path) -> None:
    tree, settings = tmp_path / "new", plan()
    to_do = dict.fromkeys(("cameras", "rig", "lens", "colours"), Done.TO_DO)
    assert states(tree, load_plan(tree)) == to_do
    with pytest.raises(CalibrationError, match="choose the cameras first"):
        write_rig(tree, Plan())
    write_cameras(tree, settings)
    assert states(tree, settings) == {**to_do, "cameras": Done.DONE}
    write_rig(tree, settings)
    assert states(tree, settings) == {**to_do, "cameras": Done.DONE, "rig": Done.DONE}
    assert load_plan(tree) == settings
    assert stat.S_IMODE((tree / KEY_FILE).stat().st_mode) == 0o600
    assert bytes.fromhex(key_of(tree, None)) == rig_key({}, tree / KEY_FILE)
    assert key_of(tree, bytes(32)) == "00" * 32
    HandModel.of(load(tree / "hands" / "desk-right.json", HandProfile))
    measured(tree)
    assert states(tree, settings) == {**dict.fromkeys(to_do, Done.DONE), "colours": Done.TO_DO}
    colours = dict.fromkeys(load(tree / "rigs/desk.json", RigCalibration).markers, RANGE)
    for path in (tree / "cameras").glob("*.json"):
        save(path, replace(load(path, CameraCalibration), markers=colours))
    assert set(states(tree, settings).values()) == {Done.DONE}


def test_what_contradicts_is_stale_and_says_what_to_do(tmp_path: Path) -> None:
    settings = plan()
    write_cameras(tmp_path, settings)
    write_rig(tmp_path, settings)
    measured(tmp_path)
    path = tmp_path / "cameras" / "left.json"
    file = load(path, CameraCalibration)
    newer = replace(file.provenance["intrinsics"], date="2999-01-01T00:00:00Z")
    save(path, replace(file, provenance={"intrinsics": newer}))
    (lens,) = (step for step in steps_of(tmp_path, settings) if step.key == "lens")
    assert (lens.state, lens.why) == (
        Done.STALE,
        "the lens of left is newer than the places: measure them again",
    )
    other = replace(
        settings, cameras=(*settings.cameras, CameraPlan(name="left2", kind="usb", mode="usb-1280x720"))
    )
    write_cameras(tmp_path, other)
    assert states(tmp_path, other)["rig"] is Done.STALE
    path.write_text("{")
    (cameras, *_) = steps_of(tmp_path, settings)
    assert (cameras.state, str(path) in cameras.why) == (Done.STALE, True)


def test_the_same_mode_keeps_a_lens_and_another_keeps_the_old_file_aside(tmp_path: Path) -> None:
    settings = plan()
    write_cameras(tmp_path, settings)
    write_rig(tmp_path, settings)
    measured(tmp_path)
    assert write_cameras(tmp_path, settings) == []
    assert load(tmp_path / "cameras/left.json", CameraCalibration).intrinsics == LENS
    hd = replace(settings, cameras=tuple(replace(camera, mode="usb-1280x720") for camera in settings.cameras))
    assert len(write_cameras(tmp_path, hd)) == 2
    assert load(tmp_path / "cameras/left.json", CameraCalibration).intrinsics is None
    (kept,) = tmp_path.glob("old/*/cameras/left.json")
    assert load(kept, CameraCalibration).intrinsics == LENS


@pytest.mark.parametrize(
    ("names", "settings"),
    [(("left",), "two or more"), (("left", "left"), "'left' stands twice")],
)
def test_cameras_that_cannot_be_a_rig_are_refused(
    tmp_path: Path, names: tuple[str, ...], settings: str
) -> None:
    cameras = tuple(CameraPlan(name=name, kind="usb", mode="usb-640x480") for name in names)
    with pytest.raises(CalibrationError, match=settings):
        write_cameras(tmp_path, Plan(cameras=cameras))
    assert not (tmp_path / PLAN).exists()


def test_a_key_that_others_can_read_is_refused(tmp_path: Path) -> None:
    write_cameras(tmp_path, plan())
    write_rig(tmp_path, plan())
    (tmp_path / KEY_FILE).chmod(0o644)
    with pytest.raises(PhalanxError, match="others can read the rig key"):
        key_of(tmp_path, None)


def test_eight_markers_stand_on_the_hand(tmp_path: Path) -> None:
    settings = plan(marker_set="eight", side="left", length_mm=170.0)
    write_cameras(tmp_path, settings)
    write_rig(tmp_path, settings)
    hand = HandModel.of(load(tmp_path / "hands" / "desk-left.json", HandProfile))
    for marker in load(tmp_path / "rigs" / "desk.json", RigCalibration).markers:
        hand.mount(marker)


def test_a_file_that_is_replaced_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "rigs" / "desk.json"
    replace_file(tmp_path, path, b"one")
    replace_file(tmp_path, path, b"two")
    (kept,) = tmp_path.glob("old/*/rigs/desk.json")
    assert (kept.read_bytes(), path.read_bytes()) == (b"one", b"two")
