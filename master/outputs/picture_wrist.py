"""Wrist device in the picture of a run.

Its laser's fan about the hand, and what its camera sees.

Beside marker cameras it stands in their rig where palm and bend place it (`device_place`), and the forearm is drawn.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from common.arrays import Float, Image
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import transform
from common.hand.model import FINGER_JOINTS, FINGERS
from common.messages import FINGER_COUNT, Source
from master.outputs.device_place import DevicePlace
from master.outputs.hand_render import View
from master.outputs.laser_fan import LASER_RGB, fan, fan_rays
from master.outputs.palette import SOURCE_RGB, TRUTH_RGB, series_rgb
from master.outputs.picture_panels import PAPER, style, unit
from master.outputs.poses import Poses
from master.outputs.truth import PosesTruth
from master.rig.setup import RigSetup
from master.rig.wrist import WristSetup

_BOX = (0.012, 0.03, 0.225, 0.30)  # left, bottom, width, height of the figure: an image of 4 to 3
_FOREARM_M = 0.055  # of it


@dataclass(frozen=True, slots=True, eq=False)
class WristPicture:
    """How to draw one wrist device.

    Attributes:
        rig: Name of its rig.
        in_rig: Poses are in the frame of a rig of markers, not of its camera.
        setup: Laser plane and palm.
        camera: Its camera.
        rays: (K, 3) directions of the laser's light.
        frame: What the camera saw by laser and LEDs at the row that is shown, (H, W) grey, or None.
    """

    rig: str
    in_rig: bool
    setup: WristSetup
    camera: CameraModel
    rays: Float
    frame: Image | None = None

    @classmethod
    def of(cls, setup: RigSetup, frame: Image | None = None) -> "WristPicture | None":
        """Of a wrist device, alone or beside marker cameras; None: there is none."""
        if setup.wrist is None or setup.wrist_rig is None:
            return None
        rays = fan_rays(setup.wrist_rig, setup.wrist)
        return cls(setup.wrist_rig.name, setup.has_markers, setup.wrist, setup.wrist.optics, rays, frame)

    def pose(self, poses: Poses, row: int) -> Float:
        """Return the camera's pose (4, 4) in the frame of the poses at a row.

        NaN: not known.
        """
        if not self.in_rig:
            return np.eye(4)
        place = DevicePlace.of(poses.rows(row, row + 1), self.setup.model)
        return place.cameras(self.setup.T_camera_palm)[0]

    def reach_m(self, poses: Poses, row: int) -> Float:
        """Return points (N, 3) [m] that must be in the hand's picture at a row.

        The device's camera, or the end of the forearm.
        """
        if not self.in_rig:
            return np.zeros((1, 3))
        return DevicePlace.of(poses.rows(row, row + 1), self.setup.model).arm_m(_FOREARM_M)[0]

    def draw_laser(self, axes: Axes, view: View, poses: Poses, row: int) -> list[Line2D]:
        """Draw the laser fan and points about the hand; return the legend entries.

        Beside marker cameras also the forearm.
        """
        T = self.pose(poses, row)
        for line in fan(self.setup.laser_m, self.rays):
            pixels = view.project(transform(T, line))
            axes.plot(pixels[:, 0], pixels[:, 1], color=unit(LASER_RGB), lw=0.8, alpha=0.4, zorder=4)
        points = view.project(transform(T, poses.laser_m[row]))
        for finger in range(FINGER_COUNT):
            colour = unit(series_rgb(finger))
            axes.plot(points[finger, 0], points[finger, 1], "D", mfc=colour, mec=PAPER, ms=9, zorder=8)
        forearm = [self._draw_forearm(axes, view, poses, row)] if self.in_rig else []
        return [
            *forearm,
            Line2D([], [], color=unit(LASER_RGB), lw=1.5, label="laser"),
            Line2D([], [], color=unit(series_rgb(0)), marker="D", mec=PAPER, ms=9, ls="", label="laser on a finger"),
        ]  # fmt: skip

    def _draw_forearm(self, axes: Axes, view: View, poses: Poses, row: int) -> Line2D:
        """Draw the forearm from the wrist towards the elbow; return its legend entry.

        Also where that end is at 2 sigma.
        """
        place = DevicePlace.of(poses.rows(row, row + 1), self.setup.model)
        colour = unit(SOURCE_RGB[Source.WRIST])
        arm, ring = view.project(place.arm_m(_FOREARM_M)[0]), view.project(place.uncertainty_m(_FOREARM_M)[0])
        axes.plot(arm[:, 0], arm[:, 1], color=colour, lw=3.0, ls=(0, (4, 1.5)), zorder=4)
        axes.plot(ring[:, 0], ring[:, 1], color=colour, lw=1.0, zorder=4)
        flexion, deviation = np.degrees(place.wrist_angles_rad[0])
        wrist_angles = (
            f"wrist bent {flexion:+.0f}°, {deviation:+.0f}°"
            if np.isfinite(flexion)
            else "bend of the wrist not known"
        )
        return Line2D([], [], color=colour, lw=3.0, ls=(0, (4, 1.5)), label=f"forearm, {wrist_angles}")

    def draw_camera(self, figure: Figure, poses: Poses, row: int, truth: PosesTruth | None) -> None:
        """Draw the camera's view at the lower left.

        Its frame, the hand and the laser points as the camera should see them.
        """
        axes = figure.add_axes(_BOX)
        style(axes, "Camera, with the hand as solved")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.grid(visible=False)
        axes.set_xlim(-0.5, self.camera.width_px - 0.5)
        axes.set_ylim(self.camera.height_px - 0.5, -0.5)
        if self.frame is not None:
            top = max(float(np.percentile(self.frame, 99.5)), 1.0)
            # level of the brightest skin as shown: such frames are dark
            bright = np.clip(self.frame * (200.0 / 255.0 / top), 0.0, 1.0)
            axes.imshow(bright, cmap="gray", vmin=0.0, vmax=1.0, interpolation="bilinear")
        at = np.where(poses.valid[row][:, None], poses.position_m[row], np.nan)
        seen = self.camera.project(at)
        for finger, joints in enumerate(FINGER_JOINTS):
            for a, b in pairwise(joints):
                axes.plot(seen[[a, b], 0], seen[[a, b], 1], color=unit(series_rgb(finger)), lw=1.8)
            axes.annotate(FINGERS[finger], seen[joints[-1]], (0, 5), textcoords="offset points",
                          color=unit(series_rgb(finger)), size=8, ha="center", annotation_clip=True)  # fmt: skip
        if truth is not None:
            true = self.camera.project(truth.joints_m[row])
            for joints in FINGER_JOINTS:
                x, y = true[list(joints)].T
                axes.plot(x, y, color=unit(TRUTH_RGB), lw=0.9, ls="--")
        points = self.camera.project(poses.laser_m[row])
        axes.plot(points[:, 0], points[:, 1], "D", mfc=unit(LASER_RGB), mec=PAPER, ms=6, ls="", zorder=8)
