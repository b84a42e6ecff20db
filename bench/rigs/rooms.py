"""Simulated cameras without pictures: rigs of N cameras round one hand, and exact projections with noise.

The cameras of a room stand on a dome of 0.62 m about the hand, within 60 degrees of where the first one stands, so that
all see most of it; one marker in twenty is not seen. Their shutters are global, their phases random.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from bench.report import CALIBRATION, rig_files
from common.arrays import Float
from common.messages import MarkerDetections
from common.sim.scene import HAND_DEPTH_M, Scene
from master.rig.setup import RigSetup

ROOM, DESK = "room", "desk"
LOOP_S = 10.0  # of the scene, then the same again
_RADIUS_M, _CONE_RAD, _GOLDEN_RAD = 0.62, np.radians(60.0), np.pi * (3.0 - np.sqrt(5.0))


def room(folder: Path, cameras: int, rate_hz: float) -> Path:
    """Write a calib_json tree with the rig `room` of so many cameras; return it. ValueError: fewer than two cameras."""
    if cameras < 2:
        raise ValueError(f"cameras={cameras}: two or more are needed")
    tree = folder / f"room{cameras}"
    shutil.copytree(CALIBRATION, tree)
    names = [f"cam{k:02d}" for k in range(cameras)]
    for name in names:
        _write_camera(tree, "left", name, frame_rate_hz=rate_hz, row_time_us=0.0)
    rig = json.loads((tree / "rigs" / f"{DESK}.json").read_text())
    rig |= {"name": ROOM, "cameras": names, "depth_model": "stereo"}
    rig["T_rig_camera"] = {name: pose.tolist() for name, pose in zip(names, dome(cameras), strict=True)}
    (tree / "rigs" / f"{ROOM}.json").write_text(json.dumps(rig, indent=1) + "\n")
    return tree


def slower(folder: Path, rates_hz: Mapping[str, float], **more: float) -> Path:
    """Write a calib_json tree whose cameras have these frame rates, and `more` in their files; return it."""
    tree = folder / "calib_json"
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(CALIBRATION, tree)
    for name, rate_hz in rates_hz.items():
        _write_camera(tree, name, name, frame_rate_hz=rate_hz, **more)
    return tree


def _write_camera(tree: Path, like: str, name: str, **changes: float) -> None:
    camera = json.loads((CALIBRATION / "cameras" / f"{like}.json").read_text()) | {"name": name} | changes
    (tree / "cameras" / f"{name}.json").write_text(json.dumps(camera, indent=1) + "\n")


def middle_m() -> Float:
    """Return the middle (3,) [m] of the view of the cameras of a room, rig frame."""
    return np.array([0.0, 0.0, _RADIUS_M])


def dome(cameras: int) -> list[Float]:
    """Return poses (4, 4) camera -> rig of so many cameras that look at the hand, the first at the rig's origin."""
    centre = np.array([0.0, 0.0, HAND_DEPTH_M])
    out: list[Float] = []
    for k in range(cameras):
        height = 1.0 - (1.0 - np.cos(_CONE_RAD)) * k / max(cameras - 1, 1)
        round_rad, ring = k * _GOLDEN_RAD, np.sqrt(1.0 - height * height)
        back = np.array([ring * np.cos(round_rad), ring * np.sin(round_rad), -height])
        ahead = -back
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        pose[:3, 3] = centre + _RADIUS_M * back
        out.append(pose)
    move = np.linalg.inv(out[0])
    return [move @ pose for pose in out]


def standard_scene() -> Scene:
    """Return the standard scene as the rig desk sees it."""
    return Scene.standard(*rig_files(DESK))


def detections(
    setup: RigSetup,
    rate_hz: float,
    *,
    loop_s: float = LOOP_S,
    phases_s: Mapping[str, float] | None = None,
    unseen: float = 0.05,
    scene_s: Callable[[float], float] = lambda t_s: t_s,
) -> dict[str, list[MarkerDetections]]:
    """Return the messages of each camera of `loop_s` of the standard scene; times are since its beginning.

    Args:
        phases_s: Of the cameras; None: random.
        unseen: Share of markers that a camera does not see.
        scene_s: Scene time at a time since the beginning [s].
    """
    scene, rng = standard_scene(), np.random.default_rng(12)
    to_rig = np.zeros(3)
    if setup.rig.name == ROOM:  # the dome's centre is its first camera's distance ahead, the scene's another
        to_rig[2] = _RADIUS_M - HAND_DEPTH_M
    count = len(setup.rig.markers)
    sigma, nowhere = np.full(count, 0.1), np.full((count, 2), np.nan)
    out: dict[str, list[MarkerDetections]] = {}
    for name, model in setup.models.items():
        phase_s = float(rng.uniform(0.0, 1.0 / rate_hz)) if phases_s is None else phases_s[name]
        out[name] = []
        for seq in range(round(loop_s * rate_hz)):
            t_s = seq / rate_hz + phase_s
            caps = scene.truth(scene_s(t_s)).markers_m + to_rig
            uv = model.project(caps) + rng.normal(size=(count, 2)) * 0.08
            uv[rng.uniform(size=count) < unseen] = np.nan
            away = np.linalg.norm(caps - model.centre, axis=1)
            area = np.where(np.isfinite(uv[:, 0]), np.pi * (0.007 * model.matrix[0, 0] / away) ** 2, np.nan)
            seen = np.where(np.isfinite(uv[:, 0]), 1.0, np.nan)
            t_ns = round(1e9 * t_s)
            out[name].append(
                MarkerDetections(name, 0, seq, t_ns, t_ns, uv, area, seen, sigma * seen, nowhere)
            )
    return out


def in_order(frames: dict[str, list[MarkerDetections]]) -> list[MarkerDetections]:
    """Return all of them, by time."""
    return sorted((one for camera in frames.values() for one in camera), key=lambda one: one.t_ns)
