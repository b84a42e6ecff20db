"""A scene through the whole line in one process: rendered frames, real detector, real pipeline, exact truth.

Without clocks and network, so that the same scene gives the same figures.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image, Int
from common.hand.model import HandModel
from common.messages import HandPose, MarkerDetections
from common.sim.motion import HandState, base_pose, smooth_step
from common.sim.painter import MarkerView
from common.sim.render import Renderer
from common.sim.scene import Scene
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.app import StageTimes
from slave.markers.detector import Detections
from slave.markers.reloadable import detector_for
from slave.markers.white_balance import Inline

START_NS = 1_000_000_000  # scene time 0 on the clock of the messages
HOLD_S, MOVE_S = 0.8, 0.7  # of a motion that holds poses


@dataclass(frozen=True, slots=True, eq=False)
class HeldPoses:
    """A motion that holds each of some states, then moves on to the next."""

    model: HandModel  # the hand
    held: Sequence[tuple[Float, Float, Float]]  # place [m], rotation vector [rad], angles (5, 4)
    period_s: float = 1e6

    def at(self, t_s: float) -> HandState:
        """Return the hand at time `t_s` [s]; before 0 the pose of 0."""
        step, phase = divmod(max(t_s, 0.0), HOLD_S + MOVE_S)
        here, there = (self.held[(int(step) + k) % len(self.held)] for k in range(2))
        share = smooth_step((phase - HOLD_S) / MOVE_S)
        at, rotation, angles = ((1.0 - share) * a + share * b for a, b in zip(here, there, strict=True))
        return HandState(base_pose(self.model, at, np.zeros(3), rotation), angles)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A motion by where the hand is at each time [s]."""

    where: Callable[[float], HandState]
    period_s: float = 60.0

    def at(self, t_s: float) -> HandState:
        """Return the hand at time `t_s` [s]."""
        return self.where(t_s)


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """One camera over T frames of a scene.

    `shown`: visible area in discs of the cap's radius at its distance; of a marker that is no cap, its visible share.
    """

    messages: tuple[MarkerDetections, ...]  # what its slave would send, frame by frame
    t_s: Float  # (T,) scene time of each frame's row 0 [s]
    shown: Float  # (T, M)


def times_of(scene: Scene, camera: str, seconds: float, rate_hz: float, start_s: float = 0.0) -> Float:
    """Return scene times (T,) [s] of the frames of a camera, which begins as late as the scene has it."""
    late_s = scene.timing(camera).start_offset_ns * 1e-9
    return start_s + late_s + np.arange(round(seconds * rate_hz)) / rate_hz


def shown_by(scene: Scene, camera: str, times_s: Float) -> Float:
    """Return exact visibility alone, (T, M) as in `Watched`; nothing is drawn."""
    renderer = Renderer(scene, camera)
    return np.array([_shown(scene, camera, renderer.markers(t), t) for t in times_s.tolist()])


def observed(
    scene: Scene, camera: str, times_s: Float, push: Callable[[Image, int], Detections] | None = None
) -> Iterator[tuple[MarkerDetections, MarkerView, Image]]:
    """Render and detect the frames of one camera: what its slave would send, what is in sight, the frame.

    `push`: of a detector; None: the one of a slave.
    """
    renderer, own = Renderer(scene, camera), scene.cameras[camera]
    if push is None:
        push = detector_for(own, scene.rig.markers, Inline(), free=scene.rig.free_markers).push
    for seq, t in enumerate(times_s.tolist()):
        t_ns, (image, view) = START_NS + round(t * 1e9), renderer.observe(t)
        yield message_of(camera, seq, t_ns, push(image, t_ns)), view, image


def found_by(scene: Scene, camera: str, times_s: Float) -> list[MarkerDetections]:
    """Return what the slave of one camera would send."""
    return [message for message, _, _ in observed(scene, camera, times_s)]


def watch(scene: Scene, camera: str, times_s: Float) -> Watched:
    """Render and detect the frames of one camera, with exact visibility beside them."""
    found = list(observed(scene, camera, times_s))
    seen = zip(found, times_s.tolist(), strict=True)
    shown = [_shown(scene, camera, view, t_s) for (_, view, _), t_s in seen]
    return Watched(tuple(message for message, _, _ in found), times_s, np.array(shown))


def message_of(camera: str, seq: int, t_ns: int, found: Detections) -> MarkerDetections:
    """Return the message of frame `seq`, taken at `t_ns` [ns] and handed over at once."""
    seen = (found.uv, found.area, found.quality, found.sigma_px, found.alt_uv)
    return MarkerDetections(camera, 1, seq, t_ns, t_ns, *seen)


def solve(setup: RigSetup, watched: Sequence[Watched]) -> tuple[list[HandPose], dict[str, int]]:
    """Return the poses of all cameras' messages in the order of capture, and the pipeline's counts."""
    pipeline = build_pipeline(setup, StageTimes())
    messages = sorted((m for one in watched for m in one.messages), key=lambda message: message.t_ns)
    poses = [solved.pose for message in messages for solved in pipeline.push(message)]
    return poses, dict(pipeline.counts)


def times_of_poses(poses: Sequence[HandPose]) -> Float:
    """Return scene times (T,) [s] of poses."""
    stamps: Int = np.array([pose.t_ns for pose in poses], np.int64)
    return np.asarray((stamps - START_NS) * 1e-9, np.float64)


def _shown(scene: Scene, camera: str, view: MarkerView, t_s: float) -> Float:
    shown = view.visible.copy()
    rows_s = 0.02  # a marker's row is exposed within this time after row 0
    joints = scene.truth(t_s + rows_s / 2).joints
    optics = scene.optics[camera]
    focal_px = float(np.sqrt(optics.matrix[0, 0] * optics.matrix[1, 1]))
    for m, name in enumerate(scene.rig.markers):
        mount = scene.model.mount(name)
        if mount.joint is not None:
            distance = float(np.linalg.norm(joints.position_m[mount.joint] - optics.centre))
            radius_px = focal_px * float(scene.model.radius_m[mount.joint]) / distance
            shown[m] = view.area[m] / (np.pi * radius_px**2)
    return shown
