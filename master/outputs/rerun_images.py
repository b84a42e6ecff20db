"""Camera pictures in the viewer.

Few enough, and at the size in which all centroids are.
"""

from collections.abc import Mapping

import cv2
import numpy as np
import rerun as rr

from common.arrays import Image
from common.errors import PictureError
from common.geometry.camera_model import CameraModel
from common.recording.picture_size import Size, jpeg_size
from master.outputs.rerun_blueprint import TIMELINE, camera_path


class CameraImages:
    """Logger of images to `recording`, which belongs to the caller.

    Holds time and size of each camera's last image.
    """

    def __init__(self, recording: rr.RecordingStream, models: Mapping[str, CameraModel]) -> None:
        """Take the cameras of the rig by name."""
        self._rec = recording
        self._models = models
        self._last_ns: dict[str, int] = {}
        self._size: dict[str, tuple[int, int]] = {}

    def log(self, camera: str, image: Image | bytes, t_ns: int, shown_ns: int | None = None) -> bool:
        """Show an image of a camera at its full size, however small it is.

        More than 10 a second are dropped, and so are images of a camera that the rig does not have, bytes that are
        no JPEG, and what claims to be larger than the camera's picture.

        Args:
            camera: A camera of the rig.
            image: (H, W, 3) BGR, (H, W) grey, or a whole JPEG file as bytes.
            t_ns: Capture time [ns].
            shown_ns: Where it stands on the timeline [ns]; None: at `t_ns`.

        Returns:
            Whether it was logged.
        """
        last = self._last_ns.get(camera)
        image_period_ns = 100_000_000  # images at most at 10 Hz: they cost the viewer more than all else
        if last is not None and 0 <= t_ns - last < image_period_ns:
            return False
        model = self._models.get(camera)
        size = _size(image)
        if model is None or size is None or size[0] > model.width_px or size[1] > model.height_px:
            return False
        self._last_ns[camera] = t_ns
        if isinstance(image, bytes):
            jpeg = image
        else:
            jpeg_quality = 80
            jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
        path = f"{camera_path(camera)}/image"
        if self._size.get(camera) != size:
            # The pinhole and all centroids are in pixels of the camera; a preview has fewer.
            scale = [model.width_px / size[0], model.height_px / size[1], 1.0]
            self._rec.log(path, rr.Transform3D(scale=scale), static=True)
            self._size[camera] = size
        self._rec.set_time(TIMELINE, duration=np.timedelta64(t_ns if shown_ns is None else shown_ns, "ns"))
        self._rec.log(path, rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        return True


def _size(image: Image | bytes) -> Size | None:
    """Width and height [px]; None: no JPEG."""
    if not isinstance(image, bytes):
        return image.shape[1], image.shape[0]
    try:
        return jpeg_size(image)
    except PictureError:
        return None
