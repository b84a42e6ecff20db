"""Pictures of one fiducial tag with exact corners: perspective, lens, shade, blur, motion, noise and the sRGB curve.

Drawn by rays, not by a warped picture: each pixel is the mean of what its sub-pixels see of the tag's plane, in linear
light. So nothing here is shared with what finds the corners.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Image, Int
from common.calibration.object_profile import TagFamily, tag_corners
from common.geometry.camera_model import CameraModel
from common.geometry.srgb import to_srgb
from common.geometry.tag_family import tag_bits

SUB = 5  # sub-pixels along a side of a pixel
BLACK, PAPER = 0.03, 0.75  # linear light of print and paper
STEPS = 7  # instants of an exposure


@dataclass(frozen=True, slots=True)
class Look:
    """How a tag is seen.

    Attributes:
        distance_m: Its middle, along the optical axis.
        tilt_rad: Between its normal and the ray to it.
        blur_px: Standard deviation of what the lens blurs.
        noise: Standard deviation [bytes] in a grey that is half bright; it follows the root of the light.
        motion_px: Way of its middle during the exposure.
        light: Of the scene; 1: paper nearly fills the bytes.
        margin: Cells of white paper about it.
    """

    distance_m: float = 0.5
    tilt_rad: float = 0.4
    blur_px: float = 0.6
    noise: float = 2.0
    motion_px: float = 0.0
    light: float = 1.0
    margin: float = 1.0


def tag_picture(
    rng: np.random.Generator, camera: CameraModel, family: TagFamily, number: int, edge_m: float, look: Look
) -> tuple[Image, Float]:
    """A BGR picture, somewhere in it the tag, and its corners (4, 2) [px] in the middle of the exposure."""
    pose, ahead = _pose(rng, camera, look)
    corners = _seen(camera, pose, edge_m, 0.0)
    low = np.floor(corners.min(axis=0) - 0.5 * np.ptp(corners, axis=0) - 8).astype(int).clip(0)
    high = np.ceil(corners.max(axis=0) + 0.5 * np.ptp(corners, axis=0) + 8).astype(int)
    high = np.minimum(high, [camera.width_px, camera.height_px])
    light = _background(rng, camera)
    steps = [0.0] if look.motion_px == 0.0 else np.linspace(-0.5, 0.5, STEPS)
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


def _seen(camera: CameraModel, pose: Float, edge_m: float, shift: float) -> Float:
    points = tag_corners(edge_m) @ pose[:3, :3].T + pose[:3, 3] + shift
    return camera.distort(points[:, :2] / points[:, 2:])


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
    full = np.where(paper, BLACK + (PAPER - BLACK) * white, under)
    return full.reshape(high[1] - low[1], SUB, high[0] - low[0], SUB).mean(axis=(1, 3))


def _background(rng: np.random.Generator, camera: CameraModel) -> Float:
    """Linear light (H, W) of something with edges and shades."""
    coarse = rng.uniform(0.05, 0.6, (6, 8))
    return cv2.resize(coarse, (camera.width_px, camera.height_px), interpolation=cv2.INTER_CUBIC).clip(
        0.02, 0.9
    )
