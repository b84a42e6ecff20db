"""Videos of cameras that run at their own times and see a moving board: against truth, and refused with the cause."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.arrays import Float, Image
from common.errors import FitError, PhalanxError, RecordingError
from common.geometry.transforms import invert, rigid, rotation_vector_to_matrix
from master.calibrate.cameras.boards import Charuco, ImageObservation, board_corners
from master.calibrate.cameras.coverage import LiveViews
from master.calibrate.cameras.fit import fit_tracks
from master.calibrate.cameras.tracks import Stream, Track, Tracks, track
from tests.cli import calibrate
from tests.master.calibrate.cameras.board_images import render
from tests.master.calibrate.cameras.board_scenes import SIZE, Scene, scene

BOARD = Charuco(5, 4, 0.05, 0.0375)
OPTIONS = ("--board", "5x4", "--square-mm", "50", "--marker-mm", "37.5", "--flat-board")
RATE_HZ, LAG_S = 10.0, 0.07
STARTS = {"left": 100.0, "right": 100.023}  # of the first exposures [s]


def pose(t_s: float) -> Float:
    """Where the board is: waved, turned and tilted by a hand, all over the images."""
    t = t_s - 100.0
    tilt = 0.55 * np.array([np.sin(1.1 * t), np.sin(1.5 * t + 1.0), 0.3 * np.sin(0.7 * t)])
    place = [0.04 + 0.13 * np.sin(0.9 * t), 0.09 * np.sin(1.3 * t + 0.5), 0.52 + 0.12 * np.sin(0.6 * t)]
    rotation = rotation_vector_to_matrix(tilt)
    return rigid(rotation, np.array(place) - rotation @ board_corners(BOARD).mean(axis=0))


def waved(seed: int, frames: int) -> Scene:
    """Two cameras, and the board at each frame of each."""
    truth = scene(seed, 2, 1, BOARD, baseline_m=0.25)
    moved = {(k, c): pose(STARTS[c] + k / RATE_HZ) for c in STARTS for k in range(frames)}
    lenses = {c: lens * np.r_[np.ones(4), 0.3 * np.ones(5)] for c, lens in truth.lenses.items()}
    return replace(truth, lenses=lenses, T_rig_board=np.stack([pose(100.0)] * frames), moved=moved)


def stamps(camera: str, frames: int) -> Float:
    """The times of a camera's frames; those of the right one lag."""
    return STARTS[camera] + np.arange(frames) / RATE_HZ + (LAG_S if camera == "right" else 0.0)


def off_mm(found: Float, truth: Scene) -> float:
    """How far the right camera's centre [mm] is from the true one."""
    true = truth.T_camera_rig["right"]
    return 1e3 * float(np.linalg.norm(invert(found)[:3, 3] - invert(true)[:3, 3]))


def test_the_lag_of_a_cameras_times_and_its_place_are_found_from_a_waved_board() -> None:
    truth, frames, rng = waved(3, 120), 120, np.random.default_rng(3)
    tracks: dict[str, Track] = {}
    for camera in truth.lenses:
        corners = [truth.corners(k, camera) + rng.normal(0.0, 0.1, (12, 2)) for k in range(frames)]
        inside = [bool(((uv > 4) & (uv < np.array(SIZE) - 5)).all()) for uv in corners]
        found = tuple(
            ImageObservation(uv, 0.9) if good else None for uv, good in zip(corners, inside, strict=True)
        )
        tracks[camera] = Track(tuple(range(frames)), stamps(camera, frames), found)
    fit = fit_tracks(Tracks(BOARD, dict.fromkeys(tracks, SIZE), tracks), bent=False)
    assert fit.delay_s["right"] == pytest.approx(LAG_S, abs=0.004)
    assert fit.delay_s["left"] == 0.0
    assert off_mm(fit.solution.bundle.T_camera_rig[1], truth) < 1.5
    assert len({shot.view for shot in fit.shots}) <= 60


def write_videos(folder: Path, change: Callable[[np.ndarray], np.ndarray] = lambda image: image) -> Scene:
    """Two videos and a table of times, 40 frames of each."""
    truth = waved(5, 40)
    for camera in truth.lenses:
        video = cv2.VideoWriter(
            str(folder / f"{camera}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), RATE_HZ, SIZE, isColor=False
        )
        assert video.isOpened()
        for k in range(40):
            video.write(change(render(truth, k, camera, seed=5)))
        video.release()
    write_table(folder)
    return truth


def write_table(folder: Path, header: str = "sync_index,cam_id,frame_time", scale: float = 1.0) -> None:
    rows = [(t, c) for c in STARTS for t in stamps(c, 40)]
    lines = [header, *(f"{k},{c},{t * scale:.7f}" for k, (t, c) in enumerate(sorted(rows)))]
    (folder / "timestamps.csv").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """White on black, which nobody says."""
    folder = tmp_path_factory.mktemp("videos")
    write_videos(folder, lambda image: 255 - image)
    return folder


def stereo(folder: Path, *options: object) -> str:
    return calibrate("stereo", folder, *(options or OPTIONS))


def test_videos_of_a_white_on_black_board_moved_by_hand_are_calibrated(videos: Path) -> None:
    output = stereo(videos)
    assert "white on black" in output
    assert "40 of 40 frames" in output
    (line,) = [line for line in output.splitlines() if line.startswith("right: its times are")]
    assert float(line.split()[4]) == pytest.approx(1e3 * LAG_S, abs=6.0)
    assert "after its exposures" in line
    (line,) = [line for line in output.splitlines() if "squares triangulated" in line]
    mean, _, sd = line.split(": ")[1].split()[:3]
    assert float(mean) == pytest.approx(50.0, abs=0.1)
    assert float(sd) < 0.5


def linked(videos: Path, folder: Path, nested: bool = False) -> Path:
    for camera in STARTS:
        place = folder / "camera" / camera if nested else folder
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{camera}.avi").write_bytes((videos / f"{camera}.avi").read_bytes())
    return folder


def test_a_table_that_does_not_fit_the_videos_is_refused_with_the_cause(videos: Path, tmp_path: Path) -> None:
    folder = linked(videos, tmp_path)
    table = folder / "timestamps.csv"

    def refused(text: str) -> None:
        with pytest.raises(RecordingError, match=text):
            stereo(folder)

    write_table(folder, "a,b,c")
    refused("needs the columns cam_id or camera; frame_time .* it has a, b, c")
    write_table(folder, scale=1e9)
    refused("frames of camera 'left' are 1e.08 s apart: frame_time is in another unit.*nanoseconds t_ns")
    write_table(folder)
    good = table.read_text().splitlines()
    table.write_text("\n".join(line for line in good if "right" not in line))
    refused("has no row of camera 'right'; it has left")
    table.write_text("\n".join(good[:-4]))
    refused(r"rows of camera 'left', which has 40 frames|rows of camera 'right', which has 40 frames")
    table.write_text("\n".join([good[0], *reversed(good[1:])]))
    refused("row 2 .*is not later than the one before")
    table.write_text("\n".join([*good[:-1], good[-1].rsplit(",", 1)[0] + ",nan"]))
    refused(f"line {len(good)}: frame_time or cam_id is no number")
    other = [
        f"{line.rsplit(',', 1)[0]},{float(line.rsplit(',', 1)[1]) + 1e4}" if "right" in line else line
        for line in good
    ]
    table.write_text("\n".join(other))
    refused("times do not overlap")


def test_videos_in_folders_and_those_that_cannot_be_decoded(videos: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="nothing of camera 'top'; there are left, right"):
        stereo(videos, *OPTIONS, "--camera", "top")
    folder = linked(videos, tmp_path, nested=True) / "camera"
    (folder / "right" / "right.avi").write_bytes((videos / "right.avi").read_bytes()[:300])
    with pytest.raises(PhalanxError, match=r"right\.avi: .*cannot be decoded"):
        stereo(folder)
    (folder / "right" / "right.avi").write_bytes(b"no video at all, not at all")
    with pytest.raises(RecordingError, match=r"right\.avi: is no video"):
        stereo(folder)


def test_another_board_is_named(videos: Path) -> None:
    with pytest.raises(
        FitError, match=r"in any of 80 frames: they show a ChArUco board of 5 x 4 .* white on black"
    ):
        stereo(videos, "--board", "4x5", *OPTIONS[2:])


def test_a_white_on_black_board_is_recognised_live(videos: Path) -> None:
    truth, live = waved(5, 1), LiveViews(BOARD, ("left",))
    image = 255 - render(truth, 0, "left", seed=5)
    live.push({"left": image})
    assert live.push({"left": image}).kept
    assert live.board == replace(BOARD, inverted=True)


def test_real_webcams_find_the_squares(datasets: Path) -> None:
    folder = datasets / "charuco_webcams"
    if not folder.is_dir():
        pytest.skip("no charuco_webcams in the folder of data sets: two webcams, a board moved by hand")
    output = stereo(
        folder, "--board", "4x5", "--square-mm", "54", "--marker-mm", "40.5", "--dictionary", "4X4_1000"
    )
    (line,) = [line for line in output.splitlines() if "squares triangulated" in line]
    mean, _, sd = line.split(": ")[1].split()[:3]
    assert float(mean) == pytest.approx(54.0, abs=0.3)
    assert float(sd) < 0.5


def test_of_ten_minutes_a_few_hundred_frames_are_looked_at_the_same_moments_of_all_cameras() -> None:
    read: dict[str, list[int]] = {"left": [], "right": []}
    empty = np.full((60, 80), 128, np.uint8)

    def stream(camera: str, rate_hz: float, start_s: float) -> Stream:
        def reader(number: int) -> Image:
            read[camera].append(number)
            return empty

        t_s = start_s + np.arange(int(600 * rate_hz)) / rate_hz
        return Stream(tuple(range(len(t_s))), t_s, reader, camera)

    streams = {"left": stream("left", 30.0, 0.0), "right": stream("right", 24.0, 3.0)}
    with pytest.raises(FitError, match=r"in any of \d+ frames"):
        track(BOARD, streams, lambda _: None)
    looked = {name: streams[name].t_s[numbers] for name, numbers in read.items()}
    for name, t_s in looked.items():
        assert 400 < len(t_s) <= 640, name
        assert (np.diff(t_s) > 0.0).all(), "files are read from front to back"
    nearest_s = np.abs(looked["left"][:, None] - looked["right"]).min(axis=1)
    assert float(np.quantile(nearest_s, 0.99)) < 0.1
    assert looked["left"][-1] - looked["left"][0] > 500.0
