"""Occluded features of an object.

What each camera should see of it is compared with what it sees.

A feature that a camera should see and does not is hidden, and so is a bead that shows much less of its disc than it has
shown: how much of a ball counts as painted depends on light and colour, so each bead in each camera is compared with
what it shows when it is whole, which is learnt as the larger part of what it has shown.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from master.objects.features import Features
from master.objects.window import ImageObservation, Window


@dataclass(frozen=True, slots=True)
class Seen:
    """Count of seen and of expected features.

    Also whether something hides a part.
    """

    seen: int
    expected: int
    occluded: bool


class Hidden:
    """Detector of occluded features.

    Push machine. Holds how much of its disc each bead shows in each camera when it is whole.
    """

    def __init__(self, features: Features, cameras: tuple[CameraModel, ...]) -> None:
        """Set up."""
        self._features, self._cameras = features, cameras
        self._whole = np.full((len(cameras), features.beads), np.nan)

    def look(self, window: Window, T_rig_object: Float, used: Bool) -> Seen:
        """Judge the occlusion at an epoch.

        Args:
            window: What was looked for.
            T_rig_object: (4, 4) the pose.
            used: (C, F) what the pose rests on in the nearest frames.
        """
        beads = self._features.beads
        expected, occluded = np.zeros(used.shape, np.bool_), False
        for c, camera in enumerate(self._cameras):
            markers, tags = window.near(c, 0), window.near(c, 1)
            if markers is None and tags is None:
                continue
            should = self._features.expected(T_rig_object, camera)
            should[:beads] &= markers is not None
            should[beads:] &= tags is not None
            expected[c] = should
            occluded |= bool((should & ~used[c]).any())
            if markers is not None and beads:
                occluded |= self._partly(c, T_rig_object, markers, should[:beads] & used[c, :beads])
        return Seen(int(used.any(axis=0).sum()), int((expected | used).any(axis=0).sum()), occluded)

    def centroid_sigma_px(self, c: int, T_rig_object: Float, area_px2: Float) -> Float:
        """Return the centroid error [px] of beads (..., B) in camera `c` by occlusion.

        It is by how much the centroids may be off, as something hides a part of the beads.

        Whatever part of a disc is cut off, its centroid moves by at most about that part of the radius.
        """
        share, radius_px = self._share(c, T_rig_object, area_px2)
        nearly = 0.93  # of that, a bead may show and be whole
        missing = 1.0 - share / (nearly * self._whole[c])
        return np.where(missing > 0.0, np.minimum(missing, 1.0) * radius_px, 0.0)  # NaN: not known, 0

    def _share(self, c: int, T: Float, area_px2: Float) -> tuple[Float, Float]:
        """Return the share of their discs that beads show, and the disc radii (B,) [px].

        The shares (..., B) are of beads of these areas [px^2].
        """
        rows = slice(0, self._features.beads)
        camera = self._cameras[c]
        line_of_sight = self._features.points[rows] @ T[:3, :3].T + (T[:3, 3] - camera.centre)
        radius = (
            self._features.radius_m[rows]
            * camera.matrix[0, 0]
            / np.sqrt(np.vecdot(line_of_sight, line_of_sight))
        )
        return area_px2 / (np.pi * radius * radius), radius

    def _partly(self, c: int, T: Float, markers: ImageObservation, seen: Bool) -> bool:
        """Whether a bead that is seen shows too little; learns what they show."""
        share = np.where(seen, self._share(c, T, markers.area_px2)[0], np.nan)
        whole = self._whole[c]
        part = 0.63  # of what a bead shows when it is whole
        partly = bool((share < part * whole).any())
        known = np.isfinite(share)
        learn, forget = 0.06, 0.004  # towards more, towards less, from frame to frame
        pull = np.where(share > whole, learn, forget)
        self._whole[c] = np.where(
            known, np.where(np.isnan(whole), share, whole + pull * (share - whole)), whole
        )
        return partly
