"""What stands for the two ends of a slave's loop, driver and uplink, and the file of the camera at one end."""

from collections.abc import Iterable
from typing import Any, Generic, TypeVar

from common.calibration import CameraCalibration
from common.messages import Message

T = TypeVar("T")
M = TypeVar("M", bound=Message)


class Listed(Generic[T]):
    """A driver that gives the items of a list, then ends; an exception in the list is raised."""

    def __init__(self, items: Iterable[T | Exception]) -> None:
        self.items = list(items)

    def read(self) -> T | None:
        if not self.items:
            return None
        one = self.items.pop(0)
        if isinstance(one, Exception):
            raise one
        return one

    def close(self) -> None:
        self.items = []


class Wire(Generic[M]):
    """An uplink for messages of one kind; the master answers after it was asked `waits` times."""

    session = 77

    def __init__(self, kind: type[M], endpoint: str | None = None, waits: int = 0) -> None:
        self._kind, self.zenoh_endpoint, self.waits = kind, endpoint, waits
        self.sent: list[M] = []
        self.counts: dict[str, int] = {"sent": 3}

    def send(self, message: Message) -> None:
        assert isinstance(message, self._kind)
        self.sent.append(message)

    def wait_for_start(self, timeout_s: float) -> bool:
        del timeout_s
        self.waits -= 1
        return self.waits < 0


def camera_file(**changes: Any) -> CameraCalibration:
    """A camera of 640x480 px at 30 Hz, but for the changes."""
    values: dict[str, Any] = {
        "version": 1,
        "name": "left",
        "width_px": 640,
        "height_px": 480,
        "frame_rate_hz": 30.0,
        "exposure_us": 5000.0,
        "analogue_gain": 1.25,
        "colour_gains": (0.83, 1.24),
        "row_time_us": 33.6,
    }
    return CameraCalibration(**(values | changes))
