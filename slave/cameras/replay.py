"""Play recorded raw frames as a camera, in their own time or as fast as possible.

A broken recording or picture raises `CameraError`, which names the file.
"""

import time
from pathlib import Path

from common.arrays import Image
from common.calibration import CameraCalibration
from common.calibration.camera_settings import figures, same_exposed
from common.clock import Clock
from common.errors import CameraError, PictureError, RecordingError
from common.recording.frame_recording import FrameRow, Manifest, open_recording
from common.recording.pictures import FramePictures, decode, read_picture
from slave.sources import Frame, Tunable


class ReplayCamera(Tunable):
    """A `FrameSource` that reads the pictures of a recording.

    Paced, the first frame comes at once and each further one when as much time has passed as in the recording, a gap
    of more than ten minutes left out; its `t_ns` is on the slave's clock then. Unpaced, `t_ns` is the recording's.
    """

    def __init__(self, folder: Path, camera: str, paced: bool, clock: Clock) -> None:
        """Open the recording; images are read one by one."""
        try:
            recording = open_recording(folder)
            self._rows = recording.frames_of(camera)
        except RecordingError as error:
            raise CameraError(str(error)) from error
        if not self._rows:
            raise CameraError(f"{folder}: frames.csv has no frame of camera {camera!r}")
        calibration = recording.manifest.cameras[camera]
        self._calibration = calibration
        self._grey = is_grey(recording.manifest, camera)
        self._folder = folder
        size = (calibration.width_px, calibration.height_px)
        self._pictures = FramePictures(folder, size, grey=self._grey)
        self._paced = paced
        self._clock = clock
        self._next = 0
        self._shift_ns: int | None = None

    def read(self) -> Frame | None:
        """Next frame in the order of time, or None after the last."""
        if self._next >= len(self._rows):
            return None
        row = self._rows[self._next]
        self._next += 1
        image, exposure_us = self._load(row), self._calibration.exposure_us
        if not self._paced:
            return Frame(row.seq, row.t_ns, row.t_ns, image, row.illumination, exposure_us=exposure_us)
        now_ns = self._clock.now_ns()
        gap_ns = 600_000_000_000  # longer than that it does not wait for the next frame
        if self._shift_ns is None or row.t_ns + self._shift_ns - now_ns > gap_ns:
            self._shift_ns = now_ns - row.t_ns
        t_ns = row.t_ns + self._shift_ns
        self._wait_until(t_ns)
        return Frame(row.seq, t_ns, self._clock.now_ns(), image, row.illumination, exposure_us=exposure_us)

    def close(self) -> None:
        """End the stream."""
        self._next = len(self._rows)

    def tune(self, camera: CameraCalibration) -> None:
        """What was recorded stays as it was exposed."""
        if same_exposed(camera, self._calibration):
            return
        raise CameraError(
            f"{self._folder}: its pictures are taken, with exposure_us {self._calibration.exposure_us:g}: a "
            "recording has no exposure or gain to change; only the colours of markers can be loaded"
        )

    def metrics(self) -> dict[str, float]:
        """The settings that the recording was made with."""
        return figures(self._calibration)

    def counts(self) -> dict[str, int]:
        """Nothing happens to a recording."""
        return {}

    def _load(self, row: FrameRow) -> Image:
        try:
            return self._pictures.read(row.file)
        except RecordingError as error:
            raise CameraError(str(error)) from error

    def _wait_until(self, t_ns: int) -> None:
        while (left_s := (t_ns - self._clock.now_ns()) * 1e-9) > 0.0:
            # 0.05 s at most at a time, so that a signal ends a wait soon
            time.sleep(min(left_s, 0.05))


def is_grey(manifest: Manifest, camera: str) -> bool:
    """Whether a camera of a recording belongs to a wrist device: its frames are grey."""
    rigs = (manifest.rig, *manifest.rigs)
    return any(rig is not None and rig.kind == "wrist" and camera in rig.cameras for rig in rigs)


def read_png(path: Path, size: tuple[int, int], *, grey: bool = False) -> Image:
    """Read a frame as (H, W, 3) BGR uint8 or grey (H, W); `size` is height and width."""
    try:
        return decode(read_picture(path), (size[1], size[0]), grey=grey)
    except OSError as error:
        raise CameraError(f"{path}: cannot read: {error.strerror}") from error
    except PictureError as error:
        raise CameraError(f"{path}: {error}; record again, or remove its line from frames.csv") from error
