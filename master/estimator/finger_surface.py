"""Kernels of a finger before a wrist device.

The skin of a finger is a chain of capsules (`common.hand.skin`), cut by the plane of the laser. What the
camera makes of the cut is the centroid of the part that is lit and seen. It lies near a *ridge*: the points
of the spheres that face the laser, pulled in to 0.77 of the radius, for the mean of a cosine over the half
circle that faces the light lies there (pi / 4, less what is seen at a slant). Where the chain of ridge points
crosses the plane nearest to the laser is the laser point: within 0.2 mm (median) from a PIP of 45 degrees on,
0.4 mm over all, at most about 1 mm. The ridge has derivatives in closed form; the exact cut
(`laser_centroid`) gives what it lacks.

A body that turns about an axis moves its point q on the plane by v, and the plane then meets the chain, of
direction s, at q + v - s (n . v) / (n . s), with n the normal of the plane.
"""

from math import atan2, cos, inf, log, sin, sqrt
from typing import Any

import numpy as np

from common.arrays import Float
from common.kernels import constant, inlined, inner
from common.records import array
from master.estimator.kinematics import finger_chain, hinge_axis
from master.estimator.parameters import HandTables
from master.estimator.settings import KERNEL

# Abduction, flexion, PIP, DIP, twist, and the wrist's flexion and deviation; all, those of the finger itself, none.
MOVES, OWN_MOVES, NO_MOVES = constant(7), constant(5), constant(0)
_BONE = np.array([0, 0, 0, 0, 1, 1, 2, 2])
_ROOT = int((_BONE == 0).sum())  # spheres of the first bone, which of a thumb is in its ball
RAYS = KERNEL.rays


class Surface:
    """Scratch for one finger."""

    S: Float = array(8, 3)  # spheres
    Q: Float = array(9, 3)  # ridge
    along: Float = array(8, 3)
    bone: Float = array(7, 3)  # unit vectors from sphere to sphere
    q: Float = array(3)  # laser point
    way: Float = array(3)  # of the chain there
    laser: Float = array(7, 12)  # terms of the cones from the laser
    camera: Float = array(7, 12)  # and from the camera
    ray: Float = array(3)
    lit: Float = array(RAYS, 5)  # x, y, z, clearness, body
    reached: Float = array(7)  # whether the plane comes near a cone
    begins: Float = array(7)  # no part of a cone is nearer to the camera [m]
    laser_centroid: Float = array(3)  # point of the exact cut
    R: Float = array(4, 3, 3)  # joints, camera frame
    P: Float = array(4, 3)
    axis: Float = array(7, 3)  # about which each of `MOVES` turns what is beyond
    tip: Float = array(3)
    seen: Float = array(5)  # laser x, y, tip x, y, logarithm of the tip's distance
    J: Float = array(5, MOVES)  # its derivatives by `MOVES`


@inner
def spheres(device: Any, f: int, work: Surface) -> None:
    """Write the spheres of finger f by `work.R`, `work.P`, and their direction."""
    S, along, bone, R, P = work.S, work.along, work.bone, work.R, work.P
    for k in range(8):
        b = _BONE[k]
        if k == 4 or k == 6:
            x = y = z = 0.0
            for other in range(b - 1, b + 1):
                for j in range(3):
                    d = device.back[f, other, j]
                    x += R[other, 0, j] * d
                    y += R[other, 1, j] * d
                    z += R[other, 2, j] * d
            scale = device.deep[f, k] / sqrt(x * x + y * y + z * z)
            S[k, 0], S[k, 1], S[k, 2] = P[b, 0] + scale * x, P[b, 1] + scale * y, P[b, 2] + scale * z
            continue
        for i in range(3):
            total = P[b, i]
            for j in range(3):
                total += R[b, i, j] * device.local[f, k, j]
            S[k, i] = total
    for k in range(7):
        x, y, z = S[k + 1, 0] - S[k, 0], S[k + 1, 1] - S[k, 1], S[k + 1, 2] - S[k, 2]
        scale = 1.0 / sqrt(x * x + y * y + z * z)
        bone[k, 0], bone[k, 1], bone[k, 2] = scale * x, scale * y, scale * z
    for k in range(8):
        x = y = z = 0.0
        for first in range(max(k - 1, 0), min(k, 6) + 1):
            x, y, z = x + bone[first, 0], y + bone[first, 1], z + bone[first, 2]
        scale = 1.0 / sqrt(x * x + y * y + z * z)
        along[k, 0], along[k, 1], along[k, 2] = scale * x, scale * y, scale * z


@inner
def crossing(device: Any, f: int, work: Surface) -> int:
    """Write where finger f's ridge crosses the plane; return the bone.

    A chain that does not reach the plane is prolonged. `work.way`: direction of the ridge there.
    """
    S, Q, along, laser = work.S, work.Q, work.along, device.laser_m
    for k in range(8):
        x, y, z = laser[0] - S[k, 0], laser[1] - S[k, 1], laser[2] - S[k, 2]
        dot = x * along[k, 0] + y * along[k, 1] + z * along[k, 2]
        x, y, z = x - dot * along[k, 0], y - dot * along[k, 1], z - dot * along[k, 2]
        scale = device.radius[f, k] / sqrt(x * x + y * y + z * z)
        pulled_in = KERNEL.pulled_in * scale
        Q[k, 0], Q[k, 1], Q[k, 2] = S[k, 0] + pulled_in * x, S[k, 1] + pulled_in * y, S[k, 2] + pulled_in * z
        if k == 7:
            out, ahead = KERNEL.cap_out * scale, KERNEL.cap_along * device.radius[f, k]
            Q[8, 0] = S[7, 0] + out * x + ahead * along[7, 0]
            Q[8, 1] = S[7, 1] + out * y + ahead * along[7, 1]
            Q[8, 2] = S[7, 2] + out * z + ahead * along[7, 2]
    n, offset = device.plane[2], device.offset[0]
    best, at, share = inf, -1, 0.0
    near = n[0] * Q[0, 0] + n[1] * Q[0, 1] + n[2] * Q[0, 2] - offset
    first = near
    for k in range(8):
        far = n[0] * Q[k + 1, 0] + n[1] * Q[k + 1, 1] + n[2] * Q[k + 1, 2] - offset
        if (near > 0.0) != (far > 0.0) and not (f == 0 and k < _ROOT - 1):
            part = near / (near - far)
            away = 0.0
            for i in range(3):
                off = Q[k, i] + part * (Q[k + 1, i] - Q[k, i]) - laser[i]
                away += off * off
            if away < best:
                best, at, share = away, k, part
        near = far
    met = at >= 0
    if not met:
        at = 7 if device.before[0] * near > 0.0 else 0
    x, y, z = Q[at + 1, 0] - Q[at, 0], Q[at + 1, 1] - Q[at, 1], Q[at + 1, 2] - Q[at, 2]
    rise, length = n[0] * x + n[1] * y + n[2] * z, sqrt(x * x + y * y + z * z)
    least = KERNEL.level * length
    held = rise
    if abs(rise) < least:
        held = least if rise >= 0.0 else -least
    if not met:
        height = near if at == 7 else first
        if at == 7:
            height -= rise  # of the beginning of the stretch
        share = min(max(-height / held, -KERNEL.prolonged), KERNEL.prolonged)
    for i in range(3):
        w = Q[at + 1, i] - Q[at, i]
        work.q[i] = Q[at, i] + share * w
        work.way[i] = w + (held - rise) * n[i]
    return int(_BONE[at])


@inlined
def _terms(S: Float, k: int, r1: float, r2: float, ox: float, oy: float, oz: float, out: Float) -> None:
    """Write `first_hit` terms (12,) of the cone from sphere k on, from a point."""
    ax, ay, az = S[k + 1, 0] - S[k, 0], S[k + 1, 1] - S[k, 1], S[k + 1, 2] - S[k, 2]
    wx, wy, wz = ox - S[k, 0], oy - S[k, 1], oz - S[k, 2]
    bx, by, bz = ox - S[k + 1, 0], oy - S[k + 1, 1], oz - S[k + 1, 2]
    narrowing = r1 - r2
    m0, m1, m5 = ax * ax + ay * ay + az * az, ax * wx + ay * wy + az * wz, wx * wx + wy * wy + wz * wz
    d2 = m0 - narrowing * narrowing
    out[0], out[1], out[2], out[3], out[4], out[5] = ax, ay, az, wx, wy, wz
    out[6] = d2
    out[7] = d2 * m5 - m1 * m1 + 2.0 * m1 * narrowing * r1 - m0 * r1 * r1
    out[8], out[9] = narrowing * r1 - m1, m1 - r1 * narrowing
    out[10], out[11] = m5 - r1 * r1, bx * bx + by * by + bz * bz - r2 * r2


@inlined
def _least_distance(S: Float, k: int) -> float:
    """How far the way from sphere k to k + 1 is from the camera at least [m]."""
    ax, ay, az = S[k + 1, 0] - S[k, 0], S[k + 1, 1] - S[k, 1], S[k + 1, 2] - S[k, 2]
    foot = -(S[k, 0] * ax + S[k, 1] * ay + S[k, 2] * az) / (ax * ax + ay * ay + az * az)
    share = min(max(foot, 0.0), 1.0)
    x, y, z = S[k, 0] + share * ax, S[k, 1] + share * ay, S[k, 2] + share * az
    return sqrt(x * x + y * y + z * z)


@inlined
def first_hit(t: Float, dx: float, dy: float, dz: float) -> float:
    """Return the distance along a unit ray to a cone's terms (12,); inf: missed."""
    m2, m3 = dx * t[0] + dy * t[1] + dz * t[2], dx * t[3] + dy * t[4] + dz * t[5]
    best, d2 = inf, t[6]
    k2, k1 = d2 - m2 * m2, d2 * m3 + m2 * t[8]
    h = k1 * k1 - t[7] * k2
    if h >= 0.0 and k2 > 1e-6 * d2:
        side = (-sqrt(h) - k1) / k2
        foot = t[9] + side * m2
        if foot > 0.0 and foot < d2:
            best = side
    h = m3 * m3 - t[10]
    if h >= 0.0:
        best = min(best, -m3 - sqrt(h))
    m3 -= m2
    h = m3 * m3 - t[11]
    if h >= 0.0:
        best = min(best, -m3 - sqrt(h))
    return best if best > 0.0 else inf


@inner
def laser_centroid(device: Any, f: int, work: Surface) -> float:
    """Write the centroid (3,) [m] of finger f's seen laser line; return its length.

    In the undistorted image [px]; 0: the laser misses the finger, or it is not seen.
    """
    S, laser, radius, broad = work.S, device.laser_m, device.radius[f], 0.0
    for k in range(8):
        broad = max(broad, 2.0 * radius[k])
    low, high = _lit_span(device, f, work)
    if not low < high:
        return 0.0
    for k in range(7):
        _terms(S, k, radius[k], radius[k + 1], 0.0, 0.0, 0.0, work.camera[k])
        rounded_m = 1e-9
        work.begins[k] = _least_distance(S, k) - max(radius[k], radius[k + 1]) - rounded_m
        if work.reached[k] > 0.0:
            _terms(S, k, radius[k], radius[k + 1], laser[0], laser[1], laser[2], work.laser[k])
    step, first = (high - low) / (RAYS - 1), _ROOT - 1 if f == 0 else 0
    for ray in range(RAYS):
        _cast(device, low + ray * step, first, work, work.lit[ray])
    total = u = v = 0.0
    for ray in range(RAYS - 1):
        weight, x, y = _chord(work.lit[ray], work.lit[ray + 1], broad)
        u += weight * x
        v += weight * y
        total += weight
    if not total > 0.0:
        return 0.0
    u, v = u / total, v / total
    n = device.plane[2]
    far = device.offset[0] / (n[0] * u + n[1] * v + n[2])
    work.laser_centroid[0], work.laser_centroid[1], work.laser_centroid[2] = far * u, far * v, far
    return total * device.focal[0]


@inner
def _lit_span(device: Any, f: int, work: Surface) -> tuple[float, float]:
    """Return the angles from the laser in which finger f may be lit; write `reached`."""
    S, laser, radius, n = work.S, device.laser_m, device.radius[f], device.plane[2]
    low, high, near = inf, -inf, 0.0
    for k in range(7):
        work.reached[k] = 0.0
    for k in range(8):
        r = radius[k]
        height = n[0] * S[k, 0] + n[1] * S[k, 1] + n[2] * S[k, 2] - device.offset[0]
        crosses = k > 0 and (height > 0.0) != (near > 0.0)
        if abs(height) < r or crosses:
            work.reached[max(k - 1, 0)] = 1.0
            work.reached[min(k, 6)] = 1.0
        if crosses:
            share = near / (near - height)
            x = S[k - 1, 0] + share * (S[k, 0] - S[k - 1, 0]) - laser[0]
            y = S[k - 1, 1] + share * (S[k, 1] - S[k - 1, 1]) - laser[1]
            z = S[k - 1, 2] + share * (S[k, 2] - S[k - 1, 2]) - laser[2]
            angle, away = _in_plane(device, x, y, z)
            wide = KERNEL.span_crossed * max(r, radius[k - 1]) / away
            low, high = min(low, angle - wide), max(high, angle + wide)
        if abs(height) < r:
            angle, away = _in_plane(device, S[k, 0] - laser[0], S[k, 1] - laser[1], S[k, 2] - laser[2])
            wide = KERNEL.span_cut * (sqrt(r * r - height * height) / away)
            low, high = min(low, angle - wide), max(high, angle + wide)
        near = height
    return low, high


@inlined
def _in_plane(device: Any, x: float, y: float, z: float) -> tuple[float, float]:
    """Return angle and distance from the laser, in its plane."""
    a, c = device.plane[0], device.plane[1]
    across, ahead = a[0] * x + a[1] * y + a[2] * z, c[0] * x + c[1] * y + c[2] * z
    return atan2(across, ahead), sqrt(across * across + ahead * ahead)


@inner
def _cast(device: Any, angle: float, first: int, work: Surface, lit: Float) -> None:
    """Write what a laser ray meets first (5,), of the cones from `first` on."""
    laser, a, b = device.laser_m, device.plane[0], device.plane[1]
    s, c = sin(angle), cos(angle)
    dx, dy, dz = s * a[0] + c * b[0], s * a[1] + c * b[1], s * a[2] + c * b[2]
    far, body = inf, -1
    for k in range(7):
        if work.reached[k] > 0.0:
            t = first_hit(work.laser[k], dx, dy, dz)
            if t < far:
                far, body = t, k
    lit[3], lit[4] = -inf, body
    if body < first:
        return
    x, y, z = laser[0] + far * dx, laser[1] + far * dy, laser[2] + far * dz
    lit[0], lit[1], lit[2] = x, y, z
    distance = sqrt(x * x + y * y + z * z)
    if not z > 0.0:
        return
    ex, ey, ez, seen = x / distance, y / distance, z / distance, inf
    for k in range(7):
        if work.begins[k] < distance:  # what is farther hides nothing
            seen = min(seen, first_hit(work.camera[k], ex, ey, ez))
    lit[3] = min(seen - distance, 0.0) + KERNEL.seen_m


@inlined
def _chord(here: Float, there: Float, broad: float) -> tuple[float, float, float]:
    """Return length and middle of what is seen between two lit points."""
    a, b = here[3], there[3]
    if not (a > -inf and b > -inf) or (a <= 0.0 and b <= 0.0):
        return 0.0, 0.0, 0.0
    dx, dy, dz = there[0] - here[0], there[1] - here[1], there[2] - here[2]
    if dx * dx + dy * dy + dz * dz > (KERNEL.chord * broad) ** 2:
        return 0.0, 0.0, 0.0
    begin = a / (a - b) if a <= 0.0 else 0.0
    end = a / (a - b) if b <= 0.0 else 1.0
    x0, y0, x1, y1 = here[0] / here[2], here[1] / here[2], there[0] / there[2], there[1] / there[2]
    weight = (end - begin) * sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2)
    middle = 0.5 * (begin + end)
    return weight, x0 + middle * (x1 - x0), y0 + middle * (y1 - y0)


@inner
def look(
    hand: HandTables,
    device: Any,
    T: Float,
    wrist_axes: Float,
    angles: Float,
    f: int,
    moves: int,
    work: Surface,
) -> None:
    """Write what is seen of finger f by ridge and tip to `seen`, derivatives to `J`.

    `T` (4, 4) palm, camera frame, `wrist_axes` (2, 3) as of `flexed_palm`, `angles` (20,) [rad]; `moves`: by
    how many of `MOVES` derivatives are wanted.
    """
    R, P, A, J, seen = work.R, work.P, work.axis, work.J, work.seen
    finger_chain(hand, T, angles, f, R, P)
    spheres(device, f, work)
    bone = crossing(device, f, work)
    n, q, w, t = device.plane[2], work.q, work.way, work.tip
    rise = n[0] * w[0] + n[1] * w[1] + n[2] * w[2]
    for i in range(3):
        t[i] = P[2, i]
        for j in range(3):
            t[i] += R[2, i, j] * device.tip[f, j]
    x, y = q[0] / q[2], q[1] / q[2]
    tx, ty = t[0] / t[2], t[1] / t[2]
    seen[0], seen[1], seen[2], seen[3], seen[4] = x, y, tx, ty, log(max(t[2], KERNEL.nearest_m))
    if moves == 0:
        return
    for k in range(4):
        A[k, 0], A[k, 1], A[k, 2] = hinge_axis(hand, T, R, f, k)
    for i in range(3):
        A[4, i] = 0.0
        A[5, i], A[6, i] = wrist_axes[0, i], wrist_axes[1, i]
    # The twist turns about the first bone as it is before the flexion.
    c, s = cos(angles[4 * f + 1]), sin(angles[4 * f + 1])
    swing, u = hand.swing, hand.twist_axis[f]
    for k in range(3):
        along = 0.0
        for j in range(3):
            along += (swing[0, f, 1, j, k] + c * swing[1, f, 1, j, k] + s * swing[2, f, 1, j, k]) * u[j]
        for i in range(3):
            A[4, i] += R[0, i, k] * along
    for k in range(moves):
        ax, ay, az = A[k, 0], A[k, 1], A[k, 2]
        ox, oy, oz, carried = P[0, 0], P[0, 1], P[0, 2], True
        if k == 2 or k == 3:
            ox, oy, oz, carried = P[k - 1, 0], P[k - 1, 1], P[k - 1, 2], bone >= k - 1
        elif k >= 5:
            ox, oy, oz = T[0, 3], T[1, 3], T[2, 3]
        J[0, k] = J[1, k] = 0.0
        if carried:
            dx, dy, dz = q[0] - ox, q[1] - oy, q[2] - oz
            vx, vy, vz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
            slide = (n[0] * vx + n[1] * vy + n[2] * vz) / rise
            vz -= slide * w[2]
            J[0, k], J[1, k] = (vx - slide * w[0] - x * vz) / q[2], (vy - slide * w[1] - y * vz) / q[2]
        dx, dy, dz = t[0] - ox, t[1] - oy, t[2] - oz
        vx, vy, vz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
        J[2, k], J[3, k], J[4, k] = (vx - tx * vz) / t[2], (vy - ty * vz) / t[2], vz / t[2]
