"""The seam between the slave and its devices: what a driver has to be.

Nothing behind it can distinguish which device it is.

A driver opens its device in its constructor. It may also have counts and metrics, and a camera settings that change.
"""

from collections.abc import Mapping
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

from msgspec import Struct

from common.arrays import Image
from common.calibration import CameraCalibration
from common.messages import ImuSample, TrackerPose
from common.recording.frame_recording import Illumination

ItemT_co = TypeVar("ItemT_co", covariant=True)


class Frame(Struct, frozen=True, eq=False):
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


class Source(Protocol[ItemT_co]):
    """A driver: frames of a camera, samples of an IMU, poses of a tracker."""

    def read(self) -> ItemT_co | None:
        """Block until the next item, or return None at the end of the stream.

        `t_ns` is on the slave's clock; a gap in `seq` is an item that was dropped. `session` is 0: the sender fills it
        in. A tracker that does not know where it is gives poses of NaN, a few in a second.

        Raises:
            PhalanxError: The device is gone, or an item is broken. Never replaced by a fake one.
            TrackerChoiceError: Several devices are there, and none was selected.
        """
        ...

    def close(self) -> None:
        """Give the device back. Safe to call twice."""
        ...


FrameSource: TypeAlias = Source[Frame]
ImuSource: TypeAlias = Source[ImuSample]
TrackerSource: TypeAlias = Source[TrackerPose]


@runtime_checkable
class Reporting(Protocol):
    """What has counts and metrics for `Health`; asked by the thread of the reports."""

    def counts(self) -> Mapping[str, int]:
        """Event -> how often since it was opened."""
        ...

    def metrics(self) -> Mapping[str, float]:
        """Quantity with its unit -> value now.

        Settings of a camera have the names of `common.calibration.camera_settings`.
        """
        ...


@runtime_checkable
class Tunable(Reporting, Protocol):
    """A camera whose settings may be changed by another thread while it is read."""

    def tune(self, camera: CameraCalibration) -> None:
        """Take exposure, gains and rate of `camera`; its size is that it was opened with.

        Raises:
            CameraError: Refused, or not taken. The text names setting, wanted and got; the old settings are back, or
                the text states that they are not.
        """
        ...
