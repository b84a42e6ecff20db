"""Reconnect a camera that was lost, or that repeats one picture.

Some cameras send one picture, or a few in turn, again and again with new stamps. Two pictures of a real sensor are
never equal: of a million pixels the noise of reading changes many. So a picture that
equals the one before, byte by byte, was not measured again. Nor was one that equals an earlier one, as where a driver
hands the same buffers round: of those not the pictures are kept but check sums. Only a real camera can be judged so: a
simulated scene without noise, or a recording, may well repeat itself.

A picture without contrast is no evidence: behind a cap, or fully exposed, all values may be cut off at black or white.
There is nothing to find in it either.
"""

import threading
import zlib
from collections import deque
from collections.abc import Callable

import cv2
import numpy as np

from common.arrays import Image
from common.calibration import CameraCalibration
from common.clock import Clock
from common.errors import CameraError
from slave.reconnect import Backoff, ReconnectingDriver
from slave.service import ConnectionLost, nobody
from slave.sources import Frame, FrameSource, Tunable

CONTRAST = 8  # levels in a channel, above what JPEG makes of an even picture


class RepeatedPictures:
    """Finds repeated pictures.

    Holds the last picture, to which nobody writes any more, and check sums of those before.

    The sums: shape, that of a few rows, and that of the whole where such rows had been there before.
    """

    def __init__(self) -> None:
        """There was none yet."""
        self._last: Image | None = None
        # A driver may hand eight buffers round: ours are asked for four and six
        self._sums: deque[tuple[tuple[int, ...], int, int | None]] = deque(maxlen=8)

    def push(self, image: Image) -> bool:
        """Whether a picture, (H, W, 3) or (H, W), is one of the last ones again."""
        last, self._last = self._last, image
        # Four rows are compared first; where one of their values differs, nothing else is
        step = max(1, len(image) // 4)
        rows = np.ascontiguousarray(image[step // 2 :: step])
        same_rows = last is not None and np.array_equal(rows, last[step // 2 :: step])
        if last is not None and same_rows and last.shape == image.shape and np.array_equal(image, last):
            return _has_contrast(image)
        return self._was_before(image, zlib.crc32(rows.data)) and _has_contrast(image)

    def _was_before(self, image: Image, rows: int) -> bool:
        """Whether a picture whose rows have this sum was there twice already."""
        key = image.shape, rows
        wholes = [whole for shape, before, whole in reversed(self._sums) if (shape, before) == key]
        whole = zlib.crc32(np.ascontiguousarray(image).data) if wholes else None
        self._sums.append((*key, whole))
        return bool(wholes) and wholes[0] == whole


def _has_contrast(image: Image) -> bool:
    """Whether any pixel is further from the first one than an even picture's are."""
    first = np.atleast_1d(image[0, 0]).astype(float)
    even = cv2.inRange(image, first - CONTRAST, first + CONTRAST)
    return cv2.countNonZero(even) < even.size


class ReconnectingCamera(ReconnectingDriver[Frame]):
    """A camera that is opened again with the settings it was given last.

    A camera that repeats one picture with new stamps measures nothing: the copies are dropped, and after a second of
    them it is opened again as one that is lost. Holds its settings, its pictures, and since when it repeats one.
    """

    def __init__(
        self,
        opener: Callable[[CameraCalibration], FrameSource],
        camera: CameraCalibration,
        clock: Clock,
        stop: threading.Event,
        connection_lost: ConnectionLost = nobody,
        *,
        backoff: Backoff | None = None,
        frozen_s: float = 1.0,
    ) -> None:
        """Open the camera; see `ReconnectingDriver`.

        Args:
            opener: Opens the camera with these settings.
            camera: Its settings at first. Its rate counts the frames of an absence.
            clock, stop, connection_lost, backoff: As there.
            frozen_s: One that repeats a picture for so long is lost [s].

        Raises:
            CameraError: The camera is not there or refused a setting.
        """
        self._camera = camera
        super().__init__(
            "camera",
            lambda: opener(self._camera),
            clock,
            stop,
            connection_lost,
            rate_hz=camera.frame_rate_hz,
            backoff=backoff,
            prefix="camera.",
        )
        self._pictures = RepeatedPictures()
        self._frozen_s = frozen_s
        self._frozen_ns: int | None = None  # since when it repeats one
        self._counts["frozen"] = 0  # frames that were copies of the one before

    def tune(self, camera: CameraCalibration) -> None:
        """Change the settings of the camera, now and whenever it is opened again.

        Raises:
            CameraError: It is away, or did not take them.
        """
        source = self._source
        if not isinstance(source, Tunable):
            raise CameraError(f"camera {camera.name!r} is away: its settings can be changed when it is back")
        try:
            source.tune(camera)
        except CameraError:
            raise
        except Exception as error:
            why = self._failures.log("its settings cannot be changed", error)
            raise CameraError(f"camera {camera.name!r}: its settings cannot be changed: {why}") from error
        self._camera, self._rate_hz = camera, camera.frame_rate_hz

    def _is_measured(self, item: Frame) -> bool:
        """Whether a frame has another picture than the one before.

        Raises:
            CameraError: All have had the same one for too long.
        """
        if not self._pictures.push(item.image):
            self._frozen_ns = None
            return True
        self._counts["frozen"] += 1
        now_ns = self._clock.now_ns()
        if self._frozen_ns is None:
            self._frozen_ns = now_ns
        if now_ns - self._frozen_ns >= self._frozen_s * 1e9:
            raise CameraError(
                "it has repeated one picture, with new stamps, for a second: it is opened again"
            )
        return False

    def _drop(self) -> None:
        self._frozen_ns = None
        super()._drop()
