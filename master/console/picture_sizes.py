"""Decide which previews may be shown, by the size that they claim.

None is shown that claims to be larger than the camera's own picture.
"""

import time
from collections.abc import Callable

from common.calibration import CameraCalibration
from common.errors import CalibrationError
from common.messages import Preview
from common.recording.picture_size import Size, jpeg_size


class PictureSizes:
    """Compares the sizes of previews with those of the camera files.

    Holds the sizes [px] that the files stated last, and why the last preview of a camera was refused.
    """

    def __init__(self, camera: Callable[[str], CameraCalibration]) -> None:
        """Compare with the camera files that `camera` reads.

        It gives the file of a camera, or raises a `CalibrationError` where there is none.
        """
        self._camera = camera
        self._known: dict[str, tuple[float, Size | None]] = {}
        self._refused: dict[str, str] = {}

    def fits(self, preview: Preview) -> bool:
        """Whether a preview is no larger than its camera's pictures.

        Where no file states their size, any that a message may carry is.
        """
        width, height = jpeg_size(preview.jpeg)
        most = self._size(preview.camera)
        if most is None or (width <= most[0] and height <= most[1]):
            self._refused.pop(preview.camera, None)
            return True
        self._refused[preview.camera] = (
            f"{preview.camera}: its picture claims {width} x {height} px, its camera file here says "
            f"{most[0]} x {most[1]}: deploy the file again, or see what runs there"
        )
        return False

    def error(self, camera: str) -> str:
        """Why its last preview was refused; empty where it was not."""
        return self._refused.get(camera, "")

    def _size(self, name: str) -> Size | None:
        poll_s = 2.0  # a camera file is not read more often
        read_s, size = self._known.get(name, (-poll_s, None))
        if time.monotonic() - read_s < poll_s:
            return size
        try:
            file = self._camera(name)
            size = file.width_px, file.height_px
        except CalibrationError:
            size = None  # not calibrated yet, or half written
        most = 64  # cameras: a bus on which names are invented costs no memory
        if name in self._known or len(self._known) < most:
            self._known[name] = time.monotonic(), size
        return size
