"""Renderer of the laser line.

Its exact curve widened by the thickness of the sheet, with the glow of the skin beside it.

A lit point moves along its ray by s where the sheet is looked at h off its middle: the point stays on the skin when
n . (h m + s r) = 0, with n the normal of the skin, m that of the sheet, r the ray. So each piece between two rays is a
ribbon of parallelograms, each as bright as the Gaussian profile gives and as large as its picture.
"""

import cv2
import numpy as np

from common.arrays import Float
from common.geometry.tapered_capsules import Capsules, Plane
from common.sim.wrist.capsules import THING_GROUP
from common.sim.wrist.light import GLOW, LASER_LEVEL, SHEET_SIGMA_M, SURFACE_AT_M
from common.sim.wrist.scene import WristScene
from common.sim.wrist.things import ALBEDO

LAYERS = np.linspace(-2.4, 2.4, 11)  # across the sheet, in its sigmas


def draw_stripe(level: Plane, scene: WristScene, bodies: Capsules, hand: Plane) -> None:
    """Add the laser line to the levels in place.

    Levels (H, W); the line glows where skin is, by `hand` (h, w), a coarser grid: what skin gives back, about 1, and
    0 where none is. Things glow as little as they give back, so not at all here.
    """
    sheet, optics = scene.sheet, scene.optics
    curve = sheet.cross(bodies)
    chords = np.flatnonzero(curve.joined)
    chords = chords[curve.seen[chords] & curve.seen[chords + 1]]
    points = curve.points[chords]
    ray = curve.rays[chords]
    normals = bodies.normals(curve.body[chords], points)
    least_cosine = 0.12  # skin that the laser grazes flatter is lit as if it were this steep
    facing = np.maximum(-np.einsum("ij,ij->i", normals, ray), least_cosine)
    rise = sheet.normal + ((normals @ sheet.normal) / facing)[:, None] * ray
    uv = optics.project(points)
    nudge_m = 1e-4
    way = (optics.project(points + nudge_m * rise) - uv) / nudge_m  # px per metre across the sheet
    piece = optics.project(curve.points[chords + 1]) - uv
    heights = LAYERS * SHEET_SIGMA_M
    area = np.abs(piece[:, 0] * way[:, 1] - piece[:, 1] * way[:, 0]) * (heights[1] - heights[0])
    reach = np.linalg.norm(points - sheet.origin, axis=1)
    given_back = np.where(curve.group[chords] == THING_GROUP, ALBEDO, scene.reflectance)
    amount = (LASER_LEVEL * given_back * facing * (SURFACE_AT_M / reach) * area)[:, None] * np.exp(
        -0.5 * LAYERS**2
    )
    place = (uv + 0.5 * piece)[:, None] + heights[:, None] * way[:, None]
    _spread(level, place.reshape(-1, 2), amount.ravel(), hand)


def _spread(level: Plane, place: Float, amount: Float, hand: Plane) -> None:
    """Add light at image places, blurred as the lens and skin do.

    Places (N, 2) [px], each shared by four pixels.
    """
    height, width = level.shape
    inside = ((place > 1.0) & (place < np.array([width - 2.0, height - 2.0]))).all(axis=1)
    place, amount = place[inside], amount[inside]
    if not len(place):
        return
    edge_px = 40
    (x0, y0), (x1, y1) = (
        np.maximum(place.min(axis=0).astype(int) - edge_px, 0).tolist(),
        np.minimum(place.max(axis=0).astype(int) + edge_px, [width, height]).tolist(),
    )
    w, h = x1 - x0, y1 - y0
    at = place - np.array([x0, y0])
    corner = at.astype(np.int64)
    fx, fy = (at - corner).T
    index = corner[:, 1] * w + corner[:, 0]
    four = np.concatenate([index, index + 1, index + w, index + w + 1])
    share = np.concatenate([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]) * np.tile(amount, 4)
    line = np.bincount(four, share, w * h).reshape(h, w).astype(np.float32)
    glow = _glow(line, hand, (x0, y0, x1, y1), width)
    lens_sigma_px = 0.9
    light = cv2.GaussianBlur(line, (0, 0), lens_sigma_px)
    light += cv2.resize(glow, (w, h), interpolation=cv2.INTER_LINEAR)
    level[y0:y1, x0:x1] += light


def _glow(line: Plane, hand: Plane, box: tuple[int, int, int, int], width: int) -> Plane:
    """Return the glow of the skin around a line, at a quarter of its size.

    None where there is no skin.
    """
    h, w = line.shape
    size = -(-w // 4), -(-h // 4)
    coarse = cv2.resize(line, size, interpolation=cv2.INTER_AREA)
    glow = np.zeros(size[::-1], dtype=np.float32)
    for sigma, part in GLOW:
        glow += part * np.asarray(cv2.GaussianBlur(coarse, (0, 0), 0.25 * sigma))
    x0, y0, x1, y1 = (round(side * hand.shape[1] / width) for side in box)
    glow *= cv2.resize(hand[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)
    return glow
