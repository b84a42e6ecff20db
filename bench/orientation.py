"""What tells the palm's orientation: one marker on the back or three, and an IMU that knows its heading or not.

Rendered hands and the whole line, the same motion for all. Gravity is 2 degrees off for a recording; the simulated IMU
is raw, and the filter of its slave makes its orientation. Where that knows its heading, it was aligned with the rig
once, to 5 degrees. The markers on the palm sit 1 mm (standard deviation, per axis) from where the master has them.
"""

import heapq
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from bench.played import START_NS, message_of, times_of
from bench.row import Row
from common.arrays import Float
from common.calibration import HandProfile, ImuCalibration, MarkerMount
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, quaternion_to_matrix
from common.hand.model import PALM_FRAME, WRIST, HandModel
from common.imu.fusion import OrientationFilter
from common.messages import ImuSample, MarkerDetections
from common.sim.imu import SimulatedImu
from common.sim.render import Renderer
from common.sim.scene import Scene
from master.rig.files import load_setup
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup
from master.run.stages import StageTimes
from slave.markers.detector import MarkerDetector

_CALIBRATION = Path(__file__).parent.parent / "calib_json"
_RIGS = {"one on the back": "desk", "three on the back": "desk-back3"}
_SEEDS = (31, 32, 33, 34, 35, 36)
_SECONDS, _APART_S = 5.0, 9.5  # each seed sees other acts of the scene
_MOUNT_M = 1e-3
_REGION = 7.815  # chi square, three degrees, 95 %
# Cameras that look down on a desk: the vertical is 30 degrees off the rig's -y.
_WORLD = (float(np.cos(np.radians(60.0))), float(np.sin(np.radians(60.0))), 0.0, 0.0)
_TILT_ONLY = ImuCalibration(q_palm_imu=(0.5, 0.5, -0.5, 0.5), q_rig_world=_WORLD)
_IMUS = {
    "no IMU": None,
    "IMU without heading": _TILT_ONLY,
    "IMU, heading to 5 deg": msgspec.structs.replace(_TILT_ONLY, heading_sigma_rad=float(np.radians(5.0))),
}


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """One seed of one rig: what the master believes, what came to it, and what was true."""

    setup: RigSetup
    scene: Scene
    messages: list[MarkerDetections]


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Of every pose: turn of the palm [deg], mean joint [mm], mean PIP of the fingers [deg], and the share of joints
    that lie in their 95 % regions."""

    palm_deg: Float
    joint_mm: Float
    pip_deg: Float
    held: Float


def rows() -> Iterator[Row]:
    """Measure; one row per figure."""
    for markers, rig in _RIGS.items():
        runs = [_record(rig, seed) for seed in _SEEDS]
        for what, imu in _IMUS.items():
            found = [errors_of(run, imu, seed) for run, seed in zip(runs, _SEEDS, strict=True)]
            name = f"{markers}, {what}"
            palm = np.concatenate([one.palm_deg for one in found])
            joint = np.concatenate([one.joint_mm for one in found])
            pip = np.concatenate([one.pip_deg for one in found])
            yield Row(f"{name}: palm", float(palm.mean()), "deg", f"95 %: {np.quantile(palm, 0.95):.1f}")
            yield Row(f"{name}: joints", float(joint.mean()), "mm", f"95 %: {np.quantile(joint, 0.95):.1f}")
            held = 100.0 * float(np.concatenate([one.held for one in found]).mean())
            yield Row(f"{name}: inside 95 %", held, "%", "of the joints in their regions")
            yield Row(f"{name}: PIP", float(pip.mean()), "deg", "index to little, seen or not")


def _record(rig: str, seed: int) -> _Run:
    """Render and detect one piece of the standard scene; every seed has another piece and other mounts."""
    setup = load_setup(_CALIBRATION, rig)
    scene = Scene.standard(setup.rig, setup.cameras, setup.hand.profile, seed)
    start_s = _APART_S * (seed - _SEEDS[0])
    messages: list[MarkerDetections] = []
    for camera in setup.rig.cameras:
        renderer, detector = Renderer(scene, camera), MarkerDetector(setup.cameras[camera], setup.rig.markers)
        times = times_of(scene, camera, _SECONDS, setup.cameras[camera].frame_rate_hz, start_s)
        for seq, t_s in enumerate(times.tolist()):
            t_ns = START_NS + round(t_s * 1e9)
            found = detector.push(renderer.render(t_s), t_ns)
            messages.append(message_of(camera, seq, t_ns, found))
    known = HandModel.of(_mounted_otherwise(setup.hand.profile, seed))
    return _Run(replace(setup, hand=known), scene, sorted(messages, key=lambda one: one.t_ns))


def _mounted_otherwise(profile: HandProfile, seed: int) -> HandProfile:
    rng = np.random.default_rng([seed, 2])

    def moved(mount: MarkerMount) -> MarkerMount:
        x, y, z = (np.array(mount.offset_m) + rng.normal(0.0, _MOUNT_M, 3)).tolist()
        return msgspec.structs.replace(mount, offset_m=(x, y, z)) if mount.joint == PALM_FRAME else mount

    return msgspec.structs.replace(profile, markers={name: moved(m) for name, m in profile.markers.items()})


def _oriented(scene: Scene, imu: ImuCalibration, seed: int, first_s: float, last_s: float) -> list[ImuSample]:
    """Samples of a span with the filter's orientation, turned about the vertical as far as the rig's file knows it."""
    fusion = OrientationFilter(imu.rate_hz)
    samples = [
        fusion.push(one) for one in SimulatedImu(scene.motion, imu, seed).around(first_s, last_s, START_NS)
    ]
    settled = next(one for one in samples if np.isfinite(one.orientation_wxyz).all())
    if imu.heading_sigma_rad is None:
        return samples
    palm = scene.motion.at((settled.t_ns - START_NS) * 1e-9).T_rig_palm[:3, :3]
    world_rig, palm_imu = (quaternion_to_matrix(np.array(q)) for q in (_WORLD, imu.q_palm_imu))
    off = world_rig.T @ palm @ palm_imu @ quaternion_to_matrix(settled.orientation_wxyz).T
    heading = np.arctan2(off[1, 0] - off[0, 1], off[0, 0] + off[1, 1])
    wrong = imu.heading_sigma_rad * np.random.default_rng([seed, 3]).normal()
    rotation = axis_rotation(2, float(heading + wrong))
    return [
        msgspec.structs.replace(
            one, orientation_wxyz=matrix_to_quaternion(rotation @ quaternion_to_matrix(one.orientation_wxyz))
        )
        for one in samples
        if np.isfinite(one.orientation_wxyz).all()
    ]


def errors_of(run: _Run, imu: ImuCalibration | None, seed: int) -> _Errors:
    """Solve a run with an IMU, or without one, and hold every pose against the truth."""
    setup = replace(run.setup, rig=msgspec.structs.replace(run.setup.rig, imu=imu))
    pipeline = build_pipeline(setup, StageTimes())
    first, last = ((one.t_ns - START_NS) * 1e-9 for one in (run.messages[0], run.messages[-1]))
    samples: Iterator[ImuSample] = iter(())
    if imu is not None:
        samples = iter(_oriented(run.scene, imu, seed, first, last))
    palm: list[float] = []
    joint: list[float] = []
    pip: list[float] = []
    held: list[float] = []
    for message in heapq.merge(samples, run.messages, key=lambda one: one.t_ns):
        if isinstance(message, ImuSample):
            pipeline.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
            continue
        for solved in pipeline.push(message):
            pose, truth = solved.pose, run.scene.truth((solved.pose.t_ns - START_NS) * 1e-9)
            if not pose.valid.any():
                continue
            found = quaternion_to_matrix(pose.orientation_wxyz[WRIST])
            rotation = matrix_to_quaternion(found.T @ truth.joints.rotation[WRIST])
            palm.append(float(np.degrees(2.0 * np.arccos(min(rotation[0], 1.0)))))
            off = (pose.position_m - truth.joints.position_m)[WRIST:]
            joint.append(1e3 * float(np.linalg.norm(off, axis=1).mean()))
            joint_chi2 = np.vecdot(off, np.linalg.solve(pose.cov_m2[WRIST:], off[..., None])[..., 0])
            held.append(float((joint_chi2 < _REGION).mean()))
            pip.append(float(np.degrees(np.abs(pose.angles_rad - truth.angles_rad)[1:, 2].mean())))
    return _Errors(np.array(palm), np.array(joint), np.array(pip), np.array(held))
