"""Draws the laser line: its exact curve widened by the thickness of the sheet, with the glow of the skin beside it.

A lit point moves along its ray by s where the sheet is looked at h off its middle: the point stays on the skin when
n . (h m + s r) = 0, with n the normal of the skin, m that of the sheet, r the ray. So each piece between two rays is a
ribbon of parallelograms, each as bright as Gauss's curve says and as large as its picture.
"""

import cv2
import numpy as np

from common.arrays import Float
from common.sim.wrist.cones import Cones
from common.sim.wrist.light import GLOW, LASER_LEVEL, LED_AT_M, SHEET_SIGMA_M, Plane
from common.sim.wrist.scene import WristScene
from common.sim.wrist.skin import Skin, SkinView

LAYERS = np.linspace(-2.6, 2.6, 15)  # across the sheet, in its sigmas
LENS_SIGMA_PX = 0.9
LEAST_COSINE = 0.12  # skin that the laser grazes flatter is lit as if it were this steep


def draw_stripe(level: Plane, scene: WristScene, bodies: Cones, skin: Skin, view: SkinView) -> None:
    """Add the line to levels (H, W) in place."""
    sheet, optics = scene.sheet, scene.optics
    curve = sheet.cross(bodies)
    chords = np.flatnonzero(curve.joined)
    chords = chords[curve.seen[chords] & curve.seen[chords + 1]]
    if not len(chords):
        return
    points = curve.points
    uv = optics.project(points)
    ray = sheet.rays[curve.ray[chords]]
    normals = bodies.normals(curve.body[chords], points[chords])
    facing = np.maximum(-np.einsum("ij,ij->i", normals, ray), LEAST_COSINE)
    slope = (normals @ sheet.normal) / facing
    rise = sheet.normal + slope[:, None] * ray
    step = 1e-4
    way = (optics.project(points[chords] + step * rise) - uv[chords]) / step  # px per metre of the sheet
    reach = np.linalg.norm(points[chords] - sheet.origin, axis=1)
    heights = LAYERS * SHEET_SIGMA_M
    piece = uv[chords + 1] - uv[chords]
    area = np.abs(piece[:, 0] * way[:, 1] - piece[:, 1] * way[:, 0]) * (heights[1] - heights[0])
    value = LASER_LEVEL * facing * (LED_AT_M / reach) * area
    place = (0.5 * (uv[chords] + uv[chords + 1]))[:, None] + heights[:, None] * way[:, None]
    amount = value[:, None] * np.exp(-0.5 * LAYERS**2)
    _spread(level, place.reshape(-1, 2), amount.ravel(), skin, view)


def _spread(level: Plane, place: Float, amount: Float, skin: Skin, view: SkinView) -> None:
    """Add light at places (N, 2) [px], each shared by four pixels, blurred as a lens and skin do."""
    height, width = level.shape
    edge = 40
    inside = ((place > 1.0) & (place < np.array([width - 2.0, height - 2.0]))).all(axis=1)
    place, amount = place[inside], amount[inside]
    if not len(place):
        return
    low = np.maximum(place.min(axis=0).astype(int) - edge, 0)
    high = np.minimum(place.max(axis=0).astype(int) + edge, [width, height])
    w, h = high - low
    at = place - low
    corner = at.astype(np.int64)
    fx, fy = (at - corner).T
    index = corner[:, 1] * w + corner[:, 0]
    light = np.zeros(w * h)
    for shift, share in ((0, (1 - fx) * (1 - fy)), (1, fx * (1 - fy)), (w, (1 - fx) * fy), (w + 1, fx * fy)):
        light += np.bincount(index + shift, amount * share, w * h)
    line = light.reshape(h, w).astype(np.float32)
    hand = np.zeros(skin.size[::-1], dtype=np.float32)
    hand.reshape(-1)[view.pixel] = view.albedo
    hand = cv2.resize(hand, (width, height), interpolation=cv2.INTER_LINEAR)[
        low[1] : high[1], low[0] : high[0]
    ]
    small = cv2.resize(
        np.minimum(line, 2.0 * LASER_LEVEL), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
    )
    glow = sum(share * cv2.GaussianBlur(small, (0, 0), 0.5 * sigma) for sigma, share in GLOW)
    glow = cv2.resize(np.asarray(glow), (int(w), int(h)), interpolation=cv2.INTER_LINEAR)
    line = cv2.GaussianBlur(line, (0, 0), LENS_SIGMA_PX)
    level[low[1] : high[1], low[0] : high[0]] += line + glow * hand
