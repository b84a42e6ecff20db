"""Painted finger tips as tables: how a cap looks from all sides.

A cap is the rounded end of a finger: half a sphere of the tip's radius about the tip joint, and a stretch of
cylinder behind it whose length follows from the profile's offset (the centroid of half a sphere and of a cylinder of
length L lies (r - L) / 2 ahead of the centre). A camera sees the part that faces it, and the centroid of that
silhouette is the mean of the facing surface weighted by the cosine of its tilt. The kernels of
`master.fabrik.cap_views` take the difference from the detection, at the hand pose known so far.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from common.arrays import Float, Int
from common.hand.model import HandModel
from master.fabrik.estimate import SolvedHand

_ANGLES = 90  # steps of the tables


class CapSettings(NamedTuple):
    """Numbers of the caps' observation model.

    Attributes:
        flat_share: A flat marker that shows less of what the best camera sees is tilted by 53 degrees, or partly
            hidden.
        least_share: Least part of a whole cap's area that counts as whole: its radius is a tenth smaller than the
            profile states.
        alike_share: Least part of the share that another camera sees: what edges of two blobs of 200 px do not explain.
        reach: Least hidden part by the largest of all cameras. What hides a part from one is near the line of sight of
            the others, and none of them can measure what is hidden from all: of 20 rendered caps the lesser hidden
            part by the larger is 0.16 in the mean, 0.28 rms.
        rotation_rad_s: [rad/s] standard deviation of how fast a finger end turns: a fist closes in a second.
        radius_share: Relative error of a profile's radii: 0.8 mm.
        relief_m: [m] of a flat marker on a back that is not flat: 16 mm of colour on a radius of curvature of 50 mm
            bulge by 0.6 mm.
        most_tilt: Largest tangent of the tilt of a sigma point, which stays on its side.
        bent_rad: [rad] farthest from the camera that a cap of an unknown hand points: it still shows a strip.
    """

    flat_share: float = 0.6
    least_share: float = 0.8
    alike_share: float = 0.9
    reach: float = 0.2
    rotation_rad_s: float = 2.0
    radius_share: float = 0.1
    relief_m: float = 0.4e-3
    most_tilt: float = 2.0
    bent_rad: float = 2.356194490192345


CAPS = CapSettings()


class CapTables(NamedTuple):
    """How the M markers of a rig look from all sides; K of them are caps.

    Attributes:
        row: (M,) row of `appearances`; -1: flat, its centroid is what is seen.
        looks: (K, A + 1, 3) over the angle between finger and sight, 0 to pi: shift of the seen centroid along the
            finger and towards the eye [m], and the area seen [m^2].
        radius_m: (K,).
        joint: (K,) index of the tip joint.
        finger: (K,).
    """

    row: Int
    appearances: Float
    radius_m: Float
    joint: Int
    finger: Int

    @classmethod
    def of(cls, model: HandModel, markers: tuple[str, ...]) -> "CapTables":
        """Tabulate the caps of a hand; once for the same hand and markers.

        A marker on the palm, or on no hand, is flat.
        """
        return _tables(model, markers)

    @classmethod
    def flat(cls, count: int) -> "CapTables":
        """Tables of markers that are all flat."""
        nothing = np.zeros(0, np.int64)
        appearances = np.zeros((0, _ANGLES + 1, 3))
        return cls(np.full(count, -1, np.int64), appearances, np.zeros(0), nothing, nothing)

    def pointing(self, hand: SolvedHand, age_s: float) -> tuple[Float, Float]:
        """Directions of the caps of a hand of `age_s` [s] ago.

        Returns:
            Unit vectors (M, 3), rig frame, and their covariances (M, 3, 3) [rad^2]; NaN and 0 for flat markers.
        """
        ahead, tilt = np.full((len(self.row), 3), np.nan), np.zeros((len(self.row), 3, 3))
        caps = self.row >= 0
        ahead[caps] = -hand.joints.rotation[self.joint, :, 2]
        rotation_m2 = (CAPS.rotation_rad_s * age_s) ** 2 * np.eye(3)
        tilt[caps] = hand.tilt_cov_rad2[self.finger] + rotation_m2
        return ahead, tilt


@lru_cache(maxsize=64)
def _tables(model: HandModel, markers: tuple[str, ...]) -> CapTables:
    out = CapTables.flat(len(markers))
    joints, fingers, appearances = list[int](), list[int](), list[Float]()
    for m, name in enumerate(markers):
        mount = model.mount(name) if name in model.mounts else None
        if mount is None or mount.joint is None or mount.finger is None:
            continue
        points, normals, areas = cap_surface(float(model.radius_m[mount.joint]), float(-mount.offset_m[2]))
        # The sampled cap is placed so that its centroid is exactly the profile's point.
        points -= np.average(points, axis=0, weights=areas)
        out.row[m] = len(appearances)
        appearances.append(_appearances(points, normals, areas))
        joints.append(mount.joint)
        fingers.append(mount.finger)
    if not appearances:
        return out
    radii = np.array([model.radius_m[joint] for joint in joints])
    return out._replace(
        appearances=np.array(appearances),
        radius_m=radii,
        joint=np.array(joints, np.int64),
        finger=np.array(fingers, np.int64),
    )


def _appearances(points: Float, normals: Float, areas: Float) -> Float:
    """Tabulate a cap whose finger points 0..180 degrees away from the eye.

    Returns:
        (_ANGLES + 1, 3): the seen centroid along the finger and, square to it, towards the eye [m], from the cap's
        own; and the area seen [m^2]. A cap is round, so that the one angle is enough.
    """
    angle = np.arange(_ANGLES + 1) * (np.pi / _ANGLES)
    eye = np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=1)
    visible_m2 = np.maximum(eye @ normals.T, 0.0) * areas
    shown = visible_m2.sum(axis=1)
    least_area_m2 = 1e-9
    seen = visible_m2 @ points / np.maximum(shown, least_area_m2)[:, None]
    return np.stack([-seen[:, 2], seen[:, 0], shown], axis=1)


def cap_surface(radius_m: float, ahead_m: float) -> tuple[Float, Float, Float]:
    """Sample a cap in the tip joint's frame (-z to the finger's end).

    Args:
        radius_m: Radius of tip and finger.
        ahead_m: How far the cap's centroid lies ahead of the tip joint, at most half a radius.

    Returns:
        Points (N, 3) [m], outward normals (N, 3), areas (N,) [m^2].
    """
    length = max(radius_m - 2.0 * min(ahead_m, 0.5 * radius_m), 0.0)
    rings, spokes = 16, 48  # samples of the surface
    phi = (np.arange(spokes) + 0.5) * 2 * np.pi / spokes
    circle = np.stack([np.cos(phi), np.sin(phi), np.zeros(spokes)], axis=1)
    # Rings of equal height have equal area, on a sphere as on a cylinder (Archimedes).
    height = (np.arange(rings) + 0.5) / rings
    points: list[Float] = []
    normals: list[Float] = []
    areas: list[Float] = []
    for h in height:
        normal = circle * np.sqrt(1 - h * h) - [0.0, 0.0, h]
        points.append(radius_m * normal)
        normals.append(normal)
        areas.append(np.full(spokes, 2 * np.pi * radius_m**2 / (rings * spokes)))
        points.append(radius_m * circle + [0.0, 0.0, length * h])
        normals.append(circle)
        areas.append(np.full(spokes, 2 * np.pi * radius_m * length / (rings * spokes)))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(areas)
