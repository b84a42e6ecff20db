"""The commands on real files: recording -> command -> rig file -> what the master makes of it; and broken input."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load, save
from common.errors import CalibrationError, FitError, PhalanxError, RecordingError
from common.hand.model import HandModel
from common.recording.frame_recording import FRAMES, Illumination, Manifest
from common.recording.frame_writing import RecordingWriter
from common.recording.recorded_files import write_npz
from common.sim.wrist.board import WristBoardScene, record_wrist_board
from common.sim.wrist.scene import WristScene
from master.calibrate.cameras.boards import Checkerboard
from master.calibrate.wrist.palm import BoardOffset
from master.rig.setup import WristSetup
from tests.cli import calibrate
from tests.conftest import ROOT
from tests.master.calibrate.wrist.devices import CAMERA, RIG, angle_deg, plane_of, scene_of

SEED = 13
BOARD = ("--board", "9x6", "--square-mm", "15")
PALM_BOARD = (
    "--board",
    "7x4",
    "--square-mm",
    "10",
    "--wrist-mm",
    "85",
    "--aside-mm",
    "4",
    "--depth-mm",
    "22",
)


def run(*arguments: object) -> str:
    """What a command says.

    Raises:
        PhalanxError: What it refuses.
    """
    name, *words = map(str, arguments)
    return calibrate(name, *words)


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calib_json tree of a device whose laser is not measured: the file says something else than the truth."""
    folder = tmp_path_factory.mktemp("calib_json")
    for name in ("rigs", "cameras", "hands"):
        (folder / name).mkdir()
    save(folder / "rigs" / "wrist.json", replace(RIG, laser_plane=None, flat_field=None))
    save(folder / "cameras" / "wrist.json", CAMERA)
    shutil.copy(ROOT / "calib_json/hands/default-right.json", folder / "hands")
    return folder


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a board shown to the device; its manifest does not know the laser."""
    folder = tmp_path_factory.mktemp("recordings") / "boards"
    record_wrist_board(folder, scene_of(SEED, 7), replace(RIG, laser_plane=None))
    return folder


def rig_of(tree: Path) -> RigCalibration:
    return load(tree / "rigs" / "wrist.json", RigCalibration)


@pytest.fixture(scope="module")
def measured(tree: Path, boards: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Numbers and picture of the plane that is written into the tree, and what the command says."""
    folder = tmp_path_factory.mktemp("plane")
    output = run(
        "laser-plane", boards, *BOARD, "--rig", "wrist", "--calibration", tree, "--out", tree,
        "--json", folder / "plane.json", "--picture", folder / "plane.png",
    )  # fmt: skip
    return folder, output


def test_a_recording_gives_the_plane_that_the_master_then_uses(
    tree: Path, measured: tuple[Path, str]
) -> None:
    folder, output = measured
    rig, true = rig_of(tree), plane_of(SEED)
    setup = WristSetup.of(rig, CAMERA, HandModel.of(load(tree / "hands/default-right.json", HandProfile)))
    assert angle_deg(setup.normal, np.array(true.normal)) < 0.1
    assert 1e3 * abs(setup.offset_m - true.offset_m) < 0.1
    how = rig.provenance["laser_plane"]
    assert (how.tool, how.data) == ("calibrate wrist laser-plane", ("boards",))
    assert {"rms_mm", "normal_sigma_deg", "offset_sigma_mm"} == how.residual.keys()
    assert rig.T_camera_palm == RIG.T_camera_palm
    assert "± " in output
    assert "wrote" in output
    numbers = json.loads((folder / "plane.json").read_text())
    assert np.array(numbers["covariance_normal_offset_m"]).shape == (4, 4)
    assert cv2.imread(str(folder / "plane.png")) is not None


def test_images_by_name_give_the_same_plane(
    tree: Path, boards: Path, measured: tuple[Path, str], tmp_path: Path
) -> None:
    rows = [line.split(",") for line in (boards / FRAMES).read_text().splitlines()[1:]]
    for k, (_, _, _, lit, file) in enumerate(rows):
        shutil.copy(boards / file, tmp_path / f"{k // 3:02d}_{lit}.png")
    numbers = tmp_path / "plane.json"
    run("laser-plane", tmp_path, *BOARD, "--rig", "wrist", "--calibration", tree, "--json", numbers)
    one, other = (json.loads(path.read_text()) for path in (measured[0] / "plane.json", numbers))
    assert one["normal"] == other["normal"]
    assert one["offset_mm"] == other["offset_mm"]


def test_intrinsics_of_the_wrist_camera_from_the_same_recording(
    tree: Path, boards: Path, tmp_path: Path
) -> None:
    output = run("intrinsics", boards, *BOARD, "--calibration", tree, "--out", tmp_path)
    lens = load(tmp_path / "cameras" / "wrist.json", CameraCalibration)
    assert lens.intrinsics is not None
    assert CAMERA.intrinsics is not None
    assert lens.intrinsics.fx_px == pytest.approx(CAMERA.intrinsics.fx_px, rel=0.01)
    assert lens.provenance["intrinsics"].residual["rms_px"] < 0.2
    assert "rms" in output
    # One frame of each triple, not all three: nothing with the laser's line across the corners.
    assert "wrist: 7 of 7 frames" in output


def test_the_flat_field_names_the_corner_that_was_not_shown(tree: Path, boards: Path) -> None:
    with pytest.raises(FitError, match=r"boards: no white squares at the .* of the image"):
        run("flat-field", boards, *BOARD, "--rig", "wrist", "--calibration", tree)


def test_the_flat_field_of_a_board_shown_everywhere(tree: Path, tmp_path: Path) -> None:
    scene = scene_of(31, 24, anywhere=True)
    record_wrist_board(tmp_path / "white", scene, illuminations=(Illumination.AMBIENT, Illumination.LED))
    output = run(
        "flat-field", tmp_path / "white", *BOARD, "--rig", "wrist", "--calibration", tree, "--out", tree,
        "--picture", tmp_path / "flat.png",
    )  # fmt: skip
    rig = rig_of(tree)
    assert rig.flat_field is not None
    assert rig.flat_field.coefficients[0] == 1.0
    assert rig.provenance["flat_field"].residual["cross_validated_rms_percent"] < 4.0
    assert "residual" in output
    assert cv2.imread(str(tmp_path / "flat.png")) is not None


def test_the_palm_from_a_board_that_lies_on_it(tree: Path, tmp_path: Path) -> None:
    board = Checkerboard(7, 4, 0.010)
    T = np.array(RIG.T_camera_palm) @ BoardOffset(0.085, 0.004, 0.022, 1.0).T_palm_board(board)
    scene = WristBoardScene(RIG, CAMERA, 7, 4, 0.010, np.stack([T, T]))
    record_wrist_board(tmp_path / "palm", scene, illuminations=(Illumination.AMBIENT, Illumination.LED))
    output = run(
        "palm", tmp_path / "palm", *PALM_BOARD, "--rig", "wrist", "--calibration", tree, "--out", tree
    )
    np.testing.assert_allclose(np.array(rig_of(tree).T_camera_palm), np.array(RIG.T_camera_palm), atol=2e-3)
    assert "mm above the wrist joint" in output
    assert rig_of(tree).provenance["T_camera_palm"].tool == "calibrate wrist palm"


@pytest.fixture(scope="module")
def curled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a curl by its manifest, and what a slave would have found in it."""
    folder = tmp_path_factory.mktemp("curl")
    RecordingWriter(folder, Manifest(version=1, kind="wrist", cameras={"wrist": CAMERA}, rig=RIG)).close()
    hand = load(ROOT / "calib_json/hands/default-right.json", HandProfile)
    scene = WristScene.by_name("curl@indoor", RIG, {"wrist": CAMERA}, hand, 4)
    truths = [scene.truth(t) for t in np.linspace(0.0, 0.5 * scene.period_s, 30)]
    uv = np.array([truth.laser_uv[1:6] for truth in truths])
    uv = np.concatenate([uv, uv[::-1]]) + np.random.default_rng(0).normal(0.0, 0.3, (60, 5, 2))
    uv[:, 4] = np.nan  # the little finger is out of the picture
    t_ns = (np.arange(60) * 33_333_333).astype(np.int64)
    write_npz(
        folder / "detections_wrist.npz", {"t_ns": t_ns, "laser_uv": uv, "tip_uv": np.full_like(uv, np.nan)}
    )
    return folder


def test_without_out_nothing_is_written(tree: Path, curled: Path) -> None:
    before = (tree / "rigs" / "wrist.json").read_bytes()
    assert "nothing written: give --out DIR" in run("curl", curled, "--detections", curled)
    assert (tree / "rigs" / "wrist.json").read_bytes() == before


def test_a_curl_gives_the_lines_of_the_fingers_that_moved(tree: Path, curled: Path, tmp_path: Path) -> None:
    output = run(
        "curl", curled, "--detections", curled, "--out", tmp_path, "--picture", tmp_path / "curl.png"
    )
    rig = rig_of(tmp_path)
    assert set(rig.finger_lines) == {"thumb", "index", "middle", "ring"}
    for line in rig.finger_lines.values():
        assert line.range_m[1] > 0.015
        assert line.residual_m < 1.5e-3
    assert "not measured: little" in rig.provenance["finger_lines"].note
    assert "little" in output
    assert "0 points, at least 20 are needed" in output
    assert cv2.imread(str(tmp_path / "curl.png")) is not None
    # The master takes the file as it is.
    model = HandModel.of(load(tree / "hands/default-right.json", HandProfile))
    assert set(WristSetup.of(rig, CAMERA, model).lines) == set(rig.finger_lines)


def broken(boards: Path, folder: Path, what: str) -> Path:
    """The recording with something wrong in it."""
    shutil.copytree(boards, folder)
    if what == "dark":
        for file in (folder / "wrist").iterdir():
            cv2.imwrite(str(file), np.full((400, 640), 2, np.uint8))
    elif what == "slipped":  # the labels are one frame off
        table = (folder / FRAMES).read_text()
        table = table.replace(",laser,", ",x,").replace(",ambient,", ",laser,").replace(",led,", ",ambient,")
        (folder / FRAMES).write_text(table.replace(",x,", ",led,"))
    elif what == "unlabelled":
        table = (folder / FRAMES).read_text()
        for lit in ("ambient", "laser", "led"):
            table = table.replace(f",{lit},", ",none,")
        (folder / FRAMES).write_text(table)
    elif what == "no image":
        (folder / "wrist" / "000004.png").write_bytes(b"not an image")
    return folder


@pytest.mark.parametrize(
    ("what", "error", "match"),
    [
        ("dark", FitError, "no board found in 7 views.*checkerboard of 9 x 6.*count the inner corners"),
        ("slipped", FitError, "in 0 views, at least 3 are needed.*\n.*view"),
        ("unlabelled", RecordingError, "frames.csv what lit"),
        ("no image", RecordingError, "000004.png: is no image"),
    ],
)
def test_broken_recordings_say_what_is_wrong(
    boards: Path, tree: Path, tmp_path: Path, what: str, error: type[PhalanxError], match: str
) -> None:
    folder = broken(boards, tmp_path / "broken", what)
    before = (tree / "rigs" / "wrist.json").read_bytes()
    with pytest.raises(error, match=f"(?s){match}"):
        run("laser-plane", folder, *BOARD, "--rig", "wrist", "--calibration", tree, "--out", tree)
    assert (tree / "rigs" / "wrist.json").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        (("laser-plane", "nowhere", *BOARD), CalibrationError, "give --rig NAME"),
        (("laser-plane", "nowhere", *BOARD, "--rig", "wrist"), RecordingError, "is not a folder"),
        (("laser-plane", "nowhere", *BOARD, "--rig", "none"), CalibrationError, "none.json: cannot read"),
        (
            ("laser-plane", "nowhere", *BOARD, "--rig", "desk"),
            CalibrationError,
            "expected a rig of kind 'wrist'",
        ),
        (
            ("subject", "nowhere", "--detections", "x", "--rig", "wrist"),
            RecordingError,
            "phalanx-slave run -o",
        ),
        (("curl", "nowhere", "--detections", "x", "--rig", "wrist"), RecordingError, "phalanx-slave run -o"),
    ],
)
def test_wrong_calls_name_file_key_and_remedy(
    arguments: tuple[str, ...], error: type[PhalanxError], match: str
) -> None:
    with pytest.raises(error, match=match):
        run(*arguments, "--calibration", ROOT / "calib_json")


def test_a_device_without_intrinsics_or_plane_says_what_measures_them(
    tree: Path, curled: Path, tmp_path: Path
) -> None:
    shutil.copytree(tree, tmp_path / "tree")
    save(tmp_path / "tree/rigs/wrist.json", replace(RIG, laser_plane=None))
    with pytest.raises(CalibrationError, match=r"laser_plane is missing.*calibrate wrist laser-plane"):
        run("curl", curled, "--detections", curled, "--rig", "wrist", "--calibration", tmp_path / "tree")
    save(tmp_path / "tree/cameras/wrist.json", replace(CAMERA, intrinsics=None))
    with pytest.raises(CalibrationError, match=r"intrinsics is missing.*calibrate cameras intrinsics"):
        run("curl", curled, "--detections", curled, "--rig", "wrist", "--calibration", tmp_path / "tree")
