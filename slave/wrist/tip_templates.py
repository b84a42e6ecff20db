"""What a finger looks like from the wrist, bent in every way: templates to find its tip with (D15).

The palm stands still before the camera, so of a finger whose bones are known two angles matter: the flexion of its
knuckle and of its PIP, which the DIP follows (D8). For each pair the finger is drawn as capsules along its bones, lit
from the lens: a surface at distance t, its normal inclined by theta to the ray, gives back light in proportion to
cos(theta) / t^2 (I15). Of a drawing the root of that is kept along the *spine*, the line in the image from the knuckle
to the fingertip, one number per row of the shrunken image; 0 where the ray meets nothing. Such a profile of nearness
begins at the contour, steps down where a folded finger ends before the palm, and has its bright bump where a fingertip
faces the camera. How far the profile lies above the palm's own nearness tells an open hand from a fist.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from common.arrays import Float, Int
from common.errors import CalibrationError
from common.hand_model import CHAINS, FINGER_JOINTS
from slave.wrist.led_depth import SHRINK, Float32, image_rows
from slave.wrist.view import WristView

FOUR = (1, 2, 3, 4)  # index ... little
DIP_PER_PIP = 0.84  # Kamper's ratio (D8)
STEP_RAD = float(np.radians(6.0))
MCP_RAD = np.radians((-12.0, 100.0))
PIP_RAD = np.radians((0.0, 120.0))  # the range of D8
# How far a finger reaches beyond its tip joint, in radii of its end: the half sphere about the joint, and a pad of the
# same thickness before it, as where the tip joint of a tracked hand lies within the last bone.
OVERHANG = (1.0, 1.4, 1.8)
SOFT = 0.3  # of the light comes from inside the skin and from the skin around, whatever the incidence
# Cosines towards the camera from which on the end of a finger counts as seen: a little beyond its own horizon, by what
# 2 to 3 mm of the pad before it are; the pad's side is thicker than the nail's, which is before it in a fist.
HORIZON_UP, HORIZON_DOWN = -0.25, -0.15
PALM_ROWS = (2, 14)  # rows below the knuckle, where no finger but a folded one is seen
LIKENESS = 5e-4  # of 1 - cosine between profile and template: what flesh differs from capsules
GAIN_SIGMA = 0.15  # of the logarithm of what a finger returns beside the palm: skin, creases, stray light
FINGER_ENDS = 0  # rows above the knuckle: so far down the end of a folded finger is seen


@dataclass(frozen=True, slots=True, eq=False)
class TipTemplates:
    """All bends of index ... little: T of each, profiles of R rows of the shrunken image.

    Attributes:
        rows: (4,) the rows that belong to each finger; beyond them its profiles are 0.
        unit: (4, T, R) profiles of unit length.
        screen: (4, T, R / 2) the same, two rows in one.
        log_length: (4, T) logarithm of what they were divided by [1/m].
        palm: (4,) nearness of the palm below the knuckle, on average [1/m].
        palm_at: (4, P) pixels of the shrunken image, counted row by row, that show the palm there.
        root_uv: (4, 2) the knuckles [px].
        table: (4, 7, T) of the end of the finger: how far it is below the finger's highest row [px] and above the
            lowest row of the fingertip [px], those two rows [px], the fingertip's radius [px], cosine between the last
            bone and the way to the camera (1: it points at the camera), and whether the end is seen.
    """

    rows: Int
    unit: Float32
    screen: Float32
    log_length: Float32
    palm: Float
    palm_at: Int
    root_uv: Float
    table: Float

    @property
    def all_rows(self) -> int:
        """How many rows of the shrunken image are read: the longest profile and the palm below it."""
        return int(self.rows.max()) + FINGER_ENDS + PALM_ROWS[1]


@lru_cache(maxsize=8)
def templates_of(view: WristView) -> TipTemplates:
    """The templates of one wrist rig and hand; made once.

    Raises:
        CalibrationError: The camera does not see the fingers of this hand above its palm.
    """
    made = [_templates(view, finger) for finger in FOUR]
    near, table, root_uv = (np.stack([one[k] for one in made]) for k in range(3))
    row, width, height = root_uv[:, 1] / SHRINK, view.optics.width_px // SHRINK, near.shape[2]
    row = np.where(np.isfinite(row), row, -1.0)  # a knuckle behind the camera
    rows = row.astype(np.int64) - FINGER_ENDS
    if rows.min() < 20 or rows.max() + FINGER_ENDS >= height:
        raise CalibrationError(
            "T_camera_palm: the camera does not see the fingers of this hand; calibrate the palm's pose"
        )
    below = np.minimum(row.astype(np.int64)[:, None] + np.arange(*PALM_ROWS), height - 1)
    palm = np.take_along_axis(near.mean(axis=1), below, axis=1).mean(axis=1)
    column = (root_uv[:, :1] / SHRINK).astype(np.int64) + np.repeat([-1, 0], len(below[0]))
    most = int(rows.max() + 1) // 2 * 2
    own = near[:, :, :most] * (np.arange(most) < rows[:, None])[:, None]
    length = np.linalg.norm(own, axis=2)
    unit = own / np.where(length > 0.0, length, 1.0)[..., None]
    return TipTemplates(
        rows=rows,
        unit=unit.astype(np.float32),
        screen=unit.reshape(*unit.shape[:2], -1, 2).sum(axis=3).astype(np.float32),
        log_length=np.log(np.where(length > 0.0, length, 1.0)).astype(np.float32),
        palm=palm,
        palm_at=np.tile(below, (1, 2)) * width + column.clip(0, width - 1),
        root_uv=root_uv,
        table=table,
    )


def _templates(view: WristView, finger: int) -> tuple[Float, Float, Float]:
    """Profiles (T, rows of the shrunken image) [1/m], table (7, T) and knuckle (2,) [px] of one finger."""
    mcp, pip = (_steps(float(low), float(high)) for low, high in (MCP_RAD, PIP_RAD))
    grid = np.stack(np.meshgrid(mcp, pip, OVERHANG, indexing="ij"), axis=-1).reshape(-1, 3)
    angles = np.zeros((len(grid), 5, 4))
    angles[:, finger, 1:3] = grid[:, :2]
    angles[:, finger, 3] = DIP_PER_PIP * grid[:, 1]
    joints = view.model.forward(view.T_camera_palm, angles)
    chain = joints.position_m[:, CHAINS[finger]]
    radius = view.model.radius_m[list(FINGER_JOINTS[finger])]
    along = -joints.rotation[:, CHAINS[finger, 3], :, 2]
    apex = chain[:, 3] + along * grid[:, 2:] * radius[-1]
    end = apex - along * radius[-1]
    metacarpal = joints.position_m[:, FINGER_JOINTS[finger][0]]
    points = np.stack([metacarpal, chain[:, 0], chain[:, 1], chain[:, 2], end], axis=1)
    root_uv, apex_uv = view.optics.project(chain[0, 0]), view.optics.project(apex)
    uv = view.optics.project(points)
    size = radius * view.optics.matrix[1, 1] / points[..., 2]
    near = _profiles(view, points, radius, root_uv, uv[:, -1])
    toward = -apex / np.linalg.norm(apex, axis=-1, keepdims=True)
    facing: Float = (along * toward).sum(axis=-1)
    down = apex_uv[:, 1] > uv[:, -1, 1]
    horizon: Float = np.where(down, HORIZON_DOWN, HORIZON_UP)
    seen: Float = (facing > horizon).astype(np.float64)
    top, bottom = (uv[..., 1] - size)[:, 1:].min(axis=1), (uv[..., 1] + size)[:, -1]
    apex_v = apex_uv[:, 1]
    table: Float = np.array([apex_v - top, bottom - apex_v, top, bottom, size[:, -1], facing, seen])
    return near, table, root_uv


def _steps(low: float, high: float) -> Float:
    return np.arange(low, high + 1e-9, STEP_RAD, dtype=np.float64)


def _profiles(view: WristView, points: Float, radius: Float, root_uv: Float, end_uv: Float) -> Float:
    """Nearness (T, rows) [1/m] along the spines of fingers of joints (T, 5, 3) [m] and radii (5,) [m]."""
    v = image_rows(view)
    rise = np.minimum(end_uv[:, 1:] - root_uv[1], -np.ptp(root_uv) / 8.0 - 1.0)
    share = np.clip((v - root_uv[1]) / rise, -0.5, 1.5)
    u = root_uv[0] + share * (end_uv[:, :1] - root_uv[0])
    ray = view.optics.ray(np.stack([u, np.broadcast_to(v, u.shape)], axis=-1))
    near, shade = np.zeros(u.shape), np.zeros(u.shape)
    for k in range(points.shape[1] - 1):
        thick = 0.5 * (radius[k] + radius[k + 1])
        distance, cosine = _capsule(ray, points[:, None, k], points[:, None, k + 1], thick)
        with np.errstate(divide="ignore", invalid="ignore"):
            nearer = 1.0 / distance > near
        near = np.where(nearer, 1.0 / np.where(nearer, distance, 1.0), near)
        shade = np.where(nearer, cosine, shade)
    return near * np.sqrt((np.clip(shade, 0.0, 1.0) + SOFT) / (1.0 + SOFT))


def _capsule(ray: Float, a: Float, b: Float, radius: float) -> tuple[Float, Float]:
    """Where unit rays (..., 3) from the origin meet capsules from a to b: distance (...), NaN where they miss.

    The second is the cosine of incidence there.
    """
    axis = b - a
    aa, ad, ao = (axis * axis).sum(-1), (axis * ray).sum(-1), -(axis * a).sum(-1)
    do, oo = -(ray * a).sum(-1), (a * a).sum(-1)
    k2, k1, k0 = aa - ad * ad, aa * do - ao * ad, aa * oo - ao * ao - radius * radius * aa
    with np.errstate(invalid="ignore", divide="ignore"):
        distance: Float = (-k1 - np.sqrt(k1 * k1 - k0 * k2)) / k2
        foot: Float = ao + distance * ad
        for end, beyond in ((a, ~(foot > 0.0)), (b, foot >= aa)):
            near: Float = (ray * end).sum(-1)
            cap: Float = near - np.sqrt(near * near - (end * end).sum(-1) + radius * radius)
            distance = np.where(beyond, cap, distance)
    point: Float = distance[..., None] * ray
    foot = np.clip((axis * (point - a)).sum(-1) / np.maximum(aa, 1e-12), 0.0, 1.0)
    normal = (point - a - foot[..., None] * axis) / radius
    return distance, -(normal * ray).sum(-1)
