"""`phalanx calibrate wrist laser-plane`: the laser plane in the camera frame.

Every view of a board that the laser crosses gives one straight line in space (`laser_line`); its distance from a
plane is two numbers (two points of it with the spread of all its points). Their covariance is that of the board's
pose, which all points of a view share, and of the line's place in the image; so a thousand points of one view do
not count as a thousand. A plane is constrained by lines that are not all the same one; the covariance states how
well, and what is not known to a tenth of a degree and of a millimetre is refused.
"""

from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import replace as replaced
from functools import partial
from itertools import combinations

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.calibration.rig import LASER_ACROSS, LaserPlane
from common.command_line import UsageError, echo
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross
from common.recording.frame_recording import Illumination
from master.calibrate.adjust import Normal, minimise
from master.calibrate.cameras.boards import Board, board_in
from master.calibrate.picture import draw_cloud, draw_plane
from master.calibrate.report import Write, finish
from master.calibrate.tree_files import refusals_named
from master.calibrate.wrist.device import (
    BoardPose,
    Device,
    LitView,
    board_corners_of,
    board_in_views,
    device_of,
    grouped_by_reason,
    lit_views,
    of_views,
    place_corners,
    writes_key,
)
from master.calibrate.wrist.laser_line import BoardLine, line_on_board

NORMAL_LIMIT_RAD, _OFFSET_LIMIT_M = np.radians(0.1), 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class ViewLine:
    """One view's line in space."""

    name: str
    points_m: Float  # (n, 3) [m], camera frame
    ends_m: Float  # (2, 3) two points of the line with the mean and the spread of all
    placed: BoardPose  # the board it lies on
    sigma_px: float  # standard deviation of the line's place in the image
    focal_px: float

    @classmethod
    def of(cls, name: str, line: BoardLine, placed: BoardPose, focal_px: float) -> "ViewLine":
        """Reduce a line to two points."""
        return cls(name, line.points_m, two_points(line.points_m), placed, line.sigma_px, focal_px)

    def covariance(self, normal: Float) -> Float:
        """(2, 2) [m^2] of the distances of both ends from a plane with this normal.

        A board that turns or shifts moves a point along its ray, with b its normal and d = X - centre:
        X' = X (1 + (b . shift + turn . (d x b)) / b . X).
        """
        facing = self.placed.T_camera_board[:3, 2]
        d = self.ends_m - self.placed.centre_m
        share = (self.ends_m @ normal) / (self.ends_m @ facing)
        board = np.broadcast_to(facing, d.shape)
        by_pose = share[:, None] * np.concatenate([cross(d, board), board], axis=1)
        own = self.sigma_px * self.ends_m[:, 2] / self.focal_px
        model_m = 1e-5  # what lens and paper add to every view that neither covariance knows
        return by_pose @ self.placed.covariance @ by_pose.T + np.diag(own**2 + model_m**2)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneFit:
    """A measured laser plane."""

    plane: LaserPlane  # normal . X = offset, offset positive
    covariance: Float  # (4, 4) of normal and offset [m]; of the normal only across itself
    rms_m: float  # distance of the used points from the plane
    used: Bool  # (views,) the views it is from
    off_m: Float  # (views,) rms distance of each view's points

    @property
    def normal_sigma_rad(self) -> float:
        """Largest standard deviation of the normal [rad], in its least certain direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def offset_sigma_m(self) -> float:
        """Standard deviation of the offset [m]."""
        return float(np.sqrt(self.covariance[3, 3]))


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """V straight lines in space, each by two points with mean and spread of its own."""

    ends_m: Float  # (V, 2, 3)
    points_m: tuple[Float, ...]  # V times (n, 3)
    covariance: Callable[
        [Float], Float
    ]  # (V, 2, 2) [m^2] of the distances of `ends_m` from a plane, by its normal
    off_m: float = 0.0  # what is less off than this is not wrong, however sure it claims to be
    dof: float = 2.0  # numbers that a line measures; 1 for single points

    def chi2(self, normal: Float, offset: float) -> Float:
        """(V,) of the distances from a plane."""
        off = self.ends_m @ normal - offset
        return np.vecdot(off, np.linalg.solve(self.covariance(normal), off[..., None])[..., 0])

    def off(self, normal: Float, offset: float) -> Float:
        """(V,) rms distances [m] of the points."""
        return np.sqrt(((self.ends_m @ normal - offset) ** 2).mean(axis=1))

    def agreeing(self, normal: Float, offset: float) -> Bool:
        """Which lines (V,) agree with a plane.

        The covariances may be small by a common factor: a wrong line is one whose residual is larger than most.
        """
        chi2, (middle, wrong) = self.chi2(normal, offset), _CHI2[self.dof]
        times = max(1.0, float(np.median(chi2)) / middle)
        return (chi2 < wrong * times) | (self.off(normal, offset) < self.off_m)


_CHI2 = {2.0: (1.386, 22.0), 1.0: (0.455, 18.5)}
"""By degrees of freedom: the median, and what one in 60 000 exceeds."""


def two_points(points_m: Float) -> Float:
    """Two points (2, 3) with the mean and the spread of a line's points (n, 3)."""
    mean = points_m.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points_m - mean, full_matrices=False)
    spread = sizes[0] / np.sqrt(len(points_m)) * axes[0]
    return np.stack([mean - spread, mean + spread])


def fit_plane(views: Sequence[ViewLine]) -> PlaneFit:
    """The plane through the lines of at least three views.

    Raises:
        FitError: Too few views, too few agree, or their lines constrain no plane, or too weakly; the text
            states what to do.
    """
    min_views = 3
    if len(views) < min_views:
        raise FitError(
            f"the line is seen on the board in {len(views)} views, at least {min_views} are needed (better 10), each"
            " with the board at another distance and tilt"
        )
    lines = Lines(
        np.stack([view.ends_m for view in views]),
        tuple(view.points_m for view in views),
        lambda normal: np.stack([view.covariance(normal) for view in views]),
        off_m=1.5e-4,
    )
    fit = settled(lines, consensus(lines), max(min_views, (len(views) + 1) // 2))
    if fit is None:
        used = int(lines.agreeing(*consensus(lines)).sum())
        raise FitError(
            f"only {used} of {len(views)} views agree on one plane: is the laser fixed to the camera,"
            " and the board flat? Views with the line on something else than the board must be taken anew"
        )
    _refuse_unsure(
        fit, np.concatenate([one for one, own in zip(lines.points_m, fit.used, strict=True) if own])
    )
    return fit


def settled(lines: Lines, plane: tuple[Float, float], fewest: int) -> PlaneFit | None:
    """Least squares over lines that agree with a first plane; None: too few."""
    (normal, offset), cov = plane, np.eye(4)
    used = np.zeros(len(lines.ends_m), dtype=np.bool_)
    for _ in range(6):
        good = lines.agreeing(normal, offset)
        if (good == used).all():
            break
        used = good
        if used.sum() < fewest:
            return None
        normal, offset, cov = _least_squares(lines, used, normal)
    return _fit_of(lines, used, normal, offset, cov)


def over_all(lines: Lines) -> PlaneFit:
    """Least squares over all lines."""
    used = np.ones(len(lines.ends_m), dtype=np.bool_)
    return _fit_of(lines, used, *_least_squares(lines, used, _through(lines.ends_m.reshape(-1, 3))[0]))


def _fit_of(lines: Lines, used: Bool, normal: Float, offset: float, cov: Float) -> PlaneFit:
    reduced = float(lines.chi2(normal, offset)[used].sum()) / max(lines.dof * float(used.sum()) - 3.0, 1.0)
    off = lines.off(normal, offset)
    count = np.array([len(one) for one in lines.points_m])
    rms = float(np.sqrt((count * off**2)[used].sum() / count[used].sum()))
    x, y, z = normal.round(9).tolist()
    plane = LaserPlane(normal=(x, y, z), offset_m=round(float(offset), 9))
    return PlaneFit(plane, cov * max(1.0, reduced), rms, used, off)


def consensus(lines: Lines, *, known_sigma: bool = True) -> tuple[Float, float]:
    """Normal and offset of the plane through a few lines that most others agree with.

    Where the lines' sigma is not known, the one of the least median of squares (Rousseeuw 1984).
    """
    few = 2 if lines.dof > 1.0 else 3  # lines, or points, that make a plane
    count, most = len(lines.ends_m), 300
    rng = np.random.default_rng(0)
    if few == 2 and count * (count - 1) // 2 <= 10 * most:
        chosen = np.array(list(combinations(range(count), 2)))
        chosen = chosen[rng.choice(len(chosen), most, replace=False)] if len(chosen) > most else chosen
    else:
        chosen = rng.integers(0, count, (most, few))
    best, cost = (np.array([0.0, 1.0, 0.0]), 0.0), np.inf
    wrong = _CHI2[lines.dof][1]
    for some in chosen:
        normal, offset = _through(lines.ends_m[some].reshape(-1, 3))
        chi2 = lines.chi2(normal, offset)
        own = float(np.minimum(chi2, wrong).sum() if known_sigma else np.median(chi2))
        if own < cost:
            best, cost = (normal, offset), own
    return best


def _through(points: Float) -> tuple[Float, float]:
    """Plane of least squares through points (n, 3); offset positive."""
    mean = points.mean(axis=0)
    normal = np.linalg.svd(points - mean, full_matrices=False)[2][-1]
    normal = normal * (1.0 if normal @ mean >= 0 else -1.0)
    return normal, float(normal @ mean)


def _least_squares(lines: Lines, used: Bool, normal: Float) -> tuple[Float, float, Float]:
    """Normal, offset, covariance (4, 4), from a first normal."""
    middle = lines.ends_m[used].reshape(-1, 3).mean(axis=0)
    arm = lines.ends_m[used] - middle

    def equations(plane: Float) -> Normal:
        """Of a plane: normal, distance from the middle."""
        out, normal = Normal(3), plane[:3]
        whiten = np.linalg.inv(np.linalg.cholesky(lines.covariance(normal)[used]))
        by = np.concatenate([arm @ _tangents(normal), -np.ones((*arm.shape[:2], 1))], axis=2)
        out.add((whiten @ (arm @ normal - plane[3])[..., None])[..., 0], whiten @ by)
        return out

    # By turn of the normal and distance from the middle, which hardly depend on each other.
    found = minimise(equations, _stepped, np.append(normal, 0.0), steps=20)
    normal, tangents = found.x[:3], _tangents(found.x[:3])
    offset = float(normal @ middle + found.x[3])
    to4 = np.zeros((4, 3))
    to4[:3, :2] = tangents
    to4[3] = np.append(middle @ tangents, 1.0)
    sign = -1.0 if offset < 0.0 else 1.0
    return sign * normal, sign * offset, to4 @ found.normal.covariance() @ to4.T


def _stepped(plane: Float, step: Float, _own: Float) -> Float:
    normal = plane[:3] + _tangents(plane[:3]) @ step[:2]
    return np.append(normal / np.linalg.norm(normal), plane[3] + step[2])


def _tangents(normal: Float) -> Float:
    """Two directions (3, 2) in a plane."""
    return np.linalg.svd(normal[None])[2][1:].T


def _refuse_unsure(fit: PlaneFit, points: Float) -> None:
    """Refuse points on one line, and a plane that is too uncertain."""
    # Of a plane that is measured far away less is known at the camera, and no more is needed.
    limit_m = max(_OFFSET_LIMIT_M, 5e-4 * float(points[:, 2].mean()))
    if fit.normal_sigma_rad <= NORMAL_LIMIT_RAD and fit.offset_sigma_m <= limit_m:
        return
    wide = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if wide[1] < max(5.0 * fit.rms_m, 0.1 * wide[0]):
        raise FitError(
            f"all points of the laser lie on one line (they spread {1e3 * wide[1]:.1f} mm across it): they define no"
            " plane; hold the board at other distances too, and turn it, so that the line falls elsewhere"
        )
    raise FitError(
        f"the plane is known to {np.degrees(fit.normal_sigma_rad):.2f} deg and {1e3 * fit.offset_sigma_m:.2f} mm only"
        f" (limits {np.degrees(NORMAL_LIMIT_RAD):.1f} deg, {1e3 * limit_m:.1f} mm): show the board in more"
        " views, nearer and farther, so large that it fills a third of the image"
    )


def laser_plane(options: Namespace) -> None:
    """Measure the plane of a wrist device's laser, from views of a board or a cloud."""
    if options.source.is_file():
        _of_cloud(options)
        return
    if options.board is None or options.square_mm is None:
        raise UsageError("of pictures: give --board COLUMNSxROWS and --square-mm MM")
    if options.unit is not None:
        raise UsageError("--unit is that of a cloud, and SOURCE is a folder")
    device = device_of(options.source, options.rig, options.calibration, options.out)
    views = lit_views(options.source, device.camera.name, Illumination.LASER)
    with refusals_named(options.source):
        board = board_in_views(views, board_in(options))
    lines, refused = lines_of(views, board, device.optics)
    with refusals_named(options.source, grouped_by_reason(refused)):
        fit = fit_plane(lines)
    note = f"{int(fit.used.sum())} of {len(fit.used)} views of a board"
    write = writes_plane(device, fit, note)
    draw = partial(draw_plane, fit=fit, lines=lines, optics=device.optics)
    own = zip(lines, (1e3 * fit.off_m).round(6).tolist(), fit.used.tolist(), strict=True)
    about = {one.name: {"rms_mm": mm, "used": used, "points": len(one.points_m)} for one, mm, used in own}
    numbers = plane_json(fit) | {"views": about, "refused": refused}
    finish(options, report_lines(fit, lines, refused), numbers, draw, write)


def _of_cloud(options: Namespace) -> None:
    from master.calibrate.wrist.laser_cloud import fit_cloud, read_cloud

    points = read_cloud(options.source, options.unit)
    device = device_of(options.source, options.rig, options.calibration, options.out)
    with refusals_named(options.source):
        found = fit_cloud(points)
    fit, used = found.fit, found.used
    lines = [f"laser plane from {used}, {1e3 * fit.rms_m:.3f} mm rms from it", *_plane_lines(fit)]
    if found.over_all is not None:
        lines += ["over all points, outliers included (not written):", *_plane_lines(found.over_all)]
    if fit.normal_sigma_rad > NORMAL_LIMIT_RAD or fit.offset_sigma_m > _OFFSET_LIMIT_M:
        lines.append(
            f"less certain than a board's views have to be ({np.degrees(NORMAL_LIMIT_RAD):.1f} deg,"
            f" {1e3 * _OFFSET_LIMIT_M:.1f} mm)"
        )
    over = {} if found.over_all is None else {"over_all": plane_json(found.over_all)}
    write = writes_plane(device, fit, used)
    own = np.repeat(fit.used, [len(p) for p in found.lines.points_m])
    draw = partial(draw_cloud, fit=fit, points_m=points, used=own)
    finish(options, lines, plane_json(fit) | {"points": len(points)} | over, draw, write)


def lines_of(
    views: tuple[LitView, ...], board: Board, optics: CameraModel
) -> tuple[tuple[ViewLine, ...], dict[str, str]]:
    """The laser's line on the board of every view, and why others show none.

    Raises:
        RecordingError: An image cannot be read.
    """
    found, refused = of_views(views, lambda view: _line_of(view, board, optics))
    return tuple(found.values()), refused


def _line_of(view: LitView, board: Board, optics: CameraModel) -> ViewLine:
    """The laser's line on the board of a view."""
    laser, ambient = view.load(Illumination.LASER, colour=True), view.load(Illumination.AMBIENT, colour=True)
    assert laser is not None  # `lit_views` gives whole ones
    if ambient is not None and laser.shape != ambient.shape:
        raise FitError("its frames differ in size")
    corners = board_corners_of(view, board, optics)
    placed = place_corners(corners, board, optics)
    line = line_on_board(laser, ambient, placed, board, optics)
    if set(view.frames) == {Illumination.LASER}:
        # Corners near the line of the same picture are drawn towards it.
        way = line.uv[-1] - line.uv[0]
        across = np.array([-way[1], way[0]]) / np.linalg.norm(way)
        near_px = 12.0
        corners = np.where(np.abs((corners - line.uv[0]) @ across)[:, None] < near_px, np.nan, corners)
        placed = place_corners(corners, board, optics)
        line = line_on_board(laser, None, placed, board, optics)
    return ViewLine.of(view.name, line, placed, float(np.sqrt(optics.matrix[0, 0] * optics.matrix[1, 1])))


def report_lines(fit: PlaneFit, seen: Sequence[ViewLine], refused: Mapping[str, str]) -> list[str]:
    """The result for a person."""
    used, views = int(fit.used.sum()), len(seen) + len(refused)
    points = sum(len(line.points_m) for line, own in zip(seen, fit.used, strict=True) if own)
    lines = [
        f"laser plane from {points} points in {used} of {views} views, {1e3 * fit.rms_m:.3f} mm rms from it",
        *_plane_lines(fit),
    ]
    wrong = [
        f"view {line.name}: {1e3 * off:.2f} mm off the plane of the others"
        for line, own, off in zip(seen, fit.used, fit.off_m, strict=True)
        if not own
    ]
    if refused or wrong:
        reasons = (*grouped_by_reason(refused), *wrong)
        lines += [f"left out ({len(refused) + len(wrong)}):", *(f"  {reason}" for reason in reasons)]
    return lines


def _plane_lines(fit: PlaneFit) -> list[str]:
    x, y, z = fit.plane.normal
    return [
        f"  normal {x:+.5f} {y:+.5f} {z:+.5f}  ± {np.degrees(fit.normal_sigma_rad):.3f} deg",
        f"  offset {1e3 * fit.plane.offset_m:.3f} ± {1e3 * fit.offset_sigma_m:.3f} mm",
    ]


def plane_json(fit: PlaneFit) -> dict[str, object]:
    """A plane for programs."""
    return {
        "normal": list(fit.plane.normal),
        "offset_mm": 1e3 * fit.plane.offset_m,
        "normal_sigma_deg": round(float(np.degrees(fit.normal_sigma_rad)), 6),
        "offset_sigma_mm": round(1e3 * fit.offset_sigma_m, 6),
        "covariance_normal_offset_m": fit.covariance.tolist(),
        "rms_mm": round(1e3 * fit.rms_m, 6),
    }


def writes_plane(device: Device, fit: PlaneFit, note: str) -> Write:
    """Writes the plane into the rig file, and leaves out a laser drawn elsewhere."""
    laser = device.rig.laser
    if laser is not None and laser.forward is not None:
        leaves = abs(sum(a * b for a, b in zip(fit.plane.normal, laser.forward, strict=True)))
        if leaves > LASER_ACROSS:
            echo("laser.origin, forward and right of the rig file lie in another plane, and are left out")
            laser = replace(laser, origin=None, forward=None, right=None)
            device = replaced(device, rig=replace(device.rig, laser=laser))
    residual = {
        "rms_mm": 1e3 * fit.rms_m,
        "normal_sigma_deg": float(np.degrees(fit.normal_sigma_rad)),
        "offset_sigma_mm": 1e3 * fit.offset_sigma_m,
    }
    return writes_key(device, "laser-plane", "laser_plane", fit.plane, residual, note)
