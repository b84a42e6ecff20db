"""What a camera sees of a painted finger tip, and how far that is from the cap's centroid.

A cap is the rounded end of a finger: half a sphere of the tip's radius about the tip joint, and a stretch of
cylinder behind it whose length follows from the profile's offset (the centroid of half a sphere and of a
cylinder of length L lies (r - L) / 2 ahead of the centre). A camera sees the part that faces it, and the
centroid of that silhouette is the mean of the facing surface weighted by the cosine of its tilt. The
difference in pixels, computed at the hand pose known so far, is taken from the detection.
"""

import numpy as np

from common.arrays import Float
from common.camera_model import CameraModel
from common.geometry import invert
from common.hand_model import HandJoints, HandModel

_RINGS, _SPOKES = 8, 16


class CapModel:
    """The painted caps of one hand as sampled surfaces. Holds no state between calls."""

    def __init__(self, model: HandModel, markers: tuple[str, ...]) -> None:
        """Sample the cap of each marker that sits on a finger; a flat marker on the palm needs none."""
        self._joint: list[int] = []
        self._marker: list[int] = []
        points: list[Float] = []
        normals: list[Float] = []
        areas: list[Float] = []
        self._offset = np.zeros((len(markers), 3))
        for index, name in enumerate(markers):
            mount = model.mount(name)
            self._offset[index] = mount.offset_m
            if mount.joint is None or mount.finger is None:
                continue
            p, n, a = cap_surface(float(model.radius_m[mount.joint]), float(-mount.offset_m[2]))
            # The sampled cap is placed so that its centroid is exactly the profile's point.
            points.append(p - np.average(p, axis=0, weights=a) + mount.offset_m)
            normals.append(n)
            areas.append(a)
            self._joint.append(mount.joint)
            self._marker.append(index)
        self._points, self._normals, self._areas = np.array(points), np.array(normals), np.array(areas)

    def bias_px(self, joints: HandJoints, cameras: tuple[CameraModel, ...], count: int) -> Float:
        """Seen centroid minus cap centroid, (C, M, 2) [px]; zero for markers without a cap.

        Args:
            joints: Hand pose, rig frame.
            cameras: The rig's cameras.
            count: Number of markers M.
        """
        bias = np.zeros((len(cameras), count, 2))
        if not self._joint:
            return bias
        R = joints.rotation[self._joint]
        centre = joints.position_m[self._joint]
        middle = centre + np.einsum("kij,kj->ki", R, self._offset[self._marker])
        for c, camera in enumerate(cameras):
            sight = centre - camera.centre
            sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
            local = np.einsum("kij,ki->kj", R, sight)
            facing = np.maximum(-np.einsum("knj,kj->kn", self._normals, local), 0.0) * self._areas
            seen = np.einsum("kn,knj->kj", facing, self._points) / facing.sum(axis=1, keepdims=True)
            bias[c, self._marker] = camera.project(centre + np.einsum("kij,kj->ki", R, seen)) - camera.project(middle)
        return np.nan_to_num(bias)

    def area_px2(self, joints: HandJoints, camera: CameraModel, count: int) -> Float:
        """Silhouette areas (M,) [px^2] of whole, unhidden caps; NaN for markers without a cap."""
        area = np.full(count, np.nan)
        if not self._joint:
            return area
        R, centre = joints.rotation[self._joint], joints.position_m[self._joint]
        sight = centre - camera.centre
        distance = np.linalg.norm(sight, axis=1)
        local = np.einsum("kij,ki->kj", R, sight / distance[:, None])
        facing = np.maximum(-np.einsum("knj,kj->kn", self._normals, local), 0.0) * self._areas
        depth = (centre @ invert(camera.T_rig_camera)[:3, :3].T + invert(camera.T_rig_camera)[:3, 3])[:, 2]
        area[self._marker] = facing.sum(axis=1) * camera.matrix[0, 0] * camera.matrix[1, 1] / depth**2
        return area


def cap_surface(radius_m: float, ahead_m: float) -> tuple[Float, Float, Float]:
    """Sample a cap in the tip joint's frame (-z to the finger's end).

    Args:
        radius_m: Radius of tip and finger.
        ahead_m: How far the cap's centroid lies ahead of the tip joint, at most half a radius.

    Returns:
        Points (N, 3) [m], outward normals (N, 3), areas (N,) [m^2].
    """
    length = max(radius_m - 2.0 * min(ahead_m, 0.5 * radius_m), 0.0)
    phi = (np.arange(_SPOKES) + 0.5) * 2 * np.pi / _SPOKES
    circle = np.stack([np.cos(phi), np.sin(phi), np.zeros(_SPOKES)], axis=1)
    # Rings of equal height have equal area, on a sphere as on a cylinder (Archimedes).
    height = (np.arange(_RINGS) + 0.5) / _RINGS
    points, normals, areas = [], [], []
    for h in height:
        normal = circle * np.sqrt(1 - h * h) - [0.0, 0.0, h]
        points.append(radius_m * normal)
        normals.append(normal)
        areas.append(np.full(_SPOKES, 2 * np.pi * radius_m**2 / (_RINGS * _SPOKES)))
        points.append(radius_m * circle + [0.0, 0.0, length * h])
        normals.append(circle)
        areas.append(np.full(_SPOKES, 2 * np.pi * radius_m * length / (_RINGS * _SPOKES)))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(areas)
