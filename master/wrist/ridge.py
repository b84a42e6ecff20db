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

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry import transform
from common.hand_model import CHAINS, Chains
from common.wrist_bend import forearm_palm
from master.wrist.fingertip import Fingertips
from master.wrist.laser_plane import PlaneAxes
from master.wrist.setup import WristSetup
from master.wrist.skin import PLACES, ROOT, Skin

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
    """The crossings of one hand before one device. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup) -> None:
        model = setup.model
        self._setup, self._axes = setup, PlaneAxes.of(setup)
        self._skin, self._beyond_m = Skin.of(model), Fingertips.of(model).beyond_m
        self._abduction = model.side_sign * model.rest_rotation[CHAINS[:, 0], :, 1]
        self._focal_px = setup.optics.matrix[0, 0]
        self._before = np.sign(
            setup.normal @ setup.T_camera_palm[:3, 3] - setup.offset_m
        )  # side of the wrist

    def __call__(self, chains: Chains, finger: Int, bend_rad: Float) -> Crossings:
        """What is seen of fingers (N,), each with its own chain (N, 4, ...) in the palm frame, at a bend (2,)."""
        palm = self._palm(bend_rad)
        q, way, stretch, met, length = self._met(chains, finger, palm)
        tip = transform(palm, Fingertips(self._beyond_m[finger]).points(chains))
        turn, at = self._hinges(chains, finger, palm, bend_rad)
        moves, bone = np.ones((len(finger), 6, 1)), _BONE[stretch]
        moves[:, 2, 0], moves[:, 3, 0] = bone >= 1, bone >= 2
        v = moves * _cross(turn, q[:, None] - at)
        slide = (v @ self._setup.normal) / (way @ self._setup.normal)[:, None]
        on_plane = (v - slide[..., None] * way[:, None]) @ self._axes.axes.T
        of_tip = _cross(turn, tip[:, None] - at)
        image = tip[:, :2] / tip[:, 2:]
        in_image = (of_tip[..., :2] - image[:, None] * of_tip[..., 2:]) / tip[:, None, 2:]
        J = np.swapaxes(np.concatenate([on_plane, in_image], axis=-1), 1, 2)
        seen = np.concatenate([self._axes.flat(q), image], axis=1)
        return Crossings(seen, J[..., :4], J[..., 4:], length, stretch, met)

    def points(self, chains: Chains, finger: Int, bend_rad: Float) -> tuple[Float, Bool]:
        """Laser points (N, 2) [m] alone, and whether the fingers cross the plane (N,)."""
        q, _, _, met, _ = self._met(chains, finger, self._palm(bend_rad))
        return self._axes.flat(q), met

    def _palm(self, bend_rad: Float) -> Float:
        """Palm -> camera (4, 4) at a bend."""
        palm = self._setup.T_camera_palm.copy()
        palm[:3, :3] = palm[:3, :3] @ forearm_palm(bend_rad)
        return palm

    def _hinges(self, chains: Chains, finger: Int, palm: Float, bend_rad: Float) -> tuple[Float, Float]:
        """Axes of the four angles and the two of the bend (N, 6, 3), and a point on each (N, 6, 3), camera frame."""
        T, R = self._setup.T_camera_palm, palm[:3, :3]
        flexion = np.array([np.cos(bend_rad[1]), 0.0, -np.sin(bend_rad[1])])
        wrist = np.stack([flexion, np.array([0.0, 1.0, 0.0])]) @ T[:3, :3].T
        turn, at = np.empty((2, len(finger), 6, 3))
        turn[:, 0] = self._abduction[finger] @ R.T
        turn[:, 1:4] = -chains.rotation[:, :3, :, 0] @ R.T
        turn[:, 4:] = wrist
        at[:, 1:4] = transform(palm, chains.position_m[:, :3])
        at[:, 0], at[:, 4:] = at[:, 1], T[:3, 3]
        return turn, at

    def _met(self, chains: Chains, finger: Int, palm: Float) -> tuple[Float, Float, Int, Bool, Float]:
        """Points (N, 3) [m], way of the chain there (N, 3), its stretch (N,), whether it is met (N,), lengths (N,)."""
        spheres = transform(palm, self._spheres(chains, finger))
        points, radius = self._points(spheres, finger)
        q, stretch, way, met = self._nearest(points, finger)
        broad = radius[np.arange(len(finger)), np.minimum(stretch, radius.shape[1] - 1)]
        length = _LENGTH * broad * self._focal_px / np.maximum(q[:, 2], _NEAREST_M)
        return q, way, stretch, met, length

    def _spheres(self, chains: Chains, finger: Int) -> Float:
        skin = Skin(self._skin.palmar_m[finger], self._skin.radius_m[finger])
        return skin.spheres(chains)

    def _points(self, spheres: Float, finger: Int) -> tuple[Float, Float]:
        """The chain (N, 9, 3) [m] through the ridge of spheres (N, 8, 3), camera frame, and their radii (N, 8) [m]."""
        radius = self._skin.radius_m[finger]
        bone = np.diff(spheres, axis=1)
        bone /= np.sqrt(np.vecdot(bone, bone))[..., None]
        along = np.concatenate([bone[:, :1], bone[:, 1:] + bone[:, :-1], bone[:, -1:]], axis=1)
        along /= np.sqrt(np.vecdot(along, along))[..., None]
        light = self._setup.laser_m - spheres
        light -= np.vecdot(light, along)[..., None] * along
        light /= np.sqrt(np.vecdot(light, light))[..., None]
        cap = spheres[:, -1] + radius[:, -1:] * (_CAP[0] * along[:, -1] + _CAP[1] * light[:, -1])
        return np.concatenate(
            [spheres + (_PULLED_IN * radius)[..., None] * light, cap[:, None]], axis=1
        ), radius

    def _nearest(self, points: Float, finger: Int) -> tuple[Float, Int, Float, Bool]:
        """Where chains (N, 9, 3) cross the plane nearest to the laser (N, 3), on which stretch and its way (N, 3).

        Last (N,): whether they cross it.
        """
        normal, rows = self._setup.normal, np.arange(len(points))
        height = points @ normal - self._setup.offset_m
        near, far = height[:, :-1], height[:, 1:]
        crossed = (near > 0.0) != (far > 0.0)
        crossed[finger == 0, : ROOT - 1] = False  # what the metacarpal of the thumb carries is its ball
        share = near / np.where(crossed, near - far, 1.0)
        q = points[:, :-1] + share[..., None] * np.diff(points, axis=1)
        off = q - self._setup.laser_m
        away = np.where(crossed, np.vecdot(off, off), np.inf)
        stretch = away.argmin(axis=1)
        met = crossed.any(axis=1)
        # One that ends before the plane is prolonged at its end, one that begins behind it at its beginning.
        stretch = np.where(met, stretch, np.where(self._before * height[:, -1] > 0.0, points.shape[1] - 2, 0))
        start, way = points[rows, stretch], points[rows, stretch + 1] - points[rows, stretch]
        rise = way @ normal
        size = np.sqrt(np.vecdot(way, way))
        rise = np.where(np.abs(rise) < _LEVEL * size, np.copysign(_LEVEL * size, rise), rise)
        share = np.clip(-height[rows, stretch] / rise, -_FARTHEST, _FARTHEST)
        q = start + share[:, None] * way
        way = way + (rise - way @ normal)[:, None] * normal
        return q, stretch, way, met


def _cross(a: Float, b: Float) -> Float:
    """Cross products (..., 3)."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
