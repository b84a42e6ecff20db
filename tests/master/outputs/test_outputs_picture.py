import errno
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from msgspec.structs import replace

from common.calibration import Volume
from common.errors import RecordingError
from common.geometry.transforms import rigid
from common.hand.model import TIPS, WRIST, HandModel
from common.hand.profiles import generated_profile
from common.messages import HandPose, Source
from master.outputs import picture
from master.outputs.drawing import SOURCE_RGB, View, render_hand
from master.outputs.picture import best_row, draw_summary, fit_view
from master.outputs.poses import Poses, PosesTruth
from tests.hand_helpers import rig_file
from tests.results import pose_of

MODEL = HandModel.of(generated_profile("test-hand", "right"))
RIG = rig_file(name="desk", hand="test-hand")
# Palm frame in the rig frame: fingers (+z) up the image (-y), back of the hand (+y) to the camera (-z).
UPRIGHT = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
PNG = b"\x89PNG\r\n\x1a\n"


def pose(index: int = 0, flexion: float = 0.0) -> HandPose:
    angles = np.tile([0.0, flexion, flexion, flexion * 0.6], (5, 1))
    joints = MODEL.forward(rigid(UPRIGHT, np.array([0.04, 0.09, 0.42])), angles)
    source = np.full(26, Source.SOLVED, np.uint8)
    source[TIPS] = Source.MEASURED
    markers = MODEL.marker_points(joints, RIG.markers)
    return pose_of(
        MODEL,
        joints,
        t_ns=10**15 + index * 16_666_667,
        tracked=source == Source.MEASURED,
        cov_m2=np.full((26, 3, 3), np.nan),
        source=source,
        angles_rad=angles,
        markers_m=markers,
        markers_raw_m=markers + 0.001,
        latency_ns=8_000_000 + index * 1000,
    )


def draw(
    path: Path, poses: Poses, truth: PosesTruth | None = None, **summary: float
) -> npt.NDArray[np.uint8]:
    draw_summary(path, poses, RIG, MODEL, summary, truth)
    return read(path)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The picture of one pose, without figures: a picture takes over a second, so what only compares shares this."""
    path = tmp_path_factory.mktemp("plain") / "hand.png"
    draw(path, Poses.of([pose()]))
    return path


def read(path: Path) -> npt.NDArray[np.uint8]:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image, np.uint8)


def near(image: npt.NDArray[np.uint8], rgb: tuple[int, int, int]) -> int:
    """Number of pixels of about that colour."""
    return int((np.abs(image.astype(int) - np.array(rgb[::-1])).max(axis=-1) <= 12).sum())


def test_the_picture_shows_a_hand_its_sources_and_its_figures(tmp_path: Path, plain: Path) -> None:
    poses = Poses.of([pose(i, 0.05 * i) for i in range(8)])
    image = draw(tmp_path / "hand.png", poses, poses_per_s=60.0, latency_p50_ms=8.0)
    assert image.shape == (900, 1600, 3)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 2000  # shading, not a flat shape
    left = image[130:880, 300:990].astype(int)
    skin = (left[..., 2] > left[..., 1] + 15) & (left[..., 1] > left[..., 0] + 8) & (left[..., 2] > 110)
    assert 0.08 < skin.mean() < 0.7
    assert near(image, SOURCE_RGB[Source.SOLVED]) > 2000  # bones
    assert near(image, SOURCE_RGB[Source.MEASURED]) > 300  # tips
    head = slice(0, 110), slice(480, 1600)
    assert (image[head] > 180).sum() > 500
    assert (read(plain)[head] > 180).sum() == 0


def test_held_joints_and_the_truth_can_be_seen(tmp_path: Path, plain: Path) -> None:
    whole = pose()
    source = whole.source.copy()
    source[11:16] = Source.HELD
    held = draw(tmp_path / "held.png", Poses.of([replace(whole, source=source)]))[130:880, 380:990]
    free = read(plain)[130:880, 380:990]
    # The orange ring of the thumb's marker is in both; the held finger's bones only in one.
    assert near(held, SOURCE_RGB[Source.HELD]) > near(free, SOURCE_RGB[Source.HELD]) + 400
    poses = Poses.of([whole])
    shifted = PosesTruth(poses.position_m + np.array([0.0, -0.015, 0.0]), poses.markers_m)
    ghost = draw(tmp_path / "ghost.png", poses, shifted)[130:880, 380:990]
    assert (ghost != free).any(axis=-1).sum() > 500


def test_the_same_run_gives_the_same_picture(tmp_path: Path, plain: Path) -> None:
    draw(tmp_path / "again.png", Poses.of([pose()]))
    assert (tmp_path / "again.png").read_bytes() == plain.read_bytes()
    assert plain.read_bytes().startswith(PNG)


def test_a_run_without_a_valid_pose_says_so_and_invalid_fingers_are_left_out(tmp_path: Path) -> None:
    lost = replace(pose(), valid=np.zeros(26, np.bool_), tracked=np.zeros(26, np.bool_))
    assert best_row(Poses.of([lost])) is None
    assert best_row(Poses.of([lost, pose(1)])) == 1
    blank = draw(tmp_path / "blank.png", Poses.of([lost]))
    assert near(blank, SOURCE_RGB[Source.SOLVED]) == 0
    assert (blank > 180).sum() > 500  # the sentence
    part = pose().valid.copy()
    part[21:26] = False
    unseen = np.full((6, 3), np.nan)
    image = draw(
        tmp_path / "part.png",
        Poses.of([
            replace(pose(), valid=part, tracked=pose().tracked & part, markers_m=unseen, markers_raw_m=unseen,
                    latency_ns=0)
        ]),
    )  # fmt: skip
    assert near(image, SOURCE_RGB[Source.SOLVED]) > 1000


def test_an_empty_run_is_drawn(tmp_path: Path) -> None:
    empty = Poses.of([pose()]).rows(0, 0)
    assert draw(tmp_path / "empty.png", empty).shape == (900, 1600, 3)


def test_the_row_that_is_shown_is_an_open_hand() -> None:
    assert best_row(Poses.of([pose(0, 1.2), pose(1, 0.0), pose(2, 0.9)])) == 1


def test_the_hand_stands_upright_and_fills_its_box() -> None:
    at = pose().position_m
    view = fit_view(at, np.eye(3))
    pixels = view.project(at)
    assert (pixels[TIPS[1:], 1] < pixels[WRIST, 1] - 300).all()  # fingers up, in pixels that count down
    # A right hand seen from its back: the thumb is on the left.
    assert pixels[TIPS[0], 0] < pixels[TIPS[4], 0]
    assert (pixels[:, :2] >= 0).all()
    assert (pixels[:, :2] <= [view.width_px, view.height_px]).all()
    # One scale for all axes: distances in pixels are distances in metres.
    length = np.linalg.norm(np.diff(pixels, axis=0), axis=-1) / view.scale_px_m
    np.testing.assert_allclose(length, np.linalg.norm(np.diff(at, axis=0), axis=-1), rtol=1e-9)


def test_rendering_covers_every_joint_and_leaves_the_far_corner_free() -> None:
    at = pose().position_m
    view = fit_view(at, np.eye(3))
    brightness, covered = render_hand(view, at, MODEL.radius_m)
    u, v = np.rint(view.project(at)[:, :2]).astype(int).T
    assert covered[v, u].all()
    assert covered[0, 0] == 0.0
    assert brightness.max() <= 1.0
    assert (brightness[covered > 0] > 0.1).all()


def test_a_nearer_sphere_hides_a_farther_one_and_nan_joints_leave_no_trace() -> None:
    at = np.full((26, 3), np.nan)
    view = View(np.eye(3), np.array([0.0, 0.0, 0.4]), 2000.0, 200, 200)
    assert render_hand(view, at, np.full(26, 0.01))[1].sum() == 0
    at[[2, 3]] = [0.0, 0.0, 0.4]  # one bone as a sphere of 20 px
    brightness, covered = render_hand(view, at, np.full(26, 0.01))
    np.testing.assert_allclose(covered.sum(), np.pi * 20.0**2, rtol=0.03)
    assert brightness[90, 90] > brightness[110, 110]  # lit from the upper left
    at[[6, 7]] = [0.0, 0.0, 0.3]  # a smaller sphere before it
    radius = np.full(26, 0.01)
    radius[[6, 7]] = 0.005
    both, _ = render_hand(view, at, radius)
    assert both[92, 92] != brightness[92, 92]
    at[[6, 7]] = [0.0, 0.0, 0.5]  # behind it
    np.testing.assert_array_equal(render_hand(view, at, radius)[0], brightness)


def test_a_full_disk_is_a_clear_error_and_the_older_picture_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "hand.png"
    path.write_bytes(b"older")

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", full)
    with pytest.raises(RecordingError, match=r"hand\.png: cannot write: No space left"):
        draw_summary(path, Poses.of([pose()]), RIG, MODEL, {})
    assert path.read_bytes() == b"older"
    assert [p.name for p in tmp_path.iterdir()] == ["hand.png"]


def test_the_small_view_holds_every_camera_of_a_large_rig_and_its_volume(tmp_path: Path, plain: Path) -> None:
    aside = ((0.0, 0.0, -1.0, 0.55), (1.0, 0.0, 0.0, 0.0), (0.0, -1.0, 0.0, 0.42), (0.0, 0.0, 0.0, 1.0))
    volume = Volume(low_m=(-0.2, -0.2, 0.4), high_m=(0.2, 0.2, 0.8))
    four = replace(
        RIG, cameras=(*RIG.cameras, "aside"), T_rig_camera=RIG.T_rig_camera | {"aside": aside}, volume=volume
    )
    images: list[npt.NDArray[np.uint8]] = []
    for name, rig in (("four", four), ("open", replace(four, volume=None))):
        draw_summary(tmp_path / f"{name}.png", Poses.of([pose()]), rig, MODEL, {})
        images.append(read(tmp_path / f"{name}.png"))
    images.append(read(plain))
    with_box, without_box, pair = (image[575:890, 10:370] for image in images)
    assert np.abs(with_box.astype(int) - without_box).max() > 20
    assert np.abs(without_box.astype(int) - pair).max() > 100
    np.testing.assert_array_equal(images[0][:570], images[1][:570])  # nothing of it beyond its panel


@pytest.mark.parametrize("count", [8, 9, 14])
def test_no_word_of_the_head_stands_on_another(count: int) -> None:
    keys = [key for key, _, _ in picture._FIGURES]
    assert len(keys) >= count
    figure = Figure(figsize=(16, 9), dpi=100)
    canvas = FigureCanvasAgg(figure)
    picture._header(figure, RIG, None, MODEL, dict.fromkeys(keys[:count], 147.8))
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in figure.texts]
    assert len(boxes) == 2 + 2 * min(count, 10)
    assert not [
        (figure.texts[a].get_text(), figure.texts[b].get_text())
        for a, b in combinations(range(len(boxes)), 2)
        if boxes[a].overlaps(boxes[b])
    ]
