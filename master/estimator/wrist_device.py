"""A wrist device and its hand as flat arrays for kernels.

Also what the device saw of the five fingers.

To the noise of what is seen comes what the model of the hand does not know: skin whose thickness is not that of this
person, what calibration leaves of plane and palm, and the part of the line that is not seen. The centroid of a line
shorter than expected is off across by up to half of what is missing, and by a third of that along, as skin curves away.
"""

from math import cos, hypot, log, sin
from typing import Any

import numpy as np

from common.arrays import Float
from common.hand.fingertips import Fingertips
from common.hand.palmar_surface import PLACES, SPREAD, PalmarSurface
from common.kernels import inlined, inner, kernel
from common.messages.records import filled, record
from master.estimator.laser_plane import PlaneAxes
from master.rig.wrist import WristSetup

TWIST, WRIST_ANGLES, RATE, TILT, HEADING, LED_SCALE, EXTRAS = 0, 5, 7, 9, 11, 12, 13
NO_EXTRAS = 1  # of a rig without wrist device: one that means nothing
_PALM_M = 7e-4  # what calibration leaves of plane and palm: a palm pitched by 0.2 degrees, and 0.3 mm


class Device:
    """Geometry of a wrist device mounted before its hand.

    Lengths are in metres, in the camera frame unless stated otherwise.

    Attributes:
        palm: (4, 4) that of a straight wrist.
        laser_m: (3,) where the laser's light comes from, in its plane.
        plane: (3, 3) unit vectors across and along the plane, and its normal.
        offset: (1,) the plane is normal . X = offset.
        focal: (1,) [px].
        before: (1,) on which side of the plane the wrist lies, 1 or -1.
        radius: (5, 8) of the spheres of the skin, finger by sphere.
        deep: (5, 8) how far behind the bone their centres lie, dorsally.
        local: (5, 8, 3) their centres in the frames of their bones' joints.
        back: (5, 3, 3) unit vectors towards the back of each bone, in the frame of its joint.
        tip: (5, 3) fingertip in the frame of the last joint but the tip.
        surface2: (5,) [m^2] variance of the skin's distance from the bone.
        tip2: (5,) [m^2] variance of where the skin ends.
    """

    palm: Float
    laser_m: Float
    plane: Float
    offset: Float
    focal: Float
    before: Float
    radius: Float
    deep: Float
    local: Float
    back: Float
    tip: Float
    surface2: Float
    tip2: Float

    @classmethod
    def of(cls, setup: WristSetup) -> "Device":
        """Lay out a device."""
        model, surface, axes = setup.model, PalmarSurface.of(setup.model), PlaneAxes.of(setup)
        tips = Fingertips.of(model)
        deep = surface.radius_m - surface.palmar_m
        back, local = np.zeros((5, 3, 3)), np.zeros((5, len(PLACES), 3))
        up = np.array([0.0, 1.0, 0.0])
        for f in range(5):
            for b in range(3):
                bone = model.bone_m[f, b] / np.linalg.norm(model.bone_m[f, b])
                dorsal = up - (up @ bone) * bone
                back[f, b] = dorsal / np.linalg.norm(dorsal)
            for k, (b, share) in enumerate(PLACES):
                local[f, k] = share * model.bone_m[f, b] + deep[f, k] * back[f, b]
        last = model.bone_m[:, 2]
        length = np.linalg.norm(last, axis=1)
        side = np.sign(setup.normal @ setup.T_camera_palm[:3, 3] - setup.offset_m)
        return filled(
            cls,
            {
                "palm": setup.T_camera_palm,
                "laser_m": np.asarray(setup.laser_m, np.float64),
                "plane": np.concatenate([axes.axes, setup.normal[None]]),
                "offset": np.array([setup.offset_m]),
                "focal": np.array([setup.optics.matrix[0, 0]]),
                "before": np.array([side]),
                "radius": surface.radius_m,
                "deep": deep,
                "local": local,
                "back": back,
                "tip": last * (1.0 + tips.beyond_m / length)[:, None] + tips.dorsal_m * back[:, 2],
                "surface2": (SPREAD * surface.palmar_m.mean(axis=1)) ** 2,
                "tip2": (SPREAD * tips.beyond_m) ** 2 + _PALM_M**2,
            },
        )

    @classmethod
    def none(cls) -> "Device":
        """Scratch of the same shape, of a rig without wrist device."""
        return record(
            cls,
            palm=(4, 4),
            laser_m=3,
            plane=(3, 3),
            offset=1,
            focal=1,
            before=1,
            radius=(5, 8),
            deep=(5, 8),
            local=(5, 8, 3),
            back=(5, 3, 3),
            tip=(5, 3),
            surface2=5,
            tip2=5,
        )


class LinesOfSight:
    """What one strobe cycle shows of five fingers, as rows.

    x, y are those of undistorted rays (x, y, 1).

    Attributes:
        lit: (5,) 1 where a laser point is a row, and `shown` (5,) where a fingertip is.
        laser: (5, 2) laser points x, y, and `laser_W` (5, 2, 2) their information.
        lack: (5, 2) what the ridge lacks there to the exact cut (`master.estimator.finger_surface`), x, y.
        laser_px: (5,) length of the line [px]; 0: not known.
        tip: (5, 2) fingertips x, y, and `tip_W` (5, 2, 2) their information.
        depth: (5,) logarithm of their distance by light, in a unit of its own, and `depth_w2` (5,) how sure; 0: none.
        teaches: (5,) 1 where a finger constrains how its hinges are rolled.
        laser_s, tip_s: (1,) how much later than the epoch laser points and fingertips were seen.
        rows: (1,) whether there is any row.
    """

    lit: Float
    shown: Float
    laser: Float
    laser_W: Float
    lack: Float
    laser_px: Float
    tip: Float
    tip_W: Float
    depth: Float
    depth_w2: Float
    teaches: Float
    laser_s: Float
    tip_s: Float
    rows: Float

    @classmethod
    def empty(cls) -> "LinesOfSight":
        """Nothing is seen."""
        return record(
            cls,
            lit=5,
            shown=5,
            laser=(5, 2),
            laser_W=(5, 2, 2),
            lack=(5, 2),
            laser_px=5,
            tip=(5, 2),
            tip_W=(5, 2, 2),
            depth=5,
            depth_w2=5,
            teaches=5,
            laser_s=1,
            tip_s=1,
            rows=1,
        )


@inlined
def inverse_2(a: float, b: float, c: float, out: Float) -> None:
    """Write the inverse of (a, b; b, c)."""
    scale = 1.0 / (a * c - b * b)
    out[0, 0], out[0, 1], out[1, 0], out[1, 1] = c * scale, -b * scale, -b * scale, a * scale


@inner
def loosen(W: Float, J: Float, row: int, cov: Float) -> None:
    """Reduce the information (2, 2) of two rows by the uncertainty of wrist flexion.

    Args:
        W: Changed.
        J: (5, 7) derivatives of what is seen, with those by the bend last, and `row` the first of the two.
        cov: (K, K) of the extras.
    """
    det = W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0]
    a, b, c = W[1, 1] / det, -W[0, 1] / det, W[0, 0] / det
    for i in range(2):
        for j in range(2):
            p = cov[WRIST_ANGLES + i, WRIST_ANGLES + j]
            a += J[row, 5 + i] * p * J[row, 5 + j]
            b += J[row, 5 + i] * p * J[row + 1, 5 + j]
            c += J[row + 1, 5 + i] * p * J[row + 1, 5 + j]
    inverse_2(a, b, c, W)


@inner
def loosen_short(
    device: Any, lines_of_sight: LinesOfSight, f: int, length_px: float, point: Float, A: Float
) -> bool:
    """Reduce the information of a laser point on a partly hidden line.

    What the point does not constrain of a line that is hidden in part is removed from its information.

    Args:
        device, sights: `LinesOfSight.laser_W` is changed.
        f: Finger.
        length_px: The line's, were all of it seen.
        point, A: (3,), (2, 2) room.

    Returns:
        Whether the line is that short.
    """
    seen_px = lines_of_sight.laser_px[f]
    x, y = lines_of_sight.laser[f, 0], lines_of_sight.laser[f, 1]
    whole = 0.85  # of the line that is expected: a shorter one is hidden in part
    if seen_px == 0.0 or seen_px > whole * length_px or not on_plane(device, x, y, point, A):
        return False
    W = lines_of_sight.laser_W[f]
    det = W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0]
    a, b, c = W[1, 1] / det, -W[0, 1] / det, W[0, 0] / det
    off = 0.5 * (length_px - seen_px) / device.focal[0]
    for axis in range(2):
        curved = 1.0 / 3.0  # of how far a centroid is off across: as far it is off along
        scale = off * (1.0 if axis == 0 else curved) / hypot(A[0, axis], A[1, axis])
        u, v = scale * A[0, axis], scale * A[1, axis]
        a, b, c = a + u * u, b + u * v, c + v * v
    inverse_2(a, b, c, W)
    return True


@inner
def on_plane(device: Any, x: float, y: float, out: Float, A: Float) -> bool:
    """Intersect the ray (x, y, 1) with the laser plane.

    Writes the intersection (3,) [m], and the derivatives (2, 2) of x, y by the plane's axes.
    """
    n = device.plane[2]
    towards = n[0] * x + n[1] * y + n[2]
    far = device.offset[0] / towards
    if not far > 0.0:
        return False
    out[0], out[1], out[2] = far * x, far * y, far
    for axis in range(2):
        a = device.plane[axis]
        A[0, axis], A[1, axis] = (a[0] - x * a[2]) / far, (a[1] - y * a[2]) / far
    return True


@kernel
def observe_wrist(
    boxed_device: Any,
    laser: Float,
    laser_sigma_px: Float,
    laser_px: Float,
    tip: Float,
    tip_sigma_px: Float,
    tip_depth: Float,
    depth_sigma: float,
    laser_s: float,
    tip_s: float,
    boxed_out: Any,
) -> None:
    """Write the rows of a strobe cycle.

    Args:
        boxed_device: (1,) `Device`.
        laser, tip: (5, 2) x, y of undistorted rays; NaN: not seen.
        laser_sigma_px, tip_sigma_px: (5,) their standard deviations per axis.
        laser_px: (5,) lengths of the lines.
        tip_depth: (5,) distances of the tips by light.
        depth_sigma: Standard deviation of their logarithms; 0: they are not used.
        laser_s, tip_s: How much later than the epoch laser points and tips were seen.
        boxed_out: (1,) `LinesOfSight`, written.
    """
    device, out = boxed_device[0], boxed_out[0]
    point, A = np.zeros(3), np.zeros((2, 2))
    out.rows[0], out.laser_s[0], out.tip_s[0] = 0.0, laser_s, tip_s
    for f in range(5):
        out.lit[f] = out.shown[f] = out.depth_w2[f] = out.laser_px[f] = 0.0
        out.lack[f, 0] = out.lack[f, 1] = 0.0
        for i in range(2):
            for j in range(2):
                out.laser_W[f, i, j] = out.tip_W[f, i, j] = 1.0 if i == j else 0.0
        x, y = laser[f, 0], laser[f, 1]
        if np.isfinite(x + y + laser_sigma_px[f]) and on_plane(device, x, y, point, A):
            blur_px = 0.5
            sensed = (laser_sigma_px[f] ** 2 + blur_px**2) / device.focal[0] ** 2
            across = 0.25 * device.surface2[f] + _PALM_M**2
            along = device.surface2[f] + _PALM_M**2
            a = sensed + A[0, 0] ** 2 * across + A[0, 1] ** 2 * along
            b = A[0, 0] * A[1, 0] * across + A[0, 1] * A[1, 1] * along
            c = sensed + A[1, 0] ** 2 * across + A[1, 1] ** 2 * along
            inverse_2(a, b, c, out.laser_W[f])
            out.laser[f, 0], out.laser[f, 1], out.lit[f], out.rows[0] = x, y, 1.0, 1.0
            out.laser_px[f] = laser_px[f] if laser_px[f] > 0.0 else 0.0
        x, y = tip[f, 0], tip[f, 1]
        if np.isfinite(x + y + tip_sigma_px[f]):
            away_m = 0.1  # a fingertip of which no laser point measures the distance
            near = point[2] if out.lit[f] > 0.0 else away_m
            variance = (tip_sigma_px[f] / device.focal[0]) ** 2 + device.tip2[f] / near**2
            inverse_2(variance, 0.0, variance, out.tip_W[f])
            out.tip[f, 0], out.tip[f, 1], out.shown[f], out.rows[0] = x, y, 1.0, 1.0
            if depth_sigma > 0.0 and tip_depth[f] > 0.0:
                out.depth[f], out.depth_w2[f] = log(tip_depth[f]), 1.0 / depth_sigma**2


@inner
def flexed_palm(F: Float, flexion: float, deviation: float, T: Float, axes: Float) -> None:
    """Write the palm (4, 4) of a flexed wrist.

    Also writes the axes (2, 3) of flexion and deviation.

    F: (4, 4) palm of the straight wrist, or the rotation of the forearm in it (`common.hand.wrist_joint`).
    """
    c, s, cd, sd = cos(flexion), sin(flexion), cos(deviation), sin(deviation)
    for i in range(3):
        x, y, z = F[i, 0], F[i, 1], F[i, 2]
        axes[0, i], axes[1, i] = cd * x - sd * z, y
        T[i, 0] = cd * x - sd * z
        T[i, 1] = sd * s * x + c * y + cd * s * z
        T[i, 2] = sd * c * x - s * y + cd * c * z
        T[i, 3] = F[i, 3]
        T[3, i] = 0.0
    T[3, 3] = 1.0
