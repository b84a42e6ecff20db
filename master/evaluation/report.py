"""Score runs against exact truth and write their report.

A simulated run is compared with the exact scene at its poses: figures, a picture and a Rerun file.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from common.arrays import Float, Image, Int
from common.errors import PhalanxError
from common.geometry.transforms import quaternion_to_matrix
from common.recording.frame_recording import Illumination
from common.sim.render import Renderer
from common.sim.scene import Scene
from common.sim.scenes import scene_by_name, scene_of_hands
from common.sim.two_rigs import TWO_RIG_SCENES
from common.sim.wrist.motion import OnForearm
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from common.sim.wrist.scene import WristTruth as WristEpoch
from master.evaluation.run_results import RunResults
from master.evaluation.score import Truth, score, score_hidden
from master.evaluation.wrist_score import WristTruth, score_laser, score_wrist
from master.outputs.picture import best_row, draw_summary
from master.outputs.picture_overlays import ResultPicture, WristPicture
from master.outputs.poses import Poses, PosesTruth
from master.outputs.rerun import write_rrd
from master.replay.offline import fingers_of
from master.rig.setup import RigSetup

Progress = Callable[[str, int, int], None]


def wrist_truth_of(t_ns: Int, scene: WristScene, epoch_ns: int, progress: Progress) -> WristTruth:
    """Return the exact scene at times (N,) [ns]; `epoch_ns` is scene time 0."""
    now: list[WristEpoch] = []
    for row, at_ns in enumerate(t_ns.tolist()):
        now.append(scene.truth((at_ns - epoch_ns) * 1e-9))
        if row % 20 == 0:
            progress("comparing with the truth", row, len(t_ns))
    return WristTruth(
        t_ns=t_ns,
        laser_m=np.array([one.laser_pt for one in now]),
        laser_seen_m=np.array([one.laser_len_vis for one in now]),
        tip_uv=np.array([one.tip_uv for one in now]),
        tip_visible=np.array([one.tip_visible for one in now], np.bool_),
        joints_m=np.array([one.joints.position_m[1:] for one in now]),
        pip_rad=np.array([one.angles_rad[:, 2] for one in now]),
    )


def laser_scores(poses: Poses, scene: WristScene, epoch_ns: int, progress: Progress) -> dict[str, float]:
    """Errors of the laser points where other sensors also give poses.

    Such a pose carries the points of the last strobe cycle. Each cycle counts once, at the first pose after
    it.
    """
    point = poses.laser_m.reshape(len(poses), -1)
    measured = np.asarray(np.isfinite(point).any(axis=1))
    measured[1:] &= (np.nan_to_num(point[1:]) != np.nan_to_num(point[:-1])).any(axis=1)
    if not measured.any():
        return {}
    truth = wrist_truth_of(poses.t_ns[measured], scene, epoch_ns, progress)
    return score_laser(poses.laser_m[measured], truth)


def forearm_tilt(poses: Poses, scene: WristScene, epoch_ns: int) -> dict[str, float]:
    """Rms error [deg] of the forearm's vertical, `forearm_tilt_deg`, where reported."""
    imu = scene.rig.imu
    rows = np.flatnonzero(np.isfinite(poses.palm_world_wxyz).all(axis=1))
    if imu is None or imu.q_rig_world is None or not len(rows):
        return {}
    up = quaternion_to_matrix(np.array(imu.q_rig_world))[:, 2]
    true_up = np.empty((len(rows), 3))
    for k, row in enumerate(rows):
        t_s = (int(poses.t_ns[row]) - epoch_ns) * 1e-9
        true_up[k] = up @ OnForearm(scene.motion).at(t_s).T_rig_palm[:3, :3]
    stated_up = quaternion_to_matrix(poses.palm_world_wxyz[rows])[:, 2]
    off_rad: Float = np.arccos(np.clip((true_up * stated_up).sum(axis=1), -1.0, 1.0))
    return {"forearm_tilt_deg": round(float(np.degrees(np.sqrt((off_rad**2).mean()))), 4)}


def lit_view(renderer: WristRenderer, t_s: float) -> Image:
    """Render (H, W) grey what laser and LEDs together light, without room light."""
    ambient = renderer.render(t_s, Illumination.AMBIENT)
    laser, led = (renderer.render(t_s, lit) for lit in (Illumination.LASER, Illumination.LED))
    return np.asarray(cv2.add(cv2.subtract(laser, ambient), cv2.subtract(led, ambient)), np.uint8)


def _images(
    poses: Poses, camera: str, render: Callable[[float], Image], epoch_ns: int, progress: Progress
) -> Iterator[tuple[str, int, Image]]:
    """Camera, time [ns] and its image, twice a second."""
    first, last = int(poses.t_ns[0]), int(poses.t_ns[-1])
    images_hz = 2.0
    for t_ns in range(first, last, int(1e9 / images_hz)):
        progress(f"rendering camera {camera}", t_ns - first, last - first)
        yield camera, t_ns, render((t_ns - epoch_ns) * 1e-9)


def wrist_images(
    poses: Poses, scene: WristScene, epoch_ns: int, progress: Progress
) -> Iterator[tuple[str, int, Image]]:
    """Images of the wrist camera by `lit_view`."""
    camera = scene.rig.cameras[0]
    yield from _images(poses, camera, partial(lit_view, WristRenderer(scene, camera)), epoch_ns, progress)


@dataclass(frozen=True, slots=True, eq=False)
class Played:
    """What the synthetic sensors of one hand sensed."""

    shown: Scene | None = None  # what cameras of markers saw, or None
    wrist_scene: WristScene | None = None  # what a wrist device saw, or None
    two_rigs: bool = False  # the scene is one for both kinds of rig, whether or not there are both

    @classmethod
    def of(cls, setup: RigSetup, name: str, seed: int, beside: Sequence[RigSetup] = ()) -> "Played":
        """The scene called `name`; with @LIGHT behind it that of a wrist device.

        `beside`: the other hands before the same cameras.

        Raises:
            PhalanxError: There is no such scene for this kind of rig, or it is not one motion for both kinds.
        """
        moves, hand = name.partition("@")[0], setup.hand.profile
        watched = {one.name: one for one in setup.objects}
        two_rigs = moves in TWO_RIG_SCENES
        if beside:
            parts = [(one.rig, one.hand.profile) for one in (setup, *beside)]
            return cls(scene_of_hands(parts, setup.cameras, seed))
        if setup.wrist_rig is None:
            return cls(scene_by_name(name, setup.rig, setup.cameras, hand, seed, watched), None, two_rigs)
        wrist_scene = WristScene.by_name(name, setup.wrist_rig, setup.cameras, hand, seed)
        if not setup.has_markers:
            return cls(None, wrist_scene, two_rigs)
        if not two_rigs:
            raise PhalanxError(
                f"scene {name!r}: cameras and wrist device see one hand only in {', '.join(TWO_RIG_SCENES)}"
            )
        return cls(scene_by_name(moves, setup.rig, setup.cameras, hand, seed, watched), wrist_scene, two_rigs)


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """A run beside its truth: scores, the true hand, and what to draw."""

    scores: dict[str, float]
    truth: PosesTruth
    images: Iterable[tuple[str, int, Image]]
    wrist: WristPicture | None = None


def report_scene(
    poses_file: Path,
    setup: RigSetup,
    played: Played,
    epoch_ns: int,
    out: Path,
    summary: dict[str, object],
    progress: Progress,
) -> dict[str, object]:
    """Score poses of a simulated run; write hand.png and run.rrd into `out`.

    Args:
        poses_file: poses.npz of the run.
        played: What its synthetic sensors sensed.
        epoch_ns: Scene time 0 on the master's clock.
        out: Existing folder.
        summary: Figures of the run so far; drawn with the scores.
        progress: Called with what is being done, and how much of how much.

    Returns:
        The summary with the scores added.

    Raises:
        RecordingError: The poses cannot be read or a result cannot be written.
    """
    poses = Poses.load(poses_file)
    poses = poses.rows(int(np.searchsorted(poses.t_ns, epoch_ns)), len(poses))
    if len(poses) == 0:
        return summary
    results = RunResults.load(poses_file.parent, setup, epoch_ns)
    shown = ResultPicture(setup.objects, results.objects, results.contacts, results.gestures)
    row = best_row(poses, shown)
    judged = _judge(poses, row, setup, played, epoch_ns, progress)
    full = (
        summary
        | judged.scores
        | results.figures(played.shown, epoch_ns, int(poses.t_ns[0]), int(poses.t_ns[-1]))
    )
    figures = {name: float(value) for name, value in full.items() if isinstance(value, int | float)}
    progress("drawing the hand", 0, 1)
    picture, truth = out / "hand.png", judged.truth
    draw_summary(picture, poses, setup.rig, setup.hand, figures, truth, row, judged.wrist, shown)
    write_rrd(out / "run.rrd", poses, setup, truth=truth, images=judged.images, results=results.messages())
    return full


def _judge(
    poses: Poses, row: int | None, setup: RigSetup, played: Played, epoch_ns: int, progress: Progress
) -> _Judged:
    """Against what was truly there, whichever sensors there are."""
    if played.shown is None:
        assert played.wrist_scene is not None, "one of the two there is"
        return _of_wrist(poses, row, setup, played.wrist_scene, epoch_ns, progress)
    judged = _of_markers(poses, setup, played.shown, epoch_ns, progress, hidden=played.two_rigs)
    if played.wrist_scene is None:
        return judged
    wrist_scene = laser_scores(poses, played.wrist_scene, epoch_ns, progress)
    images = chain(judged.images, wrist_images(poses, played.wrist_scene, epoch_ns, progress))
    return _Judged(judged.scores | wrist_scene, judged.truth, images, WristPicture.of(setup))


def _of_markers(
    poses: Poses, setup: RigSetup, scene: Scene, epoch_ns: int, progress: Progress, *, hidden: bool
) -> _Judged:
    truth, fingers = truth_of(poses, scene, epoch_ns, progress), fingers_of(setup)
    scores = score(poses, truth, fingers)
    if hidden:
        scores |= score_hidden(poses, truth, fingers)
    images = chain.from_iterable(
        _images(poses, camera, Renderer(scene, camera).render, epoch_ns, progress)
        for camera in scene.rig.cameras
    )
    return _Judged(scores, PosesTruth.of_webxr(truth.joints_m, truth.markers_m), images)


def _of_wrist(
    poses: Poses, row: int | None, setup: RigSetup, scene: WristScene, epoch_ns: int, progress: Progress
) -> _Judged:
    truth = wrist_truth_of(poses.t_ns, scene, epoch_ns, progress)
    frame = None
    if row is not None:
        renderer = WristRenderer(scene, scene.rig.cameras[0])
        frame = lit_view(renderer, (int(poses.t_ns[row]) - epoch_ns) * 1e-9)
    return _Judged(
        score_wrist(poses, truth) | forearm_tilt(poses, scene, epoch_ns),
        PosesTruth.of_webxr(truth.joints_m, poses.markers_m, truth.laser_m[:, 1:6]),
        wrist_images(poses, scene, epoch_ns, progress),
        WristPicture.of(setup, frame),
    )


def truth_of(poses: Poses, scene: Scene, epoch_ns: int, progress: Progress) -> Truth:
    """Return the scene at the times of the poses, with what each camera could see."""
    times = (poses.t_ns - epoch_ns) * 1e-9
    renderers = [Renderer(scene, camera) for camera in scene.rig.cameras]
    joints = np.empty((len(times), 25, 3))
    pip = np.empty((len(times), 4))
    markers = np.empty((len(times), len(scene.rig.markers), 3))
    visible = np.empty((len(times), len(renderers), len(scene.rig.markers)))
    for row, t in enumerate(times):
        now = scene.truth(float(t))
        joints[row], pip[row], markers[row] = now.joints.position_m[1:], now.angles_rad[1:, 2], now.markers_m
        for c, renderer in enumerate(renderers):
            visible[row, c] = np.nan_to_num(renderer.markers(float(t)).visible)
        if row % 20 == 0:
            progress("comparing with the truth", row, len(times))
    return Truth(poses.t_ns, joints, pip, markers, visible)
