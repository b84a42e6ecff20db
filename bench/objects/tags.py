"""Fiducial tags: errors of corners, share found, and false ones; baseline: cv2.aruco."""

import math
from collections.abc import Iterator

import cv2
import numpy as np

from bench.objects.tag_images import Look, tag_picture
from bench.report import CALIBRATION, Row
from common.arrays import Float, Image
from common.calibration import CameraCalibration, load
from common.calibration.object_profile import ObjectProfile, Tag, TagFamily, Tags
from common.geometry.camera_model import CameraModel
from common.geometry.tag_family import dictionary
from slave.tags.finder import TagFinder

EDGE_M, TAGS, SEEDS = 0.032, 8, 40
FAMILY: TagFamily = "aruco_5x5_100"
EMPTY_FRAMES = 300
HERE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
LOOKS = {
    "0.35 m": Look(0.35),
    "0.5 m": Look(0.5),
    "0.7 m": Look(0.7),
    "0.5 m, 57 degrees aslant": Look(0.5, tilt_rad=1.0),
    "0.5 m, blur 1.0 px": Look(0.5, blur_px=1.0),
    "0.5 m, moves 3 px in the exposure": Look(0.5, motion_px=3.0),
    "0.5 m, a tenth of the light": Look(0.5, light=0.1, noise=3.0),
}
METHODS = ("NONE", "SUBPIX", "CONTOUR", "APRILTAG")  # cv2.aruco's CORNER_REFINE_


def rows() -> Iterator[Row]:
    """The rows of the table."""
    cv2.setNumThreads(1)
    file = load(CALIBRATION / "cameras/left.json", CameraCalibration)
    for name, look in LOOKS.items():
        yield from _seen(file, name, look)
    yield from _methods(file)
    yield from _empty(file)


def _profile(family: TagFamily = FAMILY) -> ObjectProfile:
    tags = tuple(Tag(id=number, edge_m=EDGE_M, T_object_tag=HERE) for number in range(TAGS))
    return ObjectProfile(version=1, name="box", tags=Tags(family, tags))


def _pictures(file: CameraCalibration, look: Look) -> Iterator[tuple[int, Image, Float]]:
    camera = CameraModel.of(file, np.eye(4))
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        number = int(rng.integers(TAGS))
        yield number, *tag_picture(rng, camera, FAMILY, number, EDGE_M, look)


def _seen(file: CameraCalibration, name: str, look: Look) -> Iterator[Row]:
    base, miss, sigma, wrong = TagFinder(file, [_profile()]), list[Float](), list[float](), 0
    for number, image, corners in _pictures(file, look):
        found = base.fresh().push(image, 0)
        for k, one in enumerate(found.ids.tolist()):
            wrong += one != number
            if one == number:
                miss.append(found.uv[k] - corners)
                sigma.append(float(found.sigma_px[k]))
    yield Row(f"{name}: found", 100.0 * len(miss) / SEEDS, "%", f"one frame, nothing before; {wrong} wrong")
    if miss:
        square = np.square(miss)
        chi = (square / np.square(sigma)[:, None, None]).mean()
        note = f"RMS per axis; stated {np.median(sigma):.3f}; chi-square per degree {chi:.2f}, honest 1"
        yield Row(f"{name}: corners", math.sqrt(square.mean()), "px", note)


def _methods(file: CameraCalibration) -> Iterator[Row]:
    """What OpenCV's own detector and its ways to refine corners make of the same pictures."""
    pictures = list(_pictures(file, LOOKS["0.5 m"]))
    for method in METHODS:
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = getattr(cv2.aruco, f"CORNER_REFINE_{method}")
        detector = cv2.aruco.ArucoDetector(dictionary(FAMILY, range(TAGS)), settings)
        miss: list[Float] = []
        for number, image, corners in pictures:
            quads, ids, _ = detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
            numbers = np.asarray(ids).ravel().tolist()  # none: of None, which is no number
            if number in numbers:
                miss.append(np.asarray(quads[numbers.index(number)], np.float64).reshape(4, 2) - corners)
        off = np.array(miss).reshape(-1, 2)
        rms = math.sqrt(np.square(off - off.mean(axis=0)).mean())
        note = f"RMS; mean {off.mean(axis=0).round(2).tolist()} taken off; found {len(miss)} of {SEEDS}"
        yield Row(f"baseline: cv2.aruco, CORNER_REFINE_{method}", rms, "px", note)


def _empty(file: CameraCalibration) -> Iterator[Row]:
    """False tags among four-sided things with random cells, each frame as a first one."""
    rng = np.random.default_rng(0)
    families: tuple[TagFamily, ...] = ("apriltag_16h5", "aruco_4x4_50", "aruco_5x5_100", "apriltag_36h11")
    finders = {family: TagFinder(file, [_profile(family)]) for family in families}
    false: dict[TagFamily, int] = dict.fromkeys(families, 0)
    for _ in range(EMPTY_FRAMES):
        image = clutter(rng)
        for family in families:
            false[family] += len(finders[family].fresh().push(image, 0).ids)
    for family, count in false.items():
        yield Row(f"false tags of {family}", count, "", f"{EMPTY_FRAMES} frames of 40 things like tags")


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
