"""Write a rendered sequence as a recording of raw frames with its exact truth, for the offline line and its tests.

The form is that of every recording (recording.json, frames.csv, PNG files); the truth has the keys and conventions
of rendered recordings: truth.npz, truth_meta.json.
"""

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from common.arrays import Float
from common.errors import RecordingError
from common.frame_recording import Illumination, Manifest
from common.frame_writing import RecordingWriter, encode_png
from common.hand_model import CHAINS, FINGERS, WEBXR_JOINTS, HandModel
from common.imu_recording import write_imu
from common.sim.imu import SimulatedImu
from common.sim.light import paint
from common.sim.paint import MarkerView
from common.sim.render import Renderer
from common.sim.scene import Scene, SceneTruth

TRUTH = "truth.npz"
TRUTH_META = "truth_meta.json"
FIRST_NS = 10**9  # scene time 0 in frames.csv
ANGLE_NAMES = (
    *("thumb_cmc_flex", "thumb_cmc_abd", "thumb_cmc_twist", "thumb_mcp", "thumb_ip"),
    *(f"{f}_{a}" for f in FINGERS[1:] for a in ("mcp_flex", "mcp_abd", "pip", "dip")),
)


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """Truth of one row: every camera's view and its time of row 0 [s], and the scene at the reference time."""

    views: tuple[MarkerView, ...]
    t_row0: tuple[float, ...]
    reference: SceneTruth


def record_scene(
    folder: Path,
    scene: Scene,
    seconds: float,
    start_s: float = 0.0,
    continuous: bool = True,
    *,
    imu: bool = False,
) -> int:
    """Render `seconds` of a scene with every camera of its rig; return the number of frames per camera.

    Cameras run as the scene's timing says, all stamped on one clock. The reference time of a row is the middle
    of the exposure of the centre row of the rig's first camera.

    Args:
        folder: New or empty.
        scene: What to render.
        seconds: How long [s]; at least one frame is written.
        start_s: Scene time of the first frame [s].
        continuous: False tells readers that every frame is a pose of its own.
        imu: Whether the rig's IMU is recorded too, from a little before the first frame to a little after the last.

    Raises:
        CalibrationError: The rig has no IMU, or it is not known how that is mounted.
        RecordingError: The folder holds something already, or cannot be written.
        ValueError: The cameras differ in frame rate.
    """
    names, period = scene.rig.cameras, _period_s(scene)
    count = max(round(seconds / period), 1)
    sensor = SimulatedImu.of(scene) if imu else None
    renderers = [Renderer(scene, name) for name in names]
    offsets = [scene.timing(name).start_offset_ns * 1e-9 for name in names]
    lead = scene.cameras[names[0]]
    centre_s = 0.5 * (lead.height_px - 1) * lead.row_time_us * 1e-6
    first = [
        renderer.observe(start_s + offset)[1] for renderer, offset in zip(renderers, offsets, strict=True)
    ]
    writer = RecordingWriter(folder, _manifest(scene, first, continuous))
    rows: list[_Row] = []
    try:
        for k in range(count):
            times = tuple(start_s + k * period + offset for offset in offsets)
            views: list[MarkerView] = []
            for name, renderer, t in zip(names, renderers, times, strict=True):
                image, view = renderer.observe(t)
                t_ns = FIRST_NS + round(t * 1e9)
                writer.add(name, k, t_ns, Illumination.NONE, encode_png(image))
                views.append(view)
            rows.append(_Row(tuple(views), times, scene.truth(times[0] + centre_s)))
    finally:
        writer.close()
    if sensor is not None:
        write_imu(folder, sensor.around(rows[0].t_row0[0], max(rows[-1].t_row0), FIRST_NS))
    try:
        _write_truth(folder, scene, rows)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot write: {error.strerror}") from error
    return count


def _period_s(scene: Scene) -> float:
    """From frame to frame of every camera [s]."""
    rates = {scene.cameras[name].frame_rate_hz for name in scene.rig.cameras}
    if len(rates) != 1:
        raise ValueError(f"frame_rate_hz of the cameras differ: {sorted(rates)}")
    return 1.0 / rates.pop()


def _manifest(scene: Scene, first: list[MarkerView], continuous: bool) -> Manifest:
    """What was rendered; the clicks are the exact centroids in the first frame of each camera."""
    clicks = {
        name: {
            marker: (float(uv[0]), float(uv[1]))
            for marker, uv in zip(scene.rig.markers, view.uv, strict=True)
            if np.isfinite(uv).all()
        }
        for name, view in zip(scene.rig.cameras, first, strict=True)
    }
    return Manifest(
        version=1,
        kind="markers",
        cameras={name: scene.cameras[name] for name in scene.rig.cameras},
        rig=scene.rig,
        clicks=clicks,
        continuous=continuous,
        note=f"rendered scene, seed {scene.seed}",
    )


def _write_truth(folder: Path, scene: Scene, rows: list[_Row]) -> None:
    truths = [row.reference for row in rows]
    np.savez(
        folder / TRUTH,
        uv=np.array([[view.uv for view in row.views] for row in rows]),
        frac=np.array([[view.visible for view in row.views] for row in rows]),
        px=np.array([[view.area for view in row.views] for row in rows]),
        t_cap=np.array([[view.t_s for view in row.views] for row in rows]),
        t_row0=np.array([row.t_row0 for row in rows]),
        t_ref=np.array([truth.t_s for truth in truths]),
        paint_centroid=np.array([truth.markers_m for truth in truths]),
        joints=np.array([truth.joints.position_m[1:] for truth in truths]),
        angles=np.array([named_angles(scene.model, truth.angles_rad) for truth in truths]),
        T_palm=np.array([truth.T_rig_palm for truth in truths]),
    )
    meta = {
        "scene": "stereo",
        "frames": len(rows),
        "markers": scene.rig.markers,
        "joints": WEBXR_JOINTS,
        "angles": ANGLE_NAMES,
        "seed": scene.seed,
        "paint_reflectance_linear_srgb": {name: paint(name) for name in scene.rig.markers},
    }
    (folder / TRUTH_META).write_bytes(msgspec.json.format(msgspec.json.encode(meta), indent=1))


def named_angles(model: HandModel, angles_rad: Float) -> Float:
    """Angles (21,) [rad] in the order of ANGLE_NAMES, of angles (5, 4): abduction there is from the palm's +z."""
    thumb = angles_rad[0]
    ahead = -model.rest_rotation[CHAINS[1:, 0], :, 2]
    spread = angles_rad[1:, 0] + model.side_sign * np.arctan2(ahead[:, 0], ahead[:, 2])
    fingers = np.stack([angles_rad[1:, 1], spread, angles_rad[1:, 2], angles_rad[1:, 3]], axis=1)
    return np.concatenate([[thumb[1], thumb[0], 0.0, thumb[2], thumb[3]], fingers.ravel()])
