"""The seam between the slave and any camera: real, replayed or synthetic; nothing behind it can tell which."""

from dataclasses import dataclass
from typing import Protocol

from common.arrays import Image
from common.frame_recording import Illumination


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image and when it was taken.

    Attributes:
        seq: Frame counter of this camera; a gap is a frame the camera dropped.
        t_ns: Middle of the exposure of row 0 [ns], slave's clock.
        ready_t_ns: When the frame was handed to the slave [ns], same clock.
        image: (H, W, 3) BGR, or (H, W) grey, uint8. Nobody writes to it any more: others may still look at it.
        illumination: What lit the scene; NONE: not known.
        t_sigma_ns: Standard deviation of `t_ns` [ns], as far as the driver knows its camera; 0: exact.
        exposure_us: Exposure time [us]; 0: not known.
    """

    seq: int
    t_ns: int
    ready_t_ns: int
    image: Image
    illumination: Illumination = Illumination.AMBIENT
    t_sigma_ns: float = 0.0
    exposure_us: float = 0.0


class FrameSource(Protocol):
    """A camera. Opened by its constructor."""

    def read(self) -> Frame | None:
        """Block until the next frame, or return None at the end of the stream.

        Raises:
            CameraError: The device is gone or a frame is broken. Never replaced by a fake one.
        """
        ...

    def close(self) -> None:
        """Give the device back. Safe to call twice."""
        ...
