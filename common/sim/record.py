"""Export of a rendered sequence as a recording of raw frames with exact truth.

The form is that of every recording (recording.json, frames.csv, PNG files); the truth has the keys and conventions of
rendered recordings: truth.npz, truth_meta.json.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from common.arrays import Float, Image
from common.calibration.rig import rigs_by_hand
from common.errors import RecordingError
from common.hand.model import CHAINS, FINGERS, WEBXR_JOINTS, HandModel
from common.imu.csv_table import write_imu
from common.recording.frame_recording import Illumination, Manifest
from common.recording.frame_writing import RecordingWriter, encode_png
from common.recording.recorded_files import write_npz
from common.sim.light import marker_colour
from common.sim.painter import MarkerView
from common.sim.render import Renderer
from common.sim.scene import Scene, SceneTruth
from common.sim.sensors import SimulatedImu

TRUTH = "truth.npz"
TRUTH_META = "truth_meta.json"
FIRST_NS = 10**9  # scene time 0 in frames.csv
ANGLE_NAMES = (
    *("thumb_cmc_flex", "thumb_cmc_abd", "thumb_cmc_twist", "thumb_mcp", "thumb_ip"),
    *(f"{f}_{a}" for f in FINGERS[1:] for a in ("mcp_flex", "mcp_abd", "pip", "dip")),
)


Arrays = dict[str, npt.NDArray[Any]]


class RenderedFrame(NamedTuple):
    """A frame as its camera delivers it: counter, stamp [ns], what lit it, picture."""

    camera: str
    seq: int
    t_ns: int
    lit: Illumination
    image: Image


class _Row(NamedTuple):
    """Truth of one row by hand: views and times of row 0 [s], scene at the reference."""

    views: list[tuple[MarkerView, ...]]
    t_row0: list[float]
    reference: tuple[SceneTruth, ...]


class SceneTake:
    """Frames that the cameras of a rig take of a scene, and their exact truth.

    Cameras run by the scene's timing, all stamped on one clock. The reference time of a row is the middle of
    the exposure of the centre row of the rig's first camera.
    """

    def __init__(self, scene: Scene, seconds: float, start_s: float = 0.0) -> None:
        """Prepare `seconds` [s] from `start_s` [s]; ValueError: frame rates differ."""
        self._scene, self._start_s = scene, start_s
        self._hands = scene, *scene.others
        names = scene.rig.cameras
        rates = {scene.cameras[name].frame_rate_hz for name in names}
        if len(rates) != 1:
            raise ValueError(f"frame_rate_hz of the cameras differ: {sorted(rates)}")
        self._period_s = 1.0 / rates.pop()
        self.count = max(round(seconds / self._period_s), 1)
        self._renderers = [Renderer(scene, name) for name in names]
        self._offsets = [scene.timing(name).start_offset_ns * 1e-9 for name in names]
        reference = scene.cameras[names[0]]
        self._centre_s = 0.5 * (reference.height_px - 1) * reference.row_time_us * 1e-6
        self._rows: list[_Row] = []

    @property
    def span_s(self) -> tuple[float, float]:
        """Scene times [s] of the first camera's first frame and of the last frame of all."""
        return self._start_s, self._start_s + (self.count - 1) * self._period_s + max(self._offsets)

    def manifest(self, continuous: bool = True) -> Manifest:
        """Return the manifest; its clicks are exact centroids in the first frames."""
        scene, rig = self._scene, self._scene.watched or self._scene.rig
        parts = rigs_by_hand(rig, {one.rig.hand: one.model.profile for one in self._hands})
        clicks: dict[str, dict[str, tuple[float, float]]] = {}
        for name, renderer, offset in zip(scene.rig.cameras, self._renderers, self._offsets, strict=True):
            _, views = renderer.observe_all(self._start_s + offset)
            clicks[name] = {
                rig.markers[m]: (u, v)
                for (_, _, rows), view in zip(parts, views, strict=True)
                for m, (u, v) in zip(rows, view.uv.tolist(), strict=True)
                if np.isfinite([u, v]).all()
            }
        return Manifest(
            version=1,
            kind="markers",
            cameras={name: scene.cameras[name] for name in scene.rig.cameras},
            rig=rig,
            clicks=clicks,
            continuous=continuous,
            note=f"rendered scene, seed {scene.seed}",
            objects={name: scene.objects[name] for name in scene.rig.objects},
        )

    def frames(self) -> Iterator[RenderedFrame]:
        """All frames, row by row."""
        scene = self._scene
        for k in range(self.count):
            times = [self._start_s + k * self._period_s + offset for offset in self._offsets]
            views: list[tuple[MarkerView, ...]] = []
            for name, renderer, t in zip(scene.rig.cameras, self._renderers, times, strict=True):
                image, view = renderer.observe_all(t)
                views.append(view)
                yield RenderedFrame(name, k, FIRST_NS + round(t * 1e9), Illumination.NONE, image)
            at_s = times[0] + self._centre_s
            self._rows.append(_Row(views, times, tuple(one.truth(at_s) for one in self._hands)))

    def truth(self) -> Arrays:
        """One row per frame of each camera; of other hands than the first KEY_HAND."""
        arrays = self._truth(0) | self._truth_of_objects()
        for number, other in enumerate(self._hands[1:], 1):
            arrays |= {f"{key}_{other.rig.hand}": values for key, values in self._truth(number).items()}
        return arrays

    def _truth(self, hand: int) -> Arrays:
        rows, truths = self._rows, [row.reference[hand] for row in self._rows]
        seen = {"uv": "uv", "frac": "visible", "px": "area", "t_cap": "t_s"}
        return {
            **{
                key: np.array([[getattr(view[hand], of) for view in row.views] for row in rows])
                for key, of in seen.items()
            },
            "t_row0": np.array([row.t_row0 for row in rows]),
            "t_ref": np.array([truth.t_s for truth in truths]),
            "paint_centroid": np.array([truth.markers_m for truth in truths]),
            "joints": np.array([truth.joints.position_m[1:] for truth in truths]),
            "angles": np.array([named_angles(self._hands[hand].model, truth.angles_rad) for truth in truths]),
            "T_palm": np.array([truth.T_rig_palm for truth in truths]),
            "flexion": np.array([truth.wrist_angles_rad for truth in truths]),
        }

    def _truth_of_objects(self) -> Arrays:
        """Poses of each tracked object, what cameras saw of it, its tags' corners."""
        arrays: Arrays = {}
        for name in self._scene.rig.objects:
            seen = [[view[0].objects[name] for view in row.views] for row in self._rows]
            arrays[f"object_{name}"] = np.array([row.reference[0].objects[name] for row in self._rows])
            arrays[f"object_{name}_visible"] = np.array([[one.visible for one in row] for row in seen])
            arrays[f"object_{name}_corners"] = np.array([[one.corners_uv for one in row] for row in seen])
        return arrays

    def meta(self) -> dict[str, object]:
        """What the columns of the truth are."""
        scene = self._scene
        return {
            "scene": "stereo",
            "frames": len(self._rows),
            "markers": scene.rig.markers,
            "joints": WEBXR_JOINTS,
            "angles": ANGLE_NAMES,
            "seed": scene.seed,
            "paint_reflectance_linear_srgb": {
                name: marker_colour(name)
                for m, name in enumerate(scene.rig.markers)
                if name not in scene.rig.free_markers or m in scene.tracked.beads
            },
            "objects": {name: scene.tracked.features(k) for k, name in enumerate(scene.rig.objects)},
        }


def record_scene(
    folder: Path,
    scene: Scene,
    seconds: float,
    start_s: float = 0.0,
    continuous: bool = True,
    *,
    imu: bool = False,
) -> int:
    """Render `seconds` [s] with every camera; return the number of frames per camera.

    Args:
        folder: New or empty.
        seconds: At least one frame is written.
        start_s: Scene time of the first frame [s].
        continuous: False informs readers that every frame is a pose of its own.
        imu: Whether the rig's IMU is recorded too, from a little before the first frame to a little after the
            last.

    Raises:
        CalibrationError: The rig has no IMU, or it is not known how that is mounted.
        RecordingError: The folder holds something already, or cannot be written.
        ValueError: The cameras differ in frame rate.
    """
    sensor = SimulatedImu.of(scene) if imu else None
    take = SceneTake(scene, seconds, start_s)
    write_frames(folder, take.manifest(continuous), take.frames())
    if sensor is not None:
        write_imu(folder, sensor.around(*take.span_s, FIRST_NS))
    write_truth(folder, take.truth(), take.meta())
    return take.count


def write_frames(folder: Path, manifest: Manifest, frames: Iterable[RenderedFrame]) -> None:
    """Write a recording without its truth, frames in the order in which they come.

    Raises:
        RecordingError: The folder holds something already, or cannot be written.
    """
    writer = RecordingWriter(folder, manifest)
    try:
        for frame in frames:
            writer.add(frame.camera, frame.seq, frame.t_ns, frame.lit, encode_png(frame.image))
    finally:
        writer.close()


def write_truth(folder: Path, truth: Arrays, meta: dict[str, object]) -> None:
    """Write truth.npz and truth_meta.json.

    Raises:
        RecordingError: They cannot be written.
    """
    try:
        write_npz(folder / TRUTH, truth)
        (folder / TRUTH_META).write_bytes(msgspec.json.format(msgspec.json.encode(meta), indent=1))
    except OSError as error:
        raise RecordingError(f"{folder}: cannot write: {error.strerror}") from error


def named_angles(model: HandModel, angles_rad: Float) -> Float:
    """Joint angles (21,) [rad] by ANGLE_NAMES; abduction from the palm's +z."""
    thumb = angles_rad[0]
    ahead = -model.rest_rotation[CHAINS[1:, 0], :, 2]
    spread = angles_rad[1:, 0] + model.side_sign * np.arctan2(ahead[:, 0], ahead[:, 2])
    fingers = np.stack([angles_rad[1:, 1], spread, angles_rad[1:, 2], angles_rad[1:, 3]], axis=1)
    return np.concatenate([[thumb[1], thumb[0], 0.0, thumb[2], thumb[3]], fingers.ravel()])
