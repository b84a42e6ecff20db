"""Surfaces shape the simulated hand and its markers.

Few points, as a fast renderer needs. The hand is spheres joined to tapered capsules (phalanges) and hulls (palm,
thumb web, sleeve). All places that move are *key points* of one array, so that a camera can bring each to the moment
at which its own row is exposed.

A painted cap is the rounded end of a finger: half a sphere of radius R and a cylinder of length 0.7 R behind it, its
axis along the tip joint's -z. The area of a sphere between parallel planes equals that of the cylinder around it
(Archimedes), so the centroid of the painted surface is the middle of its length, 0.15 R ahead of the sphere's centre:
the cap is placed so that this is exactly the profile's marker offset. The back marker is a box painted on top and
sides, placed by its area centroid likewise.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.hand.model import CHAINS, METACARPALS, Chains, HandModel
from common.sim.light import LAYER_COSINES

CYLINDER_SHARE = 0.7
CENTROID_AHEAD = 0.5 * (1.0 - CYLINDER_SHARE)  # of a cap's centre, in its radius: the middle of [-0.7 R, R]
BOX_M = (0.025, 0.003, 0.020)  # along the palm's x, y (thickness), z
# The skin below the marker is a little smaller and shorter, so that it does not shine out around it.
SKIN_UNDER_CAP = 0.86

# Sphere indices: 4 f + k is joint k of finger f; then the rest of palm, web and sleeve.
WRIST_SPHERES = (20, 21)
METACARPAL_SPHERES = (22, 23, 24, 25)
WEB_SPHERE = 26
SLEEVE_SPHERES = (27, 28)
SPHERE_COUNT = 29
PALM_HULL = (0, 4, 8, 12, 16, *WRIST_SPHERES, *METACARPAL_SPHERES)
WEB_HULL = (0, 1, WEB_SPHERE)
CAPSULES = np.array([[4 * f + k, 4 * f + k + 1] for f in range(5) for k in range(3)])
ELBOW_RIG = np.array([0.06, 1.0, 0.25])  # where the forearm would like to go
TO_ELBOW = 0.45 * ELBOW_RIG / np.linalg.norm(ELBOW_RIG)

# Key points are linear in positions and axes of the chains' joints (`_chain_rows`); these and the axes of the palm,
# in which all else stands still, are the unit vectors of:
_UNIT_ROWS = np.eye(20 + 20 * 3 + 3)
_JOINTS, _AXES, _PALM = _UNIT_ROWS[:20], _UNIT_ROWS[20:80].reshape(20, 3, 83), _UNIT_ROWS[80:]


@dataclass(frozen=True, slots=True, eq=False)
class Cap:
    """Painted finger end: marker, finger, radius [m], key points of centre and base."""

    marker: int
    finger: int
    radius_m: float
    centre: int
    base: int


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """Painted box: marker index and its eight key points, the top ring first."""

    marker: int
    corners: slice


@dataclass(frozen=True, slots=True, eq=False)
class HandSurface:
    """Which points a hand has, and how they move with its joints.

    Attributes:
        radius_m: (SPHERE_COUNT,) sphere radii [m]; spheres are key points 0 ... SPHERE_COUNT - 1.
        caps, boxes: The painted markers.
        weights: (K, 80) and still: (K, 3) [m]: key points, palm frame, as sums of `_chain_rows`, and of what
            stands still; of the sleeve's far end, the way there that the palm asks for.
    """

    radius_m: Float
    caps: tuple[Cap, ...]
    boxes: tuple[Box, ...]
    weights: Float
    still: Float

    @classmethod
    def of(cls, model: HandModel, markers: tuple[str, ...], free: tuple[str, ...] = ()) -> "HandSurface":
        """Lay out the key points of a hand with these markers; `free` are on no hand.

        Raises:
            CalibrationError: A marker of the list is unknown to the profile, or on no finger end nor the
                palm.
        """
        radius = _sphere_radii(model)
        rows = _spheres(model)
        caps: list[Cap] = []
        boxes: list[Box] = []
        for m, name in enumerate(markers):
            if name in free:
                continue
            mount, count = model.mount(name), len(rows)
            finger = mount.finger
            if mount.joint is None:
                boxes.append(Box(m, slice(count, count + 8)))
                rows += [(mount.offset_m + corner) @ _PALM for corner in box_corners()]
            elif finger is not None and mount.joint == CHAINS[finger, 3]:
                cap = Cap(m, finger, float(model.radius_m[mount.joint]), count, count + 1)
                caps.append(cap)
                radius[4 * finger + 3] *= SKIN_UNDER_CAP
                ahead = -cap.radius_m * _AXES[4 * finger + 3, 2]
                centroid = _JOINTS[4 * finger + 3] + mount.offset_m @ _AXES[4 * finger + 3]
                centre = centroid - CENTROID_AHEAD * ahead
                rows += [centre, centre - CYLINDER_SHARE * ahead]
                skin_back_share = 0.4
                rows[4 * finger + 3] = centre - skin_back_share * ahead
            else:
                raise CalibrationError(
                    f"hand {model.profile.name!r}: markers.{name}.joint: the simulator paints finger ends and the palm"
                )
        table = np.array(rows)
        return cls(radius, tuple(caps), tuple(boxes), table[:, :80].copy(), table[:, 80:].copy())

    def key_points(self, T_rig_palm: Float, chains: Chains) -> Float:
        """Key points (..., K, 3) [m], rig frame, of palm poses and flexed fingers."""
        R, (cuff, end) = np.swapaxes(T_rig_palm[..., :3, :3], -1, -2), SLEEVE_SPHERES
        points = (self.weights @ _chain_rows(chains) + self.still) @ R
        way = unit(points[..., end, :] + TO_ELBOW)
        points += T_rig_palm[..., None, :3, 3]
        sleeve_m = 0.45
        points[..., end, :] = points[..., cuff, :] + sleeve_m * way
        return points


def _chain_rows(chains: Chains) -> Float:
    """Positions [m], then axes, of the joints of all chains (..., 80, 3), palm frame."""
    batch = chains.position_m.shape[:-3]
    axes = np.swapaxes(chains.rotation, -1, -2)
    return np.concatenate([chains.position_m.reshape(*batch, 20, 3), axes.reshape(*batch, 60, 3)], axis=-2)


def _spheres(model: HandModel) -> list[Float]:
    """The middles of all spheres as sums of unit rows."""
    wrist = 0.45 * float(model.radius_m[1])
    ends = (wrist, -0.003, -0.012), (-wrist, -0.003, -0.012)
    return [
        *_JOINTS,
        *(np.array(point) @ _PALM for point in (*ends, *model.rest_position_m[list(METACARPALS)])),
        0.38 * model.rest_position_m[6] @ _PALM + 0.62 * _JOINTS[4] - 0.004 * _PALM[1],
        -0.018 * _PALM[2],
        -0.55 * _PALM[2],
    ]


def _sphere_radii(model: HandModel) -> Float:
    """Radii (SPHERE_COUNT,) [m] of bare skin and sleeve."""
    radius = np.zeros(SPHERE_COUNT)
    radius[:20] = model.radius_m[CHAINS].ravel()
    radius[0] *= 0.85
    wrist = model.radius_m[1]
    radius[list(WRIST_SPHERES)] = 0.76 * wrist
    radius[list(METACARPAL_SPHERES)] = 0.9 * model.radius_m[list(METACARPALS)]
    radius[WEB_SPHERE] = 0.8 * model.radius_m[7]
    radius[list(SLEEVE_SPHERES)] = 1.3 * wrist, 2.2 * wrist
    return radius


def box_corners() -> Float:
    """Corners (8, 3) [m], palm axes, top first, about the painted area's centroid."""
    x, y, z = BOX_M
    top, sides = x * z, 2.0 * (x + z) * y
    above = sides * 0.5 * y / (top + sides)  # the top lies this far above the centroid
    ring = np.array([[1, 0, 1], [1, 0, -1], [-1, 0, -1], [-1, 0, 1]]) * np.array([x, 0.0, z]) / 2.0
    return np.vstack([ring + np.array([0.0, above, 0.0]), ring + np.array([0.0, above - y, 0.0])])


def cap_outline(centre: Float, base: Float, radius_m: Float, circle: Float) -> Float:
    """Points (C, 2 n, 3), camera frame; hulls of their projections outline the caps.

    The sphere's part is its contact circle with the cone of rays. Behind the sphere's equator the cylinder
    hides it: those points are moved onto the rim.

    Args:
        centre: Sphere centres (C, 3) [m]; base: centres of the rims (C, 3) [m].
        radius_m: (C,) radius of both.
        circle: `unit_circle` (n, 2).
    """
    axis = unit(centre - base)
    d2 = (centre * centre).sum(axis=-1)
    shrink = 1.0 - radius_m**2 / d2
    towards = centre / np.sqrt(d2)[:, None]
    both = np.array([towards, axis]), np.array([radius_m * np.sqrt(shrink), radius_m])
    around, across = rim(*both, circle)
    contact: Float = (centre * shrink[:, None])[:, None] + around
    edge: Float = base[:, None] + across
    ahead = ((contact - centre[:, None]) @ axis[:, :, None]) >= 0.0
    return np.concatenate([np.where(ahead, contact, edge), edge], axis=1)


def rim(normal: Float, radius_m: Float, circle: Float) -> Float:
    """Circles (..., n, 3) [m] about the origin, across unit normals (..., 3)."""
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    # A frame around the normal without a branch (Duff et al., 2017).
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows = (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)
    frame = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return radius_m[..., None, None] * (circle @ frame)


def unit(vector: Float) -> Float:
    """Vectors (..., 3) at length one."""
    return vector / np.sqrt((vector * vector).sum(axis=-1, keepdims=True))


def unit_circle(n: int) -> Float:
    """Regular polygon (n, 2) with the area of the unit circle."""
    angle = 2.0 * np.pi * np.arange(n) / n
    scale = np.sqrt((2.0 * np.pi / n) / np.sin(2.0 * np.pi / n))
    return scale * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


LAYER_SINES = np.sqrt(1.0 - LAYER_COSINES**2)


def tube_rims(centre: Float, axis: Float, radius_m: float, to_light: Float, circle: Float) -> Float:
    """Shading edges (LAYERS, n, 3) [m] of a tube with unit axis, cut at (3,) [m]."""
    across = to_light - (to_light @ axis) * axis
    middle = centre + radius_m * LAYER_COSINES[:, None] * across
    return middle[:, None] + rim(
        np.broadcast_to(axis, (len(LAYER_COSINES), 3)), radius_m * LAYER_SINES, circle
    )
