"""One hand before the marker rig and with the wrist device on its forearm: scenes, rigs, and what is truly in sight."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bench.played import START_NS
from bench.report import CALIBRATION
from common.arrays import Bool, Float, Int
from common.imu.fusion import OrientationFilter
from common.messages import ImuSample, MarkerDetections, WristDetections
from common.sim.scene import Scene, SceneTruth
from common.sim.scenes import scene_by_name
from common.sim.sensors import SimulatedImu
from common.sim.wrist.scene import WristScene
from master.rig.setup import RigSetup, load_setup

SCENES = ("both-poses", "both-curl", "both-travel", "grasp")
MARKER_RIG, WRIST_RIG = "desk", "wrist"
LINE_M = 2e-3
"""Of laser line that is lit and seen: from there on a finger counts as in sight of the wrist device."""
SPOT_PX2 = 9.0
"""Of visible paint: from there on a marker counts as in sight, for smaller spots are never found."""

Observed = MarkerDetections | WristDetections | ImuSample


@dataclass(frozen=True, slots=True, eq=False)
class Both:
    """One scene as both sensors have it.

    Attributes:
        name: Of the scene.
        seed: Of motion and noise.
        scene: What the marker rig sees; its truth is that of the hand, in the rig frame.
        wrist_scene: What the wrist device sees of the same hand.
        markers, wrist: The two rigs, each alone.
    """

    name: str
    seed: int
    scene: Scene
    wrist_scene: WristScene
    markers: RigSetup
    wrist: RigSetup

    @classmethod
    def of(cls, name: str, seed: int, rigs: tuple[str, str] = (MARKER_RIG, WRIST_RIG)) -> "Both":
        """Make the scene called `name` before a marker rig and a wrist device of one hand.

        Raises:
            PhalanxError: There is no such scene for either kind of rig.
        """
        markers, wrist = (load_setup(CALIBRATION, rig) for rig in rigs)
        scene = scene_by_name(name, markers.rig, markers.cameras, markers.hand.profile, seed)
        worn = WristScene(wrist.rig, wrist.cameras, wrist.hand, scene.motion, seed=seed)
        return cls(name, seed, scene, worn, markers, wrist)

    @property
    def fused(self) -> RigSetup:
        """Both rigs as one."""
        return RigSetup.joined([self.markers, self.wrist])

    def truth(self, t_ns: int) -> SceneTruth:
        """The hand, in the rig frame, at an instant of the messages' clock."""
        return self.scene.truth(1e-9 * (t_ns - START_NS))


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What is truly in sight, frame by frame.

    Attributes:
        visible_t_s: Camera -> (T,) scene times [s] of its frames.
        visible_px2: Camera -> (T, M) visible area of every marker [px^2].
        line_t_s: (K,) scene times [s] of the wrist device's triples.
        line_m: (K, 5) length of the laser line on each finger that is lit and seen [m].
        tip: (K, 5) whether each fingertip is in sight of the wrist camera.
    """

    visible_t_s: Mapping[str, Float]
    visible_px2: Mapping[str, Float]
    line_t_s: Float
    line_m: Float
    tip: Bool

    def cameras_of(self, t_s: Float, within_s: float, without: Bool | None = None) -> Int:
        """(N, M) how many cameras have each marker in sight within so long of the instants (N,) [s].

        `without` (N,) says when the markers' stream is cut off.
        """
        count = np.zeros((len(t_s), next(iter(self.visible_px2.values())).shape[1]), np.int64)
        for name, times in self.visible_t_s.items():
            count += _about(t_s, times, self.visible_px2[name] >= SPOT_PX2, within_s)
        return count if without is None else np.where(without[:, None], 0, count)

    def worn(self, t_s: Float, within_s: float, without: Bool | None = None) -> Bool:
        """(N, 5) whether the wrist device has laser line or tip of each finger in sight, as in `cameras_of`."""
        seen = _about(t_s, self.line_t_s, (self.line_m >= LINE_M) | self.tip, within_s)
        return seen if without is None else seen & ~without[:, None]


def _about(t_s: Float, times_s: Float, there: Bool, within_s: float) -> Bool:
    """(N, ...) whether something is there (T, ...) at any of the times (T,) within so long of the instants (N,)."""
    first, last = (np.searchsorted(times_s, t_s + way * within_s) for way in (-1.0, 1.0))
    total = np.concatenate([np.zeros((1, *there.shape[1:]), np.int64), np.cumsum(there, axis=0)])
    return np.asarray(total[last] > total[first])


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What the sensors report of a scene, and what of it is truly in sight.

    Attributes:
        both: The scene.
        seconds: How long it was watched.
        messages: Of all sensors, in the order of their stamps.
        sight: The truth of sight.
    """

    both: Both
    seconds: float
    messages: list[Observed]
    line_of_sight: Sight


def in_order(messages: list[Observed]) -> list[Observed]:
    """In the order of capture, as a recording is solved."""
    return sorted(messages, key=lambda message: message.t_ns)


def orientations(both: Both, seconds: float) -> list[Observed]:
    """What the IMU's slave sends of that time: raw samples of the forearm with its filter's orientation."""
    imu = both.wrist.rig.imu
    if imu is None:
        return []
    fusion = OrientationFilter(imu.rate_hz)
    return [fusion.push(one) for one in SimulatedImu.of(both.wrist_scene).around(0.0, seconds, START_NS)]
