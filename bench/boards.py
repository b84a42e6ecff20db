"""Flat or bent: what a calibration with the board as drawn, with its own shape, or with the one chosen is worth.

Simulated boards have exact truth: errors of focal length and place of the cameras. The real pairs have none, but
for the squares: lenses and places from four fifths of the views triangulate the corners of the last fifth, whose sides
are as long as they were drawn (paper bends, and hardly stretches). Truth is not used by the choice.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.row import Row
from common.arrays import Float
from common.geometry.transforms import invert
from master.calibrate.cameras.audit import audit_pair, pairs_with_views
from master.calibrate.cameras.boards import Board, Charuco, Checkerboard
from master.calibrate.cameras.fit import CamerasFit, fit_cameras
from master.calibrate.cameras.image_sets import image_sets
from master.calibrate.cameras.lens_files import camera_model, intrinsics_of, matrix_of
from master.calibrate.cameras.views import BoardViews, look
from tests.master.calibrate.cameras.board_scenes import Scene, scene

ROOT = Path(__file__).resolve().parents[1]
_PAIRS = Path(os.environ.get("PHALANX_DATASETS", ROOT / "../shared/datasets")).resolve() / "opencv_stereo"
_PARTS = 5
_SEEDS = range(100, 106)
_KINDS: tuple[tuple[str, bool | None], ...] = (("flat", False), ("bent", True), ("chosen", None))
_SCENES: tuple[tuple[str, Board, float, float, int], ...] = (
    # name, board, shape [mm rms], noise [px], views
    ("9x6 bent by 0.3 mm, 0.1 px", Checkerboard(9, 6, 0.025), 0.3, 0.1, 18),
    ("9x6 flat, 0.1 px", Checkerboard(9, 6, 0.025), 0.0, 0.1, 18),
    ("4x5 ChArUco flat, 1 px", Charuco(4, 5, 0.054, 0.0405), 0.0, 1.0, 30),
)


def rows() -> Iterator[Row]:
    """Simulated boards, then the real pairs."""
    for name, board, shape_mm, noise_px, views in _SCENES:
        errors: dict[str, list[tuple[float, float]]] = {kind: [] for kind, _ in _KINDS}
        bent = 0
        for seed in _SEEDS:
            truth = scene(seed, 2, views, board, shape_mm=shape_mm)
            seen = truth.views(noise_px, seed)
            for kind, option in _KINDS:
                fit = fit_cameras(seen, bent=option)
                errors[kind].append(_errors(fit, truth))
                bent += option is None and fit.board.bent
        yield Row(f"{name}: taken as bent", bent, "", f"of {len(_SEEDS)}")
        for kind, found in errors.items():
            focal, place = np.median(found, axis=0)
            yield Row(
                f"{name}: {kind}, place of the second camera",
                place,
                "mm",
                f"median; focal length {focal:.2f} px",
            )
    if not _PAIRS.is_dir():
        yield Row("opencv_stereo", float("nan"), "", f"not measured: no pictures at {_PAIRS}")
        return
    pairs = look(Checkerboard(9, 6, 0.025), image_sets(_PAIRS))
    choice = fit_cameras(pairs).board
    yield Row("opencv_stereo: held-out corners, flat", choice.flat_px, "px", f"{choice.views} views")
    note = f"taken: {'bent' if choice.bent else 'flat'}"
    yield Row("opencv_stereo: held-out corners, bent", choice.bent_px, "px", note)
    for kind, option in _KINDS:
        focal = fit_cameras(pairs, bent=option).solution.bundle.lenses[0, 0]
        yield Row(f"opencv_stereo: {kind}, focal length", focal, "px", "published 535.9")
        yield Row(
            f"opencv_stereo: {kind}, sides in views left out", sides_mm(pairs, option), "mm", "rms off 25 mm"
        )


def sides_mm(views: BoardViews, bent: bool | None) -> float:
    """Rms error [mm] of triangulated sides of squares, by lenses and places from the other views, in turn."""
    square: list[Float] = []
    for k in range(_PARTS):
        training = tuple(view for i, view in enumerate(views.views) if i % _PARTS != k)
        fit = fit_cameras(replace(views, views=training), bent=bent)
        for audit in _audits(fit, replace(views, views=views.views[k::_PARTS])):
            error = (audit[0] - 1e3 * views.board.square_m) ** 2 + audit[1] ** 2
            square.append(np.full(audit[2], error))
    return float(np.sqrt(np.concatenate(square).mean()))


def _audits(fit: CamerasFit, views: BoardViews) -> Iterator[tuple[float, float, int]]:
    """Mean, standard deviation [mm] and number of the sides that each two cameras triangulate in other views."""
    bundle, names = fit.solution.bundle, fit.views.cameras
    models = {
        name: camera_model(
            intrinsics_of(bundle.lenses[i]), views.sizes_px[name], matrix_of(invert(bundle.T_camera_rig[i]))
        )
        for i, name in enumerate(names)
    }
    corners = {view.name: {c: s.corners_px for c, s in view.observations.items()} for view in views.views}
    for pair, seen in pairs_with_views(corners).items():
        audit = audit_pair(views.board, pair, (models[pair[0]], models[pair[1]]), seen)
        if audit.edges:
            yield audit.edge_mean_mm, audit.edge_sd_mm, audit.edges


def _errors(fit: CamerasFit, truth: Scene) -> tuple[float, float]:
    """Worst focal length [px], and distance of the second camera from where it is [mm]."""
    bundle, names = fit.solution.bundle, fit.views.cameras
    focal = max(abs(bundle.lenses[i, 0] - truth.lenses[name][0]) for i, name in enumerate(names))
    off = invert(bundle.T_camera_rig[1]) - invert(truth.T_camera_rig[names[1]])
    return float(focal), 1e3 * float(np.linalg.norm(off[:3, 3]))
