"""A session guides a person through the tracker motion on a running master.

Guided tracker motion with a person.

Every second reports what was seen so far and what is still missing.

The machine that counts is `Session`; `guide` gives it what comes and talks.

The guided motion with the master that runs: opens its bus.
"""

from collections.abc import Callable

import numpy as np

from common.calibration.object_profile import ObjectProfile
from common.clock import Clock, SystemClock
from common.errors import FitError
from common.messages import ObjectPose, ObjectSource, TrackerPose
from master.calibrate.tracker.fit import first_lag
from master.calibrate.tracker.registration import MOTION
from master.calibrate.tracker.tracks import Coverage, coverage_of, object_track, tracker_track
from master.run.process import join_bus

SILENT_S = 3.0

Receive = Callable[[float], ObjectPose | TrackerPose | None]


class Session:
    """Push machine of the guided motion.

    Holds all poses of the motion, and when each side was last received.
    """

    def __init__(self) -> None:
        """Begin."""
        self.objects: list[ObjectPose] = []
        self.tracked: list[TrackerPose] = []
        self._lag_s: float | None = None

    def push(self, message: ObjectPose | TrackerPose) -> None:
        """Take one pose, of the object by cameras or of the device."""
        if isinstance(message, TrackerPose):
            self.tracked.append(message)
        elif message.tracked and message.source in (ObjectSource.MARKERS, ObjectSource.TAGS):
            self.objects.append(message)

    def coverage(self) -> Coverage | None:
        """Return the coverage so far.

        None: one side has sent nothing yet.
        """
        if not (self.objects and self.tracked):
            return None
        zero_ns = min(self.objects[0].t_ns, self.tracked[0].t_ns)
        seen, device = object_track(self.objects, zero_ns), tracker_track(self.tracked, zero_ns)
        if len(seen) < 2 or len(device) < 2:
            return None
        found = coverage_of(seen, device, self._lag_s or 0.0)
        lag_after_s = 5.0
        if self._lag_s is None and found.shared_s > lag_after_s:
            self._lag_s = first_lag(seen, device)
        return found

    def silent(self, now_ns: int) -> str:
        """Name the side that sends nothing just now, and what to look at.

        Empty: both send.
        """
        if not _recent([one.t_ns for one in self.tracked[-1:]], now_ns):
            return "no tracker data received: is `phalanx-slave run --tracker` running, and does the master know it?"
        if not np.isfinite([one.position_m for one in self.tracked[-20:]]).any():
            return "the tracker does not know where it is: let it see a base station"
        if not _recent([one.t_ns for one in self.objects[-1:]], now_ns):
            return "the cameras do not see the object: markers or tags to the cameras"
        return ""


def guide(receive: Receive, clock: Clock, notify: Callable[[str], None], longest_s: float) -> Session:
    """Lead a person through the motion until it is enough, or the time is over.

    Args:
        receive: The next pose of object or device, waiting at most so long [s].
        clock: The master's clock.
        notify: Called with one line at a time.
        longest_s: How long the motion may take [s].

    Raises:
        FitError: Nothing was received from the cameras or the tracker all the time.
    """
    session = Session()
    notify(MOTION)
    begin_ns = printed_ns = clock.now_ns()
    enough = False
    while not enough and clock.now_ns() - begin_ns < longest_s * 1e9:
        wait_s = 0.02
        message = receive(wait_s)
        if message is not None:
            session.push(message)
        now_ns = clock.now_ns()
        print_ns = 1_000_000_000
        if now_ns - printed_ns < print_ns:
            continue
        printed_ns = now_ns
        coverage, silent = session.coverage(), ""
        if now_ns - begin_ns > SILENT_S * 1e9:
            silent = session.silent(now_ns)
        if coverage is None:
            notify(silent or "waiting for cameras and tracker")
            continue
        enough_s = 15.0  # of both, when all turns are there: more of it makes the result surer
        enough = not coverage.missing and coverage.shared_s >= enough_s
        hint = silent or (
            coverage.missing[0] if coverage.missing else "go on like this" if not enough else "done"
        )
        notify(f"{100 * coverage.share:3.0f} %  {coverage.line()}. {hint}")
    if not (session.objects and session.tracked):
        raise FitError(session.silent(clock.now_ns()) or f"nothing was seen: {MOTION}")
    return session


def _recent(t_ns: list[int], now_ns: int) -> bool:
    return bool(t_ns) and now_ns - t_ns[0] < SILENT_S * 1e9


def observe_live(
    bus: str, profile: ObjectProfile, longest_s: float, notify: Callable[[str], None]
) -> Session:
    """Lead the user through the motion.

    Args:
        bus: Endpoint of the running master's bus.
        profile: The object; it has a tracker.
        longest_s: How long the motion may take [s].
        notify: Called with one line at a time.

    Raises:
        BusError: Nobody listens there.
        FitError: Nothing was received from the cameras or the tracker.
    """
    link = join_bus(bus)
    try:
        depth = 1024  # poses that may wait while a line is printed
        objects = link.subscribe("object", profile.name, depth)
        devices = link.subscribe("device", profile.tracker or profile.name, depth)

        def receive(timeout_s: float) -> ObjectPose | TrackerPose | None:
            message = objects.get(0.0) or devices.get(timeout_s)
            return message if isinstance(message, ObjectPose | TrackerPose) else None

        return guide(receive, SystemClock(), notify, longest_s)
    finally:
        link.close()
