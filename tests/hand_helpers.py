"""What the tests of the hand share: hands, natural random poses, cameras that see exact points."""

import json
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from bench.hands.draws import without_tolerance
from common.arrays import Float
from common.calibration import (
    CameraCalibration,
    HandProfile,
    Intrinsics,
    Limits,
    Preset,
    RigCalibration,
    load,
)
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, HandJoints, HandModel
from common.hand.profiles import generated_profile, preset_limits
from common.messages import MarkerDetections
from master.fabrik.caps import CapTables, seen_shift

MARKERS = ("thumb", "index", "middle", "ring", "little", "back")


def walls(preset: Preset) -> Limits:
    """The limits of a preset without their tolerance."""
    return without_tolerance(preset_limits(preset))


def walled(name: str, side: str) -> HandModel:
    """A generated hand that never leaves its limits."""
    return HandModel.of(msgspec.structs.replace(generated_profile(name, side), limits_rad=walls("K")))


RIGHT = walled("made-right", "right")
LEFT = walled("made-left", "left")

# The back of the hand towards cameras at the origin that look along +z, fingers up (-y in the image).
BACK_NORMAL = np.array([0.0, 0.0, -1.0])
R_FRONT = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])


def palm(rotation_deg: Float | None = None, at_m: Float | None = None) -> Float:
    """Palm pose (4, 4) in front of the cameras, turned by Euler angles x, y, z [deg] in the rig frame."""
    rotation = np.zeros(3) if rotation_deg is None else rotation_deg
    at = np.array([0.0, 0.08, 0.5]) if at_m is None else at_m
    return rigid(Rotation.from_euler("xyz", rotation, degrees=True).as_matrix() @ R_FRONT, at)


def any_rotation(rng: np.random.Generator) -> Float:
    """(3, 3), uniform: a normalised quaternion of normal numbers."""
    return np.asarray(Rotation.from_quat(rng.normal(size=4)).as_matrix(), np.float64)


def natural_angles(rng: np.random.Generator) -> Float:
    """A relaxed hand: PIP 5-75 deg, MCP near 0.54 PIP (Digits), DIP = 2/3 PIP, spread about 5 deg."""
    angles = np.zeros((5, 4))
    common = rng.uniform(10.0, 70.0)
    pip = np.clip(common + rng.normal(0.0, 12.0, 4), 2.0, 90.0)
    angles[1:, 0] = rng.normal(0.0, 4.0, 4) * [1, 0, 1, 1]
    angles[1:, 1] = np.clip(0.54 * pip + rng.normal(0.0, 8.0, 4), 0.0, 88.0)
    angles[1:, 2], angles[1:, 3] = pip, pip * 2 / 3
    angles[0] = rng.uniform([-5, 0, 0, 5], [20, 20, 25, 30])
    return np.radians(angles)


def within(model: HandModel, angles: Float) -> bool:
    """Whether all angles (5, 4) are finite and inside the limits."""
    return bool(model.within_limits(angles).all())


def small_cov(sigma_m: float = 3e-4, count: int = 6) -> Float:
    """(count, 3, 3) [m^2], three times worse along the sight than across."""
    return np.tile(np.diag([sigma_m**2, sigma_m**2, (3 * sigma_m) ** 2]), (count, 1, 1))


def camera_file(name: str, rate_hz: float = 60.0, row_time_us: float = 0.0) -> CameraCalibration:
    """640x480, 500 px."""
    return CameraCalibration(
        version=1,
        name=name,
        width_px=640,
        height_px=480,
        frame_rate_hz=rate_hz,
        exposure_us=4000.0,
        analogue_gain=1.0,
        colour_gains=(1.0, 1.0),
        row_time_us=row_time_us,
        intrinsics=Intrinsics(fx_px=500.0, fy_px=500.0, cx_px=319.5, cy_px=239.5),
    )


def rig_file(cameras: tuple[str, ...] = ("left", "right"), **changes: object) -> RigCalibration:
    """Parallel cameras, 75 mm apart along x."""
    poses = {name: rigid(np.eye(3), np.array([0.075 * c, 0.0, 0.0])) for c, name in enumerate(cameras)}
    values: dict[str, object] = {
        "version": 1,
        "name": "bench",
        "kind": "markers",
        "cameras": cameras,
        "hand": "made-right",
        "T_rig_camera": {name: tuple(tuple(float(v) for v in row) for row in T) for name, T in poses.items()},
    }
    return RigCalibration(**(values | changes))  # pyright: ignore[reportArgumentType]


def camera_models(rig: RigCalibration, row_time_us: float = 0.0) -> dict[str, CameraModel]:
    """Models of the rig's cameras."""
    return {
        name: CameraModel.of(camera_file(name, row_time_us=row_time_us), rig.camera_pose(name))
        for name in rig.cameras
    }


def cap_views(
    model: HandModel,
    markers: tuple[str, ...],
    joints: HandJoints,
    points: Float,
    cameras: tuple[CameraModel, ...],
) -> tuple[Float, Float]:
    """Seen centroid less the caps' own (C, M, 2) [px], and the area that whole caps show (C, M) [m^2]; 0 where flat."""
    caps, shift = CapTables.of(model, markers), np.empty(3)
    bias, whole = np.zeros((len(cameras), len(markers), 2)), np.zeros((len(cameras), len(markers)))
    for c, camera in enumerate(cameras):
        for m, point in enumerate(points):
            if (row := int(caps.row[m])) < 0 or np.isnan(point).any():
                continue
            ahead = -np.ascontiguousarray(joints.rotation[caps.joint[row], :, 2])
            back = (camera.centre - point) / np.linalg.norm(camera.centre - point)
            whole[c, m] = seen_shift(caps, row, ahead, back, shift)
            bias[c, m] = camera.project(point + shift) - camera.project(point)
    return bias, whole


def cap_bias_px(joints: HandJoints, points: Float, cameras: tuple[CameraModel, ...]) -> Float:
    """Seen centroid less the caps' own (C, 6, 2) [px] of the hand `RIGHT`."""
    return cap_views(RIGHT, MARKERS, joints, points, cameras)[0]


def cap_areas_px2(joints: HandJoints, models: tuple[CameraModel, ...]) -> Float:
    """Areas (C, 6) that cameras see of whole caps, which differ with the side they see; flat markers have 400 px."""
    points = RIGHT.marker_points(joints, MARKERS)
    shown = cap_views(RIGHT, MARKERS, joints, points, models)[1]
    scale = [m.matrix[0, 0] / np.linalg.norm(points - m.centre, axis=1) for m in models]
    return np.where(CapTables.of(RIGHT, MARKERS).row >= 0, shown * np.square(scale), 400.0)


def detections(
    camera: str, seq: int, t_ns: int, uv: Float, area_px2: float | Float = 400.0
) -> MarkerDetections:
    """One message; area, quality and sigma follow what is seen, and nothing has a rival."""
    seen = np.isfinite(uv[:, 0])
    return MarkerDetections(
        camera=camera,
        session=1,
        seq=seq,
        t_ns=t_ns,
        ready_t_ns=t_ns + 2_000_000,
        uv=uv,
        area=np.where(seen, area_px2, np.nan),
        quality=np.where(seen, 1.0, np.nan),
        sigma_px=np.where(seen, 0.1, np.nan),
        alt_uv=np.full_like(uv, np.nan),
    )


def rendered(folder: Path) -> tuple[HandModel, Float, Float, Float]:
    """Model, palm poses, rest-relative angles (N, 5, 4) and true joints of a rendered recording."""
    meta = json.loads((folder / "truth_meta.json").read_text())
    side = str(meta["side"])
    model = HandModel.of(load(folder.parents[1] / "hands" / f"webxr-{side}.json", HandProfile))
    names: list[str] = meta["angles"]
    with np.load(folder / "truth.npz") as truth:
        table, T, joints = truth["angles"], truth["T_palm"], truth["joints"]
    angles = np.zeros((len(table), 5, 4))
    angles[:, 0] = table[:, [names.index(f"thumb_{a}") for a in ("cmc_abd", "cmc_flex", "mcp", "ip")]]
    for f, finger in enumerate(("index", "middle", "ring", "pinky"), 1):
        for k, kind in enumerate(("mcp_abd", "mcp_flex", "pip", "dip")):
            angles[:, f, k] = table[:, names.index(f"{finger}_{kind}")]
        # There abduction counts from the palm's +z, here from the finger's own rest direction.
        dx, _, dz = model.rest_position_m[CHAINS[f, 1]] - model.rest_position_m[CHAINS[f, 0]]
        angles[:, f, 0] -= np.arctan2(model.side_sign * dx, dz)
    return model, T, angles, joints
