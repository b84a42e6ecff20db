"""What stands for the module openvr and a SteamVR behind it: devices that move, are lost, switched off; and its end."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from common.arrays import Float

HMD, CONTROLLER, TRACKER, STATION = 1, 2, 3, 4
OK, OUT_OF_RANGE, ROTATION_ONLY = 200, 201, 300


class OpenVRError(Exception):
    """As openvr's: the number in `error_value`."""

    def __init__(self, value: int) -> None:
        super().__init__("")
        self.error_value = value


class InitError_Init_NoServerForBackgroundApp(OpenVRError):
    """121."""


@dataclass
class Device:
    """One device of SteamVR."""

    kind: int
    serial: str
    T: Float = field(default_factory=lambda: np.eye(4))
    result: int = OK
    valid: bool = True
    connected: bool = True


@dataclass
class FakeVr:
    """The module, and the system that its `init` gives."""

    devices: list[Device]
    error: Exception | None = None
    events: list[int] = field(default_factory=list[int])
    log: list[str] = field(default_factory=list[str])

    VRApplication_Background = 3
    TrackingUniverseRawAndUncalibrated = 2
    TrackedDeviceClass_GenericTracker = TRACKER
    TrackedDeviceClass_Controller = CONTROLLER
    TrackedDeviceClass_HMD = HMD
    TrackingResult_Running_OK = OK
    Prop_SerialNumber_String = 1002
    VREvent_Quit = 700
    k_unMaxTrackedDeviceCount = 64
    OpenVRError: type[Exception] = OpenVRError
    VREvent_t: type[Any] = SimpleNamespace

    def init(self, applicationType: int) -> "FakeVr":
        assert applicationType == self.VRApplication_Background  # nothing else leaves SteamVR as it is
        if self.error is not None:
            raise self.error
        self.log.append("init")
        return self

    def shutdown(self) -> None:
        self.log.append("shutdown")

    def getDeviceToAbsoluteTrackingPose(
        self, origin: int, predictedSecondsToPhotonsFromNow: float, trackedDevicePoseArray: object
    ) -> Sequence[object]:
        assert (origin, predictedSecondsToPhotonsFromNow) == (2, 0.0)
        poses: list[object] = []
        for device in self.devices:
            matrix = SimpleNamespace(m=[list(row) for row in device.T[:3]])
            poses.append(
                SimpleNamespace(
                    mDeviceToAbsoluteTracking=matrix,
                    eTrackingResult=device.result,
                    bPoseIsValid=device.valid,
                    bDeviceIsConnected=device.connected,
                )
            )
        return poses

    def getTrackedDeviceClass(self, deviceIndex: int) -> int:
        return self.devices[deviceIndex].kind if deviceIndex < len(self.devices) else 0

    def getStringTrackedDeviceProperty(self, deviceIndex: int, prop: int) -> str:
        assert prop == 1002
        return self.devices[deviceIndex].serial

    def pollNextEvent(self, event: Any) -> bool:
        if not self.events:
            return False
        event.eventType = self.events.pop(0)
        return True

    def acknowledgeQuit_Exiting(self) -> None:
        self.log.append("acknowledged")
