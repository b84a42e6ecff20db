"""Results of the camera fits.

Lenses and poses with their uncertainty, or why the views are not enough.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.calibration import Intrinsics, Matrix4
from common.calibration.camera import check_lens
from common.errors import CalibrationError, FitError
from common.geometry.transforms import invert, skew
from master.calibrate.cameras.alone import Rejection
from master.calibrate.cameras.audit import PairAudit, audit_pair, pairs_with_views
from master.calibrate.cameras.bundle import rms
from master.calibrate.cameras.coverage import Coverage, advice, coverage
from master.calibrate.cameras.fit import CamerasFit
from master.calibrate.cameras.held_out import BoardChoice
from master.calibrate.cameras.lens_files import camera_model, intrinsics_of, matrix_of


@dataclass(frozen=True, slots=True, eq=False)
class LensResult:
    """One camera.

    Attributes:
        intrinsics: As written to the file.
        sd: Standard deviations (9,) in the order of `bundle.LENS`; 0: held or left at zero.
        rms_px: Reprojection rms over its accepted images.
        views: Number of accepted images.
        covered: What they cover.
        estimated: False: the lens was given, only used.
    """

    intrinsics: Intrinsics
    sd: Float
    rms_px: float
    views: int
    covered: Coverage
    estimated: bool


@dataclass(frozen=True, slots=True, eq=False)
class CamerasResult:
    """All cameras.

    Attributes:
        lenses: Camera -> its lens.
        T_rig_camera: Camera -> its place, as written to the file; the first camera is the rig's frame.
        place_sd: Camera -> standard deviations of its centre (3,) [m] and turn (3,) [rad].
        baseline_sd_m: Camera -> standard deviation of its distance from the first [m].
        rms_px: Reprojection rms over all accepted images that share their view; one camera: over all.
        board: Whether the board's shape was estimated, and why.
        shape_mm: How far the board's corners are from the drawn ones, in its plane and out of it, root mean square.
        pairs: Audit of each two cameras that share views.
        views: Number of views that cameras share; one camera: of all.
        rejected: What was excluded, and why.
    """

    lenses: Mapping[str, LensResult]
    T_rig_camera: Mapping[str, Matrix4]
    place_sd: Mapping[str, Float]
    baseline_sd_m: Mapping[str, float]
    rms_px: float
    board: BoardChoice
    shape_mm: tuple[float, float]
    pairs: tuple[PairAudit, ...]
    views: int
    rejected: tuple[Rejection, ...]


def result(fit: CamerasFit, held: Mapping[str, Float]) -> CamerasResult:
    """The numbers of a fit.

    Raises:
        FitError: They are not worth writing: a focal length is not determined, a lens barely covered, or it folds.
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
    return LensResult(
        intrinsics=intrinsics_of(lens),
        sd=sd,
        rms_px=error,
        views=len(own),
        covered=covered,
        estimated=estimated,
    )


def _check_determined(camera: str, focal_sd: float, covered: Coverage, views: int) -> None:
    what = ""
    most_focal_sd = 0.01  # of the focal length: one percent of every depth
    least_tilt_deg = 10.0
    least_cover = 0.25
    if covered.tilt_spread_deg < least_tilt_deg or not focal_sd <= most_focal_sd:
        what = (
            f"the focal length is not determined (standard deviation {min(100 * focal_sd, 999):.2g} %, at most"
            f" {100 * most_focal_sd:g} %): the board's tilts lie within {covered.tilt_spread_deg:.0f}° of each other"
        )
    elif covered.share < least_cover:
        what = (
            f"corners cover {100 * covered.share:.0f} % of the image, at least {100 * least_cover:.0f} %"
            " are needed: beyond them the distortion would be a guess"
        )
    if what:
        wish = advice(covered)
        raise FitError(f"camera {camera!r}: {what}, in {views} views{'; ' * bool(wish)}{wish}")


def _centre_sd(fit: CamerasFit, index: int) -> tuple[Float, float]:
    """Return the standard deviations of a camera's position, rotation and distance.

    Centre (3,) [m] and rotation (3,) [rad]; the distance is from the first camera [m].

    The centre is -R' t of T_camera_rig; turning by w on the left and moving by d moves it by -R' (d + t x w).
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
