"""A simulated camera shows the true world, whatever the slave beside it believes; names and sizes must agree."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, RigCalibration, load, save
from common.errors import CalibrationError
from common.recording.frame_recording import Manifest, open_recording
from common.sim.board import BoardScene
from slave.__main__ import main
from slave.cameras.synthetic import SyntheticCamera
from slave.commands.simulated import FrameClock, scene_of, world_of

TRUTH = Path(__file__).resolve().parents[3] / "calib_json"
RIG = load(TRUTH / "rigs/desk.json", RigCalibration)
FILE = load(TRUTH / "cameras/left.json", CameraCalibration)
BARE = msgspec.structs.replace(FILE, intrinsics=None, markers=None)
UNPLACED = msgspec.structs.replace(RIG, T_rig_camera={})


def first_image(camera: str | CameraCalibration, scene: str = "standard") -> np.ndarray:
    clock = FrameClock(0)
    made = scene_of(*world_of(Path("nowhere"), UNPLACED, TRUTH, None), scene, 7)
    frame = SyntheticCamera(made, camera, 0, clock, 0, clock, clock.sleep).read()
    assert frame is not None
    return frame.image


def test_a_camera_of_which_nothing_is_known_shows_the_true_world() -> None:
    true = first_image("left")
    np.testing.assert_array_equal(first_image(BARE), true)
    brighter = first_image(msgspec.structs.replace(BARE, exposure_us=10000.0))
    assert brighter.mean() > 1.2 * true.mean(), "the file that is believed says how it is set"


def test_a_board_from_an_empty_tree_and_the_recording_keeps_the_assumed_calibration(tmp_path: Path) -> None:
    for part in ("cameras", "rigs"):
        (tmp_path / part).mkdir()
    save(tmp_path / "cameras/left.json", BARE)
    mine = msgspec.structs.replace(UNPLACED, name="mine", cameras=("left",))
    save(tmp_path / "rigs/mine.json", mine)
    out = tmp_path / "out"
    words = (
        f"record --name left --rig mine --camera synthetic --scene board --every-frame --frames 2 -o {out}"
    )
    words += f" --calibration {tmp_path} --truth {TRUTH} --truth-rig desk"
    assert main(words.split()) == 0
    assert len(open_recording(out).rows) == 2
    assert load(out / "recording.json", Manifest).cameras["left"] == BARE
    assert isinstance(scene_of(*world_of(tmp_path, mine, TRUTH, "desk"), "board", 7), BoardScene)


def test_names_kinds_and_sizes_that_differ_are_said() -> None:
    other = msgspec.structs.replace(UNPLACED, cameras=("left", "top"))
    with pytest.raises(
        CalibrationError, match=r"desk.json: cameras: the true rig has no top, only left, right"
    ):
        world_of(TRUTH, other, TRUTH, None)
    with pytest.raises(CalibrationError, match=r"wrist.json: kind: the true rig is one of wrist"):
        world_of(TRUTH, UNPLACED, TRUTH, "wrist")
    with pytest.raises(CalibrationError, match="--truth-rig desk: needs --truth DIR"):
        world_of(TRUTH, UNPLACED, None, "desk")
    with pytest.raises(CalibrationError, match=r"nothing.json: cannot read: No such file"):
        world_of(TRUTH, UNPLACED, TRUTH, "nothing")
    with pytest.raises(CalibrationError, match="320 x 240, the simulated camera has 640 x 480"):
        first_image(msgspec.structs.replace(BARE, width_px=320, height_px=240))
