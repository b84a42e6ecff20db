"""Predict the LED image of the wrist camera from its view.

Relative depth: light from beside the lens falls with the square of the distance and comes back once, so the root of
the intensity is *nearness*, not distance (Kim et al. 2012 take sqrt(I) for distance; correction:
docs/theory/sources.md#nearness-and-distance). With alpha the angle of the ray off the optical axis,

    depth = c cos(alpha) / sqrt(I / F),        F the flat field, what the LEDs make of a white surface

along the optical axis. c (whiteness, the LEDs' power, the camera's gain) is not known: depth is monotone, and right
up to one factor where the surface is of one kind and faces the camera; inclined by theta it looks farther by 1 /
sqrt(cos theta). A pixel as dark as noise has no depth (NaN); a saturated one is at most as far as it looks.

Outline of a fingertip: along rays from the predicted middle the edge is where light falls off most steeply in
proportion. The circle fits the edges by least squares, given what was predicted; edges that lie off count less.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, cast

import cv2
import numpy as np

from common.arrays import Bool, Float, Float32, Image, Int
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.calibration.rig import FlatField, flat_of
from common.errors import CalibrationError
from common.hand.model import CHAINS, HandModel
from common.hand.wrist import WristDevice


@dataclass(frozen=True, slots=True, eq=False)
class WristView(WristDevice):
    """A wrist rig, its camera and its hand, checked."""

    flat_field: FlatField | None  # what the LEDs make of a white surface, where it was measured

    @classmethod
    def of(cls, rig: RigCalibration, camera: CameraCalibration, hand: HandProfile) -> "WristView":
        """Bring the three files together; CalibrationError as `WristDevice.joined`."""
        device = WristDevice.joined(rig, camera, HandModel.of(hand))
        palm, plane = device.T_camera_palm, (device.normal, device.offset_m)
        return cls(device.optics, device.model, palm, *plane, rig.flat_field)


PER_BONE = 6  # points along each bone
NEAREST_M = 0.03  # what is nearer to the camera is not seen as a finger


def finger_postures(view: WristView, *counts: int) -> Float:
    """Postures (P, 5, 4) [rad] of so many abductions, flexions, PIP flexions."""
    out = _grid(view.model.limits_rad[1], *counts, 1)
    dip_per_pip = 0.84  # of natural flexion (Kim et al. 2012)
    out[..., 3] = dip_per_pip * out[..., 2]
    return out


def thumb_postures(view: WristView, *counts: int) -> Float:
    """Postures (P, 5, 4) [rad] of the thumb, so many of each of its four angles."""
    return _grid(view.model.limits_rad[0], *counts)


def _grid(limits_rad: Float, *counts: int) -> Float:
    """All combinations (P, 5, 4) of so many values within limits (4, 2); one is 0."""
    ends: list[Float] = list(limits_rad)
    values: list[Float] = [
        np.linspace(low_high[0], low_high[1], count) if count > 1 else np.zeros(1)
        for low_high, count in zip(ends, counts, strict=True)
    ]
    grid = np.stack(np.meshgrid(*values, indexing="ij"), axis=-1).reshape(-1, 1, 4)
    return np.broadcast_to(grid, (len(grid), 5, 4)).copy()


def along_bones(view: WristView, angles: Float) -> Float:
    """Points (P, 5, 3 PER_BONE, 3) [m] of postures (P, 5, 4), palm frame, root first."""
    joints = view.model.chains(angles).position_m
    return _between(joints[:, :, :, None, :]).reshape(*joints.shape[:2], -1, 3)


def radius_along(view: WristView) -> Float:
    """Radius (5, 3 PER_BONE) [m] of the fingers at the points of `along_bones`."""
    return _between(view.model.radius_m[CHAINS][:, :, None, None]).reshape(5, -1)


def _between(ends: Float) -> Float:
    """Interpolate values (..., 4, 1, K) at bones' ends to (..., 3, PER_BONE, K)."""
    share = np.linspace(0.0, 1.0, PER_BONE, dtype=np.float64)[:, None]
    return ends[..., :-1, :, :] * (1.0 - share) + ends[..., 1:, :, :] * share


def unseen(part: str) -> CalibrationError:
    """The error of a palm pose with which fingers or thumb are outside of the image."""
    return CalibrationError(
        f"T_camera_palm: the camera does not see the {part} of this hand; calibrate the palm's pose"
    )


def in_image(view: WristView, palm_m: Float) -> tuple[Float, Float]:
    """Pixels and depths [m] of palm points (..., 3); what is too near is held off."""
    camera = palm_m @ view.T_camera_palm[:3, :3].T + view.T_camera_palm[:3, 3]
    depth = camera[..., 2]
    held = np.concatenate([camera[..., :2], np.maximum(depth, NEAREST_M)[..., None]], axis=-1)
    return view.optics.project(held), depth


SHRINK = 4  # the LED image is read at a quarter of its resolution


@dataclass(frozen=True, slots=True, eq=False)
class LedOptics:
    """What each pixel of the shrunken image is multiplied with."""

    cosine: Float32  # (h, w) of the angle off the optical axis
    level: Float32  # (h, w) 1 / sqrt(F)


def shrink(led: Image) -> Float32:
    """Return LED less ambient frame [grey levels] at a quarter of its resolution."""
    height, width = led.shape
    half = cv2.resize(led, (width // 2, height // 2), interpolation=cv2.INTER_AREA)  # in halves it is fast
    size = (width // SHRINK, height // SHRINK)
    return cast(Float32, cv2.resize(half.astype(np.float32), size, interpolation=cv2.INTER_AREA))


def nearness(grey: Float32, optics: LedOptics) -> Float32:
    """Nearness sqrt(I / F) (h, w) of grey levels >= 0."""
    return np.sqrt(grey) * optics.level


def depth_about(near: Float32, optics: LedOptics, u: float, v: float, radius_px: float) -> float:
    """Relative depth of what is nearest within a radius [px] about a pixel.

    The nearest faces the camera, so it is the least inclined. NaN: too dark to measure.
    """
    row, column, reach = round(v / SHRINK), round(u / SHRINK), max(round(radius_px / SHRINK), 1)
    about = (slice(max(row - reach, 0), row + reach + 1), slice(max(column - reach, 0), column + reach + 1))
    dark = 4.0  # grey levels: what the noise of a difference of two frames leaves
    lit = near[about] > np.sqrt(dark) * optics.level[about]
    return float((optics.cosine[about][lit] / near[about][lit]).min()) if lit.any() else np.nan


@lru_cache(maxsize=8)
def led_optics(view: WristView) -> LedOptics:
    """The maps of one wrist rig; made once."""
    u, v = (
        np.arange(size // SHRINK, dtype=np.float64) * SHRINK + 0.5 * (SHRINK - 1)  # centres of cells
        for size in (view.optics.width_px, view.optics.height_px)
    )
    xy = view.optics.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    ray = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1)
    flat = np.ones(xy.shape[:2]) if view.flat_field is None else flat_of(view.flat_field, xy)
    return LedOptics(
        (1.0 / np.linalg.norm(ray, axis=-1)).astype(np.float32), (1.0 / np.sqrt(flat)).astype(np.float32)
    )


def circle_of(directions: int) -> Float:
    """Unit vectors (directions, 2) in the image, from the right clockwise."""
    angle = np.arange(directions) * (2.0 * np.pi / directions)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


class OutlineSettings(NamedTuple):
    """Numbers of the fit of a fingertip's outline."""

    directions: int = 16
    steps: int = 24
    # of the radius: where an edge is sought
    first: float = 0.45
    last: float = 1.75
    expected: float = 0.35  # of the radius: how far off edges are, standard deviation
    least_drop: float = 0.12  # of the logarithm of light over an edge: none
    firm_drop: float = 0.4  # so much more is a sure one
    tiny: float = 1e-6
    rim: float = 0.05  # of the radius: how far light falls off within the outline
    width: int = 3  # steps of an edge
    # of the radius: how well the middle and the radius are predicted
    middle_sigma: float = 0.6
    radius_sigma: float = 0.12
    edge_sigma: float = 0.08  # of the radius: how far skin is off a circle
    widths: tuple[float, float, float] = (0.45, 0.25, 0.18)  # of the radius: beyond that an edge counts less
    # Tables by those numbers: of grey levels, of directions, and of steps along a ray.
    log: Float32 = np.log(np.arange(256, dtype=np.float32) + 6.0).astype(np.float32)  # and what is dark
    way: Float = circle_of(directions)
    share: Float32 = np.linspace(first, last, steps).astype(np.float32)
    middles: Float32 = 0.5 * (share[width:] + share[:-width])
    weight: Float32 = np.exp(-0.5 * ((middles - 1.0) / expected) ** 2).astype(np.float32)
    step: float = float(share[1] - share[0])


SETTINGS = OutlineSettings()
_DESIGN = np.concatenate([SETTINGS.way, np.ones((SETTINGS.directions, 1))], axis=1)
_PRODUCTS = (_DESIGN[:, :, None] * _DESIGN[:, None]).reshape(SETTINGS.directions, 9)
_PRIOR_NORMAL = np.diag(
    SETTINGS.edge_sigma**2
    / np.array([SETTINGS.middle_sigma, SETTINGS.middle_sigma, SETTINGS.radius_sigma]) ** 2
)


class Circles(NamedTuple):
    """Outlines of N fingertips."""

    middle: Float  # (N, 2) [px]
    radius: Float  # (N,) [px]
    sigma_px: Float  # (N,) standard deviation of the middle per axis
    shown: Float  # (N,) share of the edges to be seen that are where the circle has them


def fitted(led: Image, middle: Float | Float32, radius: Float | Float32, open_: Float | Float32) -> Circles:
    """Circles nearest to the outlines of N fingertips, expected at (N, 2), (N,) [px].

    `led`: (H, W) less the ambient frame; `open_` (N, DIRECTIONS): 1: an edge is to be seen, 0: the finger goes on.
    """
    middle, radius = middle.astype(np.float64), radius.astype(np.float64)
    off, strength, inside = _edges(led, middle, radius)
    wanted: Float = np.asarray(open_, np.float64) * inside
    firm = wanted * np.minimum(
        np.maximum((strength - SETTINGS.least_drop) * (1.0 / SETTINGS.firm_drop), 0.0), 1.0
    )
    weight: Float = firm
    solution, rest, normal = np.zeros((len(radius), 3)), off, np.broadcast_to(np.eye(3), (len(radius), 3, 3))
    for width in SETTINGS.widths:
        normal = (weight @ _PRODUCTS).reshape(-1, 3, 3) + _PRIOR_NORMAL
        solution = np.asarray(
            np.linalg.solve(normal, ((weight * off) @ _DESIGN)[..., None])[..., 0], np.float64
        )
        rest = (off - solution @ _DESIGN.T) * (1.0 / width)
        weight = firm / (1.0 + rest * rest) ** 2
    shown = (firm * (np.abs(rest) < 1.0)).sum(axis=1) / np.maximum(wanted.sum(axis=1), SETTINGS.tiny)
    variance = np.linalg.inv(normal)[:, (0, 1), (0, 1)].sum(axis=1) * (0.5 * SETTINGS.edge_sigma**2)
    solution *= radius[:, None]
    return Circles(middle + solution[:, :2], radius + solution[:, 2], radius * np.sqrt(variance), shown)


def _edges(led: Image, middle: Float, radius: Float) -> tuple[Float, Float, Bool]:
    """Find the edges of light around N circles in each direction.

    Returns how far beyond the circle the edge is (N, DIRECTIONS), in radii; by how much the logarithm of light falls
    there; and whether the image shows that far.
    """
    reach = radius[:, None, None].astype(np.float32) * SETTINGS.share
    x, y = (
        middle[:, k, None, None].astype(np.float32) + reach * SETTINGS.way[:, k, None].astype(np.float32)
        for k in (0, 1)
    )
    height, width = led.shape
    inside: Bool = (x[..., -1] > 0) & (y[..., -1] > 0) & (x[..., -1] < width - 1) & (y[..., -1] < height - 1)
    along = x.reshape(-1, SETTINGS.steps), y.reshape(-1, SETTINGS.steps)
    light = cv2.remap(led, *along, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    log: Float32 = SETTINGS.log[np.asarray(light, np.uint8)]
    drop = log[:, : -SETTINGS.width] - log[:, SETTINGS.width :]
    best: Int = (drop * SETTINGS.weight).argmax(axis=1)
    steps, flat = drop.shape[1], drop.ravel()
    at = best + np.arange(len(best), dtype=np.int64) * steps
    # The parabola through the steepest step and its neighbours.
    before, here, behind = flat[at - (best > 0)], flat[at], flat[at + (best < steps - 1)]
    part = 0.5 * (behind - before) / np.maximum(2.0 * here - before - behind, SETTINGS.tiny)
    part = np.minimum(np.maximum(part, -0.5), 0.5).astype(np.float64)
    off: Float = SETTINGS.rim - 1.0 + SETTINGS.middles[best] + SETTINGS.step * part
    return off.reshape(inside.shape), here.reshape(inside.shape).astype(np.float64), inside
