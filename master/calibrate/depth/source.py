"""Inputs of the depth commands: the sweep, the camera pair and the rig.

Read from the files that the user names.
"""

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, Intrinsics, RigCalibration, load
from common.errors import CalibrationError, FitError
from common.geometry.camera_model import CameraModel
from common.recording.frame_recording import FrameRecording, open_recording
from master.calibrate.depth.recording import Pairs, by_file, by_list, by_truth, read_pairs
from master.calibrate.depth.sweep import Sweep
from master.calibrate.depth.tables import parse_distances, read_table
from master.calibrate.tree_files import load_marker_rig
from master.fabrik.blob_bias import card_outline, centre_of_blob, round_outline

_LEFT_RIGHT = ("left", "right")


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two cameras and the rig they belong to.

    Attributes:
        rig: The rig file; None: nothing is known but the numbers of a table.
        file_name: Of the rig file in a calib_json tree, without .json.
        cameras: Names, first the left one.
        files: Their camera files.
        models: The same as camera models; None: intrinsics are missing.
        origin: Where the camera files come from.
    """

    rig: RigCalibration | None = None
    file_name: str = ""
    cameras: tuple[str, str] = _LEFT_RIGHT
    files: tuple[CameraCalibration, ...] = ()
    models: tuple[CameraModel, CameraModel] | None = None
    origin: str = "the recording"

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Width and height of the images."""
        return (self.files[0].width_px, self.files[0].height_px) if self.files else None


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A sweep, how it was made, and with what.

    Attributes:
        sweep: Unchecked, as measured but for the lens' shift of the centroids.
        pair: The cameras.
        data: Names of what it was read from, for the provenance.
        about: One line that describes it.
    """

    sweep: Sweep
    pair: Pair
    data: tuple[str, ...]
    about: str

    @contextmanager
    def named(self) -> Generator[None, None, None]:
        """Refusals of the sweep begin with what it was read from.

        Raises:
            FitError: As the block.
        """
        try:
            yield
        except FitError as error:
            raise FitError(f"{', '.join(self.data)}: {error}") from error


def pair_of(
    rig: RigCalibration,
    files: Mapping[str, CameraCalibration],
    file_name: str = "",
    origin: str = "the recording",
) -> Pair:
    """The first two cameras of a rig; without models where one has no intrinsics.

    Raises:
        CalibrationError: The rig has fewer than two cameras, or is none of markers.
    """
    if rig.kind != "markers" or len(rig.cameras) < 2:
        raise CalibrationError(f"rig {rig.name!r}: a depth needs a rig of kind 'markers' with two cameras")
    first, second = rig.cameras[:2]
    two = (files[first], files[second])
    models = None
    if all(file.intrinsics is not None for file in two):
        models = (
            CameraModel.of(two[0], rig.camera_pose(first)),
            CameraModel.of(two[1], rig.camera_pose(second)),
        )
    return Pair(rig, file_name or rig.name, (first, second), two, models, origin)


def load_pair(
    calibration: Path,
    rig_name: str,
    fov_deg: float | None = None,
    recorded: Mapping[str, CameraCalibration] | None = None,
) -> Pair:
    """The pair of CALIBRATION/rigs/<rig>.json with its camera files.

    Args:
        calibration: calib_json tree.
        rig_name: Rig.
        fov_deg: Nominal horizontal field of view, for camera files without intrinsics.
        recorded: Camera files of a recording; the tree's are taken where they carry the provenance of a measurement.

    Raises:
        CalibrationError: A file is missing or broken, or `fov_deg` is no angle of view.
    """
    if fov_deg is not None and not 0.0 < fov_deg < 180.0:
        raise CalibrationError(f"--fov-deg {fov_deg:g}: expected an angle between 0 and 180 degrees")
    rig = load_marker_rig(calibration, rig_name)
    paths = {name: calibration / "cameras" / f"{name}.json" for name in rig.cameras}
    there = recorded is None or all(path.exists() for path in paths.values())
    files = {name: load(path, CameraCalibration) for name, path in paths.items()} if there else {}
    origin = str(calibration)
    # Files made for their colours may carry the lens of another recording: only measured ones are the better ones.
    if recorded is not None and not (files and all("intrinsics" in f.provenance for f in files.values())):
        if missing := [name for name in rig.cameras if name not in recorded]:
            raise CalibrationError(f"rig {rig_name!r} has the camera {missing[0]!r}, the recording has not")
        files, origin = dict(recorded), "the recording"
    return pair_of(rig, {name: _with_view(file, fov_deg) for name, file in files.items()}, rig_name, origin)


def from_table(path: Path, pair: Pair, outline: Float) -> Measured:
    """The sweep of a CSV."""
    sweep, note = straightened(read_table(path), pair, outline)
    return Measured(sweep, pair, (path.name,), f"{sweep.size} rows of {path}{note}")


def from_recording(
    folder: Path,
    detections: Path | None,
    marker: str | None,
    distances: str | None,
    pair_for: Callable[[FrameRecording], Pair],
    outline: Float,
) -> Measured:
    """The sweep of a recording.

    Args:
        folder: The recording.
        detections: Folder with detections_<camera>.npz.
        marker: The target; None: the only one that is seen.
        distances: FIRST:LAST:STEP, a list, or the path of a .csv; None: from the truth.npz of a rendered recording.
        pair_for: The rig and cameras to use with this recording.
        outline: Shape of the target, see `blob_bias`.

    Raises:
        RecordingError, CalibrationError: Something is missing; the message states how to make it.
    """
    recording = open_recording(folder)
    pair = pair_for(recording)
    if detections is None:
        lines = "; ".join(
            f"phalanx-slave run --name {camera} --camera replay:{folder} -o DIR/detections_{camera}.npz"
            for camera in pair.cameras
        )
        raise CalibrationError(
            f"{folder}: --detections DIR is missing; make it with: {lines} (each with --calibration, if the recording"
            " carries no colours)"
        )
    pairs, target = read_pairs(recording, detections, pair.cameras, marker)
    sweep, summary = _placed(recording, pairs, distances)
    sweep, note = straightened(sweep, pair, outline)
    frames = f"{pairs.t_ns.size} frame pairs of {folder.name}"
    about = f"{sweep.size} places of the marker {target!r} in {frames}, {summary}{note}"
    return Measured(sweep, pair, (folder.name,), about)


def parse_target(text: str) -> Float:
    """The outline of the target `round`, or `75x50` (width x height, of any unit).

    Raises:
        CalibrationError: Neither.
    """
    if text == "round":
        return round_outline()
    try:
        width, height = (float(part) for part in text.lower().split("x"))
    except ValueError:
        width = height = 0.0
    if not (0.0 < width < 1e6 and 0.0 < height < 1e6):
        raise CalibrationError(f"--target {text!r}: expected WIDTHxHEIGHT, such as 75x50, or round")
    return card_outline(width, height)


def straightened(sweep: Sweep, pair: Pair, outline: Float) -> tuple[Sweep, str]:
    """Replace the sweep's centroids by the projections of the target's centre.

    Also return the note to print about it.
    """
    if pair.models is None or np.isnan(sweep.area_px2).all():
        return sweep, ""
    uv = np.stack(
        [
            centre_of_blob(model, sweep.uv[c], sweep.area_px2[c], outline)
            for c, model in enumerate(pair.models)
        ]
    )
    shift = float(np.nanmax(np.abs(uv - sweep.uv), initial=0.0))
    noted_px = 0.02  # shift of a centroid worth a line
    note = f"; the lens shifts its centroid by up to {shift:.2f} px, corrected" if shift > noted_px else ""
    return replace(sweep, uv=uv, disparity_px=uv[0, :, 0] - uv[1, :, 0]), note


def _placed(recording: FrameRecording, pairs: Pairs, distances: str | None) -> tuple[Sweep, str]:
    """The pairs with their distances, and where these come from."""
    if distances is None:
        sweep = by_truth(recording, pairs)
        if sweep is None:
            raise CalibrationError(
                f"{recording.folder}: --distances is missing (and there is no truth.npz with depth): give"
                " FIRST:LAST:STEP in metres, such as 1.00:0.20:-0.05, or a .csv with the columns t_s,distance_m"
            )
        return sweep, "distances from its truth.npz"
    if distances.endswith(".csv"):
        return by_file(pairs, Path(distances)), f"distances from {distances}"
    return by_list(pairs, parse_distances(distances)), f"distances {distances}"


def _with_view(file: CameraCalibration, fov_deg: float | None) -> CameraCalibration:
    """A camera file; where it has no intrinsics, with an ideal lens of `fov_deg`."""
    if file.intrinsics is not None or fov_deg is None:
        return file
    f = 0.5 * file.width_px / float(np.tan(np.radians(0.5 * fov_deg)))
    ideal = Intrinsics(fx_px=f, fy_px=f, cx_px=0.5 * (file.width_px - 1), cy_px=0.5 * (file.height_px - 1))
    return msgspec.structs.replace(file, intrinsics=ideal)
