"""Where the plane of light crosses a finger, in closed form and with derivatives: for any bend of the wrist.

The cut of light and skin (`master.wrist.laser_cut`) takes many rays for one pose, and its tables hold for one place of
the palm before the camera. What of its line the camera sees has its centroid near a *ridge* on the skin: the points of
the spheres of a finger that face the laser, pulled in to 0.77 of the radius, for the mean of a cosine over the half
circle that faces the light lies there (pi / 4, less what is seen at a slant). Where the chain through these points
crosses the plane nearest to the laser is the laser point, within 0.2 mm (median) where one phalanx alone is in the
light, and within millimetres where the next one begins to hide it.

**Derivatives.** A body that turns about an axis w through j moves its point q on the plane by v = w x (q - j), and the
plane then meets the chain s (its direction) at  q + v - s (n . v) / (n . s),  n: normal of the plane.
"""

from copy import copy
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry import transform
from master.wrist.finger_shape import FingerShapes, Shape, ShapedFingers
from master.wrist.laser_plane import PlaneAxes
from master.wrist.setup import WristSetup
from master.wrist.skin import PLACES, ROOT

_PULLED_IN = 0.77
_CAP = np.array(
    [0.7, 0.5]
)  # radii along and towards the light from the last sphere to where the skin turns away
_BONE = np.array([bone for bone, _ in PLACES])  # of each stretch of the chain, by the sphere at its beginning
_LENGTH = 2.05  # radii of the skin that a line is long
_LEVEL = 0.05  # a chain less inclined to the plane slides along it without an end
_NEAREST_M = 0.02  # no finger is nearer to the lens
_FARTHEST = 6.0  # lengths of its last stretch that a chain which ends before the plane is prolonged


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """What is seen of fingers (N), and how that moves.

    Attributes:
        seen: (N, 4) laser point on its plane (across, along) [m], tip (x / z, y / z).
        by_angles: (N, 4, 4) [1/rad].
        by_bend: (N, 4, 2) [1/rad].
        length_px: (N,) of the laser line in the undistorted image, about.
        stretch: (N,) on which stretch of the chain the point lies.
        met: (N,) False: the finger ends before the plane or begins behind it, and the point is that of the prolonged.
    """

    seen: Float
    by_angles: Float
    by_bend: Float
    length_px: Float
    stretch: Int
    met: Bool


class Ridge:
    """The crossings of one hand before one device. What it holds was prepared by the constructor.

    Attributes:
        shapes: Of the fingers beyond their knuckles.
    """

    def __init__(self, setup: WristSetup) -> None:
        axes = PlaneAxes.of(setup)
        self.shapes = FingerShapes(setup.model)
        self._laser_m, self._offset_m = setup.laser_m[:, None], setup.offset_m
        self._plane = np.concatenate([axes.axes, setup.normal[None]])  # across, along, its normal
        self._origin = axes.axes @ axes.origin_m
        self._focal_px = setup.optics.matrix[0, 0]
        self._before = np.sign(
            setup.normal @ setup.T_camera_palm[:3, 3] - setup.offset_m
        )  # side of the wrist
        self._forearm = setup.T_camera_palm[:3, :3]
        self._T = setup.T_camera_palm
        self._knuckle, self._abduction, self._wrist = self._placed(np.zeros(2))

    def bent(self, setup: WristSetup, bend_rad: Float) -> "Ridge":
        """The same hand before the palm of a wrist that is bent by (2,) [rad]."""
        other = copy(self)
        other._T = setup.T_camera_palm
        other._knuckle, other._abduction, other._wrist = other._placed(bend_rad)
        return other

    def _placed(self, bend_rad: Float) -> tuple[Float, Float, Float]:
        """Knuckles (3, 5) [m], axes of their abduction (3, 5) and of the wrist's bend (3, 2), camera frame."""
        flexion = np.array([np.cos(bend_rad[1]), 0.0, -np.sin(bend_rad[1])])
        wrist = self._forearm @ np.stack([flexion, np.array([0.0, 1.0, 0.0])], axis=1)
        knuckle = transform(self._T, self.shapes.knuckle_m).T
        return knuckle, self._T[:3, :3] @ self.shapes.abduction.T, wrist

    def __call__(self, fingers: ShapedFingers) -> Crossings:
        """What is seen of fingers (N)."""
        finger, shape = fingers.finger, fingers.shape
        R, knuckle = self._turned(fingers), self._knuckle[:, finger]
        q, way, stretch, met = self._met(R, knuckle, finger, shape)
        local = np.concatenate([q[:, None], shape.fixed, way[:, None]], axis=1)  # (3, 8, N)
        seen = (R[:, :, None] * local).sum(axis=1)
        seen[:, :4] += knuckle[:, None]
        q, hinge, tip, turn, way = seen[:, 0], seen[:, 1:3], seen[:, 3], seen[:, 4:7], seen[:, 7]
        v, of_tip = self._moved(finger, knuckle, q, hinge, tip, turn)
        bone = _BONE[stretch]
        v[:, 2] *= bone >= 1
        v[:, 3] *= bone >= 2
        way = self._plane @ way
        v = (self._plane @ v.reshape(3, -1)).reshape(v.shape)
        image = tip[:2] / tip[2]
        J = np.empty((4, *v.shape[1:]))
        J[:2] = v[:2] - v[2] / way[2] * way[:2, None]
        J[2:] = (of_tip[:2] - image[:, None] * of_tip[2]) / tip[2]
        J = np.ascontiguousarray(J.transpose(2, 0, 1))
        broad = shape.radius[np.minimum(stretch, len(shape.radius) - 1), np.arange(len(finger))]
        length = _LENGTH * broad * self._focal_px / np.maximum(q[2], _NEAREST_M)
        flat = self._plane[:2] @ q - self._origin[:, None]
        return Crossings(np.concatenate([flat, image]).T, J[..., :4], J[..., 4:], length, stretch, met)

    def points(self, fingers: ShapedFingers) -> tuple[Float, Bool]:
        """Laser points (N, 2) [m] alone, and whether the fingers cross the plane (N,)."""
        R, knuckle = self._turned(fingers), self._knuckle[:, fingers.finger]
        q, _, _, met = self._met(R, knuckle, fingers.finger, fingers.shape)
        q = (R * q).sum(axis=1) + knuckle
        return (self._plane[:2] @ q - self._origin[:, None]).T, met

    def spheres(self, fingers: ShapedFingers) -> tuple[Float, Float]:
        """Centres (N, 8, 3) and radii (N, 8) of the skin's spheres [m], camera frame."""
        R, shape = self._T[:3, :3] @ fingers.rotation, fingers.shape
        knuckle = self._knuckle[:, None, fingers.finger].T
        return shape.spheres.T @ np.swapaxes(R, 1, 2) + knuckle, shape.radius.T

    def _turned(self, fingers: ShapedFingers) -> Float:
        """Rotations (3, 3, N), first bone -> camera."""
        return np.ascontiguousarray((self._T[:3, :3] @ fingers.rotation).transpose(1, 2, 0))

    def _moved(
        self, finger: Int, knuckle: Float, q: Float, hinge: Float, tip: Float, turn: Float
    ) -> tuple[Float, Float]:
        """How laser points and tips (3, 6, N) would move with each angle and bend, were they on the last bone [m/rad].

        All in the camera frame: knuckles, points and tips (3, N), joints of PIP and DIP (3, 2, N), axes of the flexions
        (3, 3, N).
        """
        w, at = np.empty((2, 3, 6, len(finger)))
        w[:, 0], w[:, 1:4], w[:, 4:] = self._abduction[:, finger], turn, self._wrist[..., None]
        at[:, 0], at[:, 1], at[:, 2:4], at[:, 4:] = knuckle, knuckle, hinge, self._T[:3, 3, None, None]
        moved = _cross(w[:, None], np.stack([q, tip], axis=1)[:, :, None] - at[:, None])
        return moved[:, 0], moved[:, 1]

    def _met(self, R: Float, knuckle: Float, finger: Int, shape: Shape) -> tuple[Float, Float, Int, Bool]:
        """Where the chains cross the plane nearest to the laser (3, N), their way there (3, N), in the bones' frames.

        Then on which stretch (N,), and whether they cross it (N,).
        """
        laser = (R * (self._laser_m - knuckle)[:, None]).sum(axis=0)
        normal = (self._plane[2] @ R.reshape(3, -1)).reshape(3, -1)
        points = _points(shape, laser)
        height = (normal[:, None] * points).sum(axis=0) - (self._offset_m - self._plane[2] @ knuckle)
        near, far = height[:-1], height[1:]
        crossed = (near > 0.0) != (far > 0.0)
        crossed[: ROOT - 1, finger == 0] = False  # what the metacarpal of the thumb carries is its ball
        share = near / np.where(crossed, near - far, 1.0)
        off = points[:, :-1] + share * (points[:, 1:] - points[:, :-1]) - laser[:, None]
        away = np.where(crossed, (off * off).sum(axis=0), np.inf)
        stretch, met, rows = away.argmin(axis=0), crossed.any(axis=0), np.arange(len(finger))
        # One that ends before the plane is prolonged at its end, one that begins behind it at its beginning.
        stretch = np.where(met, stretch, np.where(self._before * height[-1] > 0.0, len(height) - 2, 0))
        start = points[:, stretch, rows]
        way = points[:, stretch + 1, rows] - start
        rises: Float = (normal * way).sum(axis=0)
        least: Float = _LEVEL * np.sqrt((way * way).sum(axis=0))
        rise: Float = np.where(np.abs(rises) < least, np.copysign(least, rises), rises)
        share: Float = np.clip(-near[stretch, rows] / rise, -_FARTHEST, _FARTHEST)
        return start + share * way, way + (rise - rises) * normal, stretch, met


def _points(shape: Shape, laser: Float) -> Float:
    """The chain (3, 9, N) [m] through the ridge of spheres that faces the laser (3, N), in their frame."""
    light = laser[:, None] - shape.spheres
    light -= (light * shape.along).sum(axis=0) * shape.along
    light /= np.sqrt((light * light).sum(axis=0))
    points = np.empty((3, len(shape.radius) + 1, laser.shape[1]))
    points[:, :-1] = shape.spheres + _PULLED_IN * shape.radius * light
    cap = _CAP[0] * shape.along[:, -1] + _CAP[1] * light[:, -1]
    points[:, -1] = shape.spheres[:, -1] + shape.radius[-1] * cap
    return points


def _cross(a: Float, b: Float) -> Float:
    """Cross products (3, ...)."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
