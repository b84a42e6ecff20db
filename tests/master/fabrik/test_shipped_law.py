"""The law of depth of the shipped pair against the geometry of its cameras, through the line's own triangulation."""

from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from master.estimator.sensors import CameraArrays
from master.fabrik.caps import CapTables
from master.fabrik.depth import CalibrationResidual, depth_law, law_residual
from master.fabrik.intersection import limits_of, triangulate
from master.fabrik.settings import RAYS
from master.fabrik.triangulate import DepthTriangulator, disparity_tables
from master.rig.setup import RigSetup, load_setup

SHIPPED = ("desk", "desk-fabrik", "desk-back3", "desk-cube", "desk-tracker", "desk-wand")


@pytest.mark.parametrize("name", SHIPPED)
def test_law_and_places_agree_as_the_estimator_asks(name: str, root: Path) -> None:
    setup = load_setup(root / "calib_json", name)
    cameras = tuple(setup.models.values())
    law = depth_law(setup.rig, cameras)
    assert law is not None
    assert law_residual(law, cameras, setup.rig.volume)[0] < 0.02


@pytest.mark.parametrize("sigma_px", [0.0, 0.1])
def test_depth_by_the_law_is_that_of_both_rays_within_3_mm_in_the_volume(sigma_px: float, root: Path) -> None:
    setup = load_setup(root / "calib_json", "desk")
    points, uv = _seen(setup, np.random.default_rng(3), sigma_px)
    by_law = _by_law(setup, uv)
    by_rays = triangulate(CameraArrays.of(list(setup.models.values())), uv).points_m
    off_m = (by_law - by_rays)[:, 2]  # the frame is the left camera's
    assert len(points) > 500
    assert np.isfinite(off_m).all()
    assert np.abs(off_m).mean() < 3e-3
    assert np.abs(off_m).max() < 5e-3


def _seen(setup: RigSetup, rng: np.random.Generator, sigma_px: float) -> tuple[Float, Float]:
    """Random points (N, 3) [m] of the volume that both cameras see, and where (2, N, 2) [px]."""
    assert setup.rig.volume is not None
    points = rng.uniform(setup.rig.volume.low_m, setup.rig.volume.high_m, (1200, 3))
    cameras = list(setup.models.values())
    uv = np.stack([camera.project(points) for camera in cameras])
    size = np.array([cameras[0].width_px, cameras[0].height_px]) - 1.0
    inside = ((uv > 0.0) & (uv < size)).all(axis=(0, 2))
    uv = uv[:, inside]
    return points[inside], uv + sigma_px * rng.standard_normal(uv.shape)


def _by_law(setup: RigSetup, uv: Float) -> Float:
    """Points (N, 3) [m], as many at once as the rig has markers, of no known direction."""
    rig, cameras = setup.rig, tuple(setup.models.values())
    law = depth_law(rig, cameras)
    assert law is not None
    tables = disparity_tables(
        cameras, law, CalibrationResidual.of(rig).law, float(2.0**0.5 * RAYS.rig_px), float(limits_of(2)[2])
    )
    by_depth, most = DepthTriangulator(tables, CapTables.of(setup.hand, rig.markers)), len(rig.markers)
    parts: list[Float] = []
    for start in range(0, uv.shape[1], most):
        part = np.ascontiguousarray(uv[:, start : start + most])
        sigma_px = np.full(part.shape[:2], 0.1)
        parts.append(
            by_depth(part, sigma_px, np.full(part.shape[:2], np.nan), None, 0.0, as_seen=True).points_m
        )
    return np.concatenate(parts)
