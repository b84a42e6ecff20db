"""Kernels of what is measured: predicted values, residuals and their derivatives.

A RAY row is where a camera would see a marker, minus where it did [px], without what the side of a painted cap that it
sees shifts its centroid by (`master.fabrik.rays`). A POINT row is a measured place [m].

What is wrong with the marker itself, such as its colour, bones and the side of a cap that is not known, is seen by all
cameras. It is a shift d of the marker with a covariance S, and is integrated out: with H, g the information and
gradient of the rays,

    H - H (H + S^-1)^-1 H,   g - H (H + S^-1)^-1 g,   cost - g' (H + S^-1)^-1 g / 2

so a marker that one camera sees gives two numbers and one that sixteen see is no surer than its colour.
"""

from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.kernels import inlined, kernel
from master.estimator.cameras import CameraArrays, project
from master.estimator.kinematics import Scratch
from master.estimator.matrices import inverse_3


class Observations(NamedTuple):
    """What is measured of M markers of a hand at one epoch.

    Attributes:
        uv: (C, M, 2) [px] centroids in the distorted images.
        weight: (C, M) [1/px^2] inverse variance per axis, of each camera's own errors; 0: no row.
        own: (M, 3, 3) [1/m^2] inverse covariance of what is wrong with the marker itself.
        point: (M, 3) [m] measured places, rig frame.
        information: (M, 3, 3) [1/m^2] their inverse covariances.
        placed: (M,) whether there is a POINT row.
        seen: (M,) whether there is any row.
        rays: (M,) how many rays; of a POINT row two.
    """

    uv: Float
    weight: Float
    own: Float
    point: Float
    information: Float
    triangulated: Bool
    seen: Bool
    rays: Int

    @classmethod
    def empty(cls, cameras: int, markers: int) -> "Observations":
        """Scratch for one epoch; nothing is seen yet."""
        return cls(
            np.zeros((cameras, markers, 2)),
            np.zeros((cameras, markers)),
            np.zeros((markers, 3, 3)),
            np.zeros((markers, 3)),
            np.zeros((markers, 3, 3)),
            np.zeros(markers, np.bool_),
            np.zeros(markers, np.bool_),
            np.zeros(markers, np.int64),
        )


@inlined
def _ray(cameras: CameraArrays, observed: Observations, c: int, m: int, point: Float, work: Scratch) -> float:
    """Add one RAY row to information and gradient by place; return half chi square."""
    J, g, H = work.J, work.g, work.H
    if not project(cameras, c, point, work.uv, J):
        return 1e4  # half chi square of a marker behind a camera that sees it
    w, r0, r1 = observed.weight[c, m], work.uv[0] - observed.uv[c, m, 0], work.uv[1] - observed.uv[c, m, 1]
    for a in range(3):
        g[a] += w * (J[0, a] * r0 + J[1, a] * r1)
        for b in range(3):
            H[a, b] += w * (J[0, a] * J[0, b] + J[1, a] * J[1, b])
    return 0.5 * w * (r0 * r0 + r1 * r1)


@inlined
def marker_rows(
    cameras: CameraArrays, observed: Observations, m: int, point: Float, work: Scratch
) -> tuple[float, float]:
    """Write information and gradient of one marker by its place.

    They go to work.H (3, 3) and work.g (3,).

    Args:
        cameras, observed, m: What is seen of which marker.
        point: (3,) [m] where the hand has the marker, rig frame.
        work: Written.

    Returns:
        Half chi square, and chi square of the place alone: without what rays that do not meet have between them.
    """
    H, g, K, gain, left = work.H, work.g, work.K, work.gain, work.left
    cost = 0.0
    for a in range(3):
        g[a] = 0.0
        for b in range(3):
            H[a, b] = 0.0
    if observed.triangulated[m]:
        for i in range(3):
            for j in range(3):
                H[i, j] = observed.information[m, i, j]
                g[i] += observed.information[m, i, j] * (point[j] - observed.point[m, j])
            cost += 0.5 * g[i] * (point[i] - observed.point[m, i])
        return cost, 2.0 * cost
    for c in range(observed.uv.shape[0]):
        if observed.weight[c, m] > 0.0:
            cost += _ray(cameras, observed, c, m, point, work)
    for i in range(3):
        for j in range(3):
            nowhere = 1.0  # [1/m^2] information about a marker that no row constrains
            K[i, j] = nowhere if i == j else 0.0
    inverse_3(H, K, K)
    whole, shared = 0.0, 0.0
    for i in range(3):
        whole += g[i] * (K[i, 0] * g[0] + K[i, 1] * g[1] + K[i, 2] * g[2])
    inverse_3(H, observed.own[m], K)
    for i in range(3):
        gain[i] = K[i, 0] * g[0] + K[i, 1] * g[1] + K[i, 2] * g[2]
        shared += g[i] * gain[i]
        for j in range(3):
            left[i, j] = H[i, j]
    for a in range(3):
        g[a] -= left[a, 0] * gain[0] + left[a, 1] * gain[1] + left[a, 2] * gain[2]
        for k in range(3):
            work.gained[a, k] = left[a, 0] * K[0, k] + left[a, 1] * K[1, k] + left[a, 2] * K[2, k]
        for b in range(3):
            total = 0.0
            for k in range(3):
                total += work.gained[a, k] * left[b, k]
            H[a, b] -= total
    return cost - 0.5 * shared, max(whole - shared, 0.0)


@kernel
def observe_rays(uv: Float, variance: Float, own: Float, markers: Int, observed: Observations) -> None:
    """Write the RAY rows of a hand's markers.

    Args:
        uv: (C, A, 2) [px] of all markers of the rig; NaN: not seen.
        variance: (C, A) [px^2] of each camera's own errors.
        own: (A, 3, 3) [m^2] covariance of what is wrong with each marker itself.
        markers: (M,) which of them are the hand's.
        observed: Written.
    """
    zero = np.zeros((3, 3))
    for k in range(markers.shape[0]):
        m, rays = markers[k], 0
        for c in range(uv.shape[0]):
            row = np.isfinite(uv[c, m, 0] + uv[c, m, 1] + variance[c, m])
            observed.weight[c, k] = 1.0 / variance[c, m] if row else 0.0
            observed.uv[c, k, 0], observed.uv[c, k, 1] = uv[c, m, 0], uv[c, m, 1]
            rays += 1 if row else 0
        observed.seen[k], observed.triangulated[k], observed.rays[k] = rays > 0, False, rays
        if rays > 0:
            inverse_3(own[m], zero, observed.own[k])


@kernel
def observe_points(point: Float, cov: Float, own_m2: float, observed: Observations) -> None:
    """Write POINT rows.

    Args:
        point, cov: (M, 3) [m], (M, 3, 3) [m^2]; NaN: not seen.
        own_m2: Variance of what is wrong with the markers themselves.
        observed: Written.
    """
    own = np.zeros((3, 3))
    for i in range(3):
        own[i, i] = own_m2
    for m in range(point.shape[0]):
        total = 0.0
        for i in range(3):
            total += point[m, i]
            observed.point[m, i] = point[m, i]
            for j in range(3):
                total += cov[m, i, j]
        seen = np.isfinite(total)
        observed.seen[m], observed.triangulated[m], observed.rays[m] = seen, seen, 2 if seen else 0
        for c in range(observed.weight.shape[0]):
            observed.weight[c, m] = 0.0
        if seen:
            inverse_3(cov[m], own, observed.information[m])
