"""Observations are associated with features, from an initial pose on.

While there is no past, a fit starts from current observations alone. Each tag in each camera has two poses
that show it nearly alike, tilted one way or the other (Collins, Bartoli, "Infinitesimal Plane-Based Pose
Estimation", 2014); both are named. Beads that two cameras see are points, and three of them whose distances
are the object's give a pose. Where a slave named two places of a colour, both are tried. Which of all these
is right the fit decides.

Of a single visible tag both poses are fitted (`SingleTag`); the one that was assumed stays unless the other
is clearly better over several frames, and as far as the other is possible the covariance reaches over to it.
While the same cameras see the same tag, and the other was out of the question when it was fitted last, it is
taken to be as bad for the next frames: it costs as much as the first, and what is published differs by less
than numbers are exact.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from operator import itemgetter

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration.object_profile import tag_corners
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import fit_rigid, invert, matrix_to_rotation_vector, rigid
from master.estimator.sensors import CameraArrays
from master.fabrik.intersection import triangulate
from master.objects.fit import Fitted, Motion, Observations, PoseFit
from master.objects.surface import Features
from master.objects.window import ImageObservation, Window

_COMBINATIONS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """One feature in one camera, interpolated to the epoch from two frames."""

    camera: int
    feature: int
    uv: Float  # (K, n, 2) [px] n points; K places it may be: two where the slave named an alternative


def poses_of_tags(
    sighted: Sequence[Sighted], features: Features, cameras: tuple[CameraModel, ...]
) -> list[Float]:
    """Return two poses `T_rig_object` (4, 4), likelier first, by tag and camera."""
    poses = [
        (miss, cameras[seen.camera].T_rig_camera @ T)
        for seen in sighted
        if seen.feature >= features.beads
        for miss, T in two_poses(features.corners_m(seen.feature), cameras[seen.camera].undistort(seen.uv[0]))
    ]
    return [T for _, T in sorted(poses, key=itemgetter(0))]


def two_poses(corners: Float, xy: Float) -> list[tuple[float, Float]]:
    """Return the two poses that show a tag at points (4, 2), each with its residual.

    The derivative J of the homography at the tag's middle, seen from a view turned to it, is a rotation's
    upper left 2x2 times a scale; its third row is known but for the sign (ibid., 4.1). OpenCV 5 has this
    wrong for tags near the optical axis. `corners` (4, 3) [m], object frame, as printed top left, top right,
    bottom right, bottom left; `xy` undistorted (x/z, y/z). The poses are `T_camera_object`.
    """
    edge = 0.25 * float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum())
    flat = tag_corners(edge)
    H = _homography(flat[:, :2], xy)
    if H is None:
        return []
    v = H[:2, 2]
    J = H[:2, :2] - v[:, None] * H[2, :2]
    rotation = _rotation_to(np.array([v[0], v[1], 1.0]))
    try:
        A = np.asarray(np.linalg.solve(rotation[:2, :2] - v[:, None] * rotation[2, :2], J), np.float64)
        A /= float(np.linalg.norm(A, 2))
        return _ways(A, rotation, corners, flat, xy)
    except np.linalg.LinAlgError:  # corners that no tag can have
        return []


def _ways(A: Float, rotation: Float, corners: Float, flat: Float, xy: Float) -> list[tuple[float, Float]]:
    """The two poses, as of `two_poses`, of a turn with `A` (2, 2) as upper left part."""
    left = np.eye(2) - A.T @ A
    b = np.sqrt(np.maximum(np.diagonal(left), 0.0)) * [1.0, 1.0 if left[0, 1] >= 0.0 else -1.0]
    out: list[tuple[float, Float]] = []
    for sign in (1.0, -1.0):
        first = rotation @ np.vstack([A, sign * b])
        u, _, vt = np.linalg.svd(np.column_stack([first, np.cross(first[:, 0], first[:, 1])]))
        R = u @ vt
        T = rigid(R, _shift(flat @ R.T, xy)) @ invert(fit_rigid(corners, flat))
        seen = corners @ T[:3, :3].T + T[:3, 3]
        if (seen[:, 2] > 0.0).all():
            out.append((float(np.linalg.norm(seen[:, :2] / seen[:, 2:] - xy)), T))
    return sorted(out, key=itemgetter(0))


def _homography(plane: Float, xy: Float) -> Float | None:
    """Return the homography (3, 3), H[2, 2] = 1, of plane to image; None: collinear."""
    rows = np.zeros((8, 8))
    rows[::2, :2], rows[::2, 2] = plane, 1.0
    rows[1::2, 3:5], rows[1::2, 5] = plane, 1.0
    rows[:, 6:] = -(xy[:, :, None] * plane[:, None]).reshape(8, 2)
    try:
        return np.append(np.linalg.solve(rows, xy.ravel()), 1.0).reshape(3, 3)
    except np.linalg.LinAlgError:
        return None


def _rotation_to(line_of_sight: Float) -> Float:
    """Return the smallest rotation (3, 3) from the z axis to a line of sight (3,)."""
    x, y, z = line_of_sight / np.linalg.norm(line_of_sight)
    cross = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + z)


def _shift(rotated: Float, xy: Float) -> Float:
    """Solve for the origin (3,) of rotated points (N, 3) seen at (N, 2), linearly."""
    rows = np.zeros((2 * len(xy), 3))
    rows[::2, 0] = rows[1::2, 1] = 1.0
    rows[:, 2] = -xy.ravel()
    return np.asarray(
        np.linalg.lstsq(rows, (xy * rotated[:, 2:] - rotated[:, :2]).ravel(), rcond=None)[0], np.float64
    )


def poses_of_beads(sighted: Sequence[Sighted], features: Features, cameras: CameraArrays) -> list[Float]:
    """Return poses (4, 4), best first, of three beads of the object's distances."""
    places = [_points(sighted, bead, cameras) for bead in range(features.beads)]
    seen = [bead for bead, found in enumerate(places) if len(found)]
    poses: list[tuple[float, Float]] = []
    triples = 40
    for triple in list(combinations(seen, 3))[:triples]:
        own = features.points[list(triple)]
        if np.linalg.norm(np.cross(own[1] - own[0], own[2] - own[0])) < 1e-4:  # [m^2]: nearly in one line
            continue
        wanted = _sides(own)
        for associated in list(product(*(range(len(places[bead])) for bead in triple)))[:_COMBINATIONS]:
            points = np.array([places[bead][k] for bead, k in zip(triple, associated, strict=True)])
            off = np.abs(_sides(points) - wanted)
            distance_m, distance_share = 8e-3, 0.08  # by which distances between beads may be wrong
            if (off < distance_m + distance_share * wanted).all():
                poses.append((float(off.sum()), fit_rigid(points, own)))
    return [T for _, T in sorted(poses, key=itemgetter(0))[:6]]


def _points(sighted: Sequence[Sighted], bead: int, cameras: CameraArrays) -> Float:
    """Return a bead's possible positions (K, 3) [m], rig frame, where its rays meet."""
    views = [seen for seen in sighted if seen.feature == bead]
    if len(views) < 2:
        return np.empty((0, 3))
    choices = list(product(*(range(len(seen.uv)) for seen in views)))[:_COMBINATIONS]
    uv = np.full((len(cameras.scale), len(choices), 2), np.nan)
    for seen, associated in zip(views, np.array(choices, np.int64).T, strict=True):
        uv[seen.camera] = seen.uv[associated, 0]
    sigma_px = 0.3
    found = triangulate(cameras, uv, sigma_px)
    miss_px = 6.0  # by which rays of a bead may miss each other
    return found.points_m[found.residual_px < miss_px]


def _sides(points: Float) -> Float:
    return np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)


CentroidSigma = Callable[[int, Float, Float], Float]


def observations_of(
    window: Window,
    features: Features,
    cameras: tuple[CameraModel, ...],
    T: Float | None,
    centroid_sigma: CentroidSigma,
) -> Observations | None:
    """All that is seen in a window; None: nothing.

    `T`: a pose (4, 4) near which the object is; of two places of a bead the nearer to it is taken.
    `centroid_sigma`: camera, pose and areas (..., B) [px^2] of its beads -> by how much their centroids may be
    off [px].
    """
    columns: list[tuple[Int, Int, Float, Float, Float, Float, Bool]] = []
    for c, both in enumerate(window.views):
        for kind, line in enumerate(both):
            observed = [observation for observation in line if len(observation.point)]
            if not observed:
                continue
            point = np.concatenate([one.point for one in observed])
            uv, sigma = _nearer(observed, point, features, cameras[c], T)
            if T is not None and kind == 0:
                area = np.concatenate([one.area_px2 for one in observed]).reshape(len(observed), -1)
                sigma = np.hypot(sigma, centroid_sigma(c, T, area).ravel())
            there: Int = np.flatnonzero(np.isfinite(uv[:, 0] + uv[:, 1] + sigma))
            t_ns = np.concatenate([one.t_ns for one in observed])
            size = [len(one.point) for one in observed]
            late = np.repeat([one.t_sigma_s for one in observed], size)
            near = window.near(c, kind)
            now = np.repeat([one is near for one in observed], size)
            tau = (t_ns[there] - (window.t_ns - window.origin_ns)) * 1e-9
            at = np.full(len(there), c)
            columns.append((at, point[there], tau, uv[there], sigma[there], late[there], now[there]))
    if not sum(len(column[0]) for column in columns):
        return None
    camera, point, tau, uv, sigma, t_sigma, now = (
        np.concatenate(column) for column in zip(*columns, strict=True)
    )
    return Observations(camera, point, tau, uv, sigma, t_sigma, features.feature[point], now)


def _nearer(
    line: list[ImageObservation], point: Int, features: Features, camera: CameraModel, T: Float | None
) -> tuple[Float, Float]:
    """Return positions (K, 2), of alternatives those nearer to a pose; sigmas."""
    uv, sigma = np.concatenate([one.uv for one in line]), np.concatenate([one.sigma_px for one in line])
    alternative = np.concatenate([one.alt_uv for one in line])
    if T is None or np.isnan(alternative).all():
        return uv, sigma
    there = camera.project(features.points[point] @ T[:3, :3].T + T[:3, 3])
    first, second = (np.linalg.norm(one - there, axis=1) for one in (uv, alternative))
    return np.where((second < first)[:, None], alternative, uv), sigma


def sighted_now(window: Window, features: Features) -> list[Sighted]:
    """Return what each camera sees now of each feature, on a line to the epoch."""
    out: list[Sighted] = []
    at_ns = window.t_ns - window.origin_ns
    for c, both in enumerate(window.views):
        for kind, line in enumerate(both):
            first = window.near(c, kind)
            if first is None:
                continue
            for feature in np.unique(features.feature[first.point]):
                rows = features.feature[first.point] == feature
                if np.isnan(first.uv[rows]).any():
                    continue
                uv = _brought(first.point[rows], line, at_ns)
                alternative = first.alt_uv[rows]
                places = [uv] if np.isnan(alternative).any() else [uv, alternative]
                out.append(Sighted(c, int(feature), np.stack(places)))
    return out


def _brought(points: Int, line: tuple[ImageObservation, ...], at_ns: int) -> Float:
    """Extrapolate the nearest observation's points (n, 2) to a time, by the next."""
    found: list[tuple[Float, Float]] = []  # points, and their times from the epoch [s]
    for observation in line:
        rows = [
            int(np.flatnonzero(observation.point == p)[0]) for p in points if (observation.point == p).any()
        ]
        if len(rows) == len(points) and np.isfinite(observation.uv[rows]).all():
            found.append((observation.uv[rows], (observation.t_ns[rows] - at_ns) * 1e-9))
    order: list[int] = np.argsort([abs(tau[0]) for _, tau in found]).tolist()
    far_s = 0.048  # an observation farther away says nothing about the motion now
    if len(order) < 2 or abs(found[order[1]][1][0]) > far_s:
        return found[0][0]
    (uv, tau), (other, other_tau) = found[order[0]], found[order[1]]
    return uv - (tau / (other_tau - tau))[:, None] * (other - uv)


_FLIP_RAD = np.radians(8.0)  # poses of a tag nearer than this are one


@dataclass(slots=True)
class _Clear:
    """A tag whose other pose is ruled out: by which cameras, how clearly, how long."""

    seen_by: tuple[int, ...]
    better: float
    frames: int


class SingleTag:
    """Push machine: a single tag's two poses; how much better the other was of late."""

    def __init__(self, features: Features, cameras: tuple[CameraModel, ...], fit: PoseFit) -> None:
        """Set up; `fit` fits the features to what the cameras saw."""
        self._features, self._cameras, self._fit = features, cameras, fit
        self._log_odds = 0.0
        self._clear: _Clear | None = None

    def forget(self) -> None:
        """Begin anew: what is seen is another thing."""
        self._log_odds, self._clear = 0.0, None

    def of_two(self, window: Window, seen: Observations, fitted: Fitted, *, begins: bool) -> Fitted:
        """Return the pose to use, its covariance widened by that of a lone tag's other.

        `begins`: there is no pose before it: the better one is taken at once.
        """
        features = np.unique(seen.feature[fitted.used])
        forget = 0.8  # of that sum, from frame to frame
        if len(features) != 1 or features[0] < self._features.beads:
            self._log_odds *= forget
            self._clear = None
            return fitted
        feature = int(features[0])
        who = (feature, *np.unique(seen.camera[fitted.used]).tolist())
        clear = self._clear
        if clear is not None and clear.seen_by == who and clear.frames > 0 and not begins:
            clear.frames -= 1
            self._log_odds = forget * (self._log_odds + clear.better)
            return fitted
        self._clear = None
        other = self._other(window, seen, fitted, feature)
        if other is None:
            self._log_odds *= forget
            return fitted
        better = 0.5 * (fitted.cost - other.cost)
        self._log_odds = forget * self._log_odds + 2.0 * better * (1.0 - forget) * 2.0
        flips = 12.0  # chi square, summed over frames, by which the other pose of a tag must be better
        impossible = -30.0  # chi square by which it is out of the question: exp(-30) is nothing
        if begins:
            if better > 0.0:
                fitted, other, better = other, fitted, -better
        elif self._log_odds > flips:
            fitted, other, better, self._log_odds = other, fitted, -better, 0.0
        elif better < impossible:
            # frames for which that holds: less than a tenth of a second, before a sum of it would be forgotten
            unlooked = 5
            self._clear = _Clear(who, better, unlooked)
        return _reaching(fitted, other, better)

    def _other(self, window: Window, seen: Observations, fitted: Fitted, feature: int) -> Fitted | None:
        """The fit of the only tag's other pose, where there is another."""
        own = self._features.corners_m(feature)
        best: Fitted | None = None
        for sighted in sighted_now(window, self._features):
            if sighted.feature != feature:
                continue
            camera = self._cameras[sighted.camera]
            for _, T in two_poses(own, camera.undistort(sighted.uv[0])):
                there = camera.T_rig_camera @ T
                if _rotated(there, fitted.motion.T) < _FLIP_RAD:
                    continue
                other = self._fit(seen, Motion.still(there))
                if other is None or _rotated(other.motion.T, fitted.motion.T) < _FLIP_RAD:
                    continue
                if best is None or other.cost < best.cost:
                    best = other
        return best


def _reaching(fitted: Fitted, other: Fitted, better: float) -> Fitted:
    """Widen a fit's covariance towards the other pose as far as that is possible."""
    share = 1.0 / (1.0 + np.exp(np.clip(-better, -50.0, 50.0)))
    off = np.concatenate(
        [
            other.motion.T[:3, 3] - fitted.motion.T[:3, 3],
            matrix_to_rotation_vector(other.motion.T[:3, :3] @ fitted.motion.T[:3, :3].T),
        ]
    )
    cov = fitted.cov.copy()
    cov[:6, :6] += share * np.outer(off, off)
    return replace(fitted, cov=cov)


def _rotated(T: Float, other: Float) -> float:
    """Angle between two poses [rad]: the trace of a rotation is 1 + 2 cos."""
    cosine = 0.5 * (float(np.vdot(T[:3, :3], other[:3, :3])) - 1.0)
    return float(np.arccos(min(max(cosine, -1.0), 1.0)))
