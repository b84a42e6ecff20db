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
from common.hand_model import HandJoints, HandModel

_RINGS, _SPOKES = 8, 16
_WHOLE_SHARE = (
    0.6  # seen from its end a whole cap still shows this share of that; a flat marker, tilted by 53 degrees
)


class CapModel:
    """The painted caps of one hand as sampled surfaces. Holds no state between calls."""

    def __init__(self, model: HandModel, markers: tuple[str, ...]) -> None:
        """Sample the cap of each marker on a finger; one on the palm, or on no hand, is flat and needs none."""
        self._joint: list[int] = []
        self._marker: list[int] = []
        points: list[Float] = []
        normals: list[Float] = []
        areas: list[Float] = []
        self._offset = np.zeros((len(markers), 3))
        for index, name in enumerate(markers):
            if name not in model.mounts:
                continue
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
        self._painted = np.array([model.mount(markers[index]).painted_m for index in self._marker])
        self._radius = np.array([model.radius_m[joint] for joint in self._joint])
        self._points, self._normals, self._areas = np.array(points), np.array(normals), np.array(areas)

    def doubt_px(self, area_px2: Float, points_m: Float, cameras: tuple[CameraModel, ...]) -> Float:
        """Extra centroid noise (C, M) [px] of markers that show less than they must: partly hidden.

        What is missing lies to one side, so the centroid of a cap moves by up to a radius. Two cameras see different
        remains of a hidden cap; without this, a sliver would pass for a point known to a tenth of a pixel. A flat
        marker may show little because it is tilted or because skin hides it, which is the same to us: a camera that
        sees much less of it than the one that sees it best knows it to half of its side only.

        Args:
            area_px2: Seen areas (C, M) [px^2].
            points_m: Where the caps were found (M, 3) [m], rig frame.
            cameras: The rig's cameras.
        """
        scale = np.stack(
            [_project_scale(camera) / np.linalg.norm(points_m - camera.centre, axis=1) for camera in cameras]
        )
        size_m2 = area_px2 / scale**2
        best_m2 = np.fmax.reduce(size_m2, axis=0)
        share = size_m2 / best_m2
        doubt = np.where(share < _WHOLE_SHARE, 1.0 - share, 0.0) * 0.5 * np.sqrt(best_m2) * scale
        if self._joint:
            share = size_m2[:, self._marker] / (2.0 * self._radius * self._painted)
            short = np.maximum(_WHOLE_SHARE - share, 0.0)
            doubt[:, self._marker] = short * self._radius * scale[:, self._marker]
        return np.nan_to_num(doubt)

    def bias_px(self, joints: HandJoints, points_m: Float, cameras: tuple[CameraModel, ...]) -> Float:
        """Seen centroid minus cap centroid, (C, M, 2) [px]; zero for markers without a cap or not found.

        Args:
            joints: Hand pose, rig frame; only the orientation of the finger ends is used, so that a wrong pose
                cannot move a cap by more than its radius.
            points_m: Where the caps were found (M, 3) [m], rig frame.
            cameras: The rig's cameras.
        """
        bias = np.zeros((len(cameras), len(points_m), 2))
        if not self._joint:
            return bias
        R = joints.rotation[self._joint]  # (K, 3, 3)
        middle = points_m[self._marker]
        sight = middle - np.array([camera.centre for camera in cameras])[:, None]  # (C, K, 3)
        sight /= np.sqrt(np.vecdot(sight, sight))[..., None]
        local = sight.swapaxes(0, 1) @ R  # (K, C, 3)
        facing = np.maximum(-local @ self._normals.swapaxes(1, 2), 0.0) * self._areas[:, None]  # (K, C, N)
        seen = facing @ self._points / facing.sum(axis=2, keepdims=True)
        shift = (seen - self._offset[self._marker][:, None]) @ R.swapaxes(1, 2)
        for c, camera in enumerate(cameras):
            there, here = camera.project(np.stack([middle + shift[:, c], middle]))
            bias[c, self._marker] = there - here
        return np.nan_to_num(bias)


def _project_scale(camera: CameraModel) -> float:
    return float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))


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
    points: list[Float] = []
    normals: list[Float] = []
    areas: list[Float] = []
    for h in height:
        normal = circle * np.sqrt(1 - h * h) - [0.0, 0.0, h]
        points.append(radius_m * normal)
        normals.append(normal)
        areas.append(np.full(_SPOKES, 2 * np.pi * radius_m**2 / (_RINGS * _SPOKES)))
        points.append(radius_m * circle + [0.0, 0.0, length * h])
        normals.append(circle)
        areas.append(np.full(_SPOKES, 2 * np.pi * radius_m * length / (_RINGS * _SPOKES)))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(areas)
