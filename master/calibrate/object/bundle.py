"""A bundle adjustment fits beads on a rigid body to their observations.

Bead positions over time with covariances enter, from cameras or a running master. Minimised over beads q_b
and poses R_t, p_t, with the covariances C of the points, which hold what the cameras' pixels measured (a
bundle adjustment, linear in the points: Triggs et al. 2000):

    sum_tb  rho( e' C^-1 e ),   e = R_t q_b + p_t - x_tb

The beads are shared, a pose is an epoch's own (`master.calibrate.adjust`). The frame of q is free: what only
moves the whole body is no uncertainty of it. rho is Geman and McClure's, so that a bead that was mistaken, or
was half hidden, costs itself.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float, Int
from common.calibration import RigCalibration
from common.errors import CalibrationError, FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import fit_rigid, skew, transform
from common.messages import HandPose, MarkerDetections
from master.calibrate.adjust import Loss, Normal, geman_mcclure, minimise, stepped_poses
from master.estimator.sensors import CameraArrays
from master.fabrik.caps import LensShift
from master.fabrik.depth import CalibrationResidual
from master.fabrik.intersection import triangulate
from master.fabrik.sync import FrameSet, FrameSync


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Beads of one object over time."""

    names: tuple[str, ...]  # (B,) of the beads
    t_s: Float  # (T,) rising [s], from the first
    points_m: Float  # (T, B, 3) rig frame; NaN: not seen by two cameras
    cov_m2: Float  # (T, B, 3, 3); NaN as the points

    @property
    def known(self) -> Bool:
        """(T, B) which bead is known when."""
        return np.isfinite(self.points_m[..., 0])


def rows_of(rig: RigCalibration, names: Sequence[str]) -> list[int]:
    """Rows of the beads among the rig's markers.

    Raises:
        CalibrationError: The rig has no such marker, or it sits on the hand; the message names the remedy.
    """
    listed = ", ".join(f'"{name}"' for name in names)
    for name in names:
        for key, there in (("markers", rig.markers), ("free_markers", rig.free_markers)):
            if name not in there:
                raise CalibrationError(
                    f"rig {rig.name!r}: {key}: {name!r} is not among them. Beads of an object stand in markers and in"
                    f" free_markers: add {listed} to both, teach their colours (`phalanx-slave colours`), detect again"
                )
    return [rig.markers.index(name) for name in names]


def seen_by(
    rig: RigCalibration,
    models: Mapping[str, CameraModel],
    frame_rate_hz: Mapping[str, float],
    messages: Iterable[MarkerDetections],
    names: Sequence[str],
) -> Seen:
    """Bring the cameras to common epochs and triangulate the beads there.

    What has a second place in a camera is rejected at that epoch: there is no pose yet that determines which
    is right. Models and nominal rates are by camera, in the rig's order; messages are of all cameras, by
    their stamps.

    Raises:
        CalibrationError: As `rows_of`.
    """
    rows = rows_of(rig, names)
    cameras = tuple(models.values())
    sync, shift = FrameSync(dict(models), dict(frame_rate_hz), len(rig.markers)), LensShift(cameras)
    arrays, rays_px = CameraArrays.of(cameras), CalibrationResidual.of(rig).rays_px
    late_ns = {camera: round(1e3 * us) for camera, us in rig.stamp_offset_us.items()}
    moved = (replace(one, t_ns=one.t_ns + late_ns.get(one.camera, 0)) for one in messages)
    sets = [frames for one in moved for frames in sync.push(one)] + sync.flush()
    times, points, covs = list[int](), list[Float](), list[Float]()
    for frames in sets:
        uv = shift.centres(frames.uv, frames.area) if shift.any else frames.uv
        uv, sigma = _clear(frames, uv)[:, rows], frames.sigma_px[:, rows]
        found = triangulate(arrays, uv, sigma, rays_px)
        times.append(frames.t_ns)
        points.append(np.where(found.outliers[:, None], np.nan, found.points_m))
        covs.append(found.cov_m2)
    return _seen(tuple(names), times, points, covs)


def seen_in(poses: Sequence[HandPose], rig: RigCalibration, names: Sequence[str]) -> Seen:
    """The same from the poses of a running master of this rig.

    Raises:
        CalibrationError: As `rows_of`; the master has another number of markers than the rig.
    """
    rows = rows_of(rig, names)
    for pose in poses:
        if len(pose.markers_raw_m) != len(rig.markers):
            raise CalibrationError(
                f"the running master has {len(pose.markers_raw_m)} markers, rig {rig.name!r} {len(rig.markers)}: name"
                " its rig with --rig"
            )
    ordered = sorted({pose.t_ns: pose for pose in poses}.items())
    return _seen(
        tuple(names),
        [t_ns for t_ns, _ in ordered],
        [pose.markers_raw_m[rows] for _, pose in ordered],
        [pose.markers_cov_m2[rows] for _, pose in ordered],
    )


def _clear(frames: FrameSet, uv: Float) -> Float:
    """The pixels (C, M, 2) without those that have an alternative."""
    if frames.alt_uv is None:
        return uv
    return np.where(np.isfinite(frames.alt_uv[..., :1]), np.nan, uv)


def _seen(names: tuple[str, ...], times: list[int], points: list[Float], covs: list[Float]) -> Seen:
    t_ns = np.array(times, np.int64)
    at = np.array(points, np.float64).reshape(-1, len(names), 3)
    cov = np.array(covs, np.float64).reshape(-1, len(names), 3, 3)
    nan = np.where(np.isfinite(at.sum(axis=-1) + cov.sum(axis=(-2, -1))), 0.0, np.nan)
    t_s = np.multiply(t_ns - (t_ns[0] if len(t_ns) else 0), 1e-9, dtype=np.float64)
    return Seen(names, t_s, at + nan[..., None], cov + nan[..., None, None])


_ROUNDS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """A rigid body that explains what was seen."""

    seen: Seen  # the epochs that were used
    beads_m: Float  # (B, 3) in a frame of its own
    cov_m2: Float  # (3 B, 3 B) of the beads among each other, from the covariances of the points alone
    T: Float  # (T, 4, 4) body -> rig
    off_m: Float  # (T, B, 3) fitted minus seen; NaN: not seen
    weight: Float  # (T, B) 0..1; 0: not seen
    spread: float  # residuals as a factor of what the covariances expect

    @property
    def outlier(self) -> Bool:
        """The observations (T, B) that the body does not explain."""
        # weight below which a bead at an epoch counts as an outlier
        return self.seen.known & (self.weight < 0.1)


def usable(seen: Seen) -> Bool:
    """The epochs (T,) that constrain the body: three beads or more are known."""
    return seen.known.sum(axis=1) >= 3


def fit_bundle(seen: Seen, rows: Int | None = None) -> Bundle:
    """Fit a body to epochs `rows`; None: all that are usable, thinned to a maximum.

    Raises:
        FitError: A bead is never seen together with two others whose places are known.
    """
    chosen = np.flatnonzero(usable(seen)) if rows is None else rows
    most = 1500  # epochs: more of the same motion adds time, not information
    if len(chosen) > most:
        chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, most).astype(np.int64))]
    own = Seen(seen.names, seen.t_s[chosen], seen.points_m[chosen], seen.cov_m2[chosen])
    beads, T = first_body(own)
    known_cov = np.where(np.isfinite(own.cov_m2), own.cov_m2, np.eye(3))
    whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(known_cov)), np.float64)
    scale_2, body, cov = 1.0, _Body(beads, T), np.empty(0)
    for _ in range(_ROUNDS):
        chi = (_whitened(body, own, whiten) ** 2).sum(axis=-1)
        last, scale_2 = scale_2, _scale_2(chi, own.known)
        found = minimise(partial(_equations, own, whiten, _loss(scale_2)), _stepped, body, gain_share=1e-10)
        body, cov = found.x, found.normal.covariance(_free(found.x.beads_m))
        if abs(scale_2 / last - 1.0) < 1e-4:
            break
    chi = (_whitened(body, own, whiten) ** 2).sum(axis=-1)
    weight = np.where(own.known, _loss(scale_2)(np.nan_to_num(chi))[1], 0.0)
    off = _off(body.beads_m, body.T, own.points_m)
    return Bundle(own, body.beads_m, scale_2 * cov, body.T, off, weight, float(np.sqrt(scale_2)))


@dataclass(frozen=True, slots=True, eq=False)
class _Body:
    """What is fitted: beads (B, 3) [m], and poses (T, 4, 4) body -> rig."""

    beads_m: Float
    T: Float


def _loss(scale_2: float) -> Loss:
    soft_2 = 12.0  # chi square of three numbers at which a bead counts a quarter
    return geman_mcclure(float(np.sqrt(soft_2 * scale_2)))


def _whitened(body: _Body, seen: Seen, whiten: Float) -> Float:
    """Fitted minus seen (T, B, 3) in standard deviations; NaN: not seen."""
    return (whiten @ _off(body.beads_m, body.T, seen.points_m)[..., None])[..., 0]


def _equations(seen: Seen, whiten: Float, loss: Loss, body: _Body) -> Normal:
    """Normal equations of beads and poses; a pose turns and moves by rig axes."""
    epochs, count = seen.known.shape
    R = body.T[:, None, :3, :3]
    by_turn = -skew((R @ body.beads_m[..., None])[..., 0])
    by_pose = whiten @ np.concatenate([by_turn, np.broadcast_to(np.eye(3), by_turn.shape)], axis=-1)
    by_beads = np.zeros((epochs, count, 3, count, 3))
    each = np.arange(count, dtype=np.int64)
    by_beads[:, each, :, each] = np.moveaxis(whiten @ R, 1, 0)
    normal = Normal(3 * count, epochs, 6)
    normal.add(
        _whitened(body, seen, whiten).reshape(epochs, -1),
        by_beads.reshape(epochs, 3 * count, 3 * count),
        by_pose.reshape(epochs, 3 * count, 6),
        loss=loss,
        group=3,
    )
    return normal


def _stepped(body: _Body, shared: Float, own: Float) -> _Body:
    return _Body(body.beads_m + shared.reshape(-1, 3), stepped_poses(body.T, own))


def first_body(seen: Seen) -> tuple[Float, Float]:
    """Beads (B, 3), by medians from the best known epoch, and poses (T, 4, 4).

    Raises:
        FitError: A bead is never seen together with two others whose places are known.
    """
    known = seen.known
    size = np.nan_to_num(np.einsum("tbii->tb", seen.cov_m2), nan=0.0).sum(axis=1)
    most = known.sum(axis=1) == known.sum(axis=1).max(initial=0)
    first: int = int(np.argmin(np.where(most, size, np.inf)))
    beads = seen.points_m[first] - np.nanmean(seen.points_m[first], axis=0)
    for _ in range(3 + len(seen.names)):
        T = np.array([_pose(points, beads) for points in seen.points_m])
        placed = np.asarray((seen.points_m - T[:, None, :3, 3]) @ T[:, :3, :3], np.float64)
        beads = _medians(placed, beads)
    if np.isnan(beads).any():
        lost = [name for name, bead in zip(seen.names, beads, strict=True) if np.isnan(bead).any()]
        raise FitError(f"{', '.join(lost)}: never seen by two cameras together with three others")
    T = np.array([_pose(points, beads) for points in seen.points_m])
    return beads, T


def _medians(placed: Float, beads: Float) -> Float:
    """Beads (B, 3) by medians of places (T, B, 3); those of no place as they were."""
    out = beads.copy()
    observed = np.flatnonzero(np.isfinite(placed).all(axis=2).any(axis=0))
    out[observed] = np.nanmedian(placed[:, observed], axis=0)
    return out


def _pose(points: Float, beads: Float) -> Float:
    """Pose (4, 4) of a body (B, 3) from points (B, 3); NaN: fewer than three known."""
    both = np.isfinite(points[:, 0] + beads[:, 0])
    return fit_rigid(points[both], beads[both]) if both.sum() >= 3 else np.full((4, 4), np.nan)


def _off(beads: Float, T: Float, points: Float) -> Float:
    return np.array([transform(pose, beads) for pose in T]) - points


def _scale_2(chi: Float, known: Bool) -> float:
    """Factor of the covariances, at least 1, by the median of chi-squares (T, B).

    Of the 3 n numbers of an epoch 6 go into its pose, so the chi square of a bead is that of 3 - 6 / n
    numbers, whose median follows by Wilson and Hilferty (1931).
    """
    own = chi[known]
    free = 3.0 - 6.0 / float(known.sum(axis=1).mean())
    median = free * (1.0 - 2.0 / (9.0 * free)) ** 3
    return max(1.0, float(np.median(own)) / median)


def _free(beads: Float) -> Float:
    """Basis (3 B, 3 B - 6) of steps that change the body and not only its frame."""
    middle = beads - beads.mean(axis=0)
    moves = np.concatenate([np.tile(np.eye(3), (len(beads), 1)), skew(middle).reshape(-1, 3)], axis=1)
    return np.linalg.svd(moves)[0][:, 6:]
