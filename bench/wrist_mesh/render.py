"""One device before one hand: frames under each illumination, the label picture, and what is true of a triple."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bench.wrist_mesh.hand_mesh import HandMesh, Posed
from bench.wrist_mesh.light import Optics, shade
from bench.wrist_mesh.line import Curve, Fan, cross
from bench.wrist_mesh.raster import SUPER, Samples, rasterise
from bench.wrist_mesh.room import Room, grained, picture
from bench.wrist_mesh.truth import laser_truth, tip_truth
from common.arrays import Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.geometry.camera_model import CameraModel
from common.hand.model import HandModel
from common.hand.wrist import forearm_palm
from common.recording.frame_recording import Illumination, Manifest

ORDER = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)
Arrays = dict[str, npt.NDArray[np.generic]]


class Moment(NamedTuple):
    """The hand at one instant: named angles (21,) [rad], and flexion and deviation of the wrist (2,) [rad]."""

    angles_rad: Float
    wrist_angles_rad: Float


class View(NamedTuple):
    """A moment as the camera sees it."""

    posed: Posed
    samples: Samples
    curve: Curve


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """Camera, laser and LEDs, and the hand before them.

    Attributes:
        rig, camera: Their files.
        optics: The camera.
        fan: The laser.
        hand_mesh: The hand.
        leds: (L, 3) [m].
    """

    rig: RigCalibration
    camera: CameraCalibration
    optics: CameraModel
    fan: Fan
    hand_mesh: HandMesh
    leds: Float

    @classmethod
    def of(cls, manifest: Manifest, datasets: Path) -> "Device":
        """The device of a rendered recording, with the hand that its rig names."""
        rig = manifest.wrist_rig()
        camera = manifest.cameras[rig.cameras[0]]
        assert rig.led is not None
        model = HandModel.of(load(datasets / "hands" / f"{rig.hand}.json", HandProfile))
        optics = CameraModel.of(camera, np.eye(4))
        return cls(rig, camera, optics, Fan.of(rig), HandMesh.of(model, datasets), np.array(rig.led))

    def view(self, moment: Moment) -> View:
        """Pose the hand and look at it."""
        T = np.array(self.rig.T_camera_palm)
        T[:3, :3] = T[:3, :3] @ forearm_palm(moment.wrist_angles_rad)
        posed = self.hand_mesh.pose(moment.angles_rad, T)
        uv = self.optics.project(posed.verts)
        size = self.optics.width_px, self.optics.height_px
        samples = rasterise(uv, posed.verts[:, 2], self.hand_mesh.faces, size)
        return View(posed, samples, cross(self.fan, self.hand_mesh, posed, self.optics, samples))

    def light(self, view: View, room: Room, constants: Optics) -> tuple[Float, Float, Float]:
        """Light (H, W) [grey] of the room, and what the laser and the LEDs add; noise and black left out."""
        surface_light = room.on_surface(view.posed, self.hand_mesh.faces)
        hand, laser, led, cover = shade(
            view.samples,
            self.hand_mesh,
            view.posed,
            surface_light,
            self.leds,
            self.fan,
            view.curve.reach_m,
            constants,
        )
        ambient = hand + (1.0 - cover) * room.behind
        return ambient, laser, led

    def frame(self, view: View, room: Room, lit: Illumination, rng: np.random.Generator) -> Image:
        """What the camera takes (H, W)."""
        ambient, laser, led = self.light(view, room, Optics())
        if lit is Illumination.LASER:
            return picture(ambient + grained(laser, rng), rng)
        return picture(ambient if lit is Illumination.AMBIENT else ambient + led, rng)

    def label(self, view: View) -> Image:
        """finger * 10 + segment (H, W), 255 behind the hand."""
        face = view.samples.face[SUPER // 2 :: SUPER, SUPER // 2 :: SUPER]
        return np.where(face >= 0, self.hand_mesh.label[face], 255).astype(np.uint8)

    def truth(self, view: View, label: Image) -> Arrays:
        """All that is true of one moment but the angles."""
        out: Arrays = {"joints": view.posed.joints}
        out |= laser_truth(view.curve, self.fan, self.optics)
        return out | tip_truth(self.hand_mesh, view.posed, self.optics, view.samples, label)
