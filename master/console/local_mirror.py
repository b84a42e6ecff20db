"""Copy of a camera's file on this machine, updated after its slave saved.

The master and the wizards read this copy.

A slave of this machine has written the very file; one of another machine has written its own, and only what its answer
contains can be copied: settings and colour ranges, not the calibration.
"""

from pathlib import Path

import msgspec

from common.calibration import CameraCalibration, load, save
from common.calibration.camera_settings import CameraSettings
from common.errors import CalibrationError
from master.calibrate.tree_files import provenance
from master.console.tuner import InUse, markers_over


def update_copy(path: Path, saved: InUse) -> bool:
    """Bring the file to what the slave saved. Whether anything differed.

    Raises:
        CalibrationError: The file is missing, broken or read-only, or the slave has what a file must not contain.
    """
    camera = load(path, CameraCalibration)
    body = saved.body() | {"markers": markers_over(saved, camera.markers or {})}
    try:
        new = msgspec.convert(body, CameraSettings).over(camera)
    except msgspec.ValidationError as error:
        raise CalibrationError(f"{path}: what {camera.name} saved cannot be copied: {error}") from error
    if new == camera:
        return False
    made = provenance("console", (), {}, "as the slave saved it")
    save(path, msgspec.structs.replace(new, provenance=camera.provenance | {"markers": made}))
    return True
