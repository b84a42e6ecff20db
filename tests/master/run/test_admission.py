"""What a sender may say, given the files of its rig."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.link.datagram import Refusal
from common.messages import MarkerDetections, TagDetections, WristDetections
from master.rig.setup import load_setups
from master.run.link_senders import READY_NS, Sender, SenderLimits, bucket_of, limits_of, refused
from tests.network_helpers import cycle, detections

S = 1_000_000_000
CALIBRATION = Path(__file__).resolve().parents[3] / "calib_json"
DESK = SenderLimits((640, 480), 6, 60.0)


def at(*uv: float) -> MarkerDetections:
    points = detections("left", 1, 0).uv.copy()
    points[2] = uv
    return msgspec.structs.replace(detections("left", 1, 0), uv=points)


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (at(-640.0, -480.0), None),
        (at(1280.0, 960.0), None),
        (at(-641.0, 0.0), Refusal.OUTSIDE_PICTURE),
        (at(0.0, 961.0), Refusal.OUTSIDE_PICTURE),
        (msgspec.structs.replace(at(1.0, 1.0), ready_t_ns=READY_NS), None),
        (msgspec.structs.replace(at(1.0, 1.0), ready_t_ns=READY_NS + 1), Refusal.READY_TIME),
        (msgspec.structs.replace(at(1.0, 1.0), ready_t_ns=-READY_NS - 1), Refusal.READY_TIME),
        (msgspec.structs.replace(at(1.0, 1.0), alt_uv=np.full((6, 2), 2000.0)), Refusal.OUTSIDE_PICTURE),
        (cycle("left", 1, 0), None),
        (msgspec.structs.replace(cycle("left", 1, 0), tip_sigma_px=np.ones(5), tip_uv=np.full((5, 2), -999.0)),
         Refusal.OUTSIDE_PICTURE),
        (TagDetections("left", 1, 0, 0, 0, np.array([3], np.uint16), np.full((1, 4, 2), 1290.0), np.ones(1)),
         Refusal.OUTSIDE_PICTURE),
    ],
)  # fmt: skip
def test_points_and_times_of_a_camera_have_bounds(
    message: MarkerDetections | WristDetections | TagDetections, why: Refusal | None
) -> None:
    assert refused(message, DESK) is why


def test_a_camera_sends_as_many_markers_as_its_rig_has() -> None:
    assert refused(detections("left", 1, 0), DESK) is None
    assert refused(detections("left", 1, 0), SenderLimits((640, 480), 8)) is Refusal.MARKER_COUNT
    assert refused(detections("left", 1, 0), SenderLimits()) is None


def test_twice_the_rate_of_the_file_passes_and_more_does_not() -> None:
    bucket = bucket_of(60.0)
    assert all(bucket.take(k * S // 119) for k in range(1000))
    fast = bucket_of(60.0)
    taken = sum(fast.take(k * S // 1000) for k in range(10_000))
    assert taken == pytest.approx(10 * 120 + 60, abs=2)
    assert fast.take(11 * S)  # and it recovers by itself


def test_a_changed_file_changes_what_is_taken() -> None:
    sender = Sender.of({MarkerDetections: 1}, SenderLimits((640, 480), 6, 30.0))
    sender.limit(SenderLimits((640, 480), 6, 90.0))
    assert all(sender.buckets[MarkerDetections].take(k * S // 90) for k in range(1000))
    kept = sender.buckets[MarkerDetections]
    sender.limit(SenderLimits((640, 480), 6, 90.0))
    assert sender.buckets[MarkerDetections] is kept, "the same limits give no new burst"


def test_the_limits_are_those_of_the_files() -> None:
    limits = limits_of(load_setups(CALIBRATION, ("desk-tracker", "wrist")))
    left = limits["left"]
    assert left.picture_px == (640, 480)
    assert left.markers is not None
    assert left.markers >= 6
    assert left.rate_hz is not None
    wrist = next(one for name, one in limits.items() if name.startswith("wrist"))
    assert wrist.markers is None
    assert wrist.picture_px is not None
    assert all(one.rate_hz is not None for one in limits.values())
