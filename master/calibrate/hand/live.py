"""The routine with the master that runs: opens the bus and a person's terminal."""

from common.clock import SystemClock
from common.errors import CalibrationError
from common.hand.model import HandModel
from common.messages import HandPose
from common.terminal import echo
from master.calibrate.hand.observed import Observed, marker_rows
from master.calibrate.hand.session import guide
from master.run.master_bus import join_bus


def observe_live(bus: str, names: tuple[str, ...], model: HandModel) -> Observed:
    """Lead the user through the routine.

    Args:
        bus: Endpoint of the running master's bus.
        names: The rig's markers.
        model: The hand to begin with.

    Raises:
        BusError: Nobody listens there.
        CalibrationError: The master's poses have other markers.
        FitError: The routine was not seen.
    """
    tips = marker_rows(names, model)[:5]
    link = join_bus(bus)
    try:
        depth = 256  # poses that may wait while a line is printed
        poses = link.subscribe("hand", depth=depth)

        def receive(timeout_s: float) -> HandPose | None:
            message = poses.get(timeout_s)
            if message is None or not isinstance(message, HandPose):
                return None
            if len(message.markers_raw_m) != len(names):
                raise CalibrationError(
                    f"the running master has {len(message.markers_raw_m)} markers, the rig {len(names)}: name its"
                    " rig with --rig"
                )
            return message

        track = guide(receive, tips, names, SystemClock(), echo)
    finally:
        link.close()
    return Observed.of(*track.arrays(), names, model)
