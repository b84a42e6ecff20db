"""Shaded image of a hand.

Spheres swept along the bones and the palm, drawn into a depth buffer.

Orthographic view; the view frame is OpenCV's (x right, y down, z away from the eye), pixels follow it.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from common.arrays import Float
from common.hand.model import FINGER_JOINTS, WRIST

Pixels = npt.NDArray[np.float32]

_LIGHT = np.array([-0.45, -0.6, -0.66], np.float32)
_WEBS = ((1, 2), (2, 3), (3, 4))  # neighbouring fingers whose metacarpals the palm spans


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Where the eye stands.

    Attributes:
        rotation: Rig frame -> view frame (3, 3).
        centre_m: Point of the rig frame (3,) [m] that is drawn at the centre of the image.
        scale_px_m: Pixels per metre.
        width_px, height_px: Image size.
    """

    rotation: Float
    centre_m: Float
    scale_px_m: float
    width_px: int
    height_px: int

    def project(self, points_m: Float) -> Float:
        """Project points (..., 3) [m] of the rig frame to pixels and depth [px].

        Returns (..., 3) [px]; NaN stays NaN.
        """
        view = (points_m - self.centre_m) @ self.rotation.T * self.scale_px_m
        return view + np.array([self.width_px / 2, self.height_px / 2, 0.0])


def render_hand(view: View, position_m: Float, radius_m: Float) -> tuple[Pixels, Pixels]:
    """Draw one hand.

    Args:
        view: The eye.
        position_m: Joints (26, 3) [m], rig frame. A bone with a NaN end is not drawn.
        radius_m: (26,) [m].

    Returns:
        Brightness (H, W) in 0..1, and coverage (H, W): 1 on the hand, 0 elsewhere.
    """
    depth = np.full((view.height_px, view.width_px), np.inf, np.float32)
    normal = np.zeros((view.height_px, view.width_px, 3), np.float32)
    for sphere in _spheres(position_m, radius_m):
        _draw_sphere(depth, normal, view.project(sphere[:3]), float(sphere[3]) * view.scale_px_m)
    covered = np.isfinite(depth)
    lambert = np.clip(normal @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    facing = np.clip(-normal[..., 2], 0.0, 1.0)
    brightness = 0.30 + 0.58 * lambert + 0.16 * facing**2
    return np.where(covered, brightness, 0.0).astype(np.float32), covered.astype(np.float32)


def _spheres(position_m: Float, radius_m: Float) -> Float:
    """Centres and radii (N, 4) [m] that fill the hand."""
    joints = np.column_stack([position_m, radius_m])
    wrist_share = 0.75  # a wrist is flat: half its width would make a ball of it
    joints[WRIST, 3] *= wrist_share
    segments = [(joints[a], joints[b]) for chain in FINGER_JOINTS for a, b in pairwise(chain)]
    web_steps = 28
    for left, right in _WEBS:
        a, b = joints[list(FINGER_JOINTS[left][:2])], joints[list(FINGER_JOINTS[right][:2])]
        segments += [tuple((1 - t) * a + t * b) for t in np.linspace(0.0, 1.0, web_steps)[1:-1]]
    # The ball of the thumb spans from the lower part of the thumb's metacarpal to that of the index finger's.
    thumb, index = joints[list(FINGER_JOINTS[0][:2])], joints[list(FINGER_JOINTS[1][:2])]
    thumb, root = (np.stack([bone[0], 0.45 * bone[0] + 0.55 * bone[1]]) for bone in (thumb, index))
    segments += [tuple((1 - t) * thumb + t * root) for t in np.linspace(0.0, 1.0, web_steps)[1:-1]]
    segments += [(joints[WRIST], joints[chain[0]]) for chain in FINGER_JOINTS]
    swept = [_sweep(a, b) for a, b in segments if np.isfinite(a + b).all()]
    return np.concatenate(swept) if swept else np.empty((0, 4))


def _sweep(a: Float, b: Float) -> Float:
    """Spheres (N, 4) from `a` to `b`, radius changing evenly."""
    length = float(np.linalg.norm(b[:3] - a[:3]))
    step = 0.12  # of a radius, between swept spheres: ripples stay far below a pixel
    count = 2 + int(length / (step * max(min(a[3], b[3]), 1e-3)))
    t = np.linspace(0.0, 1.0, count)[:, None]
    return (1 - t) * a + t * b


def _draw_sphere(depth: Pixels, normal: Pixels, centre: Float, radius_px: float) -> None:
    """Put one sphere into depth and normal buffers; parts outside the image are cut."""
    height, width = depth.shape
    u0, u1 = max(int(centre[0] - radius_px), 0), min(int(centre[0] + radius_px) + 2, width)
    v0, v1 = max(int(centre[1] - radius_px), 0), min(int(centre[1] + radius_px) + 2, height)
    if u0 >= u1 or v0 >= v1:
        return
    x = ((np.arange(u0, u1) - centre[0]) / radius_px).astype(np.float32)
    y = ((np.arange(v0, v1) - centre[1]) / radius_px).astype(np.float32)
    towards = 1.0 - x[None, :] ** 2 - y[:, None] ** 2
    z = np.sqrt(np.maximum(towards, 0.0))
    front = np.float32(centre[2]) - z * np.float32(radius_px)
    window = depth[v0:v1, u0:u1]
    nearer = (towards >= 0.0) & (front < window)
    window[nearer] = front[nearer]
    rows, columns = np.nonzero(nearer)
    normal[v0 + rows, u0 + columns] = np.column_stack([x[columns], y[rows], -z[nearer]])
