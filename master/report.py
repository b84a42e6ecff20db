"""After a simulated run: its poses against the scene's exact truth, as figures, a picture and a Rerun file."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from common.arrays import Float, Image
from common.sim.render import Renderer
from common.sim.scene import Scene
from master.outputs.files import load_poses
from master.outputs.picture import draw_summary
from master.outputs.poses import Poses
from master.outputs.rerun import write_rrd
from master.outputs.truth import PosesTruth
from master.rig import RigSetup
from master.score import Truth, score
from master.solve import fingers_of

_IMAGES_HZ = 2.0
Progress = Callable[[str, int, int], None]


def report_scene(
    poses_file: Path,
    setup: RigSetup,
    scene: Scene,
    epoch_ns: int,
    out: Path,
    summary: dict[str, object],
    tell: Progress,
) -> dict[str, object]:
    """Score poses of a simulated run; write hand.png and run.rrd into `out`.

    Args:
        poses_file: poses.npz of the run.
        setup: Rig, cameras, hand.
        scene: What the synthetic cameras rendered.
        epoch_ns: Scene time 0 on the master's clock.
        out: Existing folder.
        summary: Figures of the run so far; drawn with the scores.
        tell: Told what is being done, and how much of how much.

    Returns:
        The summary with the scores added.

    Raises:
        RecordingError: The poses cannot be read or a result cannot be written.
    """
    poses = load_poses(poses_file)
    poses = poses.rows(int(np.searchsorted(poses.t_ns, epoch_ns)), len(poses))
    if len(poses) == 0:
        return summary
    truth = truth_of(poses, scene, epoch_ns, tell)
    full = summary | score(poses, truth, fingers_of(setup))
    ghost = PosesTruth.of_webxr(truth.joints_m, truth.markers_m)
    figures = {name: float(value) for name, value in full.items() if isinstance(value, int | float)}
    tell("drawing the hand", 0, 1)
    draw_summary(out / "hand.png", poses, setup.rig, setup.hand, figures, ghost)
    images = _images(poses, scene, epoch_ns, tell)
    write_rrd(out / "run.rrd", poses, setup.rig, setup.cameras, setup.hand, truth=ghost, images=images)
    return full


def truth_of(poses: Poses, scene: Scene, epoch_ns: int, tell: Progress) -> Truth:
    """The scene at the instants of the poses, with what each camera could see."""
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
            visible[row, c] = _fraction(renderer, float(t))
        if row % 20 == 0:
            tell("comparing with the truth", row, len(times))
    return Truth(poses.t_ns, joints, pip, markers, visible)


def _fraction(renderer: Renderer, t_s: float) -> Float:
    return np.nan_to_num(renderer.visible_fraction(t_s))


def _images(poses: Poses, scene: Scene, epoch_ns: int, tell: Progress) -> Iterator[tuple[str, int, Image]]:
    first, last = int(poses.t_ns[0]), int(poses.t_ns[-1])
    for camera in scene.rig.cameras:
        renderer = Renderer(scene, camera)
        for t_ns in range(first, last, int(1e9 / _IMAGES_HZ)):
            tell(f"rendering camera {camera}", t_ns - first, last - first)
            yield camera, t_ns, renderer.render((t_ns - epoch_ns) * 1e-9)
