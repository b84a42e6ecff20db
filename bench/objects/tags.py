"""Errors of the corners of a fiducial tag of 32 mm at 0.5 m; baseline: cv2.aruco with its ways to refine corners.

Pictures with exact corners are drawn by rays in linear light: each pixel is the mean of what its sub-pixels see of the
tag's plane. Nothing of it is shared with what finds the corners.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bench.report import CALIBRATION, Row, rms
from common.arrays import Float, Image, Int
from common.calibration import CameraCalibration, load
from common.calibration.object_profile import ObjectProfile, Tag, TagFamily, Tags, tag_corners
from common.geometry.camera_model import CameraModel
from common.geometry.srgb import to_srgb
from common.geometry.tag_family import dictionary, tag_bits
from slave.tags.finder import TagFinder

SUB = 5  # sub-pixels along a side of a pixel
BLACK = 0.03  # linear light of print; paper: 0.75


@dataclass(frozen=True, slots=True)
class Look:
    """How a tag is seen."""

    distance_m: float = 0.5  # its middle, along the optical axis
    tilt_rad: float = 0.4  # between its normal and the ray to it
    blur_px: float = 0.6  # standard deviation of what the lens blurs
    noise: float = 2.0  # standard deviation [bytes] in half bright grey; follows the root of the light
    motion_px: float = 0.0  # way of its middle during the exposure
    light: float = 1.0  # of the scene; 1: paper nearly fills the bytes
    margin: float = 1.0  # cells of white paper about it


def tag_picture(
    rng: np.random.Generator, camera: CameraModel, family: TagFamily, number: int, edge_m: float, look: Look
) -> tuple[Image, Float]:
    """A BGR picture, somewhere in it the tag, and its corners (4, 2) [px] in the middle of the exposure."""
    pose, ahead = _pose(rng, camera, look)
    points = tag_corners(edge_m) @ pose[:3, :3].T + pose[:3, 3]
    corners = camera.distort(points[:, :2] / points[:, 2:])
    low = np.floor(corners.min(axis=0) - 0.5 * np.ptp(corners, axis=0) - 8).astype(int).clip(0)
    high = np.ceil(corners.max(axis=0) + 0.5 * np.ptp(corners, axis=0) + 8).astype(int)
    high = np.minimum(high, [camera.width_px, camera.height_px])
    light = _background(rng, camera)
    steps = [0.0] if look.motion_px == 0.0 else np.linspace(-0.5, 0.5, 7)
    drawn: list[Float] = []
    for step in steps:
        moved = pose.copy()
        moved[:3, 3] += step * ahead
        drawn.append(_drawn(light, camera, moved, family, number, edge_m, look.margin, low, high))
    light[low[1] : high[1], low[0] : high[0]] = np.mean(drawn, axis=0)
    slope = rng.uniform(-0.4, 0.4, 2)
    y, x = np.indices(light.shape).astype(np.float64)
    light *= look.light * (
        1.0 + slope[0] * (x / camera.width_px - 0.5) + slope[1] * (y / camera.height_px - 0.5)
    )
    if look.blur_px > 0.0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), look.blur_px), np.float64)
    grey = 255.0 * to_srgb(light)
    noisy = (
        grey[..., None]
        + rng.normal(size=(*grey.shape, 3)) * (look.noise * np.sqrt(grey / 128.0 + 0.1))[..., None]
    )
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), corners


def _pose(rng: np.random.Generator, camera: CameraModel, look: Look) -> tuple[Float, Float]:
    """`T_camera_tag` (4, 4) [m], facing the camera at the tilt, and its way (3,) [m] during the exposure."""
    at = rng.uniform([0.2, 0.2], [0.8, 0.8]) * [camera.width_px, camera.height_px]
    ray = np.append(camera.undistort(at), 1.0)
    back = -ray / np.linalg.norm(ray)
    side = np.cross(back, rng.normal(size=3))
    normal = np.cos(look.tilt_rad) * back + np.sin(look.tilt_rad) * side / np.linalg.norm(side)
    x = np.cross(normal, rng.normal(size=3))
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(normal, x), normal], axis=1)
    pose[:3, 3] = look.distance_m * ray
    rotation = rng.uniform(0.0, 2.0 * np.pi)
    way_m = look.motion_px * look.distance_m / camera.matrix[0, 0]
    return pose, way_m * np.array([np.cos(rotation), np.sin(rotation), 0.0])


def _drawn(
    light: Float,
    camera: CameraModel,
    pose: Float,
    family: TagFamily,
    number: int,
    edge_m: float,
    margin: float,
    low: Int,
    high: Int,
) -> Float:
    """Linear light of the window from `low` to `high` [px] with the tag over the background."""
    sub: Float = (np.arange(SUB, dtype=np.float64) + 0.5) / SUB - 0.5
    u = (np.arange(low[0], high[0], dtype=np.float64)[:, None] + sub).ravel()
    v = (np.arange(low[1], high[1], dtype=np.float64)[:, None] + sub).ravel()
    rays = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    # The point of the plane on a ray, in the tag's frame: pose^-1 applied to ray and centre.
    inverse = np.linalg.inv(pose)
    direction = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1) @ inverse[:3, :3].T
    origin = inverse[:3, 3]
    on = origin[:2] - direction[..., :2] * (origin[2] / direction[..., 2:])
    black = np.pad(tag_bits(family, number), 1)
    cells = len(black)
    column, row = (on[..., 0] / edge_m + 0.5) * cells, (0.5 - on[..., 1] / edge_m) * cells
    inside = (column >= 0) & (column < cells) & (row >= 0) & (row < cells)
    white = np.ones(column.shape)
    white[inside] = black[row[inside].astype(int), column[inside].astype(int)]
    paper = (np.abs(column - cells / 2) < cells / 2 + margin) & (np.abs(row - cells / 2) < cells / 2 + margin)
    under = np.repeat(np.repeat(light[low[1] : high[1], low[0] : high[0]], SUB, 0), SUB, 1)
    full = np.where(paper, BLACK + (0.75 - BLACK) * white, under)
    return full.reshape(high[1] - low[1], SUB, high[0] - low[0], SUB).mean(axis=(1, 3))


def _background(rng: np.random.Generator, camera: CameraModel) -> Float:
    """Linear light (H, W) of something with edges and shades."""
    coarse = rng.uniform(0.05, 0.6, (6, 8))
    return cv2.resize(coarse, (camera.width_px, camera.height_px), interpolation=cv2.INTER_CUBIC).clip(
        0.02, 0.9
    )


EDGE_M, TAGS, SEEDS = 0.032, 8, 40
FAMILY: TagFamily = "aruco_5x5_100"
HERE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
METHODS = ("SUBPIX", "CONTOUR", "APRILTAG")  # cv2.aruco's CORNER_REFINE_


def rows() -> Iterator[Row]:
    """Measure our finder, each frame as a first one, then OpenCV's on the same pictures."""
    cv2.setNumThreads(1)
    file = load(CALIBRATION / "cameras/left.json", CameraCalibration)
    camera, pictures = CameraModel.of(file, np.eye(4)), list[tuple[int, Image, Float]]()
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        number = int(rng.integers(TAGS))
        pictures.append((number, *tag_picture(rng, camera, FAMILY, number, EDGE_M, Look())))
    tags = tuple(Tag(id=number, edge_m=EDGE_M, T_object_tag=HERE) for number in range(TAGS))
    finder = TagFinder(file, [ObjectProfile(version=1, name="box", tags=Tags(FAMILY, tags))])
    off = np.array([p for one in (_miss(finder, *picture) for picture in pictures) for p in one])
    yield Row("corners at 0.5 m", rms(off), "px RMS", f"per axis; found {len(off) // 4} of {SEEDS}")
    for method in METHODS:
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = getattr(cv2.aruco, f"CORNER_REFINE_{method}")
        detector = cv2.aruco.ArucoDetector(dictionary(FAMILY, range(TAGS)), settings)
        off = np.array([p for one in (_baseline(detector, *picture) for picture in pictures) for p in one])
        middle = off.mean(axis=0)
        note = f"mean {middle.round(2).tolist()} taken off; found {len(off) // 4} of {SEEDS}"
        yield Row(f"baseline: cv2.aruco, CORNER_REFINE_{method}", rms(off - middle), "px RMS", note)


def _miss(finder: TagFinder, number: int, image: Image, corners: Float) -> Float:
    """Errors (4 n, 2) [px] of the corners of the tag wherever it is found."""
    found = finder.fresh().push(image, 0)
    return (found.uv[found.ids == number] - corners).reshape(-1, 2)


def _baseline(detector: cv2.aruco.ArucoDetector, number: int, image: Image, corners: Float) -> Float:
    quads, ids, _ = detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    numbers = np.asarray(ids).ravel().tolist()  # none: of None, which is no number
    if number not in numbers:
        return np.empty((0, 2))
    return np.asarray(quads[numbers.index(number)], np.float64).reshape(4, 2) - corners
