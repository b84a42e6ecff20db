"""Simulated camera with faults that come and go, for checklist rehearsals.

The faults are in a JSON file that is read again whenever it changes (`phalanx-slave run --camera synthetic --faults
FILE`, docs/checklist.md).

The pictures, settings and times are those of the camera inside; here they are spoiled as a real one spoils them.
"""

import logging
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace

from common.arrays import Image
from common.calibration import CameraCalibration
from common.calibration.json_file import decode_json
from common.errors import CalibrationError, CameraError
from slave.cameras.synthetic import SyntheticCamera
from slave.sources import Frame

_LOG = logging.getLogger(__name__)
Byte = Annotated[int, Meta(ge=0, le=255)]


class Patch(Struct, frozen=True, forbid_unknown_fields=True):
    """A disc of one colour before the camera.

    Its centre and radius are in [px], its colour in sRGB, blue first.
    """

    uv: tuple[float, float]
    radius_px: Annotated[float, Meta(gt=0.0, le=1000.0)]
    bgr: tuple[Byte, Byte, Byte]


class Faults(Struct, frozen=True, forbid_unknown_fields=True):
    """What is wrong with the camera; by default nothing.

    Attributes:
        exposes: How many times as long as it was set it exposes: an automatic that was not switched off.
        moved_px: How far the picture has moved since the calibration: somebody turned the camera a little.
        patches: Things before the camera that the scene does not have.
        keep_one_in: Of so many frames one is delivered: a camera, or a cable, that is too slow.
        swap_every: Of so many frames two come in the wrong order: the strobe of a wrist device slips. 0: none.
        unplugged: It is not there: lost while it runs, and not to be opened.
        raises: Its driver raises an error that is none of ours at the next frame.
        frozen: It sends one picture again and again, with new stamps, also after it was opened again.
    """

    exposes: Annotated[float, Meta(gt=0.0, le=10.0)] = 1.0
    moved_px: tuple[float, float] = (0.0, 0.0)
    patches: tuple[Patch, ...] = ()
    keep_one_in: Annotated[int, Meta(ge=1, le=100)] = 1
    swap_every: Annotated[int, Meta(ge=0, le=1000)] = 0
    unplugged: bool = False
    raises: bool = False
    frozen: bool = False


class Frozen:
    """The one picture of a frozen camera, kept while it is opened again.

    Holds it while the camera is frozen.
    """

    def __init__(self) -> None:
        """It is not."""
        self._image: Image | None = None

    def shown(self, image: Image, frozen: bool) -> Image:
        """What comes in place of a picture."""
        if not frozen:
            self._image = None
            return image
        if self._image is None:
            self._image = image
        return self._image


class FaultyCamera:
    """A `FrameSource` and `Tunable` that adds faults to a simulated camera.

    Holds the faults, and the settings that the camera was last given.
    """

    def __init__(
        self, source: SyntheticCamera, camera: CameraCalibration, path: Path, frozen: Frozen | None = None
    ) -> None:
        """Load the faults from the file `path`.

        The file need not exist yet.

        `frozen` is the same for every opening of one camera.

        Raises:
            CameraError: The file is broken, or states that the camera is unplugged.
        """
        self._source, self._camera, self._path = source, camera, path
        self._faults = Faults()
        self._stat: tuple[int, int] | None = None
        self._looked_ns = 0
        self._count = 0
        self._held: Frame | None = None
        self._frozen = frozen or Frozen()
        self._look()
        self._refuse_unplugged()

    def read(self) -> Frame | None:
        """The next frame, spoiled.

        Raises:
            CameraError: The camera was unplugged.
            RuntimeError: Its driver is to raise something that no driver of ours raises.
        """
        while (frame := self._source.read()) is not None:
            if frame.ready_t_ns - self._looked_ns >= 100_000_000:  # the file is looked at ten times a second
                self._looked_ns = frame.ready_t_ns
                try:
                    self._look()
                except CameraError as error:
                    _LOG.warning("%s", error)
                self._refuse_unplugged()
            if self._faults.raises:
                raise RuntimeError(
                    f"the driver of camera {self._camera.name!r} fails, as set in {self._path}"
                )
            self._count += 1
            if self._count % self._faults.keep_one_in:
                continue
            image = self._spoiled(self._swapped(frame))
            return replace(frame, image=self._frozen.shown(image, self._faults.frozen))
        return None

    def close(self) -> None:
        """End the stream."""
        self._source.close()

    def tune(self, camera: CameraCalibration) -> None:
        """As of the camera inside.

        Raises:
            CameraError: As there.
        """
        self._source.tune(self._exposed(camera, self._faults))
        self._camera = camera

    def metrics(self) -> dict[str, float]:
        """Return the actual settings of the camera.

        They differ from the commanded ones where it exposes by itself.
        """
        return self._source.metrics()

    def counts(self) -> dict[str, int]:
        """Those of the camera inside."""
        return self._source.counts()

    def _refuse_unplugged(self) -> None:
        if self._faults.unplugged:
            raise CameraError(f"camera {self._camera.name!r} is unplugged, as set in {self._path}")

    def _look(self) -> None:
        """Read the file if it was changed.

        Raises:
            CameraError: It is broken; the faults stay as they were.
        """
        try:
            status = self._path.stat()
            stat, raw = (status.st_mtime_ns, status.st_ino), None
            if stat != self._stat:
                raw = self._path.read_bytes()
        except OSError:
            stat, raw = None, b"{}" if self._stat is not None else None
        self._stat = stat
        if raw is None:
            return
        try:
            faults = decode_json(raw, Faults, str(self._path))
        except CalibrationError as error:
            raise CameraError(str(error)) from error
        if faults.exposes != self._faults.exposes:
            self._source.tune(self._exposed(self._camera, faults))
        self._faults = faults

    def _exposed(self, camera: CameraCalibration, faults: Faults) -> CameraCalibration:
        return replace(camera, exposure_us=camera.exposure_us * faults.exposes)

    def _swapped(self, frame: Frame) -> Image:
        """The picture that comes under the stamp of `frame`."""
        held, self._held = self._held, None
        if held is not None:
            return held.image
        if self._faults.swap_every and self._count % self._faults.swap_every == 0:
            late = self._source.read()
            if late is not None:
                self._held = frame
                return late.image
        return frame.image

    def _spoiled(self, image: Image) -> Image:
        faults = self._faults
        if faults.moved_px != (0.0, 0.0):
            move = np.array([[1.0, 0.0, faults.moved_px[0]], [0.0, 1.0, faults.moved_px[1]]])
            size = image.shape[1], image.shape[0]
            image = np.asarray(cv2.warpAffine(image, move, size, borderMode=cv2.BORDER_REFLECT), np.uint8)
        if faults.patches:
            image = image.copy()
            for patch in faults.patches:
                middle = round(patch.uv[0]), round(patch.uv[1])
                colour = patch.bgr if image.ndim == 3 else (patch.bgr[1],)
                cv2.circle(image, middle, round(patch.radius_px), colour, cv2.FILLED, cv2.LINE_AA)
        return image
