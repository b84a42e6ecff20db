"""What the sections of the wrist device are shown alike: recordings as a detector sees them, and palms that differ."""

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from msgspec.structs import replace

from common.arrays import Float, Image
from common.calibration import HandProfile, RigCalibration, load
from common.recording.frame_recording import open_recording
from common.recording.npz import read_npz
from slave.cameras.replay import read_png
from slave.sources import Frame
from slave.wrist.background import lit
from slave.wrist.strobe import StrobeCycle
from slave.wrist.view import WristView

ROOT = Path(__file__).resolve().parents[1]
RECORDINGS = ("curl", "mcp", "spread", "left_small")
_ROTATION_RAD, _SHIFT_M = np.radians(3.0), 3e-3


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """A recording in differences of frames.

    Attributes:
        view: Its device.
        laser, led: Differences to the ambient frame, triple by triple.
        frames: The LED frames themselves.
        truth: Arrays of its truth.npz, a row per triple.
    """

    view: WristView
    laser: list[Image]
    led: list[Image]
    frames: list[Image]
    truth: dict[str, Float]


def datasets() -> Path:
    """Where recordings are, if there are any."""
    return Path(os.environ.get("PHALANX_DATASETS", ROOT / "../shared/datasets")).resolve()


def recorded(data: Path, name: str) -> Recorded:
    """The triples of one of RECORDINGS."""
    folder = data / "wrist" / name
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    camera = recording.manifest.cameras[rig.cameras[0]]
    view = WristView.of(rig, camera, load(data / f"hands/{rig.hand}.json", HandProfile))
    size = (camera.height_px, camera.width_px)
    frames = [
        Frame(row.seq, row.t_ns, row.t_ns, read_png(folder / row.file, size, grey=True))
        for row in recording.frames_of(camera.name)
    ]
    cycles = [StrobeCycle(*frames[k : k + 3]) for k in range(0, len(frames) - 2, 3)]
    laser = [lit(cycle.laser.image, cycle.ambient.image) for cycle in cycles]
    led = [lit(cycle.led.image, cycle.ambient.image) for cycle in cycles]
    return Recorded(view, laser, led, [cycle.led.image for cycle in cycles], read_npz(folder / "truth.npz"))


def other_palm(rig: RigCalibration, rng: np.random.Generator) -> RigCalibration:
    """The rig before a palm that lies a little differently."""
    palm = np.array(rig.T_camera_palm)
    palm[:3, :3] = cv2.Rodrigues(rng.normal(0.0, _ROTATION_RAD, 3))[0] @ palm[:3, :3]
    palm[:3, 3] += rng.normal(0.0, _SHIFT_M, 3)
    rows = [tuple(row) for row in palm.tolist()]
    return replace(rig, T_camera_palm=(rows[0], rows[1], rows[2], (0.0, 0.0, 0.0, 1.0)))
