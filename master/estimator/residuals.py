"""Kernels of what is measured: predicted values, residuals and their derivatives.

A RAY row is where a camera would see a marker, minus where it did [px]. A camera sees the side of a painted finger end
that faces it, so the centroid of what it sees is off that of the cap by a shift that follows from the direction in
which the finger points: both, place and direction, are the body point's. A POINT row is a measured place [m].

What is wrong with the marker itself, such as paint and bones, is seen by all cameras alike. It is a shift d of the
marker with a covariance S, and is integrated out: with H, g the information and gradient of the rays,

    H - H (H + S^-1)^-1 H,   g - H (H + S^-1)^-1 g,   cost - g' (H + S^-1)^-1 g / 2

so a marker that one camera sees tells two numbers and one that sixteen see is no surer than its paint.
"""

from math import acos, sqrt
from typing import NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.kernels import inlined, kernel
from master.estimator.cameras import CameraArrays, project
from master.estimator.kinematics import Scratch
from master.estimator.matrices import inverse_3
from master.fabrik.caps import CapTables

_POLE = 0.05  # least sine of the angle between finger and sight of the slopes of the tables
_BEHIND = 1e4  # half chi square of a marker behind a camera that sees it
_NOWHERE = 1.0  # [1/m^2] information about a marker that no row tells of


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
    """

    uv: Float
    weight: Float
    own: Float
    point: Float
    information: Float
    placed: Bool
    seen: Bool

    @classmethod
    def empty(cls, cameras: int, markers: int) -> "Observations":
        """Room for one epoch; nothing is seen yet."""
        return cls(
            np.zeros((cameras, markers, 2)),
            np.zeros((cameras, markers)),
            np.zeros((markers, 3, 3)),
            np.zeros((markers, 3)),
            np.zeros((markers, 3, 3)),
            np.zeros(markers, np.bool_),
            np.zeros(markers, np.bool_),
        )


@inlined
def cap_shift(caps: CapTables, row: int, ahead: Float, back: Float, shift: Float, slope: Float) -> None:
    """Write the shift of a cap's seen centroid, and how it changes with the finger's direction.

    With c the cosine between both directions, the shift is (F - c G) ahead + G back; F and G are tabulated.

    Args:
        caps, row: The cap.
        ahead, back: (3,) unit vectors along the finger and to the eye.
        shift, slope: Written: (3,) [m], (3, 3) [m].
    """
    cosine = ahead[0] * back[0] + ahead[1] * back[1] + ahead[2] * back[2]
    cosine = min(max(cosine, -1.0), 1.0)
    sine = max(sqrt(1.0 - cosine * cosine), _POLE)
    last = caps.looks.shape[1] - 1
    per_rad = last / np.pi
    at = acos(cosine) * per_rad
    low = min(int(at), last - 1)
    part = at - low
    f0, f1 = caps.looks[row, low, 0], caps.looks[row, low + 1, 0]
    g0, g1 = caps.looks[row, low, 1], caps.looks[row, low + 1, 1]
    f, g = (1.0 - part) * f0 + part * f1, ((1.0 - part) * g0 + part * g1) / sine
    df = -(f1 - f0) * per_rad / sine  # by the cosine
    dg = -((g1 - g0) * per_rad - cosine * g) / (sine * sine) if sine > _POLE else 0.0
    along = f - cosine * g
    for i in range(3):
        shift[i] = along * ahead[i] + g * back[i]
        for j in range(3):
            by_cosine = (df - g - cosine * dg) * ahead[i] + dg * back[i]
            slope[i, j] = by_cosine * back[j] + (along if i == j else 0.0)


@inlined
def _ray(
    cameras: CameraArrays,
    caps: CapTables,
    observed: Observations,
    c: int,
    m: int,
    point: Float,
    ahead: Float,
    work: Scratch,
) -> float:
    """Add one RAY row to information and gradient by place and direction; return half chi square."""
    back, A, g, H = work.back, work.A, work.g, work.H
    length = 0.0
    for i in range(3):
        back[i] = cameras.centre[c, i] - point[i]
        length += back[i] * back[i]
    length = sqrt(length)
    row = caps.row[m]
    for i in range(3):
        back[i] /= length
        work.there[i] = point[i]
    if row >= 0:
        cap_shift(caps, row, ahead, back, work.shift, work.slope)
        for i in range(3):
            work.there[i] += work.shift[i]
    if not project(cameras, c, work.there, work.uv, work.J):
        return _BEHIND
    for k in range(2):
        for i in range(3):
            A[k, i], A[k, 3 + i] = work.J[k, i], 0.0
            if row >= 0:
                for j in range(3):
                    A[k, 3 + i] += work.J[k, j] * work.slope[j, i]
    w, r0, r1 = observed.weight[c, m], work.uv[0] - observed.uv[c, m, 0], work.uv[1] - observed.uv[c, m, 1]
    for a in range(6 if row >= 0 else 3):
        g[a] += w * (A[0, a] * r0 + A[1, a] * r1)
        for b in range(a + 1):
            H[a, b] += w * (A[0, a] * A[0, b] + A[1, a] * A[1, b])
            H[b, a] = H[a, b]
    return 0.5 * w * (r0 * r0 + r1 * r1)


@inlined
def marker_rows(
    cameras: CameraArrays,
    caps: CapTables,
    observed: Observations,
    m: int,
    point: Float,
    ahead: Float,
    work: Scratch,
) -> tuple[float, float]:
    """Write information and gradient of one marker by its place and direction.

    Into work.H (6, 6) and work.g (6,).

    Args:
        cameras, caps, observed, m: What is seen of which marker.
        point: (3,) [m] where the hand has the marker, rig frame.
        ahead: (3,) unit vector in which its finger points; not used of a marker on the palm.
        work: Written.

    Returns:
        Half chi square, and chi square of the place alone: without what rays that do not meet have between them.
    """
    H, g, K, gain = work.H, work.g, work.K, work.gain
    for a in range(6):
        g[a] = 0.0
        for b in range(6):
            H[a, b] = 0.0
    cost = 0.0
    if observed.placed[m]:
        for i in range(3):
            for j in range(3):
                H[i, j] = observed.information[m, i, j]
                g[i] += observed.information[m, i, j] * (point[j] - observed.point[m, j])
            cost += 0.5 * g[i] * (point[i] - observed.point[m, i])
        return cost, 2.0 * cost
    for c in range(observed.uv.shape[0]):
        if observed.weight[c, m] > 0.0:
            cost += _ray(cameras, caps, observed, c, m, point, ahead, work)
    for i in range(3):
        for j in range(3):
            K[i, j] = _NOWHERE if i == j else 0.0
    inverse_3(H, K, K)
    whole, shared = 0.0, 0.0
    for i in range(3):
        whole += g[i] * (K[i, 0] * g[0] + K[i, 1] * g[1] + K[i, 2] * g[2])
    inverse_3(H, observed.own[m], K)
    for i in range(3):
        gain[i] = K[i, 0] * g[0] + K[i, 1] * g[1] + K[i, 2] * g[2]
        shared += g[i] * gain[i]
    left, gained = work.left, work.gained
    for a in range(6):
        for i in range(3):
            left[a, i] = H[a, i]
            gained[a, i] = H[a, 0] * K[0, i] + H[a, 1] * K[1, i] + H[a, 2] * K[2, i]
    for a in range(6):
        g[a] -= left[a, 0] * gain[0] + left[a, 1] * gain[1] + left[a, 2] * gain[2]
        for b in range(6):
            H[a, b] -= gained[a, 0] * left[b, 0] + gained[a, 1] * left[b, 1] + gained[a, 2] * left[b, 2]
    return cost - 0.5 * shared, max(whole - shared, 0.0)


@kernel
def observe_rays(uv: Float, variance: Float, own: Float, markers: Int, observed: Observations) -> int:
    """Write the RAY rows of a hand's markers; return how many markers have any.

    Args:
        uv: (C, A, 2) [px] of all markers of the rig; NaN: not seen.
        variance: (C, A) [px^2] of each camera's own errors.
        own: (A, 3, 3) [m^2] covariance of what is wrong with each marker itself.
        markers: (M,) which of them are the hand's.
        observed: Written.
    """
    count = 0
    zero = np.zeros((3, 3))
    for k in range(markers.shape[0]):
        m = markers[k]
        seen = False
        for c in range(uv.shape[0]):
            row = np.isfinite(uv[c, m, 0] + uv[c, m, 1] + variance[c, m])
            observed.weight[c, k] = 1.0 / variance[c, m] if row else 0.0
            observed.uv[c, k, 0], observed.uv[c, k, 1] = uv[c, m, 0], uv[c, m, 1]
            seen = seen or row
        observed.seen[k], observed.placed[k] = seen, False
        if seen:
            inverse_3(own[m], zero, observed.own[k])
            count += 1
    return count


@kernel
def observe_points(point: Float, cov: Float, own_m2: float, observed: Observations) -> int:
    """Write POINT rows; return how many markers have one.

    Args:
        point, cov: (M, 3) [m], (M, 3, 3) [m^2]; NaN: not seen.
        own_m2: Variance of what is wrong with the markers themselves.
        observed: Written.
    """
    count = 0
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
        observed.seen[m], observed.placed[m] = seen, seen
        for c in range(observed.weight.shape[0]):
            observed.weight[c, m] = 0.0
        if seen:
            inverse_3(cov[m], own, observed.information[m])
            count += 1
    return count
