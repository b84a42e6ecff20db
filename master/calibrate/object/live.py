"""The guided motion with the master that runs: opens its bus."""

from collections.abc import Callable, Sequence

from common.calibration import RigCalibration
from common.clock import SystemClock
from common.messages import HandPose
from master.calibrate.object.seen import Seen
from master.calibrate.object.session import guide
from master.run.master_bus import join_bus


def observe_live(
    bus: str, rig: RigCalibration, names: Sequence[str], longest_s: float, notify: Callable[[str], None]
) -> Seen:
    """Lead the user through the motion.

    Args:
        bus: Endpoint of the running master's bus.
        rig: That it runs.
        names: Of the beads.
        longest_s: How long the motion may take [s].
        notify: Called with one line at a time.

    Raises:
        BusError: Nobody listens there.
        CalibrationError: The master runs another rig.
        FitError: No pose came.
    """
    link = join_bus(bus)
    try:
        depth = 512  # poses that may wait while a line is printed
        poses = link.subscribe("hand", depth=depth)

        def receive(timeout_s: float) -> HandPose | None:
            message = poses.get(timeout_s)
            # A wrist device alone reports hands without markers.
            return message if isinstance(message, HandPose) and len(message.markers_raw_m) else None

        return guide(receive, rig, names, SystemClock(), notify, longest_s)
    finally:
        link.close()
