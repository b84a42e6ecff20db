"""What a camera sees of a painted finger tip, and how far that is from the cap's centroid.

A cap is the rounded end of a finger: half a sphere of the tip's radius about the tip joint, and a stretch of
cylinder behind it whose length follows from the profile's offset (the centroid of half a sphere and of a
cylinder of length L lies (r - L) / 2 ahead of the centre). A camera sees the part that faces it, and the
centroid of that silhouette is the mean of the facing surface weighted by the cosine of its tilt. The
difference in pixels, computed at the hand pose known so far, is taken from the detection.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from common.arrays import Float
from common.camera_model import CameraModel
from common.geometry import cross
from common.hand_model import HandJoints, HandModel
from master.fabrik.estimate import SolvedHand
from master.stereo.together import together

_RINGS, _SPOKES = 16, 48
_ANGLES = 90  # steps of the tables
_HEXAGON = sqrt(2.0) * np.stack([f(np.arange(6) * np.pi / 3) for f in (np.cos, np.sin)])  # (2, 6)
_LEAST_TILT_2 = 1e-30  # [rad^2]
_MOST_TILT = 2.0  # tangent of the tilt of a sigma point: it stays on its side
_BENT_RAD = np.radians(135.0)  # away from the eye: a cap still shows a strip of its side
FLAT_SHARE = 0.6  # a flat marker that shows less is tilted by 53 degrees, or partly hidden
LEAST_SHARE = 0.8  # of what a whole cap shows: where its radius is a tenth smaller than the profile says
ALIKE = 0.9  # of the share that another camera sees: what edges of two blobs of 200 px do not explain
# What hides a part from one camera is near to the sight of the others too, and may hide as much from all as none of
# them can tell: the lesser hidden share by the larger, of 20 rendered caps, is 0.16 in the mean and 0.28 rms.
REACH = 0.2
_SPECK_M2 = 1e-9
TURN_RAD_S = (
    2.0  # standard deviation of how fast a finger end turns: a fist closes in a second, and mostly rests
)


@dataclass(frozen=True, slots=True, eq=False)
class CapLook:
    """What C cameras see of M markers, for each of T directions; zero for markers without a cap or not found.

    Attributes:
        bias_px: Seen centroid minus cap centroid (T, C, M, 2).
        whole_m2: Area that the whole cap shows (T, C, M), square to the sight.
    """

    bias_px: Float
    whole_m2: Float


class CapModel:
    """The painted caps of one hand, each as a table of how it looks from all sides. Holds no state between calls.

    Attributes:
        on_finger: (M,) markers that are caps.
        looks: (K, A + 1, 3) of the K caps, in the order of the markers, see `_looks`.
        radius_m: (K,).
    """

    def __init__(self, model: HandModel, markers: tuple[str, ...]) -> None:
        """Tabulate the cap of each marker on a finger; one on the palm, or on no hand, is flat and needs none."""
        self._joint: list[int] = []
        self._finger: list[int] = []
        self._marker: list[int] = []
        tables: list[Float] = []
        for index, name in enumerate(markers):
            if name not in model.mounts:
                continue
            mount = model.mount(name)
            if mount.joint is None or mount.finger is None:
                continue
            points, normals, areas = cap_surface(
                float(model.radius_m[mount.joint]), float(-mount.offset_m[2])
            )
            # The sampled cap is placed so that its centroid is exactly the profile's point.
            points -= np.average(points, axis=0, weights=areas)
            tables.append(_looks(points, normals, areas))
            self._joint.append(mount.joint)
            self._finger.append(mount.finger)
            self._marker.append(index)
        self.looks = np.array(tables).reshape(-1, _ANGLES + 1, 3)
        self.radius_m = np.array([model.radius_m[joint] for joint in self._joint])
        self._row = np.arange(len(self._joint))
        self.on_finger = np.zeros(len(markers), np.bool_)
        self.on_finger[self._marker] = True

    def tilted(self, joints: HandJoints, tilt_cov_rad2: Float) -> Float:
        """Directions (7, K, 3) of the K caps: those of a hand, and six tilted as far as its pose is unsure.

        The six are sigma points of two uncertain numbers: the mean square of whatever differs between them and the
        first is its variance (Julier, Uhlmann 1997; four would do where all is linear, but a cap seen from behind
        looks different from every side).

        Args:
            joints: Hand pose, rig frame; only the directions of the finger ends are used, so that a wrong pose
                cannot move a cap by more than its radius.
            tilt_cov_rad2: (5, 3, 3) covariance of the directions of the last phalanges; only that across them counts.
        """
        R = joints.rotation[self._joint]
        across, ahead = R[:, :, :2], -R[:, :, 2]
        cov = across.swapaxes(1, 2) @ tilt_cov_rad2[self._finger] @ across  # (K, 2, 2)
        # Its Cholesky factor, which gives a round hexagon its shape.
        first = np.sqrt(np.maximum(cov[:, 0, 0], _LEAST_TILT_2))
        mixed = cov[:, 0, 1] / first
        second = np.sqrt(np.maximum(cov[:, 1, 1] - mixed * mixed, 0.0))
        root = np.stack([first, np.zeros_like(first), mixed, second], axis=1).reshape(-1, 2, 2)
        around = across @ np.clip(root @ _HEXAGON, -_MOST_TILT, _MOST_TILT)  # (K, 3, 6)
        tilted = ahead + around.transpose(2, 0, 1)
        tilted /= np.sqrt(np.vecdot(tilted, tilted))[..., None]
        return np.concatenate([ahead[None], tilted])

    def pointing(self, hand: SolvedHand, age_s: float) -> tuple[Float, Float]:
        """Where the caps of a hand of `age_s` [s] ago point, and how surely.

        Returns:
            Unit vectors (M, 3), rig frame, and their covariances (M, 3, 3) [rad^2]; NaN and 0 for markers without cap.
        """
        ahead, tilt = np.full((len(self.on_finger), 3), np.nan), np.zeros((len(self.on_finger), 3, 3))
        ahead[self._marker] = self._ahead(hand.joints)
        tilt[self._marker] = hand.tilt_cov_rad2[self._finger] + (TURN_RAD_S * age_s) ** 2 * np.eye(3)
        return ahead, tilt

    def anyhow(self, points_m: Float, cameras: tuple[CameraModel, ...]) -> Float:
        """Directions (5, K, 3) of the K caps at (M, 3) [m] while no hand is known: towards the cameras, and four bent
        away from them as far as the cap is still seen."""
        back = together(cameras).centre.mean(axis=0) - points_m[self._marker]
        back /= np.sqrt(np.vecdot(back, back))[:, None]
        right = cross(back, cameras[0].T_rig_camera[:3, 1])
        right /= np.sqrt(np.vecdot(right, right))[:, None]
        down = cross(back, right)
        away, across = np.cos(_BENT_RAD) * back, np.sin(_BENT_RAD) * np.stack([right, down, -right, -down])
        return np.concatenate([back[None], away + across])

    def look(self, ahead: Float, points_m: Float, cameras: tuple[CameraModel, ...]) -> CapLook:
        """What the cameras see of caps at points (M, 3) [m], rig frame, that point along `ahead` (T, K, 3)."""
        bias = np.zeros((len(ahead), len(cameras), len(points_m), 2))
        whole = np.zeros(bias.shape[:3])
        if not self._joint:
            return CapLook(bias, whole)
        middle = points_m[self._marker]
        every = together(cameras)
        back = every.centre[:, None] - middle  # (C, K, 3)
        back /= np.sqrt(np.vecdot(back, back))[..., None]
        cosine = np.clip(np.vecdot(ahead[:, None], back), -1.0, 1.0)  # (T, C, K)
        across = back - cosine[..., None] * ahead[:, None]
        along, towards, shown = np.moveaxis(self._seen(np.arccos(cosine)), -1, 0)
        sine = np.maximum(np.sqrt(1.0 - cosine * cosine), 1e-9)
        shift = along[..., None] * ahead[:, None] + (towards / sine)[..., None] * across
        # Of each camera the caps as they point in each direction, and last their centroids (C, (T + 1) K, 3).
        points = np.empty((len(cameras), len(ahead) + 1, *middle.shape))
        np.add(middle, shift.swapaxes(0, 1), out=points[:, :-1])
        points[:, -1] = middle
        there = every.project(points.reshape(len(cameras), -1, 3)).reshape(*points.shape[:3], 2)
        bias[:, :, self._marker] = (there[:, :-1] - there[:, -1:]).swapaxes(0, 1)
        whole[..., self._marker] = shown
        return CapLook(np.nan_to_num(bias), np.nan_to_num(whole))

    def bias_px(self, joints: HandJoints, points_m: Float, cameras: tuple[CameraModel, ...]) -> Float:
        """Seen centroid minus cap centroid, (C, M, 2) [px], of one hand pose; see `look`."""
        return self.look(self._ahead(joints)[None], points_m, cameras).bias_px[0]

    def by_marker(self, by_finger: Float) -> Float:
        """Numbers of the fingers (5,) for each marker (M,); 1 for those without a cap."""
        out = np.ones(len(self.on_finger))
        out[self._marker] = by_finger[self._finger]
        return out

    def doubt_px(
        self, area_px2: Float, points_m: Float, cameras: tuple[CameraModel, ...], whole_m2: Float
    ) -> Float:
        """Extra centroid noise (C, M) [px] of markers that show less than they must: partly hidden.

        What is missing lies to one side, so the centroid of a cap moves by up to a radius. Two cameras see different
        remains of a hidden cap; without this, a sliver would pass for a point known to a tenth of a pixel. The radius
        of a cap may be wrong, but it is wrong for all cameras: one that sees less of its share than another sees a
        cap that is partly hidden. Whatever part of a disc is cut off, its centroid moves by about that part of the
        radius, until half is gone.

        A flat marker may show little because it is tilted or because skin hides it, which is the same to us: a camera
        that sees much less of it than the one that sees it best knows it to half of its side only.

        Args:
            area_px2: Seen areas (C, M) [px^2].
            points_m: Where the caps were found (M, 3) [m], rig frame.
            cameras: The rig's cameras.
            whole_m2: Areas (T, C, M) that the whole caps show where they point in T directions; doubted is what none
                of them explains.
        """
        every = together(cameras)
        away = points_m - every.centre[:, None]
        scale = every.scale[:, None] / np.sqrt(np.vecdot(away, away))
        size_m2 = area_px2 / scale**2
        best_m2 = np.fmax.reduce(size_m2, axis=0)
        share = size_m2 / best_m2
        doubt = np.where(share < FLAT_SHARE, 1.0 - share, 0.0) * 0.5 * np.sqrt(best_m2) * scale
        if self._joint:
            k = self._marker
            shows = size_m2[:, k] / np.maximum(whole_m2[..., k], _SPECK_M2)  # (T, C, K)
            hidden = np.maximum(1.0 - shows.max(axis=0) / LEAST_SHARE, 0.0)
            alike = (shows / np.fmax.reduce(shows, axis=1)[:, None]).max(axis=0)
            hidden = np.maximum(hidden, np.where(alike < ALIKE, 1.0 - alike, 0.0))
            hidden = np.maximum(hidden, REACH * np.fmax.reduce(hidden, axis=0))
            doubt[:, k] = hidden * self.radius_m * scale[:, k]
        return np.nan_to_num(doubt)

    def _ahead(self, joints: HandJoints) -> Float:
        """Directions (K, 3) of the caps of a hand."""
        return -joints.rotation[self._joint][:, :, 2]

    def _seen(self, angle: Float) -> Float:
        """Rows (..., K, 3) of the tables, see `_looks`, at the angles (..., K) [rad]."""
        place = np.nan_to_num(angle) * (_ANGLES / np.pi)
        low = np.minimum(place.astype(np.int64), _ANGLES - 1)
        part = (place - low)[..., None]
        return (1.0 - part) * self.looks[self._row, low] + part * self.looks[self._row, low + 1]


def _looks(points: Float, normals: Float, areas: Float) -> Float:
    """How a cap looks when its finger points 0..180 degrees away from the eye, (_ANGLES + 1, 3).

    Columns: the seen centroid along the finger and, square to it, towards the eye [m], from the cap's own; and the area
    seen [m^2]. A cap is round, so that this one angle tells all.
    """
    angle = np.arange(_ANGLES + 1) * (np.pi / _ANGLES)
    eye = np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=1)
    facing = np.maximum(eye @ normals.T, 0.0) * areas
    shown = facing.sum(axis=1)
    seen = facing @ points / np.maximum(shown, _SPECK_M2)[:, None]
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
