"""What a finger looks like from the wrist, bent in every way: templates to find its tip with (D15).

The palm stands still before the camera, so of a finger whose bones are known two angles matter: the flexion of its
knuckle and of its PIP, which the DIP follows more or less (D8); of the thumb all four, in its limits. For each posture
the finger is drawn as round cones along its bones, lit from the lens: a surface at distance t, its normal inclined by
theta to the ray, gives back light in proportion to cos(theta) / t^2 (I15). Of a drawing the root of that is kept along
the *spine*, the line in the finger's strip (`strips`) from its root to its end, one number per station; 0 where the ray
meets nothing. Such a profile of nearness begins at the contour, steps down where a folded finger ends before the palm,
and has its bright bump where a fingertip faces the camera. How far the profile lies above the palm's own nearness tells
an open hand from a fist.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from common.arrays import Float, Int
from common.errors import CalibrationError
from common.hand_model import CHAINS, FINGER_JOINTS
from common.round_cones import Cones, first_hits, terms
from slave.wrist.led_depth import SHRINK, Float32
from slave.wrist.strips import ROW_PX, THUMB, Strips, strips_of
from slave.wrist.sweep import NEAREST_M, thumb_postures
from slave.wrist.view import WristView

FIVE = range(5)
DIP_PER_PIP = (0.62, 0.84)  # how far fingers follow: 2/3 of the hand models, Kamper's ratio (D8)
STEP_RAD = float(np.radians(6.0))
MCP_RAD = np.radians((-12.0, 100.0))
PIP_RAD = np.radians((0.0, 120.0))  # the range of D8
THUMB_POSTURES = (4, 7, 5, 5)  # values of its angles
# How far a finger reaches beyond its tip joint, in radii of its end: the half sphere about the joint, and a pad of the
# same thickness before it, as where the tip joint of a tracked hand lies within the last bone.
OVERHANG = (1.0, 1.5)
SOFT = 0.3  # of the light comes from inside the skin and from the skin around, whatever the incidence
# Cosines towards the camera from which on the end of a finger counts as seen: a little beyond its own horizon, by what
# 2 to 3 mm of the pad before it are; the pad's side is thicker than the nail's, which is before it in a fist.
HORIZON_UP, HORIZON_DOWN = -0.27, -0.2
PALM_ROWS = (2, 14)  # rows of the shrunken image below the knuckle, where no finger but a folded one is seen
PROFILE_VARIANCE = 1e-3  # of 1 - cosine between profile and template: what flesh differs from cones
GAIN_SIGMA = 0.15  # of the logarithm of what a finger returns beside the palm: skin, creases, stray light
_ORIGIN = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class TipTemplates:
    """All postures of thumb, index ... little: T of each, profiles of R stations.

    Attributes:
        rows: (5,) the stations that belong to each finger; beyond them its profiles are 0.
        unit: (5, T, R) profiles of unit length; 0: there are fewer postures.
        screen: (5, T, R / 2) the same, two stations in one.
        log_length: (5, T) logarithm of what they were divided by [1/m].
        palm: (4,) nearness of the palm below the knuckle, on average [1/m].
        palm_at: (4, P) pixels of the shrunken image, counted row by row, that show the palm there.
        root_uv: (4, 2) the knuckles [px].
        table: (5, 7, T) of the end of the finger, in its strip: how far it is below the finger's highest row [px] and
            above the lowest row of the fingertip [px], those two rows [px], the fingertip's radius [px], cosine
            between the last bone and the way to the camera (1: it points at the camera), whether the end is seen.
    """

    rows: Int
    unit: Float32
    screen: Float32
    log_length: Float32
    palm: Float
    palm_at: Int
    root_uv: Float
    table: Float


@lru_cache(maxsize=8)
def templates_of(view: WristView) -> TipTemplates:
    """The templates of one wrist rig and hand; made once.

    Raises:
        CalibrationError: The camera does not see the fingers of this hand above its palm.
    """
    strips = strips_of(view)
    knuckles = view.optics.project(
        view.model.forward(view.T_camera_palm, np.zeros((5, 4))).position_m[CHAINS[1:, 0]]
    )
    row = np.where(np.isfinite(knuckles[:, 1]), knuckles[:, 1], -1.0)  # one behind the camera
    if row.min() < 20 * SHRINK or row.max() >= view.optics.height_px:
        raise CalibrationError(
            "T_camera_palm: the camera does not see the fingers of this hand; calibrate the palm's pose"
        )
    made = [_templates(view, strips, finger) for finger in FIVE]
    first = np.array([root for _, _, root in made])
    rows: Int = (np.minimum(first, view.optics.height_px) / ROW_PX).astype(np.int64)
    most, count = int(rows.max() + 1) // 2 * 2, max(len(near) for near, _, _ in made)
    unit, table = np.zeros((5, count, most)), np.zeros((5, 7, count))
    for finger, (near, of_end, _) in enumerate(made):
        unit[finger, : len(near), :] = near[:, :most] * (np.arange(most) < rows[finger])
        table[finger, :, : len(near)] = of_end
    length = np.linalg.norm(unit, axis=2)
    length = np.where(length > 0.0, length, 1.0)
    unit /= length[..., None]
    below = (row / SHRINK).astype(np.int64)[:, None] + np.arange(*PALM_ROWS)
    below = np.minimum(below, view.optics.height_px // SHRINK - 1)
    width = view.optics.width_px // SHRINK
    column = (knuckles[:, :1] / SHRINK).astype(np.int64) + np.repeat([-1, 0], len(below[0]))
    at = np.minimum(below * SHRINK // ROW_PX, len(strips.v) - 1)
    palm = [near.mean(axis=0)[rows_of].mean() for (near, _, _), rows_of in zip(made[1:], at, strict=True)]
    return TipTemplates(
        rows=rows,
        unit=unit.astype(np.float32),
        screen=unit.reshape(5, count, -1, 2).sum(axis=3).astype(np.float32),
        log_length=np.log(length).astype(np.float32),
        palm=np.array(palm),
        palm_at=np.tile(below, (1, 2)) * width + column.clip(0, width - 1),
        root_uv=knuckles,
        table=table,
    )


def _postures(view: WristView, finger: int) -> tuple[Float, Float]:
    """Angles (T, 5, 4) [rad] and overhangs (T,) of one finger's templates."""
    if finger == THUMB:
        angles = thumb_postures(view, *THUMB_POSTURES)
    else:
        grids = (np.arange(low, high + 1e-9, STEP_RAD) for low, high in (MCP_RAD, PIP_RAD))
        mcp, pip, dip = (each.ravel() for each in np.meshgrid(*grids, DIP_PER_PIP, indexing="ij"))
        angles = np.zeros((len(mcp), 5, 4))
        angles[:, finger, 1:] = np.stack([mcp, pip, dip * pip], axis=-1)
    return np.repeat(angles, len(OVERHANG), axis=0), np.tile(OVERHANG, len(angles))


def _templates(view: WristView, strips: Strips, finger: int) -> tuple[Float, Float, float]:
    """Profiles (T, all stations) [1/m], table (7, T) and where the finger is rooted [v] of one finger."""
    angles, overhang = _postures(view, finger)
    joints = view.model.forward(view.T_camera_palm, angles)
    chain = joints.position_m[:, CHAINS[finger]]
    radius = view.model.radius_m[list(FINGER_JOINTS[finger])]
    along = -joints.rotation[:, CHAINS[finger, 3], :, 2]
    apex = chain[:, 3] + along * overhang[:, None] * radius[-1]
    end = apex - along * radius[-1]
    bones = joints.position_m[:, list(FINGER_JOINTS[finger][:-1])]
    points = np.concatenate([bones, end[:, None]], axis=1)
    pixels = view.optics.project(points)
    uv = strips.of_image(finger, pixels)
    apex_uv = strips.of_image(finger, view.optics.project(apex))
    root_uv = uv[:, 1]  # the knuckle of a finger, the thumb's second
    # Spines leave a finger the way its bones point: it ends where its contour is in that direction.
    bone = pixels[:, -1:] - pixels[:, 1:2] if finger == THUMB else np.array([[[0.0, -1.0]]])
    bone = np.broadcast_to(bone / np.linalg.norm(bone, axis=-1, keepdims=True), pixels.shape)
    rise = (bone * strips.up(finger, uv)).sum(axis=-1)
    above, below = (rise * part for part in _contour(view, points, radius, bone))
    near = _profiles(view, strips, finger, points, radius, root_uv, uv[:, -1])
    toward = -apex / np.linalg.norm(apex, axis=-1, keepdims=True)
    facing: Float = (along * toward).sum(axis=-1)
    down = apex_uv[:, 1] > uv[:, -1, 1]
    seen: Float = (facing > np.where(down, HORIZON_DOWN, HORIZON_UP)).astype(np.float64)
    top, bottom = (uv[..., 1] - above)[:, 1:].min(axis=1), (uv[..., 1] + below)[:, -1]
    apex_v, size = apex_uv[:, 1], radius[-1] * view.optics.matrix[1, 1] / end[:, 2]
    table: Float = np.array([apex_v - top, bottom - apex_v, top, bottom, size, facing, seen])
    good = np.isfinite(table).all(axis=0) & (points[..., 2] > NEAREST_M).all(axis=1)
    if finger == THUMB:  # it can reach beyond the image and beside the lens
        good &= (top > 0.0) & (apex_v < strips.v[-1])
    return near[good], table[:, good], float(np.median(root_uv[good, 1]))


def _contour(view: WristView, centres: Float, radius: Float, up: Float) -> tuple[Float, Float]:
    """How far (T, J) [px] the contours of spheres (T, J, 3) [m] reach in the image directions up (T, J, 2), and down.

    The line w . x = s of the image plane at distance 1 touches the contour of (c, r) where the plane through the lens
    that it is seen on touches the sphere: (w . c - s c_z)^2 = r^2 (1 + s^2).
    """
    a, z = (up * centres[..., :2]).sum(axis=-1), centres[..., 2]
    root = radius * np.sqrt(np.maximum(a * a + z * z - radius**2, 0.0))
    scale = np.maximum(z * z - radius**2, 1e-9)
    middle = view.optics.project(centres)
    ends: list[Float] = []
    for s in ((a * z + root) / scale, (a * z - root) / scale):
        at = centres[..., :2] / z[..., None] + up * (s - a / z)[..., None]
        touched = view.optics.project(np.concatenate([at, np.ones_like(at[..., :1])], axis=-1))
        ends.append(((touched - middle) * up).sum(axis=-1))
    return ends[0], -ends[1]


def _profiles(
    view: WristView, strips: Strips, finger: int, points: Float, radius: Float, root_uv: Float, end_uv: Float
) -> Float:
    """Nearness (T, stations) [1/m] along the spines of fingers of joints (T, J, 3) [m] and radii (J,) [m]."""
    v = strips.v
    rise = np.minimum(end_uv[:, 1] - root_uv[:, 1], -np.ptp(root_uv[0]) / 8.0 - 1.0)
    share = np.clip((v - root_uv[:, 1:]) / rise[:, None], -0.5, 1.5)
    u = root_uv[:, :1] + share * (end_uv[:, :1] - root_uv[:, :1])
    spine = strips.to_image(finger, np.stack([u, np.broadcast_to(v, u.shape)], axis=-1))
    ray = view.optics.ray(spine)
    count = points.shape[1] - 1
    near_r, far_r = (np.tile(part, len(points)) for part in (radius[:-1], radius[1:]))
    cones = Cones(points[:, :-1].reshape(-1, 3), points[:, 1:].reshape(-1, 3), near_r, far_r)
    known = terms(cones, _ORIGIN, np.float64).reshape(12, -1, count)
    distance = np.stack([first_hits(known[:, :, k, None], np.moveaxis(ray, -1, 0)) for k in range(count)])
    first, distance = distance.argmin(axis=0), distance.min(axis=0)
    hit = np.isfinite(distance)
    body = (np.arange(len(points), dtype=np.int64)[:, None] * count + first)[hit]
    normal = cones.normals(body, ray[hit] * distance[hit][:, None])
    shade = np.zeros(u.shape)
    shade[hit] = np.sqrt((np.clip(-(normal * ray[hit]).sum(axis=-1), 0.0, 1.0) + SOFT) / (1.0 + SOFT))
    return shade / np.where(hit, distance, 1.0)
