"""Strobe cycles of the wrist device with exact truth: of recordings, and of simulated scenes."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from msgspec import convert
from msgspec.structs import replace

from common.arrays import Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.calibration.files import Matrix4
from common.recording.frame_recording import open_recording
from common.recording.recorded_files import read_npz
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from slave.cameras.replay import read_png
from slave.cameras.synthetic import STROBE
from slave.sources import Frame
from slave.wrist.led_image import WristView
from slave.wrist.strobe import StrobeCycle, lit

RECORDINGS = ("curl", "mcp", "spread", "left_small")
_ROTATION_RAD = np.radians(3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """A recording: its device, its strobe cycles, and the arrays of its truth.npz, a row per cycle."""

    rig: RigCalibration
    camera: CameraCalibration
    hand: HandProfile
    view: WristView
    cycles: list[StrobeCycle]
    truth: dict[str, Float]


def recorded(folder: Path, hands: Path) -> Recorded:
    """Read a rendered recording; `hands` is a folder of hand files."""
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    camera = recording.manifest.cameras[rig.cameras[0]]
    hand, size = load(hands / f"{rig.hand}.json", HandProfile), (camera.height_px, camera.width_px)
    frames = [
        Frame(row.seq, row.t_ns, row.t_ns, read_png(folder / row.file, size, grey=True))
        for row in recording.frames_of(camera.name)
    ]
    cycles = [StrobeCycle(*frames[k : k + 3]) for k in range(0, len(frames) - 2, 3)]
    truth = read_npz(folder / "truth.npz")
    return Recorded(rig, camera, hand, WristView.of(rig, camera, hand), cycles, truth)


def drawn(scene: WristScene, camera: str, times_s: Float, step_s: float = 0.0) -> list[StrobeCycle]:
    """Render the strobe cycles that begin at scene times (T,) [s]; the hand moves on by `step_s` a frame."""
    renderer = WristRenderer(scene, camera)
    return [
        StrobeCycle(
            *(Frame(k, k, k, renderer.render(float(t) + k * step_s, kind)) for k, kind in enumerate(STROBE))
        )
        for t in times_s
    ]


def differences(cycle: StrobeCycle) -> tuple[Image, Image]:
    """Return the light of laser and of LEDs alone."""
    return lit(cycle.laser.image, cycle.ambient.image), lit(cycle.led.image, cycle.ambient.image)


def other_palm(rig: RigCalibration, rng: np.random.Generator) -> RigCalibration:
    """Return the rig before a palm that lies a little differently."""
    palm = np.array(rig.T_camera_palm)
    palm[:3, :3] = cv2.Rodrigues(rng.normal(0.0, _ROTATION_RAD, 3))[0] @ palm[:3, :3]
    palm[:3, 3] += rng.normal(0.0, 3e-3, 3)
    return replace(rig, T_camera_palm=convert(palm.tolist(), Matrix4))
