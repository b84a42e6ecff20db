"""Tags found in pictures with exact corners: place, honesty, identity; and nothing where there is none."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.objects.tags import Look, tag_picture
from common.arrays import Image
from common.calibration import CameraCalibration, load
from common.calibration.object_profile import ObjectProfile, Tag, TagFamily, Tags
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from slave.tags.finder import HOLD_NS, TagFinder

ROOT = Path(__file__).resolve().parents[3]
FILE = load(ROOT / "calib_json/cameras/left.json", CameraCalibration)
CAMERA = CameraModel.of(FILE, np.eye(4))
FRAME_NS = 16_666_667
HERE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def box(family: TagFamily = "aruco_5x5_100", numbers: range = range(8), name: str = "box") -> ObjectProfile:
    tags = tuple(Tag(id=number, edge_m=0.032, T_object_tag=HERE) for number in numbers)
    return ObjectProfile(version=1, name=name, tags=Tags(family, tags))


def clutter(rng: np.random.Generator) -> Image:
    """A desk full of dark and bright four-sided things, most with a border as of tags about random cells, and noise."""
    shape = (640, 480)
    coarse = rng.integers(40, 220, (12, 16, 3), np.uint8)
    image = np.asarray(cv2.resize(coarse, shape, interpolation=cv2.INTER_CUBIC), np.uint8)
    for _ in range(40):
        side, cells = rng.uniform(16, 90), int(rng.integers(3, 9))
        patch = np.pad(rng.integers(0, 2, (cells, cells), np.uint8), int(rng.random() < 0.7))
        patch = np.pad(patch, 1, constant_values=1)
        angle, at = rng.uniform(0.0, np.pi), rng.uniform([0, 0], shape)
        rotation = (
            np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * side / len(patch)
        )
        warp = np.column_stack([rotation, at])
        over = cv2.warpAffine(255 * patch, warp, shape, flags=cv2.INTER_NEAREST)
        mask = cv2.warpAffine(np.ones_like(patch), warp, shape, flags=cv2.INTER_NEAREST)
        image[mask > 0] = np.asarray(over)[mask > 0][:, None]
    noisy = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.6)) + rng.normal(0.0, 3.0, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("look", "within_px"),
    [
        (Look(0.5), 0.05),
        (Look(0.35, tilt_rad=0.8), 0.04),
        (Look(0.45, blur_px=1.0), 0.10),
        (Look(0.45, motion_px=3.0), 0.15),
        (Look(0.45, light=0.1, noise=3.0), 0.06),
    ],
)
def test_corners_are_where_they_are_and_as_sure_as_stated(look: Look, within_px: float) -> None:
    base, missed, miss, sigmas = TagFinder(FILE, [box()]), 0, [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        number = int(rng.integers(8))
        image, corners = tag_picture(rng, CAMERA, "aruco_5x5_100", number, 0.032, look)
        found = base.fresh().push(image, 0)
        assert set(found.ids.tolist()) <= {number}
        if not len(found.ids):
            missed += 1
            continue
        miss.append(found.uv[0] - corners)
        sigmas.append(found.sigma_px[0])
    assert missed <= 1
    square = np.square(miss)
    assert np.sqrt(square.mean()) < within_px
    assert (square / np.square(sigmas)[:, None, None]).mean() < 4.0


@pytest.mark.parametrize(
    "family", ["apriltag_16h5", "apriltag_25h9", "apriltag_36h11", "aruco_4x4_50", "aruco_6x6_250"]
)
def test_every_family_is_read(family: TagFamily) -> None:
    image, corners = tag_picture(np.random.default_rng(5), CAMERA, family, 7, 0.032, Look(0.35))
    found = TagFinder(FILE, [box(family)]).push(image, 0)
    assert found.ids.tolist() == [7]
    np.testing.assert_allclose(found.uv[0], corners, atol=0.1)


@pytest.mark.parametrize("family", ["apriltag_16h5", "aruco_4x4_50", "aruco_5x5_100", "apriltag_36h11"])
def test_a_desk_without_tags_has_none(family: TagFamily) -> None:
    rng, finder = np.random.default_rng(3), TagFinder(FILE, [box(family, range(5))])
    for _ in range(6):
        assert finder.fresh().push(clutter(rng), 0).ids.tolist() == []


def test_a_tag_of_the_family_that_is_on_no_object_is_none_of_them() -> None:
    image, _ = tag_picture(np.random.default_rng(1), CAMERA, "apriltag_16h5", 20, 0.032, Look(0.35))
    assert TagFinder(FILE, [box("apriltag_16h5", range(20))]).push(image, 0).ids.tolist() == []
    assert TagFinder(FILE, [box("apriltag_16h5", range(20, 21))]).push(image, 0).ids.tolist() == [20]


def test_a_tag_that_moves_is_followed_and_one_that_jumps_is_found_again() -> None:
    finder, seen = TagFinder(FILE, [box()]), []
    image, corners = tag_picture(np.random.default_rng(2), CAMERA, "aruco_5x5_100", 3, 0.032, Look(0.45))
    for k, shift in enumerate([0, 9, 18, 27, 27, -60, -60, -60, -60, -60]):
        moved = np.roll(image, shift, axis=1)
        found = finder.push(moved, k * FRAME_NS)
        seen.append(found.ids.tolist() == [3])
        if seen[-1]:
            np.testing.assert_allclose(found.uv[0], corners + np.array([shift, 0.0]), atol=0.1)
    assert seen[:5] == [True] * 5
    assert seen[-1]


def test_what_appears_later_is_found_within_a_turn_of_the_parts() -> None:
    finder = TagFinder(FILE, [box()])
    empty = np.full((480, 640, 3), 120, np.uint8)
    image, _ = tag_picture(np.random.default_rng(4), CAMERA, "aruco_5x5_100", 6, 0.032, Look(0.45))
    assert finder.push(empty, 0).ids.tolist() == []
    assert any(finder.push(image, k * FRAME_NS).ids.tolist() == [6] for k in range(1, 6))
    gone = finder.push(empty, 6 * FRAME_NS + 2 * HOLD_NS)
    assert (gone.ids.shape, gone.uv.shape, gone.sigma_px.shape) == ((0,), (0, 4, 2), (0,))


def test_a_covered_side_is_no_tag_a_little_further_in() -> None:
    image, corners = tag_picture(
        np.random.default_rng(6), CAMERA, "aruco_5x5_100", 2, 0.032, Look(0.3, tilt_rad=0.1)
    )
    for share in (0.1, 0.2, 0.3):
        cut = corners + share * (np.roll(corners, 1, axis=0) - corners) * np.array([[0], [1], [0], [0]])
        cut += share * (np.roll(corners, -1, axis=0) - corners) * np.array([[0], [0], [1], [0]])
        strip = np.rint([corners[1], corners[2], cut[2], cut[1]]).astype(np.int32)
        covered = np.asarray(cv2.fillPoly(image.copy(), [strip], (140, 170, 220)), np.uint8)
        found = TagFinder(FILE, [box()]).push(covered, 0)
        for uv, sigma in zip(found.uv, found.sigma_px, strict=True):
            assert np.abs(uv - corners).max() < 5.0 * sigma


def test_a_grey_image_does_and_one_of_another_size_is_refused() -> None:
    image, _ = tag_picture(np.random.default_rng(1), CAMERA, "aruco_5x5_100", 1, 0.032, Look())
    finder = TagFinder(FILE, [box()])
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    assert finder.push(grey, 0).ids.tolist() == [1]
    with pytest.raises(ValueError, match="the camera file says"):
        finder.push(image[:100], 1)


def test_tags_that_nobody_could_distinguish_are_refused() -> None:
    with pytest.raises(CalibrationError, match="3 is on object 'box', too"):
        TagFinder(FILE, [box(), box("apriltag_36h11", range(3, 4), "other")])
    with pytest.raises(CalibrationError, match="apriltag_16h5 has 0 to 29"):
        TagFinder(FILE, [box("apriltag_16h5", range(28, 32))])
