"""What a program on the bus is told of the hand while faults come and go, against the truth of the scene."""

import threading
import time
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.detections_sender import CALIBRATION
from bench.faults_sender import WAY_S, scene_s, standard_scene
from common.arrays import Float
from common.bus.zenoh_bus import ZenohBus
from common.messages import HandPose
from master.rig.files import load_setup

GRID_HZ = 200.0
STEADY_S, STEADY_SHARE, GAP_S = 0.5, 0.8, 0.2
SANE_MM = 20.0  # of a joint that is said to be tracked; the scene's hand is 180 mm long


@dataclass(frozen=True, slots=True)
class ReceivedPose:
    """One pose.

    Attributes:
        came_s: When, `time.monotonic`.
        age_s: How old it was then, by its own time.
        worst_mm: Error of the worst tracked joint; NaN: none is tracked.
        mean_mm: Mean error of the tracked joints.
        beyond: Errors of valid joints, tracked or not, in units of their standard deviations, the worst.
    """

    came_s: float
    age_s: float
    worst_mm: float
    mean_mm: float
    beyond: float


@dataclass(frozen=True, slots=True)
class Pace:
    """How poses come: so many a second, with gaps no longer than this [s]."""

    rate_hz: float
    gap_s: float = GAP_S


class Judge:
    """Where the joints truly are at each moment. Holds a table of one way of the scene."""

    def __init__(self, epoch_ns: int) -> None:
        """Of the scene that began then."""
        self._epoch_ns = epoch_ns
        scene = standard_scene(load_setup(CALIBRATION, "desk"))
        self._table: Float = np.stack(
            [scene.truth(k / GRID_HZ).joints.position_m for k in range(round(WAY_S * GRID_HZ) + 2)]
        )

    def joints_m(self, t_ns: int) -> Float:
        """Positions (26, 3) [m]."""
        at = scene_s(t_ns, self._epoch_ns) * GRID_HZ
        k = int(at)
        return self._table[k] + (at - k) * (self._table[k + 1] - self._table[k])

    def received(self, pose: HandPose, came_ns: int) -> ReceivedPose:
        """How right a pose is that came at `came_ns`."""
        error = np.linalg.norm(pose.position_m - self.joints_m(pose.t_ns), axis=1)
        sigma = np.sqrt(np.trace(pose.cov_m2, axis1=1, axis2=2))
        beyond = np.max(error / sigma, where=pose.valid, initial=0.0)
        tracked_mm = 1e3 * error[pose.tracked]
        worst_mm, mean_mm = (
            (float(tracked_mm.max()), float(tracked_mm.mean())) if len(tracked_mm) else (np.nan, np.nan)
        )
        return ReceivedPose(came_ns * 1e-9, (came_ns - pose.t_ns) * 1e-9, worst_mm, mean_mm, float(beyond))


class Poses:
    """All poses of one hand that came over the bus. Holds them, and a thread."""

    def __init__(self, bus: ZenohBus, judge: Judge) -> None:
        """Listen from now on."""
        self._hands, self._judge = bus.subscribe("hand", depth=256), judge
        self._lock, self._closing = threading.Lock(), threading.Event()
        self._received: list[ReceivedPose] = []
        self._thread = threading.Thread(target=self._hear, daemon=True)
        self._thread.start()

    def since(self, moment_s: float, until_s: float = float("inf")) -> list[ReceivedPose]:
        """Those that came in between, `time.monotonic`."""
        with self._lock:
            return [one for one in self._received if moment_s <= one.came_s < until_s]

    def close(self) -> None:
        """Listen no more."""
        self._closing.set()
        self._thread.join()

    def _hear(self) -> None:
        while not self._closing.is_set():
            pose = self._hands.get(0.05)
            if isinstance(pose, HandPose):
                received = self._judge.received(pose, time.monotonic_ns())
                with self._lock:
                    self._received.append(received)


def pace_of(received: list[ReceivedPose], began_s: float, ended_s: float, rate_hz: float) -> Pace:
    """The pace of what came from `began_s` to `ended_s`: at most `rate_hz`; gaps half as long again as the longest."""
    came = [began_s, *(one.came_s for one in received), ended_s]
    longest_s = max(b - a for a, b in pairwise(came))
    return Pace(min(rate_hz, len(received) / (ended_s - began_s)), max(GAP_S, 1.5 * longest_s))


def steady_from(received: list[ReceivedPose], moment_s: float, pace: Pace) -> float | None:
    """When, after `moment_s`, poses came steadily and were right for half a second; None: not yet.

    Steady: four fifths of the number of the pace, no gap above its own, no tracked joint off by more than 20 mm.
    """
    came = [one for one in received if one.came_s >= moment_s]
    for k, first in enumerate(came):
        window = [one for one in came[k:] if one.came_s < first.came_s + STEADY_S]
        if came[-1].came_s < first.came_s + STEADY_S:
            return None
        gaps = [b.came_s - a.came_s for a, b in pairwise(window)]
        enough = len(window) >= STEADY_SHARE * STEADY_S * pace.rate_hz and max(gaps, default=9.0) < pace.gap_s
        if enough and all(one.worst_mm < SANE_MM for one in window):
            return first.came_s
    return None
