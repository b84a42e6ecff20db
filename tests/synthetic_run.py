"""A short run of exact detections of a moving hand: what cameras would report if they made no errors."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from common.arrays import Float
from common.calibration import RigCalibration
from common.hand.model import HandJoints
from common.messages import MarkerDetections
from master.rig.setup import RigSetup
from tests.hand_helpers import MARKERS, RIGHT, camera_file, cap_bias_px, detections, palm, rig_file

PERIOD_NS = 16_666_667
ROW_TIME_US = 20.6
LATE_NS = {"left": 0, "right": 5_000_000}


@dataclass(frozen=True)
class SyntheticRun:
    """Messages in the order of their capture times, and the truth at any moment."""

    setup: RigSetup
    messages: list[MarkerDetections]

    def truth(self, t_ns: int) -> HandJoints:
        return hand_at(t_ns * 1e-9)


def hand_at(t_s: float) -> HandJoints:
    """A hand that sways sideways (0.5 m/s at most), turns a little, and opens and closes."""
    pip = np.radians(20.0 + 10.0 * np.sin(3.0 * t_s))  # more would hide the caps behind the fingers
    angles = np.zeros((5, 4))
    angles[0] = np.radians([8.0, 8.0, 12.0, 12.0])
    angles[1:] = [0.0, 0.54 * pip, pip, pip * 2 / 3]
    at = np.array([0.08 * np.sin(6.0 * t_s), 0.08, 0.5])
    return RIGHT.forward(palm(np.array([8.0, 5.0, 0.0]) * np.sin(2.0 * t_s), at), angles)


def setup_of(rig: RigCalibration) -> RigSetup:
    return RigSetup.of(rig, {name: camera_file(name, 60.0, ROW_TIME_US) for name in rig.cameras}, RIGHT)


def synthetic_run(frames: int = 40, **changes: object) -> SyntheticRun:
    """Two cameras at 60 Hz, the right one 5 ms late, rolling shutters; changes to the rig leave them where they are."""
    setup = setup_of(rig_file(**changes))  # pyright: ignore[reportArgumentType]
    messages = [_frame(name, seq) for name in setup.models for seq in range(frames)]
    return SyntheticRun(setup, sorted(messages, key=lambda m: m.t_ns))


CAMERAS = setup_of(rig_file()).models


@cache
def _frame(name: str, seq: int) -> MarkerDetections:
    """What a camera sees at a frame, made once."""
    camera, t_ns = CAMERAS[name], 1_000_000_000 + seq * PERIOD_NS + LATE_NS[name]
    uv = np.full((6, 2), 240.0)
    for _ in range(4):  # each marker at the time of its own row
        rows: list[Float] = []
        for m in range(6):
            joints = hand_at(t_ns * 1e-9 + ROW_TIME_US * 1e-6 * float(uv[m, 1]))
            points = RIGHT.marker_points(joints, MARKERS)
            seen = camera.project(points) + cap_bias_px(joints, points, (camera,))[0]
            rows.append(seen[m])
        uv = np.stack(rows)
    return detections(name, seq, t_ns, uv)
