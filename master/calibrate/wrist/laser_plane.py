"""`phalanx calibrate wrist laser-plane`: the laser plane in the camera frame.

Every view of a board that the laser crosses gives one straight line in space (`laser_line`); its distance from a
plane is two numbers (two points of it with the spread of all its points). Their covariance is that of the board's
pose, which all points of a view share, and of the line's place in the image; so a thousand points of one view do
not count as a thousand. A plane is constrained by lines that are not all the same one; the covariance states how
well, and what is not known to a tenth of a degree and of a millimetre is refused.
"""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float
from common.calibration import RigCalibration
from common.calibration.rig import LaserPlane
from common.command_line import echo
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import cross
from common.recording.frame_recording import Illumination
from master.calibrate.adjust import Normal, minimise
from master.calibrate.cameras.boards import Board, board_in
from master.calibrate.tree_files import print_lines, provenance, refusals_named, write_report
from master.calibrate.wrist.device import (
    BoardPose,
    Device,
    LitView,
    board_pose,
    device_of,
    grouped_by_reason,
    lit_views,
    write_device,
)
from master.calibrate.wrist.laser_line import BoardLine, line_on_board

NORMAL_LIMIT_RAD = np.radians(0.1)
_WRONG_CHI2 = 22.0  # of two degrees of freedom: one in 60 000


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
        mean = line.points_m.mean(axis=0)
        _, sizes, axes = np.linalg.svd(line.points_m - mean, full_matrices=False)
        spread = sizes[0] / np.sqrt(len(line.points_m)) * axes[0]
        return cls(
            name, line.points_m, np.stack([mean - spread, mean + spread]), placed, line.sigma_px, focal_px
        )

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
    normal, offset = _consensus(views)
    used, cov = np.zeros(len(views), dtype=np.bool_), np.eye(4)
    for _ in range(6):
        good = _agreeing(views, normal, offset)
        if (good == used).all():
            break
        used = good
        if used.sum() < max(min_views, (len(views) + 1) // 2):
            raise FitError(
                f"only {int(used.sum())} of {len(views)} views agree on one plane: is the laser fixed to the camera,"
                " and the board flat? Views with the line on something else than the board must be taken anew"
            )
        normal, offset, cov = _least_squares([v for v, own in zip(views, used, strict=True) if own], normal)
    cov = cov * max(1.0, _reduced(views, used, normal, offset))
    off = np.array([_off(view, normal, offset) for view in views])
    points = np.concatenate([view.points_m for view, own in zip(views, used, strict=True) if own])
    rms = float(np.sqrt(np.mean((points @ normal - offset) ** 2)))
    fit = PlaneFit(LaserPlane(normal=_vector(normal), offset_m=round(float(offset), 9)), cov, rms, used, off)
    _refuse_unsure(fit, points)
    return fit


def _consensus(views: Sequence[ViewLine]) -> tuple[Float, float]:
    """Normal and offset of the plane through two lines that most others agree with."""
    pairs: list[tuple[int, int]] = list(combinations(range(len(views)), 2))
    most_pairs = 300
    if len(pairs) > most_pairs:
        chosen = np.random.default_rng(0).choice(len(pairs), most_pairs, replace=False)
        pairs = [pairs[int(i)] for i in chosen]
    best, cost = (np.array([0.0, 1.0, 0.0]), 0.0), np.inf
    for i, j in pairs:
        normal, offset = _through(np.concatenate([views[i].ends_m, views[j].ends_m]))
        own = sum(min(_chi2(view, normal, offset), _WRONG_CHI2) for view in views)
        if own < cost:
            best, cost = (normal, offset), own
    return best


def _through(points: Float) -> tuple[Float, float]:
    """Plane of least squares through points (n, 3); offset positive."""
    mean = points.mean(axis=0)
    normal = np.linalg.svd(points - mean)[2][2]
    normal = normal * (1.0 if normal @ mean >= 0 else -1.0)
    return normal, float(normal @ mean)


def _chi2(view: ViewLine, normal: Float, offset: float) -> float:
    off = view.ends_m @ normal - offset
    return float(off @ np.linalg.solve(view.covariance(normal), off))


def _off(view: ViewLine, normal: Float, offset: float) -> float:
    return float(np.sqrt(np.mean((view.points_m @ normal - offset) ** 2)))


def _agreeing(views: Sequence[ViewLine], normal: Float, offset: float) -> Bool:
    """Which views (V,) agree with a plane."""
    chi2 = np.array([_chi2(view, normal, offset) for view in views])
    off = np.array([_off(view, normal, offset) for view in views])
    # The covariances may be small by a common factor: a wrong view is one whose residual is larger than most.
    times = max(1.0, float(np.median(chi2)) / 1.386)
    wrong_m = 1.5e-4  # a view that is less off than this is not wrong, however sure it claims to be
    return (chi2 < _WRONG_CHI2 * times) | (off < wrong_m)


def _reduced(views: Sequence[ViewLine], used: Bool, normal: Float, offset: float) -> float:
    """Chi square per degree of freedom."""
    total = sum(_chi2(view, normal, offset) for view, own in zip(views, used, strict=True) if own)
    return total / max(2.0 * float(used.sum()) - 3.0, 1.0)


def _least_squares(views: Sequence[ViewLine], normal: Float) -> tuple[Float, float, Float]:
    """Normal, offset, covariance (4, 4), from a first normal."""
    middle = np.concatenate([view.ends_m for view in views]).mean(axis=0)
    # By turn of the normal and distance from the middle, which hardly depend on each other.
    found = minimise(partial(_equations, views, middle), _stepped, np.append(normal, 0.0), steps=20)
    normal, tangents = found.x[:3], _tangents(found.x[:3])
    offset = float(normal @ middle + found.x[3])
    to4 = np.zeros((4, 3))
    to4[:3, :2] = tangents
    to4[3] = np.append(middle @ tangents, 1.0)
    sign = -1.0 if offset < 0.0 else 1.0
    return sign * normal, sign * offset, to4 @ found.normal.covariance() @ to4.T


def _equations(views: Sequence[ViewLine], middle: Float, plane: Float) -> Normal:
    """Normal equations of a plane (normal, distance from the middle)."""
    out, normal, tangents = Normal(3), plane[:3], _tangents(plane[:3])
    for view in views:
        whiten, arm = np.linalg.inv(np.linalg.cholesky(view.covariance(normal))), view.ends_m - middle
        by = np.concatenate([arm @ tangents, -np.ones((2, 1))], axis=1)
        out.add((whiten @ (arm @ normal - plane[3]))[None], (whiten @ by)[None])
    return out


def _stepped(plane: Float, step: Float, _own: Float) -> Float:
    normal = plane[:3] + _tangents(plane[:3]) @ step[:2]
    return np.append(normal / np.linalg.norm(normal), plane[3] + step[2])


def _tangents(normal: Float) -> Float:
    """Two directions (3, 2) in a plane."""
    return np.linalg.svd(normal[None])[2][1:].T


def _refuse_unsure(fit: PlaneFit, points: Float) -> None:
    """Refuse points on one line, and a plane that is too uncertain."""
    offset_limit_m = 1e-4
    if fit.normal_sigma_rad <= NORMAL_LIMIT_RAD and fit.offset_sigma_m <= offset_limit_m:
        return
    wide = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if wide[1] < max(5.0 * fit.rms_m, 0.1 * wide[0]):
        raise FitError(_collinear(wide[1]))
    raise FitError(
        f"the plane is known to {np.degrees(fit.normal_sigma_rad):.2f} deg and {1e3 * fit.offset_sigma_m:.2f} mm only"
        f" (limits {np.degrees(NORMAL_LIMIT_RAD):.1f} deg, {1e3 * offset_limit_m:.1f} mm): show the board in more"
        " views, nearer and farther, so large that it fills a third of the image"
    )


def _collinear(wide_m: float) -> str:
    return (
        f"all points of the laser lie on one line (they spread {1e3 * wide_m:.1f} mm across it): they define no plane;"
        " hold the board at other distances too, and turn it, so that the line falls elsewhere"
    )


def _vector(value: Float) -> tuple[float, float, float]:
    x, y, z = (round(float(number), 9) for number in value)
    return x, y, z


@dataclass(frozen=True, slots=True)
class LinesSeen:
    """Lines of the views that show one, and of every other view the reason."""

    lines: tuple[ViewLine, ...]
    refused: Mapping[str, str]


def laser_plane(options: Namespace) -> None:
    """Measure the plane of a wrist device's laser, from ten views of a board."""
    device = device_of(options.source, options.rig, options.calibration, options.out)
    views = lit_views(options.source, device.camera.name, Illumination.LASER)
    seen = lines_of(views, board_in(options), device.optics)
    with refusals_named(options.source, grouped_by_reason(seen.refused)):
        fit = fit_plane(seen.lines)
    print_lines(report_lines(fit, seen, len(views)))
    if options.picture is not None:
        from master.calibrate.picture import draw_plane

        draw_plane(options.picture, fit, seen.lines, device.optics)
        echo(f"drew {options.picture}")
    written = write_device(options.out, device, rig_with_plane(device, fit), "laser_plane")
    write_report(options.json_file, report_json(fit, seen), written)


def lines_of(views: tuple[LitView, ...], board: Board, optics: CameraModel) -> LinesSeen:
    """The laser's line on the board of every view.

    Raises:
        RecordingError: An image cannot be read.
    """
    focal = float(np.sqrt(optics.matrix[0, 0] * optics.matrix[1, 1]))
    lines: list[ViewLine] = []
    refused: dict[str, str] = {}
    for view in views:
        laser, ambient = view.load(Illumination.LASER), view.load(Illumination.AMBIENT)
        assert laser is not None  # `lit_views` gives whole ones
        assert ambient is not None
        try:
            placed = board_pose(view, board, optics)
            if laser.shape != ambient.shape:
                raise FitError("its frames differ in size")
            line = line_on_board(laser, ambient, placed, board, optics)
        except FitError as error:
            refused[view.name] = str(error)
            continue
        lines.append(ViewLine.of(view.name, line, placed, focal))
    return LinesSeen(tuple(lines), refused)


def report_lines(fit: PlaneFit, seen: LinesSeen, views: int) -> list[str]:
    """The result for a person."""
    x, y, z = fit.plane.normal
    used = int(fit.used.sum())
    points = sum(len(line.points_m) for line, own in zip(seen.lines, fit.used, strict=True) if own)
    lines = [
        f"laser plane from {points} points in {used} of {views} views, {1e3 * fit.rms_m:.3f} mm rms from it",
        f"  normal {x:+.5f} {y:+.5f} {z:+.5f}  ± {np.degrees(fit.normal_sigma_rad):.3f} deg",
        f"  offset {1e3 * fit.plane.offset_m:.3f} ± {1e3 * fit.offset_sigma_m:.3f} mm",
    ]
    wrong = [
        f"view {line.name}: {1e3 * off:.2f} mm off the plane of the others"
        for line, own, off in zip(seen.lines, fit.used, fit.off_m, strict=True)
        if not own
    ]
    if seen.refused or wrong:
        reasons = (*grouped_by_reason(seen.refused), *wrong)
        lines += [f"left out ({len(seen.refused) + len(wrong)}):", *(f"  {reason}" for reason in reasons)]
    return lines


def report_json(fit: PlaneFit, seen: LinesSeen) -> dict[str, object]:
    """The same for programs."""
    return {
        "normal": list(fit.plane.normal),
        "offset_mm": 1e3 * fit.plane.offset_m,
        "normal_sigma_deg": round(float(np.degrees(fit.normal_sigma_rad)), 6),
        "offset_sigma_mm": round(1e3 * fit.offset_sigma_m, 6),
        "covariance_normal_offset_m": fit.covariance.tolist(),
        "rms_mm": round(1e3 * fit.rms_m, 6),
        "views": {
            line.name: {"rms_mm": round(1e3 * float(off), 6), "used": bool(own), "points": len(line.points_m)}
            for line, own, off in zip(seen.lines, fit.used, fit.off_m, strict=True)
        },
        "refused": dict(seen.refused),
    }


def rig_with_plane(device: Device, fit: PlaneFit) -> RigCalibration:
    """The device's rig with the new plane and where it comes from."""
    residual = {
        "rms_mm": round(1e3 * fit.rms_m, 4),
        "normal_sigma_deg": round(float(np.degrees(fit.normal_sigma_rad)), 4),
        "offset_sigma_mm": round(1e3 * fit.offset_sigma_m, 4),
    }
    note = f"{int(fit.used.sum())} of {len(fit.used)} views of a board"
    how = provenance("calibrate wrist laser-plane", (device.source,), residual, note)
    rig = device.rig
    return replace(rig, laser_plane=fit.plane, provenance=rig.provenance | {"laser_plane": how})
