"""Cameras and a wrist device measure a hand; here they are flat arrays.

A pixel is the ray r = (x, y, 1) through its undistorted point; it meets the laser plane n . X = c at X = c r
/ (n . r) (Digits, UIST 2012: triangulation by one camera and a plane of light). The plane is seen at a flat
angle, so one pixel is many times longer along it than across; the covariance carries that.

To the noise of what a wrist device sees comes what the model of the hand does not know: the thickness of this
person's skin, what calibration leaves of plane and palm, and the part of the line that is not seen. The
centroid of a line shorter than expected is off across by up to half of what is missing, and by a third of
that along, as skin curves away.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, hypot, log, sin, sqrt
from typing import Any, NamedTuple

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import intersect_plane
from common.hand.model import Fingertips
from common.hand.skin import PLACES, SPREAD, PalmarSurface
from common.kernels import inlined, inner, kernel
from common.records import array, filled, record
from master.estimator.settings import KERNEL
from master.rig.setup import WristSetup


class CameraArrays(NamedTuple):
    """C cameras of the pinhole model with five distortion coefficients."""

    R: Float  # (C, 3, 3) rotations rig -> camera
    t: Float  # (C, 3) [m], so that a point of the camera's frame is R X + t
    centre: Float  # (C, 3) [m] optical centres, rig frame
    focal: Float  # (C, 2) [px] fx, fy
    principal: Float  # (C, 2) [px] cx, cy
    distortion: Float  # (C, 5) k1, k2, p1, p2, k3
    scale: Float  # (C,) [px] of a step of one in the normalised image, the mean of both axes

    @classmethod
    def of(cls, cameras: Sequence[CameraModel]) -> "CameraArrays":
        """Lay cameras out in their order."""
        matrix = np.stack([camera.matrix for camera in cameras])
        focal = np.stack([matrix[:, 0, 0], matrix[:, 1, 1]], axis=1)
        return cls(
            np.stack([np.ascontiguousarray(camera.T_camera_rig[:3, :3]) for camera in cameras]),
            np.stack([np.ascontiguousarray(camera.T_camera_rig[:3, 3]) for camera in cameras]),
            np.stack([np.ascontiguousarray(camera.centre) for camera in cameras]),
            np.ascontiguousarray(focal),
            np.ascontiguousarray(matrix[:, :2, 2]),
            np.stack([np.ascontiguousarray(camera.distortion, np.float64) for camera in cameras]),
            np.sqrt(focal[:, 0] * focal[:, 1]),
        )


@inlined
def _through_lens(
    cameras: CameraArrays, c: int, x: float, y: float
) -> tuple[float, float, float, float, float, float]:
    """Return where the lens of camera c shows a normalised point, and derivatives.

    x, y; the derivatives of x by x, of x by y and y by x, of y by y; and the radial factor.
    """
    D = cameras.distortion[c]
    k1, k2, p1, p2, k3 = D[0], D[1], D[2], D[3], D[4]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    radial_derivative = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # of radial, by r^2, twice
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + radial_derivative * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        radial_derivative * x * y + 2.0 * (p1 * x + p2 * y),
        radial + radial_derivative * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
        radial,
    )


@inlined
def project(cameras: CameraArrays, c: int, point: Float, uv: Float, J: Float) -> bool:
    """Write where camera c sees a point (3,) [m], rig frame, and J (2, 3) [px/m].

    `uv` (2,) [px], distorted image. False: the point is behind the camera, nothing is written.
    """
    R, x, y, z = cameras.R[c], cameras.t[c, 0], cameras.t[c, 1], cameras.t[c, 2]
    for i in range(3):
        x += R[0, i] * point[i]
        y += R[1, i] * point[i]
        z += R[2, i] * point[i]
    least_depth_m = 1e-9
    if not z > least_depth_m:
        return False
    x, y = x / z, y / z
    fx, fy = cameras.focal[c, 0], cameras.focal[c, 1]
    u, v, a, b, d, _ = _through_lens(cameras, c, x, y)
    uv[0], uv[1] = fx * u + cameras.principal[c, 0], fy * v + cameras.principal[c, 1]
    for i in range(3):
        by_x = (R[0, i] - x * R[2, i]) / z
        by_y = (R[1, i] - y * R[2, i]) / z
        J[0, i] = fx * (a * by_x + b * by_y)
        J[1, i] = fy * (b * by_x + d * by_y)
    return True


@inlined
def undistort(cameras: CameraArrays, c: int, u: float, v: float, out: Float) -> bool:
    """Write a pixel's normalised point (2,), by Newton; False: the lens folds there."""
    seen_x = (u - cameras.principal[c, 0]) / cameras.focal[c, 0]
    seen_y = (v - cameras.principal[c, 1]) / cameras.focal[c, 1]
    x, y = seen_x, seen_y
    for _ in range(KERNEL.lens_steps):
        there_x, there_y, a, b, d, radial = _through_lens(cameras, c, x, y)
        off_x, off_y = seen_x - there_x, seen_y - there_y
        determinant = a * d - b * b
        step_x = (d * off_x - b * off_y) / determinant
        step_y = (a * off_y - b * off_x) / determinant
        x += step_x
        y += step_y
        settled = 1e-10  # normalised: the error after a step so small is its square, about
        if sqrt(step_x * step_x + step_y * step_y) < settled:
            out[0], out[1] = x, y
            return determinant > 0.0 and radial > 0.0
        if not np.isfinite(x + y):
            break
    return False


_STEP_PX = 0.5  # of the differences that carry a pixel's noise onto the plane
_AROUND_PX = np.array([[0.0, 0.0], [_STEP_PX, 0.0], [-_STEP_PX, 0.0], [0.0, _STEP_PX], [0.0, -_STEP_PX]])


@dataclass(frozen=True, slots=True, eq=False)
class LaserPoints:
    """Points on the plane."""

    point_m: Float  # (N, 3) [m], camera frame; NaN: not seen, or the ray meets no plane before the camera
    cov_m2: Float  # (N, 3, 3) [m^2], of rank two


def in_image(setup: WristSetup, uv: Float, sigma_px: Float) -> Bool:
    """Return which pixels (N, 2) lie in the image, their sigmas (N,) not beyond it."""
    size = np.array([setup.optics.width_px, setup.optics.height_px])
    return ((uv >= -0.5) & (uv <= size - 0.5)).all(axis=1) & (sigma_px <= size.max())


def laser_points(setup: WristSetup, uv: Float, sigma_px: Float) -> LaserPoints:
    """Return the points on the laser plane behind pixels (N, 2), distorted image."""
    rays = setup.optics.ray(uv[:, None] + _AROUND_PX)
    found = intersect_plane(np.zeros(3), rays, setup.normal, setup.offset_m)
    by_pixel = (found[:, 1::2] - found[:, 2::2]) * (sigma_px / (2.0 * _STEP_PX))[:, None, None]
    cov = np.swapaxes(by_pixel, -1, -2) @ by_pixel
    point = np.where(np.isfinite(cov[:, 0, :1]), found[:, 0], np.nan)
    return LaserPoints(point, cov)


@dataclass(frozen=True, slots=True, eq=False)
class PlaneAxes:
    """Axes in the laser plane: across (image right), along (away from the camera)."""

    origin_m: Float  # (3,) [m] where the light comes from, camera frame
    axes: Float  # (2, 3) unit vectors

    @classmethod
    def of(cls, setup: WristSetup) -> "PlaneAxes":
        """Axes of a device."""
        across = np.array([1.0, 0.0, 0.0]) - setup.normal[0] * setup.normal
        across /= np.linalg.norm(across)
        along = np.cross(across, setup.normal)
        return cls(setup.laser_m, np.stack([across, along * np.sign(along[2])]))

    def flat(self, points_m: Float) -> Float:
        """Coordinates (..., 2) [m] of points (..., 3)."""
        return (points_m - self.origin_m) @ self.axes.T

    def flat_cov(self, cov_m2: Float) -> Float:
        """Covariances (..., 2, 2) of covariances (..., 3, 3)."""
        return self.axes @ cov_m2 @ self.axes.T


TWIST, WRIST_ANGLES, RATE, TILT, HEADING, LED_SCALE, EXTRAS = 0, 5, 7, 9, 11, 12, 13
NO_EXTRAS = 1  # of a rig without wrist device: one that means nothing


class Device:
    """Geometry of a wrist device mounted before its hand [m], camera frame."""

    palm: Float = array(4, 4)  # that of a straight wrist
    laser_m: Float = array(3)  # where the laser's light comes from, in its plane
    plane: Float = array(3, 3)  # unit vectors across and along the plane, and its normal
    offset: Float = array(1)  # the plane is normal . X = offset
    focal: Float = array(1)  # [px]
    before: Float = array(1)  # on which side of the plane the wrist lies, 1 or -1
    radius: Float = array(5, 8)  # of the spheres of the skin, finger by sphere
    deep: Float = array(5, 8)  # how far behind the bone their centres lie, dorsally
    local: Float = array(5, 8, 3)  # their centres in the frames of their bones' joints
    back: Float = array(5, 3, 3)  # unit vectors towards the back of each bone, in the frame of its joint
    tip: Float = array(5, 3)  # fingertip in the frame of the last joint but the tip
    surface2: Float = array(5)  # [m^2] variance of the skin's distance from the bone
    tip2: Float = array(5)  # [m^2] variance of where the skin ends

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
        return filled(
            record(cls),
            palm=setup.T_camera_palm,
            laser_m=setup.laser_m,
            plane=np.concatenate([axes.axes, setup.normal[None]]),
            offset=setup.offset_m,
            focal=setup.optics.matrix[0, 0],
            before=np.sign(setup.normal @ setup.T_camera_palm[:3, 3] - setup.offset_m),
            radius=surface.radius_m,
            deep=deep,
            local=local,
            back=back,
            tip=last * (1.0 + tips.beyond_m / length)[:, None] + tips.dorsal_m * back[:, 2],
            surface2=(SPREAD * surface.palmar_m.mean(axis=1)) ** 2,
            tip2=(SPREAD * tips.beyond_m) ** 2 + KERNEL.palm_m**2,
        )


class CycleRows:
    """What one strobe cycle shows of five fingers, as rows; rays are (x, y, 1)."""

    lit: Float = array(5)  # 1 where a laser point is a row, and `shown` where a fingertip is
    shown: Float = array(5)
    laser: Float = array(5, 2)  # laser points x, y, and `laser_W` (5, 2, 2) their information
    laser_W: Float = array(5, 2, 2)
    lack: Float = array(5, 2)  # x, y that the ridge lacks there to the exact cut (`finger_surface`)
    laser_px: Float = array(5)  # length of the line [px]; 0: not known
    tip: Float = array(5, 2)  # fingertips x, y, and `tip_W` (5, 2, 2) their information
    tip_W: Float = array(5, 2, 2)
    depth: Float = array(5)  # logarithm of their distance by light, in a unit of its own
    depth_w2: Float = array(5)  # how sure; 0: none
    teaches: Float = array(5)  # 1 where a finger constrains how its hinges are rolled
    laser_s: Float = array(1)  # how much later than the epoch the laser points were seen, as `tip_s` the tips
    tip_s: Float = array(1)
    rows: Float = array(1)  # whether there is any row


@inlined
def inverse_2(a: float, b: float, c: float, out: Float) -> None:
    """Write the inverse of (a, b; b, c)."""
    scale = 1.0 / (a * c - b * b)
    out[0, 0], out[0, 1], out[1, 0], out[1, 1] = c * scale, -b * scale, -b * scale, a * scale


@inlined
def _covariance(W: Float) -> tuple[float, float, float]:
    """Return a, b, c of the inverse (a, b; b, c) of information W (2, 2)."""
    det = W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0]
    return W[1, 1] / det, -W[0, 1] / det, W[0, 0] / det


@inner
def loosen(W: Float, J: Float, row: int, cov: Float) -> None:
    """Reduce the information W (2, 2) of two rows by the uncertain wrist flexion.

    `J` (5, 7): derivatives by the bend last; `row`: the first of the two; `cov` (K, K) of the extras.
    """
    a, b, c = _covariance(W)
    for i in range(2):
        for j in range(2):
            p = cov[WRIST_ANGLES + i, WRIST_ANGLES + j]
            a += J[row, 5 + i] * p * J[row, 5 + j]
            b += J[row, 5 + i] * p * J[row + 1, 5 + j]
            c += J[row + 1, 5 + i] * p * J[row + 1, 5 + j]
    inverse_2(a, b, c, W)


@inner
def loosen_short(
    device: Any, cycle_rows: CycleRows, f: int, length_px: float, point: Float, A: Float
) -> bool:
    """Take from a laser point's information what a partly hidden line leaves open.

    Changes `laser_W`; `length_px` is the line's, were all of it seen. Returns whether the line is that short.
    """
    seen_px = cycle_rows.laser_px[f]
    x, y = cycle_rows.laser[f, 0], cycle_rows.laser[f, 1]
    if seen_px == 0.0 or seen_px > KERNEL.whole * length_px or not on_plane(device, x, y, point, A):
        return False
    W = cycle_rows.laser_W[f]
    a, b, c = _covariance(W)
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
    """Write where the ray (x, y, 1) meets the plane (3,) [m]; A (2, 2): d(x, y)/axes."""
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


class WristRows(NamedTuple):
    """Measurements of five fingers from one strobe cycle; rays are (x, y, 1)."""

    laser: Float  # (5, 2) x, y, as `tip`; NaN: not seen
    laser_sigma_px: Float  # (5,) standard deviation per axis, as `tip_sigma_px`
    laser_px: Float  # (5,) lengths of the lines
    tip: Float
    tip_sigma_px: Float
    tip_depth: Float  # (5,) distances of the tips by light, in a unit of its own
    laser_s: float  # how much later than the epoch the laser points were seen, as `tip_s` the fingertips
    tip_s: float
    law: Float  # (5,) PIPs [rad] by another law of the laser point; NaN: none


@kernel
def observe_wrist(boxed_device: Any, seen: WristRows, depth_sigma: float, boxed_out: Any) -> None:
    """Write the rows of a strobe cycle into `boxed_out`, (1,) `CycleRows`.

    `depth_sigma`: standard deviation of the logarithms of `tip_depth`; 0: they are not used.
    """
    laser, laser_sigma_px, tip, tip_sigma_px = seen.laser, seen.laser_sigma_px, seen.tip, seen.tip_sigma_px
    device, out = boxed_device[0], boxed_out[0]
    point, A = np.zeros(3), np.zeros((2, 2))
    out.rows[0], out.laser_s[0], out.tip_s[0] = 0.0, seen.laser_s, seen.tip_s
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
            across = device.surface2[f] / 4.0 + KERNEL.palm_m**2
            along = device.surface2[f] + KERNEL.palm_m**2
            a = sensed + A[0, 0] ** 2 * across + A[0, 1] ** 2 * along
            b = A[0, 0] * A[1, 0] * across + A[0, 1] * A[1, 1] * along
            c = sensed + A[1, 0] ** 2 * across + A[1, 1] ** 2 * along
            inverse_2(a, b, c, out.laser_W[f])
            out.laser[f, 0], out.laser[f, 1], out.lit[f], out.rows[0] = x, y, 1.0, 1.0
            out.laser_px[f] = seen.laser_px[f] if seen.laser_px[f] > 0.0 else 0.0
        x, y = tip[f, 0], tip[f, 1]
        if np.isfinite(x + y + tip_sigma_px[f]):
            away = point[2] if out.lit[f] > 0.0 else KERNEL.assumed_m
            variance = (tip_sigma_px[f] / device.focal[0]) ** 2 + device.tip2[f] / away**2
            inverse_2(variance, 0.0, variance, out.tip_W[f])
            out.tip[f, 0], out.tip[f, 1], out.shown[f], out.rows[0] = x, y, 1.0, 1.0
            if depth_sigma > 0.0 and seen.tip_depth[f] > 0.0:
                out.depth[f], out.depth_w2[f] = log(seen.tip_depth[f]), 1.0 / depth_sigma**2


@inner
def flexed_palm(F: Float, flexion: float, deviation: float, T: Float, axes: Float) -> None:
    """Write the palm (4, 4) of a flexed wrist, and axes (2, 3) of its two bends.

    F: (4, 4) palm of the straight wrist, or the rotation of the forearm in it (`common.hand.wrist`).
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
