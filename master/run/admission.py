"""Bounds on what a sender may report, given the files of its rig.

The message alone does not know these bounds. `common.messages` refuses what no sensor can measure. Here the
picture's size, the number of markers and the rate are those of the sender's own files, and times are compared
with the clock.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from common.arrays import Float
from common.link.datagram import Refusal
from common.link.token_bucket import TokenBucket
from common.messages import (
    Detections,
    ImuSample,
    MarkerDetections,
    TagDetections,
    TrackerPose,
    WristDetections,
)
from master.rig.setup import RigSetup
from master.run.sequence import CYCLE_FRAMES

READY_NS = 10_000_000_000  # between the exposure of a frame and the slave's having it
OLD_NS = 1_000_000_000  # no message is older when it comes: it would be of no use

Sensed = Detections | TagDetections | ImuSample | TrackerPose


@dataclass(frozen=True, slots=True)
class SenderLimits:
    """Limits that the files state for one camera, IMU or tracker.

    What is None is not known and not checked.

    Attributes:
        picture_px: Width and height.
        markers: How many markers its rig names.
        rate_hz: Messages per second and kind.
    """

    picture_px: tuple[int, int] | None = None
    markers: int | None = None
    rate_hz: float | None = None


def bucket_of(rate_hz: float | None) -> TokenBucket:
    """How many messages of one kind may come from a sender.

    `rate_hz` is that of its files; None: they state none.
    """
    # than the rate of the file: settings can be tried live; each message costs milliseconds of solving
    faster = 2.0
    any_hz = 10_000.0  # where no file states a rate
    least_hz = 60.0
    per_s = any_hz if rate_hz is None else max(faster * rate_hz, least_hz)
    # of it may come at once: at the rate of the file, what a second's halt of the network held up
    burst_s = 0.5
    return TokenBucket(per_s, per_s * burst_s)


def refused(message: Sensed, limits: SenderLimits) -> Refusal | None:
    """Why a message cannot be of a sender with these files; None: it can."""
    if isinstance(message, (ImuSample, TrackerPose)):  # a tuple: a union would be made anew for each message
        return None
    if abs(message.ready_t_ns - message.t_ns) > READY_NS:
        return Refusal.READY_TIME
    if isinstance(message, MarkerDetections) and limits.markers not in (None, len(message.area)):
        return Refusal.MARKER_COUNT
    if limits.picture_px is not None and any(_outside(uv, limits.picture_px) for uv in _points(message)):
        return Refusal.OUTSIDE_PICTURE
    return None


def limits_of(setups: Iterable[RigSetup]) -> dict[str, SenderLimits]:
    """Return the limits of all senders of these rigs.

    Sender -> what its files state, of all cameras, IMUs and trackers of these rigs.
    """
    limits: dict[str, SenderLimits] = {}
    for setup in setups:
        for name, camera in setup.cameras.items():
            size = camera.width_px, camera.height_px
            own = None if name in setup.wrist_cameras else len(setup.rows.get(name, setup.markers))
            before = limits[name].markers if name in limits else None  # of a rig that watches several hands
            markers = own if before is None or own is None else own + before
            rate_hz = camera.frame_rate_hz / (CYCLE_FRAMES if name in setup.wrist_cameras else 1)
            limits[name] = SenderLimits(size, markers, rate_hz)
        for rig in (setup.rig, setup.wrist_rig):
            if rig is not None and rig.imu is not None:
                # than its file: a sensor has its own rates, and takes the next that is enough
                imu_faster = 2.0
                limits[rig.imu.name] = SenderLimits(rate_hz=imu_faster * rig.imu.rate_hz)
        tracker_hz = 500.0
        limits |= dict.fromkeys(setup.trackers, SenderLimits(rate_hz=tracker_hz))
    return limits


def _points(message: Detections | TagDetections) -> tuple[Float, ...]:
    if isinstance(message, WristDetections):
        return message.laser_uv, message.tip_uv
    if isinstance(message, MarkerDetections) and message.has_alternatives:
        return message.uv, message.alt_uv
    return (message.uv,)


def _outside(uv: Float, size: tuple[int, int]) -> bool:
    """Whether any point (..., 2) is far outside of a picture of this size [px].

    Far: further out than one picture's size. NaN is not.
    """
    width, height = size
    points: list[list[float]] = uv.reshape(-1, 2).tolist()
    return any(u < -width or u > 2 * width or v < -height or v > 2 * height for u, v in points)
