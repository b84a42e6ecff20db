"""The card's line against the estimator: what power law, filter and FABRIK cost, and what the line takes per pose.

A scene as two cameras report it, with errors as large as measured (`bench.fusion_shown`), through the shipped rig:
as it is, with `solver: fabrik`, and that with one part replaced by a better one. Then the depth of the power law
against triangulation over the volume that the rig states.
"""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec.structs import replace as with_fields

from bench.fusion_scene import Shown
from bench.fusion_shown import shown
from bench.row import Row
from common.arrays import Float
from common.calibration import FilterCalibration, RigCalibration
from common.hand.model import FINGER_JOINTS
from common.messages import HandPose, MarkerDetections
from master.estimator.cameras import CameraArrays
from master.fabrik.intersection import triangulate
from master.rig.files import load_setup
from master.rig.pipeline import build_pipeline, line_of
from master.rig.setup import RigSetup
from master.run.stages import StageTimes

ROOT = Path(__file__).resolve().parents[1]
SECONDS, SEED = 10.0, 7
SCENES = ("standard", "grasp", "both-travel")
_WARM = 30  # instants
_NEAR_S = 0.02
_POINTS = 4000
UNFILTERED = FilterCalibration(min_cutoff_hz=1e4, beta=0.0, d_cutoff_hz=1e4, jitter_m=1.0)


def rows() -> Iterator[Row]:
    """Errors by scene and by what is replaced, the law over the volume, cost."""
    desk = load_setup(ROOT / "calib_json", "desk")
    yield from _law_rows(desk)
    for scene in SCENES:
        played = shown(scene, SECONDS, SEED)
        setup = replace(played.both.markers, rig=_as_desk(played.both.markers, desk))
        for name, changes in (
            ("estimator", {}),
            ("fabrik", {"solver": "fabrik"}),
            ("fabrik, triangulated instead of the power law", {"solver": "fabrik", "depth_model": "stereo"}),
            ("fabrik, without the filter", {"solver": "fabrik", "filter": UNFILTERED}),
        ):
            poses = solved(replace(setup, rig=with_fields(setup.rig, **changes)), played)
            joint, pip = errors(played, poses)
            yield Row(f"{scene}: {name}: joints of fingers seen", joint, "mm", f"PIP {pip:.2f} deg")
        yield from _cost_rows(scene, replace(setup, rig=with_fields(setup.rig, solver="fabrik")), played)


def _as_desk(setup: RigSetup, desk: RigSetup) -> RigCalibration:
    """The rig of a scene with the law of the shipped one: the same cameras at the same places."""
    rig = desk.rig
    return with_fields(
        setup.rig,
        depth_model=rig.depth_model,
        power_law=rig.power_law,
        filter=rig.filter,
        provenance=rig.provenance,
    )


def solved(setup: RigSetup, played: Shown) -> list[HandPose]:
    """The poses of a rig of what its cameras told."""
    pipeline = build_pipeline(setup, StageTimes())
    messages = [message for message in played.messages if isinstance(message, MarkerDetections)]
    poses = [one.pose for message in messages for one in pipeline.push(message)]
    return [pose for pose in poses + [one.pose for one in pipeline.flush()] if pose.valid.any()]


def errors(played: Shown, poses: list[HandPose]) -> tuple[float, float]:
    """Mean error of joints [mm] and PIPs [deg] of fingers that both cameras see, and of the palm."""
    markers = played.both.markers.rig.markers
    names = ("thumb", "index", "middle", "ring", "little")
    joints, angles = list[Float](), list[Float]()
    for pose in poses:
        truth = played.both.truth(pose.t_ns)
        both = played.line_of_sight.cameras_of(np.array([truth.t_s]), _NEAR_S)[0] >= 2
        clear = np.ones(26, np.bool_)
        for finger, name in enumerate(names):
            clear[list(FINGER_JOINTS[finger])] = both[markers.index(name)]
        joints.append(1e3 * np.linalg.norm(pose.position_m - truth.joints.position_m, axis=1)[1:][clear[1:]])
        seen = [finger for finger in range(1, 5) if both[markers.index(names[finger])]]
        angles.append(np.degrees(np.abs(pose.angles_rad - truth.angles_rad))[seen, 2])
    return float(np.concatenate(joints).mean()), float(np.concatenate(angles).mean())


def _cost_rows(scene: str, setup: RigSetup, played: Shown) -> Iterator[Row]:
    line = line_of(setup, StageTimes())
    messages = [message for message in played.messages if isinstance(message, MarkerDetections)]
    epochs = [epoch for message in messages for epoch in line.sync.push(message)]
    spent, iterations, fingers = list[float](), 0, 0
    for epoch in epochs:
        begun_ns = time.thread_time_ns()
        hand = line.solve(epoch)
        spent.append(1e-6 * (time.thread_time_ns() - begun_ns))
        iterations, fingers = iterations + int(hand.iterations.sum()), fingers + int(hand.seen.sum())
    low, middle, high = np.percentile(spent[_WARM:], [25, 50, 75])
    each = iterations / max(fingers, 1)
    note = f"middle half {low:.2f} to {high:.2f}; goal 1, compiled 0.3; {each:.2f} iterations a finger"
    yield Row(f"{scene}: the line, an instant", float(middle), "ms", note)


def _law_rows(desk: RigSetup) -> Iterator[Row]:
    """Depth by the shipped law against triangulation, of points over the whole volume, exact and with 0.1 px noise."""
    volume, cameras = desk.rig.volume, tuple(desk.models.values())
    assert volume is not None
    rng, line = np.random.default_rng(SEED), line_of(desk, StageTimes())
    count = len(desk.rig.markers)
    points = rng.uniform(volume.low_m, volume.high_m, (_POINTS // count, count, 3))
    nothing = np.full((2, count), np.nan)
    for noise_px in (0.0, 0.1):
        off, inside = list[Float](), list[Float]()
        for some in points:
            uv = np.stack([camera.project(some) for camera in cameras])
            seen = ((uv > 0.0) & (uv < [cameras[0].width_px, cameras[0].height_px])).all(axis=(0, 2))
            uv = uv + rng.normal(0.0, noise_px, uv.shape)
            by_law = line.triangulate(uv, np.full((2, count), 0.1), nothing, None, 0.0, as_seen=True).points_m
            by_rays = triangulate(CameraArrays.of(cameras), uv, 0.1).points_m
            off.append((by_law - by_rays)[seen, 2])
            inside.append(some[seen, 2])
        mm = 1e3 * np.concatenate(off)
        at = f"mean of sizes {np.abs(mm).mean():.2f}, worst {np.abs(mm).max():.1f}; goal 3"
        yield Row(f"power law against stereo, {noise_px} px noise: depth", float(mm.mean()), "mm", at)
