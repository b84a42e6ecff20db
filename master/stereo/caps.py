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
from master.fabrik.caps import CAPS, CapTables
from master.stereo.together import together

_ANGLES = 90  # steps of the tables
_HEXAGON = sqrt(2.0) * np.stack([f(np.arange(6) * np.pi / 3) for f in (np.cos, np.sin)])  # (2, 6)
_LEAST_TILT_2 = 1e-30  # [rad^2]
_MOST_TILT = 2.0  # tangent of the tilt of a sigma point: it stays on its side
_BENT_RAD = np.radians(135.0)  # away from the eye: a cap still shows a strip of its side
_SPECK_M2 = 1e-9
TURN_RAD_S = CAPS.turn_rad_s


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
        self.tables = tables = CapTables.of(model, markers)
        self.looks, self.radius_m = tables.looks, tables.radius_m
        self._joint, self._finger = tables.joint, tables.finger
        self.on_finger = tables.row >= 0
        self._marker = np.flatnonzero(self.on_finger)
        self._row = np.arange(len(self._joint))

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
        if not len(self._joint):
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
        doubt = np.where(share < CAPS.flat_share, 1.0 - share, 0.0) * 0.5 * np.sqrt(best_m2) * scale
        if len(self._joint):
            k = self._marker
            shows = size_m2[:, k] / np.maximum(whole_m2[..., k], _SPECK_M2)  # (T, C, K)
            hidden = np.maximum(1.0 - shows.max(axis=0) / CAPS.least_share, 0.0)
            alike = (shows / np.fmax.reduce(shows, axis=1)[:, None]).max(axis=0)
            hidden = np.maximum(hidden, np.where(alike < CAPS.alike_share, 1.0 - alike, 0.0))
            hidden = np.maximum(hidden, CAPS.reach * np.fmax.reduce(hidden, axis=0))
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
