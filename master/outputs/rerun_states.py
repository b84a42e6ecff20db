"""Lanes of lasting states over time in the viewer.

Such as a pose of the hand or a held object.
"""

import numpy as np
import rerun as rr

from master.outputs.rerun_blueprint import STATES, TIMELINE


class States:
    """Logger of state changes to a recording that belongs to the caller.

    Holds the last state of each lane.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording
        self._last: dict[str, str | None] = {}

    def log(self, lane: str, t_ns: int, state: str | None) -> None:
        """Log the state of a lane (a path of names) at a time.

        None: no state. Logging the same state again costs nothing.
        """
        if self._last.get(lane) == state:
            return
        self._last[lane] = state
        self.at(t_ns)
        path = rr.new_entity_path([STATES, *lane.split("/")])
        self._rec.log(path, rr.Clear(recursive=False) if state is None else rr.StateChange(state=state))

    def at(self, t_ns: int) -> None:
        """Let what is logged row by row stand at this time."""
        self._rec.set_time(TIMELINE, duration=np.timedelta64(t_ns, "ns"))
