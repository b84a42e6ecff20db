"""What sessions of cameras are refused for: each with the camera and the cause, from pictures and from videos."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from common.arrays import Image
from common.errors import FitError, PhalanxError
from master.calibrate.cameras.boards import ImageObservation
from master.calibrate.cameras.fit import fit_tracks
from master.calibrate.cameras.tracks import Track, Tracks
from tests.cli import calibrate
from tests.master.calibrate.cameras.board_images import render
from tests.master.calibrate.cameras.board_scenes import SIZE
from tests.master.calibrate.cameras.test_videos import BOARD, OPTIONS, STARTS, stamps, waved

FRAMES = 8
Change = Callable[[str, int, Image], Image]


def as_it_is(camera: str, frame: int, image: Image) -> Image:
    return image


def mirrored(camera: str, frame: int, image: Image) -> Image:
    return np.ascontiguousarray(image[:, ::-1])


def of_two_sizes(camera: str, frame: int, image: Image) -> Image:
    return np.asarray(cv2.resize(image, (320, 240)), np.uint8) if frame > 3 else image


def without_board(camera: str, frame: int, image: Image) -> Image:
    return np.full_like(image, 90) if camera == "right" else image


@pytest.fixture(scope="module")
def images() -> dict[tuple[str, int], Image]:
    """Frames of a board that is waved."""
    truth = waved(5, FRAMES)
    return {(camera, k): render(truth, k, camera, seed=5) for camera in STARTS for k in range(FRAMES)}


def session(folder: Path, images: dict[tuple[str, int], Image], kind: str, change: Change) -> Path:
    """A session: pictures taken together, pictures with times, or videos."""
    for camera in STARTS:
        own = [change(camera, k, images[camera, k]) for k in range(FRAMES)]
        if kind == "videos":
            video = cv2.VideoWriter(
                str(folder / f"{camera}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, SIZE, isColor=False
            )
            for image in own:
                video.write(image)
            video.release()
            continue
        (folder / camera).mkdir()
        for k, image in enumerate(own):
            assert cv2.imwrite(str(folder / camera / f"{k:02d}.png"), image)
    if kind != "pictures":
        rows = [f"{camera},{t:.6f}" for camera in STARTS for t in stamps(camera, FRAMES)]
        (folder / "times.csv").write_text("\n".join(["camera,t_s", *rows]))
    return folder


@pytest.mark.parametrize("kind", ["pictures", "pictures with times", "videos"])
@pytest.mark.parametrize(
    ("board", "change", "cause"),
    [
        (("--board", "4x5", *OPTIONS[2:]), as_it_is, "they show a ChArUco board of 5 x 4"),
        (("--board", "6x4", *OPTIONS[2:]), as_it_is, "they show a ChArUco board of 5 x 4"),
        ((*OPTIONS, "--dictionary", "5X5_50"), as_it_is, "they show a ChArUco board of 5 x 4 .* 4X4"),
        (OPTIONS, mirrored, "the pictures are mirrored"),
        (OPTIONS, without_board, "'right': the board is seen in 0 images, at least 4"),
    ],
    ids=["sides swapped", "one more", "dictionary", "mirrored", "one camera does not see it"],
)
def test_a_wrong_session_is_refused_with_its_cause(
    kind: str,
    board: tuple[str, ...],
    change: Change,
    cause: str,
    images: dict[tuple[str, int], Image],
    tmp_path: Path,
) -> None:
    folder = session(tmp_path, images, kind, change)
    with pytest.raises(PhalanxError, match=cause):
        calibrate("stereo", folder, *board)


@pytest.mark.parametrize("kind", ["pictures", "pictures with times"])
def test_pictures_of_two_sizes_are_refused(
    kind: str, images: dict[tuple[str, int], Image], tmp_path: Path
) -> None:
    with pytest.raises(FitError, match=r"view 0?4 is 320 x 240 px, the views before it 640 x 480"):
        calibrate("stereo", session(tmp_path, images, kind, of_two_sizes), *OPTIONS)


@pytest.mark.parametrize("moves", [False, True])
def test_a_camera_that_moves_while_the_board_is_waved_is_refused(moves: bool) -> None:
    truth, frames, rng = waved(3, 120), 120, np.random.default_rng(3)
    tracks: dict[str, Track] = {}
    for camera in truth.lenses:
        found: list[ImageObservation | None] = []
        for k in range(frames):
            uv = truth.corners(k, camera) + rng.normal(0.0, 0.1, (12, 2))
            inside = bool(((uv > 4) & (uv < np.array(SIZE) - 5)).all())
            found.append(ImageObservation(uv, 0.9) if inside else None)
            if moves and inside and camera == "right" and k >= 70:
                found[-1] = ImageObservation(uv + np.array([6.0, 3.0]), 0.9)
        tracks[camera] = Track(tuple(range(frames)), stamps(camera, frames), tuple(found))
    both = Tracks(BOARD, dict.fromkeys(tracks, SIZE), tracks)
    if not moves:
        assert fit_tracks(both, bent=False).rms_px < 0.25
        return
    with pytest.raises(FitError, match="camera 'left' or 'right' moved between the views"):
        fit_tracks(both, bent=False)
