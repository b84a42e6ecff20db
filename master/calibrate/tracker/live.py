"""The guided motion with the master that runs: opens its bus."""

from collections.abc import Callable

from common.calibration.object_profile import ObjectProfile
from common.clock import SystemClock
from common.messages import ObjectPose, TrackerPose
from master.calibrate.tracker.session import Session, guide
from master.run.master_bus import join_bus


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
