"""Lock of Pi cameras in step: from the metadata that libcamera's algorithm writes, reckoned here as its source does."""

import logging
import math
from collections.abc import Sequence
from typing import Any

import pytest

from common.clock import SystemClock
from slave.cameras.picamera2 import Picamera2Camera
from slave.cameras.picamera2_settings import Picamera2Options
from slave.cameras.picamera2_timing import MOST_OFF_US, PERIOD_FRAMES, SILENT_FRAMES, SyncMonitor
from tests.slave.cameras.test_live_settings import FILE
from tests.slave.fake_picamera2 import Sensor, install

PERIOD_US = 16_667
READY_AT = 100


def frames(
    count: int, received: Sequence[int] | None = None, off_us: dict[int, int] | None = None
) -> list[dict[str, Any]]:
    """Metadata of a client's frames 0 … count - 1.

    Args:
        count: How many.
        heard: Frames in which a message of the server came; None: every 30th.
        off_us: Frame -> correction that the message before it asked for [us].
    """
    messages = set(range(30, count, PERIOD_FRAMES) if received is None else received)
    found: list[dict[str, Any]] = []
    wall_us, ready_us, known = 1_700_000_000_000_000, 0, False
    for k in range(count):
        wall_us += PERIOD_US - (off_us or {}).get(k, 0)
        if k in messages:
            # Reckoned back over k frames, each about a us long or short: it wanders.
            ready_us, known = wall_us + (READY_AT - k) * PERIOD_US + round(k * math.sin(k)), True
        metadata: dict[str, Any] = {
            "FrameWallClock": wall_us * 1000 + 123,
            "FrameDuration": PERIOD_US - (off_us or {}).get(k, 0),
            "SyncReady": known and k >= READY_AT,
        }
        if known:
            metadata["SyncTimer"] = ready_us - wall_us
        found.append(metadata)
    return found


def watched(metadata: list[dict[str, Any]]) -> tuple[SyncMonitor, list[bool]]:
    watch = SyncMonitor("camera 'left'", client=True)
    locked: list[bool] = []
    for frame in metadata:
        watch.push(frame)
        locked.append(watch.locked)
    return watch, locked


def test_a_client_that_hears_its_server_is_in_step_from_the_agreed_moment_on() -> None:
    watch, locked = watched(frames(1000))
    assert locked == [False] * READY_AT + [True] * 900
    assert watch.metrics() == {"sync_locked": 1.0, "sync_error_us": 0.0}
    assert watch.lost == 0


@pytest.mark.parametrize("ns_per_unit", [1, 1000])
def test_a_server_that_is_no_longer_heard_is_a_lost_lock_and_comes_back(
    ns_per_unit: int, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    metadata = frames(1200, received=[*range(30, 300, 30), *range(900, 1200, 30)])
    for frame in metadata:  # some versions of libcamera tell the wall clock in microseconds
        frame["FrameWallClock"] //= ns_per_unit
    watch, locked = watched(metadata)
    assert locked.index(False, READY_AT) == 270 + SILENT_FRAMES
    assert locked.index(True, 270 + SILENT_FRAMES) == 900
    assert watch.lost == 1
    assert (
        "no longer in step with the others: nothing was received from the server for 300 frames"
        in caplog.text
    )
    assert "in step again, after loss number 1" in caplog.text


def test_a_correction_is_the_error_until_a_message_finds_none() -> None:
    metadata = frames(400, off_us={241: 180})
    watch, _ = watched(metadata[:250])
    assert watch.metrics() == {"sync_locked": 1.0, "sync_error_us": 180.0}
    watch, locked = watched(metadata)
    assert watch.metrics()["sync_error_us"] == 0.0
    assert all(locked[READY_AT:])


@pytest.mark.parametrize("off_us", [4000, -4000])
def test_a_frame_far_off_was_not_in_step(off_us: int, caplog: pytest.LogCaptureFixture) -> None:
    assert abs(off_us) > MOST_OFF_US
    watch, locked = watched(frames(400, off_us={241: off_us}))
    assert not locked[241]
    assert locked[-1]
    assert watch.lost == 1
    assert f"it was {off_us} us off" in caplog.text


def test_a_camera_that_begins_anew_is_not_in_step(caplog: pytest.LogCaptureFixture) -> None:
    metadata = frames(300)
    metadata[200] = metadata[200] | {"SyncReady": False}
    watch, locked = watched(metadata)
    assert [k for k in range(READY_AT, 300) if not locked[k]] == [200]
    assert "libcamera began anew" in caplog.text
    assert watch.lost == 1


def test_a_server_is_in_step_when_it_is_ready() -> None:
    watch = SyncMonitor("camera 'left'", client=False)
    watch.push({"SyncReady": False})
    assert watch.metrics() == {"sync_locked": 0.0}
    for _ in range(1000):
        watch.push({"SyncReady": True})
    assert watch.metrics() == {"sync_locked": 1.0}


def test_junk_in_the_metadata_is_no_lock() -> None:
    _, locked = watched(
        [{"SyncTimer": "?", "FrameWallClock": None, "FrameDuration": [], "SyncReady": True}] * 400
    )
    assert not locked[-1]


def test_a_running_camera_reports_its_lock(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def restarts(number: int, metadata: dict[str, Any]) -> None:
        metadata["SyncReady"] &= not 300 <= number < 310

    install(monkeypatch, Sensor(sync_ready_at=100, tamper=restarts))
    camera = Picamera2Camera(FILE, Picamera2Options(sync="client"), SystemClock())
    locks: list[float] = []
    for _ in range(300):
        assert camera.read() is not None
        locks.append(camera.metrics()["sync_locked"])
    camera.close()
    assert locks[0] == 1.0
    assert sum(locks) == 290.0
    assert camera.counts() == {"camera.out_of_step": 1}
    assert "no longer in step" in caplog.text


def test_a_camera_that_runs_free_reports_no_lock(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, Sensor())
    camera = Picamera2Camera(FILE, Picamera2Options(), SystemClock())
    camera.read()
    assert "sync_locked" not in camera.metrics()
    assert camera.counts() == {}
    camera.close()
