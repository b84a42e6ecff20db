"""Add an output: a sink is one class with `write` and `close`; this one logs where the index finger points."""

import threading
from pathlib import Path

import numpy as np

from common.clock import SystemClock
from common.hand.model import JOINTS
from common.messages import HandPose, MarkerDetections, ResultMessage
from master.outputs.bus import Sink
from master.rig.pipeline import pipeline_of
from master.run.app import RunFigures, run
from master.run.dispatcher import Dispatcher
from tests.synthetic_run import synthetic_run
from tests.test_walk import nothing

TIP, KNUCKLE = JOINTS.index("index-finger-tip"), JOINTS.index("index-finger-phalanx-proximal")


class PointingLog:
    """One line per pose: time [s] and direction of the index finger in the rig frame."""

    def __init__(self, path: Path) -> None:
        """Begin a new file."""
        self._file = path.open("w")

    def write(self, message: ResultMessage) -> None:
        """Write the direction of a hand; other results are not for this sink."""
        if not isinstance(message, HandPose) or not message.valid[[KNUCKLE, TIP]].all():
            return
        along = message.position_m[TIP] - message.position_m[KNUCKLE]
        x, y, z = along / np.linalg.norm(along)
        self._file.write(f"{message.t_ns * 1e-9:.6f} {x:+.3f} {y:+.3f} {z:+.3f}\n")

    def close(self) -> None:
        """Complete the file. Safe to call twice."""
        self._file.close()


class Played:
    """The messages of a run, one at a time; then the loop is stopped."""

    def __init__(self, messages: list[MarkerDetections], stop: threading.Event) -> None:
        self._left, self._stop = list(messages), stop

    def get(self, timeout_s: float) -> MarkerDetections | None:
        """The next message, or None."""
        if self._left:
            return self._left.pop(0)
        self._stop.set()
        return None


def test_the_live_loop_writes_every_hand_to_it(tmp_path: Path) -> None:
    made, stop, path = synthetic_run(12), threading.Event(), tmp_path / "pointing.txt"
    dispatcher = Dispatcher([made.setup], [pipeline_of(made.setup, nothing)], nothing, gestures=False)
    sink: Sink = PointingLog(path)
    figures = RunFigures()
    run(Played(made.messages, stop).get, dispatcher.push, [sink], SystemClock(), figures, stop)
    sink.close()
    sink.close()
    lines = path.read_text().splitlines()
    assert len(lines) == figures.poses >= 8
    t_s, *direction = map(float, lines[-1].split())
    joints = made.truth(round(t_s * 1e9)).position_m
    along = joints[TIP] - joints[KNUCKLE]
    assert float(np.dot(direction, along / np.linalg.norm(along))) > np.cos(np.radians(3.0))
