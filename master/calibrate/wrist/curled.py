"""What a slave saw of a hand that curls: laser points on their plane and fingertips, triple by triple."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.geometry import intersect_plane
from master.calibrate.wrist.device import Device
from master.recorded import recorded_triples


@dataclass(frozen=True, slots=True, eq=False)
class Curled:
    """T triples, fingers thumb ... little; NaN: not seen.

    Attributes:
        laser_m: (T, 5, 3) [m] on the laser plane, camera frame.
        tip_uv: (T, 5, 2) [px].
    """

    laser_m: Float
    tip_uv: Float


def read_curled(detections: Path, device: Device) -> Curled:
    """The triples of detections_<camera>.npz, put on the plane of the device.

    Raises:
        RecordingError: The file is missing or broken.
        CalibrationError: The rig has no laser plane yet.
    """
    plane = device.rig.laser_plane
    if plane is None:
        raise CalibrationError(
            f"rig {device.file_name!r}: laser_plane is missing, which `phalanx-master calibrate laser-plane` measures"
        )
    triples = list(recorded_triples(detections, device.camera.name))
    uv = np.array([triple.laser_uv for triple in triples]).reshape(-1, 5, 2)
    tips = np.array([triple.tip_uv for triple in triples]).reshape(-1, 5, 2)
    normal = np.array(plane.normal)
    length = float(np.linalg.norm(normal))
    points = intersect_plane(np.zeros(3), device.optics.ray(uv), normal / length, plane.offset_m / length)
    return Curled(points, tips)
