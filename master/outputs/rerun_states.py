"""What lasts in the viewer: lanes of states over time, such as a pose of the hand or a held object."""

import numpy as np
import rerun as rr

from master.outputs.rerun_blueprint import STATES, TIMELINE


class States:
    """Logs changes of state to a recording that belongs to the caller; holds the last state of each lane."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording
        self._last: dict[str, str | None] = {}

    def log(self, lane: str, t_ns: int, state: str | None) -> None:
        """The state of a lane (a path of names) at a time; None: none. The same again costs nothing."""
        if self._last.get(lane) == state:
            return
        self._last[lane] = state
        self.at(t_ns)
        path = rr.new_entity_path([STATES, *lane.split("/")])
        self._rec.log(path, rr.Clear(recursive=False) if state is None else rr.StateChange(state=state))

    def at(self, t_ns: int) -> None:
        """Let what is logged row by row stand at this time."""
        self._rec.set_time(TIMELINE, duration=np.timedelta64(t_ns, "ns"))
