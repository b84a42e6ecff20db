"""A result holds lenses and poses, their audited accuracy, and the report.

The audit measures accuracy from the values as they are written to the files.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

import cv2
import numpy as np

from common.arrays import Float
from common.calibration import Intrinsics, Matrix4
from common.calibration.camera import check_lens
from common.errors import CalibrationError, FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert, skew
from master.calibrate.cameras.boards import Board, grid_edges
from master.calibrate.cameras.bundle import LENS, rms
from master.calibrate.cameras.coverage import Coverage, advice, coverage
from master.calibrate.cameras.fit import CamerasFit
from master.calibrate.cameras.outliers import BoardChoice, Rejection
from master.calibrate.tree_files import camera_model, intrinsics_of, lens_of, matrix_of


@dataclass(frozen=True, slots=True)
class PairAudit:
    """Two cameras, over all views that both see."""

    first: str
    second: str
    views: int
    baseline_m: float  # distance of the optical centres
    epipolar_rms_px: float  # distance of undistorted corners from the epipolar lines of the other camera's
    # this, edge_sd_mm and edge_worst_mm: triangulated sides of squares: mean, standard deviation, and
    # largest difference from the drawn side
    edge_mean_mm: float
    edge_sd_mm: float
    edge_worst_mm: float
    edges: int  # number of sides


def audit_pair(
    board: Board,
    names: tuple[str, str],
    models: tuple[CameraModel, CameraModel],
    views: Sequence[tuple[Float, Float]],
) -> PairAudit:
    """Epipolar error and triangulated squares of two cameras as written to files.

    `views`: Corners (N, 2) [px] in both, NaN = not seen, at least one view.
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
    """Distances (2n,) of normalized points (n, 2) from epipolar lines, both ways."""
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
    """Pairs of cameras, with the corners of each board place that both see.

    `shared`: Place -> camera -> corners (N, 2) [px].
    """
    pairs: dict[tuple[str, str], list[tuple[Float, Float]]] = {}
    for cameras in shared.values():
        names = list(cameras)
        for i, first in enumerate(names):
            for second in names[i + 1 :]:
                pairs.setdefault((first, second), []).append((cameras[first], cameras[second]))
    return pairs


@dataclass(frozen=True, slots=True, eq=False)
class LensResult:
    """One camera."""

    intrinsics: Intrinsics  # as written to the file
    sd: Float  # standard deviations (9,) in the order of `bundle.LENS`; 0: held or left at zero
    rms_px: float  # reprojection rms over its accepted images
    views: int  # number of accepted images
    covered: Coverage
    estimated: bool  # False: the lens was given, only used


@dataclass(frozen=True, slots=True, eq=False)
class CamerasResult:
    """All cameras."""

    lenses: Mapping[str, LensResult]
    # camera -> its pose, as written to the file; the first camera is the rig's frame
    T_rig_camera: Mapping[str, Matrix4]
    # camera -> standard deviations of its centre (3,) [m] and rotation (3,) [rad]
    place_sd: Mapping[str, Float]
    baseline_sd_m: Mapping[str, float]  # camera -> standard deviation of its distance from the first [m]
    rms_px: float  # reprojection rms over all accepted images that share their view; one camera: over all
    board: BoardChoice  # whether the board's shape was estimated, and why
    # rms offset of the board's corners from the drawn ones, in its plane and out of it
    shape_mm: tuple[float, float]
    pairs: tuple[PairAudit, ...]
    views: int  # number of views that cameras share; one camera: of all
    rejected: tuple[Rejection, ...]  # what was excluded, and why
    # camera -> lag of its times against the first camera's and its standard deviation [s]; empty: no times
    delay_s: Mapping[str, tuple[float, float]]


def result(fit: CamerasFit, held: Mapping[str, Float]) -> CamerasResult:
    """The numbers of a fit.

    Raises:
        FitError: A focal length is not determined, or a lens folds.
    """
    names = fit.views.cameras
    bundle = fit.solution.bundle
    lenses = {name: _lens(fit, index, name not in held) for index, name in enumerate(names)}
    places = {name: matrix_of(invert(bundle.T_camera_rig[i])) for i, name in enumerate(names)}
    models = {
        name: camera_model(lenses[name].intrinsics, fit.views.sizes_px[name], places[name]) for name in names
    }
    shared: dict[str, dict[str, Float]] = {}
    for i in fit.shared():
        corners = np.full((len(bundle.drawn_m), 2), np.nan)
        corners[fit.observations[i].corners] = fit.observations[i].uv
        shared.setdefault(fit.shots[i].place, {})[fit.shots[i].camera] = corners
    pairs = tuple(
        audit_pair(fit.views.board, pair, (models[pair[0]], models[pair[1]]), views)
        for pair, views in pairs_with_views(shared).items()
    )
    used = fit.shared() if len(names) > 1 else range(len(fit.shots))
    shape = 1e3 * bundle.shape_m
    centres = {name: _centre_sd(fit, i) for i, name in enumerate(names)}
    return CamerasResult(
        lenses=lenses,
        T_rig_camera=places,
        place_sd={name: sd for name, (sd, _) in centres.items()},
        baseline_sd_m={name: sd for name, (_, sd) in centres.items()},
        rms_px=rms([fit.solution.residuals[i] for i in used]),
        board=fit.board,
        shape_mm=(
            float(np.sqrt((shape[:, :2] ** 2).sum(axis=1).mean())),
            float(np.sqrt((shape[:, 2] ** 2).mean())),
        ),
        pairs=pairs,
        views=len(shared) if len(names) > 1 else len(fit.shots),
        rejected=fit.rejected,
        delay_s={
            name: (fit.delay_s[name], fit.solution.delay_sd(i))
            for i, name in enumerate(names)
            if i and fit.delay_s
        },
    )


def _lens(fit: CamerasFit, index: int, estimated: bool) -> LensResult:
    name = fit.views.cameras[index]
    bundle, own = fit.solution.bundle, fit.of(name)
    T_camera_board = np.stack(
        [bundle.T_camera_rig[index] @ bundle.T_rig_board[fit.observations[i].view] for i in own]
    )
    uv = [fit.observations[i].uv for i in own]
    covered = coverage(fit.views.sizes_px[name], uv, T_camera_board, bundle.drawn_m.mean(axis=0))
    lens, sd = bundle.lenses[index], fit.solution.lens_sd(index)
    error = rms([fit.solution.residuals[i] for i in own])
    most_rms = 0.0025  # of the image's width: five times what poor pictures of a good board leave
    if error > most_rms * fit.views.sizes_px[name][0]:
        raise FitError(
            f"camera {name!r}: corners are off by {error:.2f} px rms over {len(own)} images: they do not agree on any"
            " place of the board; is it rigid and flat, are columns and rows right, did the zoom or focus change?"
        )
    if estimated:
        _check_determined(name, float(sd[0] / lens[0]), covered, len(own))
    try:
        check_lens(intrinsics_of(lens), fit.views.sizes_px[name], f"camera {name!r}: the fit cannot be used")
    except CalibrationError as error:
        raise FitError(str(error)) from error
    return LensResult(intrinsics_of(lens), sd, error, len(own), covered, estimated)


_MOST_FOCAL_SD, _GOOD_FOCAL_SD = 0.03, 0.01  # of the focal length, and so of every depth


def _check_determined(camera: str, focal_sd: float, covered: Coverage, views: int) -> None:
    least_tilt_deg = 10.0
    if covered.tilt_spread_deg < least_tilt_deg or not focal_sd <= _MOST_FOCAL_SD:
        advised = advice(covered)
        raise FitError(
            f"camera {camera!r}: the focal length is not determined (standard deviation"
            f" {min(100 * focal_sd, 999):.2g} %, at most {100 * _MOST_FOCAL_SD:g} %): the board's tilts lie within"
            f" {covered.tilt_spread_deg:.0f}° of each other, in {views} views{'; ' * bool(advised)}{advised}"
        )


def _centre_sd(fit: CamerasFit, index: int) -> tuple[Float, float]:
    """Standard deviations (6,) [m, rad] of centre and rotation, and of baseline [m].

    The centre is -R' t of T_camera_rig; rotation by w on the left and shift by d move it by -R' (d + t x w).
    """
    bundle = fit.solution.bundle
    rotation, t = bundle.T_camera_rig[index][:3, :3], bundle.T_camera_rig[index][:3, 3]
    at = 9 * len(bundle.lenses) + 6 * index
    covariance = fit.solution.covariance[at : at + 6, at : at + 6]
    by_step = -rotation.T @ np.concatenate([skew(t), np.eye(3)], axis=1)
    centre = by_step @ covariance @ by_step.T
    sd = np.sqrt(np.concatenate([np.diag(centre), np.diag(covariance)[:3]]))
    length = float(np.linalg.norm(t))
    if length == 0.0:
        return sd, 0.0
    way = -rotation.T @ t / length
    return sd, float(np.sqrt(way @ centre @ way))


def report_lines(result: CamerasResult) -> Iterator[str]:
    """The table, line by line."""
    for name, lens in result.lenses.items():
        yield from _lens_lines(name, lens)
    for name, pair_sd in result.baseline_sd_m.items():
        if pair_sd > 0.0:
            centre, rotation = result.place_sd[name][:3] * 1e3, result.place_sd[name][3:] * 57.2958
            yield (
                f"{name}: place known to {centre[0]:.3f} {centre[1]:.3f} {centre[2]:.3f} mm,"
                f" {rotation[0]:.4f} {rotation[1]:.4f} {rotation[2]:.4f}° (standard deviations)"
            )
    for pair in result.pairs:
        sd = result.baseline_sd_m[pair.second] if pair.first == next(iter(result.lenses)) else 0.0
        known = f" ± {1e3 * sd:.3f}" if sd > 0.0 else ""
        yield (
            f"{pair.first} - {pair.second}: {pair.views} views, baseline {1e3 * pair.baseline_m:.3f}{known} mm,"
            f" epipolar rms {pair.epipolar_rms_px:.3f} px"
        )
        yield (
            f"  squares triangulated from the written values: {pair.edge_mean_mm:.3f} ± {pair.edge_sd_mm:.3f} mm"
            f" (mean, standard deviation of {pair.edges} sides; worst off by {pair.edge_worst_mm:.2f} mm)"
        )
    for name, (delay_s, sd_s) in result.delay_s.items():
        late = "after" if delay_s > 0.0 else "before"
        yield (
            f"{name}: its times are {1e3 * abs(delay_s):.1f} ± {1e3 * sd_s:.1f} ms {late} its exposures, counted from"
            f" those of {next(iter(result.lenses))}: taken into account"
        )
    what = "stereo rms" if len(result.lenses) > 1 else "rms"
    yield f"{what} {result.rms_px:.3f} px over {result.views} views"
    yield _board_line(result)
    yield "nothing was left out" if not result.rejected else f"left out ({len(result.rejected)}):"
    for no in result.rejected:
        yield f"  {no}"


def _board_line(result: CamerasResult) -> str:
    board, (along, out) = result.board, result.shape_mm
    taken = (
        f"corners {along:.2f} mm in its plane and {out:.2f} mm out of it from where they are drawn (rms)"
        if board.bent
        else "taken as drawn, flat"
    )
    if board.reason:
        return f"board: {taken}: {board.reason}"
    return (
        f"board: {taken}: in {board.views} views held out of the fit, corners are {board.flat_px:.3f} px off where a"
        f" flat board predicts them and {board.bent_px:.3f} px with a shape of its own"
        f"{'' if board.bent or board.bent_px >= board.flat_px else ', which is not certainly less'}"
    )


def _lens_lines(name: str, lens: LensResult) -> Iterator[str]:
    values = lens_of(lens.intrinsics)
    kind = "" if lens.estimated else " (held)"
    yield f"{name}: {lens.views} images, rms {lens.rms_px:.3f} px{kind}"
    yield "  " + "  ".join(
        f"{term.removesuffix('_px')} {value:.2f}" + (f" ± {sd:.2f}" if sd > 0 else "")
        for term, value, sd in zip(LENS[:4], values[:4], lens.sd[:4], strict=True)
    )
    yield "  " + "  ".join(
        f"{term} {value:.4f} ± {sd:.4f}" if sd > 0 else f"{term} {value:g}"
        for term, value, sd in zip(LENS[4:], values[4:], lens.sd[4:], strict=True)
    )
    covered = lens.covered
    yield (
        f"  seen: {100 * covered.share:.0f} % of the image, tilts to {covered.tilt_deg.max():.0f}°"
        f" ({covered.tilt_spread_deg:.0f}° apart), {covered.distance_m.min():.2f} to"
        f" {covered.distance_m.max():.2f} m"
    )
    for row in covered.cells:
        yield "    " + "".join("#" if cell else "." for cell in row)
    little = 0.25  # of the image
    if lens.estimated and covered.share < little:
        yield "  beyond these corners the distortion is that of an ordinary lens, no surer than its ± says"
    if lens.estimated and lens.sd[0] > _GOOD_FOCAL_SD * values[0]:
        yield f"  the focal length is known to {100 * lens.sd[0] / values[0]:.1f} % only, and so is every depth"
    if advised := advice(covered):
        yield f"  it would gain most if you {advised}"


def report_json(result: CamerasResult) -> dict[str, object]:
    """The numbers; lengths in the unit of their key."""
    return {
        "rms_px": result.rms_px,
        "views": result.views,
        "cameras": {name: _lens_json(lens) for name, lens in result.lenses.items()},
        "T_first_camera": {name: [list(row) for row in place] for name, place in result.T_rig_camera.items()},
        "place_sd": {
            name: {"centre_m": sd[:3].tolist(), "rotation_rad": sd[3:].tolist()}
            for name, sd in result.place_sd.items()
        },
        "delay_s": {name: {"delay_s": delay, "sd_s": sd} for name, (delay, sd) in result.delay_s.items()},
        "pairs": [_pair_json(pair) for pair in result.pairs],
        "board": _board_json(result),
        "rejected": [{"view": no.view, "camera": no.camera, "reason": no.reason} for no in result.rejected],
    }


def _pair_json(pair: PairAudit) -> dict[str, object]:
    numbers: dict[str, object] = asdict(pair)
    return {"cameras": [numbers.pop("first"), numbers.pop("second")]} | numbers


def _board_json(result: CamerasResult) -> dict[str, object]:
    board, (along, out) = result.board, result.shape_mm
    compared: dict[str, object] = {"reason": board.reason}
    if not board.reason:
        compared = {"flat_px": board.flat_px, "bent_px": board.bent_px, "views_held_out": board.views}
    return {"bent": board.bent, "shape_rms_mm": {"in_plane": along, "out_of_plane": out}} | compared


def _lens_json(lens: LensResult) -> dict[str, object]:
    covered = lens.covered
    return {
        "views": lens.views,
        "rms_px": lens.rms_px,
        "estimated": lens.estimated,
        "values": dict(zip(LENS, lens_of(lens.intrinsics).tolist(), strict=True)),
        "sd": dict(zip(LENS, lens.sd.tolist(), strict=True)),
        "coverage": {
            "share": covered.share,
            "cells": covered.cells.astype(int).tolist(),
            "tilt_deg": covered.tilt_deg.tolist(),
            "tilt_spread_deg": covered.tilt_spread_deg,
            "distance_m": covered.distance_m.tolist(),
            "advice": advice(covered),
        },
    }
