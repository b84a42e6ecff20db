"""Accuracy of a calibration, measured from the values as written to the files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert, skew
from master.calibrate.cameras.boards import Board, grid_edges


@dataclass(frozen=True, slots=True)
class PairAudit:
    """Two cameras, over all views that both see.

    Attributes:
        first, second: Their names.
        views: Number of views.
        baseline_m: Distance of the optical centres.
        epipolar_rms_px: Distance of undistorted corners from the epipolar lines of the other camera's.
        edge_mean_mm, edge_sd_mm, edge_worst_mm: Sides of squares, triangulated: mean, standard deviation, and the
            largest difference from the drawn side.
        edges: Number of sides.
    """

    first: str
    second: str
    views: int
    baseline_m: float
    epipolar_rms_px: float
    edge_mean_mm: float
    edge_sd_mm: float
    edge_worst_mm: float
    edges: int


def audit_pair(
    board: Board,
    names: tuple[str, str],
    models: tuple[CameraModel, CameraModel],
    views: Sequence[tuple[Float, Float]],
) -> PairAudit:
    """Epipolar error and triangulated squares of two cameras.

    Args:
        board: The board.
        names: Of the cameras.
        models: Of the cameras, as read from their files.
        views: Corners (N, 2) [px] in both, NaN = not seen, at least one view.
    """
    T = invert(models[1].T_rig_camera) @ models[0].T_rig_camera
    essential = skew(T[:3, 3]) @ T[:3, :3]
    focal = float(np.mean([m.matrix[i, i] for m in models for i in (0, 1)]))
    distances: list[Float] = []
    sides: list[Float] = []
    edges = grid_edges(board)
    for uv_a, uv_b in views:
        a, b = models[0].undistort(uv_a), models[1].undistort(uv_b)
        both = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
        distances.append(focal * _epipolar(essential, a[both], b[both]))
        points = np.full((len(a), 3), np.nan)
        points[both] = _triangulate(T, a[both], b[both])
        side = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        sides.append(side[np.isfinite(side)])
    off, side_mm = np.concatenate(distances), 1e3 * np.concatenate(sides)
    return PairAudit(
        first=names[0],
        second=names[1],
        views=len(views),
        baseline_m=float(np.linalg.norm(T[:3, 3])),
        epipolar_rms_px=float(np.sqrt(np.mean(off**2))),
        edge_mean_mm=float(side_mm.mean()) if len(side_mm) else float("nan"),
        edge_sd_mm=float(side_mm.std()) if len(side_mm) else float("nan"),
        edge_worst_mm=float(np.abs(side_mm - 1e3 * board.square_m).max(initial=0.0)),
        edges=len(side_mm),
    )


def _epipolar(essential: Float, a: Float, b: Float) -> Float:
    """Return the distances of normalized points from their epipolar lines.

    Distances (2n,) of points (n, 2) from the lines of their partners, in both images.
    """
    a1, b1 = np.column_stack([a, np.ones(len(a))]), np.column_stack([b, np.ones(len(b))])
    in_b, in_a = a1 @ essential.T, b1 @ essential
    product = (b1 * in_b).sum(axis=1)
    return np.concatenate(
        [product / np.linalg.norm(in_b[:, :2], axis=1), product / np.linalg.norm(in_a[:, :2], axis=1)]
    )


def _triangulate(T_b_a: Float, a: Float, b: Float) -> Float:
    """Points (n, 3) [m] in the first camera's frame of normalized points (n, 2)."""
    homogeneous = cv2.triangulatePoints(np.eye(4)[:3], T_b_a[:3], a.T, b.T)
    points = np.asarray(homogeneous, dtype=np.float64)
    return (points[:3] / points[3]).T


def pairs_with_views(
    shared: Mapping[str, Mapping[str, Float]],
) -> dict[tuple[str, str], list[tuple[Float, Float]]]:
    """Pairs of cameras, with the corners of each place of the board that both see.

    Args:
        shared: Place -> camera -> corners (N, 2) [px].
    """
    pairs: dict[tuple[str, str], list[tuple[Float, Float]]] = {}
    for cameras in shared.values():
        names = list(cameras)
        for i, first in enumerate(names):
            for second in names[i + 1 :]:
                pairs.setdefault((first, second), []).append((cameras[first], cameras[second]))
    return pairs
