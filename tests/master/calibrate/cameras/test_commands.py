"""The commands on real pictures: the numbers asked for, the files they write, and what they say to bad input."""

import json
import shutil
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from common.calibration import CameraCalibration, PowerLawCalibration, RigCalibration, load, save
from common.errors import CalibrationError, PhalanxError, RecordingError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert
from common.recording.frame_recording import FRAMES, MANIFEST
from master.calibrate.cameras.boards import Checkerboard, find_board, grid_edges
from master.calibrate.cameras.commands import without_wrong_law, write_files
from master.calibrate.cameras.views import image_sets
from tests.cli import calibrate
from tests.hand_helpers import camera_file, rig_file
from tests.master.calibrate.cameras.board_images import render
from tests.master.calibrate.cameras.board_scenes import scene

ROOT = Path(__file__).resolve().parents[4]
BOARD = ["--board", "9x6", "--square-mm", "25"]


def run(*arguments: object) -> str:
    """What a command says.

    Raises:
        PhalanxError: What it refuses.
    """
    name, *words = map(str, arguments)
    return calibrate(name, *words)


@pytest.fixture(scope="module")
def pictures(datasets: Path) -> Path:
    return datasets / "opencv_stereo"


@pytest.fixture(scope="module")
def written(pictures: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object], str]:
    """Tree, numbers and words of one stereo calibration of the real pictures."""
    out = tmp_path_factory.mktemp("stereo")
    output = run(
        "stereo", pictures, *BOARD, "--rig", "bench", "--calibration", out, "--out", out,
        "--json", out / "numbers.json", "--picture", out / "picture.png",
    )  # fmt: skip
    return out, json.loads((out / "numbers.json").read_text()), output


def test_real_pictures_give_the_published_lens_and_a_good_pair(
    pictures: Path, written: tuple[Path, dict[str, object], str]
) -> None:
    out, numbers, output = written
    published = cv2.FileStorage(str(pictures / "left_intrinsics.yml"), cv2.FILE_STORAGE_READ)
    focal = float(published.getNode("camera_matrix").mat()[0, 0])
    left = load(out / "cameras" / "left.json", CameraCalibration)
    assert left.intrinsics is not None
    assert abs(left.intrinsics.fx_px - focal) < 2.5
    assert isinstance(numbers["rms_px"], float)
    assert numbers["rms_px"] < 0.35
    assert "stereo rms" in output
    picture = cv2.imread(str(out / "picture.png"))
    assert picture is not None
    assert len(picture) > 500


def test_squares_triangulated_from_the_written_files_are_25_mm(
    pictures: Path, written: tuple[Path, dict[str, object], str]
) -> None:
    # By OpenCV alone: undistort, triangulate, measure; also with its own plain corners in the published size.
    out, numbers, _ = written
    rig = load(out / "rigs" / "bench.json", RigCalibration)
    models = {
        name: CameraModel.of(load(out / "cameras" / f"{name}.json", CameraCalibration), rig.camera_pose(name))
        for name in rig.cameras
    }
    board = Checkerboard(9, 6, 0.025)
    sides: list[float] = []
    for name, images in image_sets(pictures):
        seen = {camera: find_board(board, read()) for camera, read in images.items()}
        points = [
            cv2.undistortPoints(
                s.corners_px.reshape(-1, 1, 2), models[c].matrix, models[c].distortion
            ).reshape(-1, 2)
            for c, s in seen.items()
            if s is not None
        ]
        assert len(points) == 2, name
        T = invert(models["right"].T_rig_camera) @ models["left"].T_rig_camera
        homogeneous = cv2.triangulatePoints(np.eye(4)[:3], T[:3], points[0].T, points[1].T)
        corners = (homogeneous[:3] / homogeneous[3]).T
        edges = grid_edges(board)
        sides += [1e3 * float(np.linalg.norm(corners[a] - corners[b])) for a, b in edges]
    assert np.mean(sides) == pytest.approx(25.0, abs=0.3)
    assert np.std(sides) < 0.3
    pairs = numbers["pairs"]
    assert isinstance(pairs, list)
    assert pairs[0]["edge_mean_mm"] == pytest.approx(np.mean(sides), abs=0.05)


def test_files_carry_provenance_and_say_what_is_not_measured(
    written: tuple[Path, dict[str, object], str],
) -> None:
    out, _, output = written
    camera = load(out / "cameras" / "left.json", CameraCalibration)
    how = camera.provenance["intrinsics"]
    assert how.tool == "calibrate cameras stereo"
    assert how.data == ("opencv_stereo",)
    assert "neutral" in how.note
    assert "neutral" in output
    rig = load(out / "rigs" / "bench.json", RigCalibration)
    assert rig.cameras == ("left", "right")
    assert rig.provenance["T_rig_camera"].residual["rms_px"] < 0.35


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rendered pictures of two cameras, eight of each."""
    folder, truth = tmp_path_factory.mktemp("views"), scene(31, 2, 8)
    for camera in truth.lenses:
        (folder / camera).mkdir()
        for view in range(8):
            cv2.imwrite(str(folder / camera / f"{view:02d}.png"), render(truth, view, camera, seed=31))
    return folder


def test_a_recording_of_cameras_that_are_not_synchronised_is_calibrated(
    views: Path, tmp_path: Path, datasets: Path
) -> None:
    manifest = sorted((datasets / "stereo").glob(f"*/{MANIFEST}"))[0]
    (tmp_path / MANIFEST).write_bytes(manifest.read_bytes())
    rows, held, step_ns = ["camera,seq,t_ns,illumination,file"], 12, 33_333_333
    for camera, late_ns in (("left", 0), ("right", 13_000_000)):
        for view in range(8):
            shutil.copy(views / camera / f"{view:02d}.png", tmp_path / f"{camera}{view}.png")
            for k in range(held * view, held * (view + 1)):
                t_ns = k * step_ns + view * 500_000_000 + late_ns
                rows.append(f"{camera},{k},{t_ns},none,{camera}{view}.png")
    (tmp_path / FRAMES).write_text("\n".join(rows) + "\n")
    words = ("stereo", tmp_path, *BOARD, "--json", tmp_path / "result.json")
    assert "left: 48 of 48 frames, the board in 48" in run(*words, "--calibration", tmp_path / "none")
    pair = json.loads((tmp_path / "result.json").read_text())["pairs"][0]
    assert pair["views"] == 8
    assert pair["edge_mean_mm"] == pytest.approx(25.0, abs=0.05)


def test_a_rig_that_is_there_keeps_everything_but_the_places_and_a_law_that_they_contradict(
    views: Path, tmp_path: Path
) -> None:
    out = tmp_path / "calib"
    run("intrinsics", views, *BOARD, "--calibration", out, "--out", out)
    before = load(out / "cameras" / "right.json", CameraCalibration)
    (out / "rigs").mkdir()
    law = PowerLawCalibration(k_m=45.4, z=-1.03)
    T_rig_right = ((1.0, 0.0, 0.0, 0.5), (0.0, 0.0, -1.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    T_rig_left = ((1.0, 0.0, 0.0, 0.6), *T_rig_right[1:])
    kept = RigCalibration(
        version=1, name="pair", kind="markers", cameras=("right", "left"), hand="mine",
        T_rig_camera={"right": T_rig_right, "left": T_rig_left}, power_law=law, depth_model="power_law",
    )  # fmt: skip
    save(out / "rigs" / "pair.json", kept)
    words = ("stereo", views, *BOARD, "--rig", "pair", "--keep-intrinsics", "--calibration", out)
    assert "depth_model" not in run(*words)  # nothing is written
    output = run(*words, "--out", out)
    assert "(held)" in output
    rig = load(out / "rigs" / "pair.json", RigCalibration)
    assert (rig.power_law, rig.hand, rig.cameras) == (law, "mine", ("right", "left"))
    # The law was that of other cameras.
    assert rig.depth_model == "stereo"
    assert "turn them, or use 'stereo': depth_model is 'stereo' now\n" in output
    assert rig.T_rig_camera["right"] == T_rig_right  # the rig's frame stays where it was
    truth = scene(31, 2, 8).T_camera_rig
    found = invert(rig.camera_pose("right")) @ rig.camera_pose("left")
    assert 1e3 * np.linalg.norm((found - truth["right"] @ invert(truth["left"]))[:3, 3]) < 1.0
    assert load(out / "cameras" / "right.json", CameraCalibration) == before


@pytest.mark.parametrize(("k_m", "kept"), [(37.5, True), (38.2, True), (38.5, False)])
def test_a_law_that_new_places_contradict_is_to_be_fitted_anew(k_m: float, kept: bool) -> None:
    """Cameras of 500 px focal length, 75 mm apart: k is 37.5 m px, and 2 % are allowed."""
    rig = rig_file(depth_model="power_law", power_law=PowerLawCalibration(k_m=k_m, z=-1.0))
    cameras = {name: camera_file(name) for name in rig.cameras}
    new, output = without_wrong_law(rig, cameras)
    assert new.depth_model == ("power_law" if kept else "stereo")
    assert new.power_law == rig.power_law
    again = "depth_model is 'stereo' now; `phalanx calibrate depth --use power_law` fits it anew"
    assert output == "" if kept else again in output
    assert without_wrong_law(rig, {**cameras, "left": None}) == (rig, "")


def test_images_of_another_mode_than_the_file_are_refused(views: Path, tmp_path: Path) -> None:
    small, out = tmp_path / "views" / "left", tmp_path / "calib"
    for folder in (small, out / "cameras"):
        folder.mkdir(parents=True)
    save(out / "cameras" / "left.json", camera_file("left"))
    for file in (views / "left").iterdir():
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(small / file.name), cv2.resize(image, (320, 240)))
    with pytest.raises(CalibrationError, match=r"320 x 240 px, its file says 640 x 480"):
        run("intrinsics", small.parent, *BOARD, "--calibration", out)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is not a folder"):
        run("intrinsics", tmp_path / "no", *BOARD)
    with pytest.raises(RecordingError, match="no images here"):
        run("intrinsics", tmp_path, *BOARD)
    (tmp_path / "left01.png").write_bytes(b"not a picture")
    with pytest.raises(RecordingError, match=r"left01\.png: is no image"):
        run("intrinsics", tmp_path, *BOARD)
    with pytest.raises(RecordingError, match=r"no image is named right\*; the names begin with left"):
        run("intrinsics", tmp_path, *BOARD, "--camera", "right", "--camera", "left")
    cv2.imwrite(str(tmp_path / "left01.png"), np.zeros((64, 64), np.uint8))
    with pytest.raises(PhalanxError, match="no checkerboard of 9 x 6 inner corners"):
        run("intrinsics", tmp_path, *BOARD)


def test_views_are_matched_by_the_rest_of_the_name(tmp_path: Path) -> None:
    names = [
        "left1.png",
        "right1.png",
        "left2.png",
        "left10.png",
        "right10.png",
        "left_top1.png",
        "notes.txt",
    ]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    sets = image_sets(tmp_path, ["left", "right", "left_top"])
    assert [(name, set(images)) for name, images in sets] == [
        ("1", {"left", "right", "left_top"}),
        ("2", {"left"}),
        ("10", {"left", "right"}),
    ]
    assert {camera for _, images in image_sets(tmp_path) for camera in images} == {
        "left",
        "right",
        "left_top",
    }


def test_nothing_is_written_where_one_file_would_be_impossible(tmp_path: Path) -> None:
    file = load(ROOT / "calib_json/cameras/left.json", CameraCalibration)
    rig = load(ROOT / "calib_json/rigs/desk.json", RigCalibration)
    one_place = msgspec.structs.replace(
        rig, T_rig_camera=dict.fromkeys(rig.cameras, rig.T_rig_camera["left"])
    )
    with pytest.raises(CalibrationError, match=r"desk\.json: T_rig_camera\.right: 0 mm from camera 'left'"):
        write_files(tmp_path, {"left": file}, {"desk": one_place})
    assert not list(tmp_path.iterdir())
