"""Interface to openvr (pyopenvr), as far as Phalanx uses it.

Its interface as types, and the one place that imports it.

It is there on PCs with x86 processors only, and useless without SteamVR, so it is imported when a tracker is opened.
Names and meanings were read in openvr 2.12 (openvr/__init__.py, error_code/__init__.py).
"""

import importlib
from collections.abc import Sequence
from typing import Any, Protocol, cast

from common.errors import TrackerError

INSTALL = "pip install 'phalanx-hand[vive]', on a PC with an x86 processor; elsewhere use --device survive"


class VrSystem(Protocol):
    """`openvr.IVRSystem`: the devices of a SteamVR that runs."""

    def getDeviceToAbsoluteTrackingPose(
        self, origin: int, predictedSecondsToPhotonsFromNow: float, trackedDevicePoseArray: Any
    ) -> Sequence[Any]:
        """Return `TrackedDevicePose_t` of all devices.

        Predicted to a time so many seconds after the call.
        """
        ...

    def getTrackedDeviceClass(self, deviceIndex: int) -> int:
        """What kind of device it is; 0: there is none."""
        ...

    def getStringTrackedDeviceProperty(self, deviceIndex: int, prop: int) -> str:
        """A property in words. Raises `OpenVRError` where the device has none."""
        ...

    def pollNextEvent(self, event: Any) -> bool:
        """Fill `event` with the oldest one; False: there is none."""
        ...

    def acknowledgeQuit_Exiting(self) -> None:
        """SteamVR may end; without it SteamVR ends the program."""
        ...


class Library(Protocol):
    """The module `openvr`."""

    VRApplication_Background: int
    TrackingUniverseRawAndUncalibrated: int
    TrackedDeviceClass_GenericTracker: int
    TrackedDeviceClass_Controller: int
    TrackedDeviceClass_HMD: int
    TrackingResult_Running_OK: int
    Prop_SerialNumber_String: int
    VREvent_Quit: int
    k_unMaxTrackedDeviceCount: int
    OpenVRError: type[Exception]
    VREvent_t: type[Any]

    def init(self, applicationType: int) -> VrSystem:
        """Connect to SteamVR. Raises `OpenVRError`."""
        ...

    def shutdown(self) -> None:
        """Let go of SteamVR."""
        ...


def load_library() -> Library:
    """Import the module.

    Raises:
        TrackerError: It is not installed, or has no code for this machine.
    """
    try:
        return cast(Library, importlib.import_module("openvr"))
    except ImportError as error:
        raise TrackerError(f"--device openvr: the library openvr is not installed: {INSTALL}") from error
    except (OSError, ValueError) as error:  # of its shared library, which it loads at once
        raise TrackerError(f"--device openvr: the library does not run here ({error}): {INSTALL}") from error


def connect(library: Library) -> VrSystem:
    """Connect to a SteamVR that runs; it is never started from here.

    Raises:
        TrackerError: With what to do.
    """
    try:
        return library.init(library.VRApplication_Background)
    except library.OpenVRError as error:
        raise TrackerError(f"--device openvr: {_why(error)}") from error


def _why(error: Exception) -> str:
    kind = type(error).__name__
    number = getattr(error, "error_value", None)
    no_server, no_headset = 121, 108  # VRInitError_Init_NoServerForBackgroundApp, _Init_HmdNotFound
    if number == no_server:
        return "SteamVR does not run: start it, with the tracker switched on and paired (docs/tracker.md)"
    if number == no_headset:
        return (
            'SteamVR wants a headset: set "requireHmd" to false in its settings and enable the null driver '
            "(docs/tracker.md)"
        )
    text = f" ({error})" if str(error) else ""
    return f"no SteamVR answers, {kind}{text}: install SteamVR from Steam, start it, pair the tracker (docs/tracker.md)"
