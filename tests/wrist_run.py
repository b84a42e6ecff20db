"""A simulated wrist device without errors: what its camera would report, and the poses of an exact master."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.hand.model import HandModel
from common.hand.profiles import mirrored_profile
from common.messages import Source, WristDetections
from common.sim.wrist.scene import WristScene, WristTruth
from master.outputs.poses import Poses
from master.rig.setup import RigSetup, WristSetup, load_setup
from tests.results import pose_of

CYCLE_NS = 33_333_333
START_NS = 1_000_000_000
_MIRROR = np.array([-1.0, 1.0, 1.0])


def wrist_setup(root: Path, rig: str = "wrist") -> RigSetup:
    """A shipped wrist rig with its camera and its hand."""
    return load_setup(root / "calib_json", rig)


def wrist_scene(setup: RigSetup, name: str = "standard", seed: int = 7) -> WristScene:
    """What the simulated camera of that rig looks at."""
    return WristScene.by_name(name, setup.rig, setup.cameras, setup.hand.profile, seed)


def exact_cycle(setup: RigSetup, now: WristTruth, k: int, t_ns: int | None = None) -> WristDetections:
    """Triple number `k` without errors: laser points and tips where the truth has them."""
    laser = now.laser_uv[1:6]
    tips = np.where(now.tip_visible[:, None], now.tip_uv, np.nan)
    at_ns = START_NS + k * CYCLE_NS if t_ns is None else t_ns
    return WristDetections(
        camera=setup.rig.cameras[0],
        session=1,
        seq=3 * k + 1,
        t_ns=at_ns,
        ready_t_ns=at_ns + 12_000_000,
        laser_uv=laser,
        laser_sigma_px=_where_seen(laser, 0.2),
        laser_px=_where_seen(laser, 20.0),
        tip_uv=tips,
        tip_sigma_px=_where_seen(tips, 2.0),
        tip_depth=np.where(now.tip_visible, now.tip_xyz[:, 2], np.nan),
    )


def true_poses(setup: RigSetup, truths: list[WristTruth]) -> Poses:
    """One pose for each instant, as an errorless master would publish it."""
    return Poses.of(
        [
            pose_of(
                setup.hand,
                now.joints,
                t_ns=START_NS + k * CYCLE_NS,
                source=np.full(26, Source.WRIST, np.uint8),
                angles_rad=now.angles_rad,
                markers_m=np.empty((0, 3)),
                latency_ns=8_000_000,
                laser_m=now.laser_pt[1:6],
            )
            for k, now in enumerate(truths)
        ]
    )


def _where_seen(uv: Float, value: float) -> Float:
    return np.where(np.isnan(uv).any(axis=1), np.nan, value)


def mirrored_setup(setup: WristSetup) -> WristSetup:
    """The same device seen in a mirror at x = 0, on the other hand; its camera is taken as symmetric."""
    palm = setup.T_camera_palm.copy()
    palm[:3, :3] = np.diag(_MIRROR) @ palm[:3, :3] @ np.diag(_MIRROR)
    palm[:3, 3] *= _MIRROR
    return replace(
        setup,
        model=HandModel.of(mirrored_profile(setup.model.profile)),
        T_camera_palm=palm,
        normal=setup.normal * _MIRROR,
        laser_m=setup.laser_m * _MIRROR,
    )
