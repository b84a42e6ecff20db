"""Locate markers by the rays of all cameras, corrected for how caps look.

What a camera sees of a cap is not its centroid; the difference follows from the direction in which the finger
points, which is itself uncertain. So a point's covariance has these parts:

    centroids     noise, occlusion and time, each camera's own              gain diag(sigma^2) gain'
    common        part of the noise is the same in all cameras              moves the point, not its depth
    direction     one finger is tilted for all cameras alike                spread of six tilted hands
    radius        of the profile                                            a tenth of the whole correction
    relief        of a flat marker: the back of a hand is not flat          0.4 mm
    calibration   its reprojection error                                    added to each centroid

Tilt matters most along the line of sight: two cameras see a finger that points at one of them from different
sides, so a degree of tilt moves the two centroids apart, and the distance with them. Cameras side by side see
the same cap in the same light, so that its rim and its shading mislead them alike: most of a whole cap's
error is one of place.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.kernels import bound, inner, kernel
from master.estimator.epoch import MarkerPositions, SolvedHand
from master.estimator.sensors import CameraArrays, project
from master.fabrik.caps import (
    CapTables,
    Views,
    any_direction,
    appearance,
    hidden_part,
    tilted,
)
from master.fabrik.intersection import (
    Rays,
    Triangulation,
    chi_square,
    limits_of,
    linear,
    observe,
    outlier,
    refine,
    triangulate,
)
from master.fabrik.settings import CAPS, RAYS


class _Rig(NamedTuple):
    """What is the same at every epoch, and scratch."""

    cameras: CameraArrays
    caps: CapTables
    rays_px: float  # standard deviation per axis that the calibration leaves
    limits: Float  # (C + 1,) most chi-square by the number of cameras
    rays: Rays
    views: Views


class _Hand(NamedTuple):
    """Directions of the K caps."""

    known: bool  # False: a cap may point anywhere where it is seen
    as_seen: bool  # what is seen is taken for the centroid, and the whole correction for uncertainty
    R: Float  # (K, 3, 3) rotations of the tip joints, rig frame
    tilt_rad2: Float  # (K, 3, 3) covariance of their directions
    rotation_rad2: float  # variance that their age adds
    at: Float  # (K, 3) [m] about where they are
    process_noise: Float  # (K,) tilt growth to a fit that starts there, as a share of its variance


class _Positions(NamedTuple):
    """As of `RayPositions`, which is made of it."""

    points: Float
    cov: Float
    noise: Float
    outliers: Bool
    rejected: Bool
    uv: Float
    variance: Float
    own: Float


@inner
def _covariance(
    rig: _Rig, row: int, count: int, shared: float, process_noise: float, cov: Float, own: Float
) -> None:
    """Write the covariance (3, 3) of a refined point, and its part unseen by rays."""
    cameras, rays, bias, gain = rig.cameras, rig.rays, rig.views.bias, rig.views.gain
    moved, step, both = rig.views.correction_jacobian_m, rig.views.step, rig.views.both
    for i in range(3):
        for j in range(3):
            step[i, j] = both[i, j] = 0.0  # of the point by a common step; gain gain'
        for t in range(count):
            moved[t, i] = 0.0
    for c in range(rays.weight.shape[0]):
        if rays.weight[c] == 0.0 or not project(cameras, c, rays.point, rays.seen, rays.J):
            continue
        for i in range(3):
            for axis in range(2):
                gain[i, axis] = 0.0
                for k in range(3):
                    gain[i, axis] += rays.weight[c] * rays.cov[i, k] * rays.J[axis, k]
        for i in range(3):
            for t in range(count):
                moved[t, i] += gain[i, 0] * bias[t, c, 0] + gain[i, 1] * bias[t, c, 1]
            for j in range(3):
                step[i, j] += gain[i, 0] * cameras.R[c, 0, j] + gain[i, 1] * cameras.R[c, 1, j]
                both[i, j] += gain[i, 0] * gain[j, 0] + gain[i, 1] * gain[j, 1]
    for i in range(3):
        for j in range(3):
            common = step[i, 0] * step[j, 0] + step[i, 1] * step[j, 1] + step[i, 2] * step[j, 2] - both[i, j]
            shape = CAPS.radius_share**2 * moved[0, i] * moved[0, j]
            shape += CAPS.relief_m**2 if row < 0 and i == j else 0.0
            tilt = 0.0
            for t in range(1, count):
                tilt += (moved[t, i] - moved[0, i]) * (moved[t, j] - moved[0, j]) / (count - 1)
            cov[i, j] = rays.cov[i, j] + shared * common + shape + tilt
            own[i, j] = shape + (1.0 + process_noise) * tilt


@inner
def _correct(rig: _Rig, hand: _Hand, observed: Float, m: int) -> tuple[int, float]:
    """Take the caps' bias from the centroids and weigh them by what is hidden.

    Returns directions that the cap may have, and the variance [px^2] that all cameras have in common.
    """
    rays, views, row = rig.rays, rig.views, rig.caps.row[m]
    for c in range(rays.weight.shape[0]):
        views.area[c] = observed[c, m, 3] if rays.weight[c] > 0.0 else np.nan
    count = CAPS.tilted if hand.known else CAPS.any_tilted
    if row < 0:
        count = 1
    elif hand.known:
        tilted(row, hand.R, hand.tilt_rad2, hand.rotation_rad2, views.aim)
    else:
        any_direction(rig.cameras, rays.point, views.aim)
    appearance(rig.cameras, rig.caps, row, count, rays, views)
    hidden_part(rig.caps, row, views.area, views.scale, views.whole, count, views.hidden)
    shared = RAYS.common_px * RAYS.common_px
    occluded = False
    for c in range(rays.weight.shape[0]):
        if hand.as_seen:
            views.bias[0, c, 0] = views.bias[0, c, 1] = 0.0
        if rays.weight[c] == 0.0:
            continue
        shared = min(shared, rays.variance[c])
        occluded = occluded or views.hidden[c] > 0.0
        rays.uv[c, 0] -= views.bias[0, c, 0]
        rays.uv[c, 1] -= views.bias[0, c, 1]
        rays.variance[c] += views.hidden[c]
        rays.weight[c] = 1.0 / (rays.variance[c] + rig.rays_px * rig.rays_px)
    return count, 0.0 if occluded else RAYS.common * shared


@inner
def _triangulate(
    rig: _Rig, hand: _Hand, observed: Float, rejected: Bool, m: int
) -> tuple[int, bool, int, float]:
    """Triangulate marker m by the cameras that are not rejected.

    Returns how many see it; whether their rays meet; and as `_correct`.
    """
    seen = observe(rig.cameras, observed, rejected, rig.rays_px, m, rig.rays)
    if seen < 2 or not linear(rig.cameras, rig.rays):
        return seen, False, 1, 0.0
    count, shared = _correct(rig, hand, observed, m)
    meets = refine(rig.cameras, rig.rays) and chi_square(rig.rays) <= rig.limits[seen]
    return seen, meets, count, shared


@inner
def _monocular(rig: _Rig, hand: _Hand, observed: Float, m: int) -> None:
    """Take a cap's bias, by the hand, from a single camera; its tilt is own error."""
    rays, bias = rig.rays, rig.views.bias
    for i in range(3):
        rays.point[i] = hand.at[rig.caps.row[m], i]
    count, _ = _correct(rig, hand, observed, m)
    for c in range(rays.weight.shape[0]):
        for t in range(1, count):
            for axis in range(2):
                off = bias[t, c, axis] - bias[0, c, axis]
                rays.variance[c] += off * off / (2.0 * (count - 1))


@kernel
def correct_centres(rig: _Rig, hand: _Hand, observed: Float, out: _Positions) -> None:
    """Locate M markers with covariance.

    `observed` (C, M, 4): u, v, sigma [px], area [px^2]; NaN: not seen. `out` is written.
    """
    cameras, rays, rejected = rig.cameras, rig.rays, out.rejected
    for m in range(observed.shape[1]):
        for c in range(observed.shape[0]):
            rejected[c, m] = False
        seen, meets, count, shared = _triangulate(rig, hand, observed, rejected, m)
        if seen >= 3 and not meets:  # one may be an outlier
            outlying = outlier(cameras, rig.limits[seen - 1], rays)
            if outlying >= 0:
                rejected[outlying, m] = True
                seen, meets, count, shared = _triangulate(rig, hand, observed, rejected, m)
                rejected[outlying, m] = meets
        out.outliers[m] = seen >= 2 and not meets
        row, cov, own = rig.caps.row[m], out.cov[m], out.own[m]
        for i in range(3):
            for j in range(3):
                own[i, j] = 0.0
        if meets:
            much = float(hand.process_noise[row]) if hand.known and row >= 0 else 0.0
            _covariance(rig, row, count, shared, much, cov, own)
        elif seen == 1 and hand.known and row >= 0:
            _monocular(rig, hand, observed, m)
        common = 0.0
        for c in range(observed.shape[0]):
            used = rays.weight[c] > 0.0 and not out.outliers[m]
            own_variance = rays.variance[c] + rig.rays_px * rig.rays_px - (shared if meets else 0.0)
            out.variance[c, m] = own_variance if used else np.nan
            out.uv[c, m, 0], out.uv[c, m, 1] = rays.uv[c, 0], rays.uv[c, 1]
            if meets and used:
                squared = 0.0
                for i in range(3):
                    squared += (rays.point[i] - cameras.centre[c, i]) ** 2
                common += shared * squared / (cameras.scale[c] ** 2 * seen)
        for i in range(3):
            own[i, i] += common
            out.points[m, i] = rays.point[i] if meets else np.nan
            for j in range(3):
                out.noise[m, i, j] = rays.cov[i, j] if meets else np.nan
                if not meets:
                    cov[i, j] = np.nan


@dataclass(frozen=True, slots=True, eq=False)
class RayPositions(MarkerPositions):
    """Markers triangulated by rays, with the information of each ray.

    `own_m2`: covariance of what is wrong with the markers themselves: what all cameras see alike, the tilt
    and the radius of caps; as large as a fit that starts from the same hand must assume.
    """

    uv: Float  # (C, M, 2) [px] centroids without the bias of the caps; NaN: not seen
    variance_px2: Float  # (C, M) per axis, each camera's own; NaN: not seen, an outlier, or rays miss
    own_m2: Float  # (M, 3, 3)


class RayTriangulator:
    """Triangulator of the markers of a rig by rays; holds no state."""

    def __init__(self, cameras: Sequence[CameraModel], caps: CapTables, rays_px: float = 0.0) -> None:
        """Triangulate these markers with these cameras.

        `rays_px`: standard deviation per axis that the calibration leaves.

        Raises:
            ValueError: Fewer than two cameras.
        """
        if len(cameras) < 2:
            raise ValueError(f"triangulation needs two cameras or more, not {len(cameras)}")
        count = len(cameras)
        scratch = Rays.empty(count), Views.empty(count)
        self._rig = _Rig(CameraArrays.of(cameras), caps, rays_px, limits_of(count), *scratch)
        self._unknown = np.zeros((len(caps.radius_m), 3, 3))
        self._correct_centres: Callable[..., None] | None = None

    def __call__(
        self,
        uv: Float,
        sigma_px: Float,
        area_px2: Float,
        hand: SolvedHand | None,
        age_s: float,
        *,
        as_seen: bool = False,
    ) -> "RayPositions":
        """As `master.fabrik.triangulate.DepthTriangulator`, by the rays of all cameras."""
        shape, count, caps = uv.shape[:2], uv.shape[1], self._rig.caps
        observed = np.empty((*shape, 4))
        observed[..., :2], observed[..., 2], observed[..., 3] = uv, sigma_px, area_px2
        R = tilt = self._unknown
        at, process_noise, rotation_rad2 = R[:, 0], R[:, 0, 0], (CAPS.rotation_rad_s * age_s) ** 2
        if hand is not None:
            R, tilt = hand.joints.rotation[caps.joint], hand.tilt_cov_rad2[caps.finger]
            at = hand.joints.position_m[caps.joint]
            # A fit assumes that fingers move as fast as its priors allow. Given less than it assumes itself, it
            # would follow its own error, and finger and cap would drag each other away.
            grown = hand.tilt_process_noise_rad2_s2[caps.finger] * age_s**2 - 2.0 * rotation_rad2
            ours = tilt[:, 0, 0] + tilt[:, 1, 1] + tilt[:, 2, 2] + 2.0 * rotation_rad2
            process_noise = np.maximum(grown, 0.0) / np.maximum(ours, 1e-12)
        about = np.ascontiguousarray(at), np.ascontiguousarray(process_noise)
        directions = _Hand(hand is not None, as_seen, R, tilt, rotation_rad2, *about)
        places = np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, 3, 3))
        flags = np.empty(count, np.bool_), np.empty(shape, np.bool_)
        out = _Positions(*places, *flags, np.empty((*shape, 2)), np.empty(shape), np.empty((count, 3, 3)))
        if self._correct_centres is None:
            self._correct_centres = bound(correct_centres, self._rig, directions, observed, out)
        self._correct_centres(self._rig, directions, observed, out)
        return RayPositions(*out)

    def triangulate(self, uv: Float, sigma_px: float | Float = RAYS.sigma_px) -> Triangulation:
        """Triangulate markers as they are seen (`master.fabrik.intersection`)."""
        return triangulate(self._rig.cameras, uv, sigma_px, self._rig.rays_px)
