"""Observations of a curling hand by a slave.

Laser points on their plane and fingertips, strobe cycle by strobe cycle.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.geometry.transforms import intersect_plane
from common.hand.wrist_device import laser_plane_of
from master.calibrate.wrist.device import Device
from master.replay.recorded import recorded_cycles


@dataclass(frozen=True, slots=True, eq=False)
class Curled:
    """Observations of T strobe cycles, fingers thumb ... little.

    NaN: not seen.

    Attributes:
        laser_m: (T, 5, 3) [m] on the laser plane, camera frame.
        tip_uv: (T, 5, 2) [px].
    """

    laser_m: Float
    tip_uv: Float


def read_curled(detections: Path, device: Device) -> Curled:
    """Read the strobe cycles of detections_<camera>.npz.

    The laser points are put on the plane of the device.

    Raises:
        RecordingError: The file is missing or broken.
        CalibrationError: The rig has no laser plane yet, or one that crosses no finger.
    """
    normal, offset_m = laser_plane_of(device.rig, f"rig {device.file_name!r}")
    cycles = list(recorded_cycles(detections, device.camera.name))
    uv = np.array([cycle.laser_uv for cycle in cycles]).reshape(-1, 5, 2)
    tips = np.array([cycle.tip_uv for cycle in cycles]).reshape(-1, 5, 2)
    points = intersect_plane(np.zeros(3), device.optics.ray(uv), normal, offset_m)
    return Curled(points, tips)
