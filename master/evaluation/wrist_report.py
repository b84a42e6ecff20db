"""Comparison of a simulated run of a wrist device with its scene.

It has the exact truth at the poses, and what its camera saw.
"""

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from common.arrays import Float, Image, Int
from common.geometry.transforms import quaternion_to_matrix
from common.recording.frame_recording import Illumination
from common.sim.wrist.motion import OnForearm
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from common.sim.wrist.scene import WristTruth as WristEpoch
from master.evaluation.wrist_score import WristTruth, score_laser
from master.outputs.poses import Poses

Progress = Callable[[str, int, int], None]


def wrist_truth_of(t_ns: Int, scene: WristScene, epoch_ns: int, progress: Progress) -> WristTruth:
    """Return the exact scene at the times (N,) [ns] of poses.

    `epoch_ns` is scene time 0 on their clock.
    """
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
    """Compute errors of the laser points where other sensors also give poses.

    The errors are as `score_wrist` has them.

    Such a pose carries the points of the last strobe cycle. Each cycle counts once, at the first pose after it.
    """
    point = poses.laser_m.reshape(len(poses), -1)
    measured = np.asarray(np.isfinite(point).any(axis=1))
    measured[1:] &= (np.nan_to_num(point[1:]) != np.nan_to_num(point[:-1])).any(axis=1)
    if not measured.any():
        return {}
    truth = wrist_truth_of(poses.t_ns[measured], scene, epoch_ns, progress)
    return score_laser(poses.laser_m[measured], truth)


def forearm_tilt(poses: Poses, scene: WristScene, epoch_ns: int) -> dict[str, float]:
    """Compute the rms error [deg] of the forearm's vertical: `forearm_tilt_deg`.

    The result is empty where no pose reports the forearm's orientation.
    """
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
    """Render what laser and LEDs together light at scene time `t_s` [s].

    The image is (H, W) grey and without the light of the room.
    """
    ambient = renderer.render(t_s, Illumination.AMBIENT)
    laser, led = (renderer.render(t_s, lit) for lit in (Illumination.LASER, Illumination.LED))
    return np.asarray(cv2.add(cv2.subtract(laser, ambient), cv2.subtract(led, ambient)), np.uint8)


def wrist_images(
    poses: Poses, scene: WristScene, epoch_ns: int, progress: Progress
) -> Iterator[tuple[str, int, Image]]:
    """Camera, time [ns] and `lit_view`, twice a second."""
    first, last = int(poses.t_ns[0]), int(poses.t_ns[-1])
    camera = scene.rig.cameras[0]
    renderer = WristRenderer(scene, camera)
    images_hz = 2.0
    for t_ns in range(first, last, int(1e9 / images_hz)):
        progress(f"rendering camera {camera}", t_ns - first, last - first)
        yield camera, t_ns, lit_view(renderer, (t_ns - epoch_ns) * 1e-9)
