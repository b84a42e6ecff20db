"""What is true of one triple, under the keys of the rendered recordings (without the curve itself)."""

import numpy as np
import numpy.typing as npt

from bench.wrist_mesh.hand_mesh import HandMesh, Posed
from bench.wrist_mesh.hinges import CHAINS
from bench.wrist_mesh.line import Curve, Fan
from bench.wrist_mesh.raster import Samples
from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel

LEAST_M = 2e-4  # of visible line, for a centroid
GROUPS = ("palm", "thumb", "index", "middle", "ring", "pinky", "thenar")
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
TIP_WITHIN_M = 0.002  # behind what the camera sees: the tip is on the outline


def laser_truth(curve: Curve, fan: Fan, optics: CameraModel) -> dict[str, npt.NDArray[np.generic]]:
    """The line by group (7, …): palm, thumb … little, thenar."""
    out: dict[str, npt.NDArray[np.generic]] = {}
    uv, xyz, point = np.full((7, 2), np.nan), np.full((7, 3), np.nan), np.full((7, 3), np.nan)
    lit_xyz = np.full((7, 3), np.nan)
    vis, lit, by_segment = np.zeros(7), np.zeros(7), np.zeros((7, 4))
    segment = np.full(7, -1)
    group = np.where(curve.label == 10, 6, np.where(curve.label == 255, -1, curve.label // 10))
    middle, between = curve.points.copy(), curve.uv.copy()
    middle[:-1] = 0.5 * (middle[:-1] + middle[1:])
    between[:-1] = 0.5 * (between[:-1] + between[1:])
    in_image = np.zeros(len(curve.chord_m))
    in_image[:-1] = np.linalg.norm(np.diff(curve.uv, axis=0), axis=1)
    for g in range(7):
        own = (group == g) & (curve.chord_m > 0.0)
        lit[g] = curve.chord_m[own].sum()
        if lit[g] > 0.0:
            lit_xyz[g] = np.average(middle[own], axis=0, weights=curve.chord_m[own])
        own &= curve.seen
        vis[g] = curve.chord_m[own].sum()
        by_segment[g] = np.bincount(curve.label[own] % 10, curve.chord_m[own], 4)
        if vis[g] > LEAST_M:
            xyz[g] = np.average(middle[own], axis=0, weights=curve.chord_m[own])
            uv[g] = np.average(between[own], axis=0, weights=in_image[own])
            ray = optics.ray(uv[g])
            point[g] = ray * ((fan.origin @ fan.normal) / (ray @ fan.normal))
            segment[g] = by_segment[g].argmax()
    out |= {"laser_xyz": xyz, "laser_pt": point, "laser_uv": uv, "laser_xyz_lit": lit_xyz}
    return out | {
        "laser_len_vis": vis,
        "laser_len_lit": lit,
        "laser_seg": segment,
        "laser_seg_len": by_segment,
    }


def tip_truth(
    hand_mesh: HandMesh, posed: Posed, optics: CameraModel, samples: Samples, label: npt.NDArray[np.uint8]
) -> dict[str, npt.NDArray[np.generic]]:
    """The tips (5, …), and the nearest visible point of each last segment; `label` (H, W) as in its picture."""
    tip = np.full((5, 3), np.nan)
    uv = np.full((5, 2), np.nan)
    visible: Bool = np.zeros(5, dtype=np.bool_)
    near_uv: Float = np.full((5, 2), np.nan)
    near = np.full((5, 3), np.nan)
    count = np.zeros((5, 4), dtype=np.int64)
    fine = samples.depth.shape[0] // label.shape[0]
    depth = samples.depth[fine // 2 :: fine, fine // 2 :: fine]
    for f, chain in enumerate(CHAINS):
        along = posed.joints[chain[3]] - posed.joints[chain[2]]
        own = np.unique(hand_mesh.faces[hand_mesh.label == 10 * (f + 1) + 3])
        tip[f] = posed.verts[own[(posed.verts[own] @ along).argmax()]]
        uv[f] = optics.project(tip[f])
        u, v = np.rint(np.nan_to_num(uv[f], nan=-9.0)).astype(np.int64)
        if 0 <= u < label.shape[1] and 0 <= v < label.shape[0]:
            visible[f] = bool(label[v, u] == 10 * (f + 1) + 3) and tip[f, 2] < depth[v, u] + TIP_WITHIN_M
        for s in range(4):
            count[f, s] = int((label == 10 * (f + 1) + s).sum())
        rows, columns = np.nonzero(label == 10 * (f + 1) + 3)
        if len(rows):
            rays = optics.undistort(np.stack([columns, rows], axis=1).astype(np.float64))
            far = depth[rows, columns].astype(np.float64)[:, None]
            points = np.concatenate([rays * far, far], axis=1)
            length = np.where(np.isfinite(far[:, 0]), np.linalg.norm(points, axis=1), np.inf)
            best = int(length.argmin())
            near[f], near_uv[f] = points[best], (columns[best], rows[best])
    out: dict[str, npt.NDArray[np.generic]] = {
        "tip_xyz": tip,
        "tip_uv": uv,
        "tip_visible": visible,
        "seg_px": count,
    }
    return out | {"near_uv": near_uv, "near_xyz": near}
