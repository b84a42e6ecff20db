"""Read a Vive tracker by SteamVR, through openvr.

The library (pyopenvr) is there on PCs with x86 processors only, and useless without SteamVR, so it is imported when a
tracker is opened. Names and meanings were read in openvr 2.12 (openvr/__init__.py, error_code/__init__.py).

SteamVR is asked some hundred times a second where the tracker is at the very moment of the call: it leads its newest
measurement over the milliseconds since, so a pose holds when it was asked for and needs no stamp of the device. Poses
are in the raw frame of the base stations, y up: to set the room's floor or middle anew moves nothing, to move a base
station does. A pose counts only where SteamVR reports that it is valid, of a connected device, and tracked by light
(`Running_OK`); what it leads by the gyroscope alone is NaN. A program that holds on when SteamVR ends is ended by
SteamVR (ValveSoftware/openvr, issues 878 and 1490), so its end is confirmed.
"""

import importlib
import threading
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from common.arrays import Float
from common.clock import Clock
from common.errors import TrackerChoiceError, TrackerError
from common.geometry.transforms import matrix_to_quaternion
from common.messages import TrackerPose
from slave.sources import Reporting

INSTALL = "pip install 'phalanx-hand[vive]', on a PC with an x86 processor; elsewhere use --device survive"


Library: TypeAlias = Any  # the module `openvr`
VrSystem: TypeAlias = Any  # its `IVRSystem`: the devices of a SteamVR that runs


def load_library() -> Library:
    """Import the module; TrackerError: not installed, or no code for this machine."""
    try:
        return importlib.import_module("openvr")
    except ImportError as error:
        raise TrackerError(f"--device openvr: the library openvr is not installed: {INSTALL}") from error
    except (OSError, ValueError) as error:  # of its shared library, which it loads at once
        raise TrackerError(f"--device openvr: the library does not run here ({error}): {INSTALL}") from error


def connect(library: Library) -> VrSystem:
    """Connect to a SteamVR that runs, never start it; TrackerError: what to do."""
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


_NOTHING = (np.full(3, np.nan), np.full(4, np.nan))


class OpenVrTracker(Reporting):
    """`TrackerSource` that reads a device from SteamVR."""

    def __init__(
        self,
        name: str,
        serial: str | None,
        clock: Clock,
        stop: threading.Event,
        loader: Callable[[], Library] = load_library,
        rate_hz: float = 120.0,
    ) -> None:
        """Connect to SteamVR.

        `serial`: number of the device (LHR-...); None: there is one tracker only. `rate_hz`: how often SteamVR is
        asked. Raises TrackerError: the library is missing, or SteamVR does not answer.
        """
        self._name, self._serial, self._clock, self._stop = name, serial, clock, stop
        self._library = loader()
        self._system: VrSystem = connect(self._library)  # None: closed
        self._period_ns = round(1e9 / rate_hz)
        self._next_ns = clock.now_ns()
        self._index: int | None = None
        self._looked_ns: int | None = None
        self._seq = -1
        self._lost = 0
        self._counts = {"lost_itself": 0, "absent": 0}

    def read(self) -> TrackerPose | None:
        """Ask where it is when that is due; None once stopped or closed.

        Raises TrackerError: SteamVR is ending; TrackerChoiceError: several trackers, and none was selected.
        """
        while not self._stop.is_set() and self._system is not None:
            left_ns = self._next_ns - self._clock.now_ns()
            if left_ns > 0:
                self._stop.wait(left_ns * 1e-9)
                continue
            self._next_ns += self._period_ns * (1 + (-left_ns) // self._period_ns)
            self._poll_events(self._system)
            pose = self._ask(self._system)
            if pose is not None:
                return pose
        return None

    def close(self) -> None:
        """Let go of SteamVR. Safe to call twice."""
        system, self._system = self._system, None
        if system is not None:
            self._library.shutdown()

    def counts(self) -> Mapping[str, int]:
        """Asked while it saw no base station, `lost_itself`, or was off, `absent`."""
        return dict(self._counts)

    def metrics(self) -> Mapping[str, float]:
        """Nothing."""
        return {}

    def _poll_events(self, system: VrSystem) -> None:
        event = self._library.VREvent_t()
        while system.pollNextEvent(event):
            if event.eventType == self._library.VREvent_Quit:
                system.acknowledgeQuit_Exiting()
                self.close()
                raise TrackerError("SteamVR ends: start it again")

    def _ask(self, system: VrSystem) -> TrackerPose | None:
        """Ask for one pose; None: the device is lost, and that has just been reported."""
        before_ns = self._clock.now_ns()
        poses = system.getDeviceToAbsoluteTrackingPose(
            self._library.TrackingUniverseRawAndUncalibrated, 0.0, None
        )
        t_ns = (before_ns + self._clock.now_ns()) // 2
        index = self._found(system, t_ns)
        found = None if index is None else self._valid(poses[index])
        if found is None:
            self._lost += 1
            lost_every = 30  # poses of NaN: four a second suffice
            if self._lost % lost_every != 1:
                return None
        else:
            self._lost = 0
        self._seq += 1
        place, quaternion = _NOTHING if found is None else found
        return TrackerPose(self._name, 0, self._seq, t_ns, place, quaternion)

    def _found(self, system: VrSystem, now_ns: int) -> int | None:
        """Return the device's number; searched once a second until it is there."""
        poll_ns = 1_000_000_000  # between two searches for the device
        if self._index is None and (self._looked_ns is None or now_ns - self._looked_ns >= poll_ns):
            self._looked_ns = now_ns
            self._index = self._search(system)
        if self._index is None:
            self._counts["absent"] += 1
        return self._index

    def _search(self, system: VrSystem) -> int | None:
        """The only tracker; or the tracker or controller of the serial number."""
        library = self._library
        kinds = library.TrackedDeviceClass_GenericTracker, library.TrackedDeviceClass_Controller
        trackers: dict[int, str] = {}
        for index in range(library.k_unMaxTrackedDeviceCount):
            kind = system.getTrackedDeviceClass(index)
            if kind not in (kinds[:1] if self._serial is None else kinds):
                continue
            try:
                serial = system.getStringTrackedDeviceProperty(index, library.Prop_SerialNumber_String)
            except library.OpenVRError:
                continue
            if self._serial in (None, serial):
                trackers[index] = serial
        if self._serial is None and len(trackers) > 1:
            there = ", ".join(trackers.values())
            raise TrackerChoiceError(
                f"SteamVR has several trackers, {there}: say with --serial which one sits on the object"
            )
        return next(iter(trackers), None)

    def _valid(self, pose: Any) -> tuple[Float, Float] | None:
        """Place and turn of a `TrackedDevicePose_t`, if it is one to rely on."""
        if not pose.bDeviceIsConnected:
            self._counts["absent"] += 1
            return None
        if pose.eTrackingResult != self._library.TrackingResult_Running_OK or not pose.bPoseIsValid:
            self._counts["lost_itself"] += 1
            return None
        return matrix34(pose.mDeviceToAbsoluteTracking)


def matrix34(matrix: Any) -> tuple[Float, Float] | None:
    """`HmdMatrix34_t` as place (3,) [m], quaternion (4,) wxyz; None: it is no pose."""
    rows = np.array([list(row) for row in matrix.m], float)
    if not np.isfinite(rows).all():
        return None
    axes = rows[:, :3]
    unit_within = 1e-3
    if not np.allclose(axes @ axes.T, np.eye(3), atol=unit_within) or np.linalg.det(axes) < 0.0:
        return None
    return rows[:, 3], matrix_to_quaternion(axes)
