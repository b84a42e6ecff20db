"""A tracker by SteamVR: poses and what makes one none, which device, SteamVR's end; and the library where it is not."""

import importlib
import threading
from collections.abc import Callable

import numpy as np
import pytest

from common.clock import SystemClock
from common.errors import TrackerChoiceError, TrackerError
from common.geometry.transforms import axis_rotation, rigid
from common.messages import TrackerPose
from slave.objects import openvr_tracker
from slave.objects.openvr_tracker import OpenVrTracker, connect, load_library
from slave.reconnect import ReconnectingTracker
from tests.slave.objects.fake_openvr import (
    CONTROLLER,
    HMD,
    OUT_OF_RANGE,
    ROTATION_ONLY,
    STATION,
    TRACKER,
    Device,
    FakeVr,
    InitError_Init_NoServerForBackgroundApp,
    OpenVRError,
)


def place() -> Device:
    """A tracker a quarter turned about SteamVR's y, which is up."""
    return Device(TRACKER, "LHR-AAAAAAAA", rigid(axis_rotation(1, np.pi / 2), np.array([0.1, 1.2, -0.5])))


def opened(vr: FakeVr, serial: str | None = None) -> OpenVrTracker:
    return OpenVrTracker("tracker", serial, SystemClock(), threading.Event(), lambda: vr, rate_hz=1000.0)


def next_pose(source: OpenVrTracker) -> TrackerPose:
    pose = source.read()
    assert pose is not None
    return pose


def test_a_pose_holds_when_it_was_asked_for_and_is_a_matrix_row_by_row() -> None:
    vr = FakeVr([Device(HMD, "HMD"), Device(STATION, "LHB-1"), Device(CONTROLLER, "LHR-C"), place()])
    source, clock = opened(vr), SystemClock()
    before_ns = clock.now_ns()
    first, second = next_pose(source), next_pose(source)
    assert before_ns <= first.t_ns < second.t_ns <= clock.now_ns()
    assert (first.seq, second.seq) == (0, 1)
    np.testing.assert_allclose(first.position_m, [0.1, 1.2, -0.5])
    np.testing.assert_allclose(first.orientation_wxyz, [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0], atol=1e-12)
    source.close()
    source.close()
    assert vr.log == ["init", "shutdown"]
    assert source.read() is None


Spoil = Callable[[Device], None]


def out_of_range(device: Device) -> None:
    device.result = OUT_OF_RANGE


def by_gyroscope_alone(device: Device) -> None:
    device.result = ROTATION_ONLY


def invalid(device: Device) -> None:
    device.valid = False


def switched_off(device: Device) -> None:
    device.connected = False


def no_rotation(device: Device) -> None:
    device.T = np.diag([1.0, 1.0, 0.5, 1.0])


def nan(device: Device) -> None:
    device.T = np.full((4, 4), np.nan)


@pytest.mark.parametrize("spoil", [out_of_range, by_gyroscope_alone, invalid, switched_off, no_rotation, nan])
def test_what_steamvr_does_not_vouch_for_is_nowhere_a_few_times_a_second(spoil: Spoil) -> None:
    device = place()
    source = opened(FakeVr([device]))
    next_pose(source)
    spoil(device)
    first, second = next_pose(source), next_pose(source)
    assert np.isnan([*first.position_m, *first.orientation_wxyz]).all()
    assert second.t_ns - first.t_ns >= 25_000_000  # 30 periods, of which a busy machine skips some
    source.close()


def test_a_tracker_that_is_switched_on_later_is_found() -> None:
    vr = FakeVr([Device(HMD, "HMD")])
    source = opened(vr)
    assert np.isnan(next_pose(source).position_m).all()
    vr.devices.append(place())
    for _ in range(100):
        if np.isfinite(next_pose(source).position_m).all():
            break
    else:
        pytest.fail("never found")
    source.close()


def test_of_two_trackers_one_must_be_named() -> None:
    other = Device(TRACKER, "LHR-BBBBBBBB", rigid(np.eye(3), np.array([9.0, 0.0, 0.0])))
    with pytest.raises(TrackerChoiceError, match=r"LHR-AAAAAAAA, LHR-BBBBBBBB.*--serial"):
        opened(FakeVr([place(), other])).read()
    chosen = opened(FakeVr([place(), other]), "LHR-BBBBBBBB")
    assert next_pose(chosen).position_m[0] == 9.0
    controller = opened(FakeVr([place(), Device(CONTROLLER, "LHR-C", other.T)]), "LHR-C")
    assert next_pose(controller).position_m[0] == 9.0
    absent = opened(FakeVr([place()]), "LHR-CCCCCCCC")
    assert np.isnan(next_pose(absent).position_m).all()


def test_when_steamvr_ends_it_is_acknowledged_and_looked_for_again() -> None:
    vr = FakeVr([place()])
    stop = threading.Event()
    source = ReconnectingTracker("tracker", lambda: opened(vr), SystemClock(), stop)
    assert source.read() is not None
    vr.events = [100, 700]
    vr.error = InitError_Init_NoServerForBackgroundApp(121)
    lost = [source.read() for _ in range(3)]
    assert all(one is not None and np.isnan(one.position_m).all() for one in lost)
    assert vr.log == ["init", "acknowledged", "shutdown"]
    vr.error = None
    for _ in range(40):
        pose = source.read()
        assert pose is not None
        if np.isfinite(pose.position_m).all():
            break
    else:
        pytest.fail("never came back")
    counts = source.counts()
    assert (counts["lost"], counts["back"]) == (1, 1)
    assert source.metrics()["away_s"] == 0.0
    source.close()


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (InitError_Init_NoServerForBackgroundApp(121), "SteamVR does not run: start it"),
        (OpenVRError(108), "requireHmd"),
        (OpenVRError(110), "install SteamVR from Steam"),
    ],
)
def test_why_steamvr_does_not_answer_is_reported(error: Exception, text: str) -> None:
    with pytest.raises(TrackerError, match=text):
        connect(FakeVr([], error))


def test_a_library_that_is_missing_or_does_not_run_here_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}")

    def foreign(name: str) -> None:
        raise OSError(f"libopenvr_api_64.so: wrong ELF class ({name})")

    for broken, text in (
        (missing, r"not installed: pip install 'phalanx-hand\[vive\]'"),
        (foreign, "does not run here.*--device survive"),
    ):
        monkeypatch.setattr(openvr_tracker.importlib, "import_module", broken)
        with pytest.raises(TrackerError, match=text):
            load_library()


def test_the_real_library_says_that_there_is_no_steamvr() -> None:
    openvr = pytest.importorskip("openvr", exc_type=ImportError)
    if openvr.isRuntimeInstalled():
        pytest.skip("this machine has SteamVR")
    library = load_library()
    for name in (
        "VREvent_Quit",
        "TrackingResult_Running_OK",
        "TrackedDeviceClass_GenericTracker",
        "VREvent_t",
    ):
        assert hasattr(library, name)
    fields = dict(importlib.import_module("openvr").TrackedDevicePose_t._fields_)
    assert {"mDeviceToAbsoluteTracking", "eTrackingResult", "bPoseIsValid", "bDeviceIsConnected"} <= set(
        fields
    )
    with pytest.raises(TrackerError, match=r"no SteamVR answers, InitError_\w+: install SteamVR"):
        connect(library)
