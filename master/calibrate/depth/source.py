"""The inputs of a depth fit are read from a rig, a recording or a table.

Frames of the two cameras are paired by time. The target stands still while a distance is measured, so neither
interpolation nor the rolling shutter matters; `still_runs` excludes the frames of its way from place to
place.
"""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from common.arrays import Float, Int
from common.calibration import CameraCalibration, Intrinsics, RigCalibration, load
from common.errors import CalibrationError, RecordingError
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections
from common.recording.frame_recording import FrameRecording, open_recording
from common.recording.recorded_files import TRUTH, has_truth, read_truth
from master.calibrate.depth.sweep import Sweep, column, parse_distances, place_of, read_table, rows_of
from master.calibrate.tree_files import load_marker_rig
from master.fabrik.caps import card_outline, centre_of_blob, round_outline
from master.replay.recorded import recorded_detections

STILL_S = 0.5  # shortest stretch that counts as standing
STILL_FRAMES = 5


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """T frame pairs of two cameras in which one marker is looked for."""

    t_ns: Int  # this and seq: (T,) time and frame counter of the first camera's frame
    seq: Int
    uv: Float  # (2, T, 2) [px]; NaN: not seen
    area_px2: Float  # (2, T) [px^2]
    sigma_px: Float  # (2, T) stated standard deviations of the centroids [px]


def read_pairs(
    recording: FrameRecording, detections: Path, cameras: tuple[str, str], marker: str | None
) -> tuple[Pairs, str]:
    """Frame pairs of two cameras, left first, and the target's marker.

    `marker` None: the only one that both cameras see, by detections_<camera>.npz of the folder.

    Raises:
        RecordingError: Detections are missing or broken, or no frames belong together.
        CalibrationError: No such marker; or none is named and there are several, or none.
    """
    names = recording.manifest.marker_rig().markers
    if marker is not None and marker not in names:
        raise CalibrationError(f"--marker {marker!r}: the recording's rig has {', '.join(names)}")
    first, second = (list(recorded_detections(detections, camera, len(names))) for camera in cameras)
    index = _target([*first, *second], names) if marker is None else names.index(marker)
    limit_ns = round(0.5e9 / min(recording.manifest.cameras[camera].frame_rate_hz for camera in cameras))
    matched = list(_nearest_pairs(first, second, limit_ns))
    if not matched:
        raise RecordingError(
            f"{detections}: no frame of {cameras[1]!r} lies within {limit_ns * 1e-6:.1f} ms, half a frame, of one of"
            f" {cameras[0]!r}: were both recorded at the same time, on one clock?"
        )
    return Pairs(
        np.array([a.t_ns for a, _ in matched], np.int64),
        np.array([a.seq for a, _ in matched], np.int64),
        np.array([[m.uv[index] for m in side] for side in zip(*matched, strict=True)]),
        np.array([[m.area[index] for m in side] for side in zip(*matched, strict=True)]),
        np.array([[m.sigma_px[index] for m in side] for side in zip(*matched, strict=True)]),
    ), names[index]


def by_truth(recording: FrameRecording, pairs: Pairs) -> Sweep | None:
    """Each pair at its true distance in truth.npz; None: it has no `depth`.

    Raises:
        RecordingError: truth.npz is broken, leads out of the folder, or has another number of frames.
    """
    truth = read_truth(recording.folder, also=["depth"]) if has_truth(recording.folder) else {}
    if "depth" not in truth:
        return None
    path = recording.folder / TRUTH
    try:
        depth = truth["depth"].astype(np.float64)
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{path}: depth: {error}") from error
    frames = recording.frames_of(recording.manifest.marker_rig().cameras[0])
    if depth.shape != (len(frames),):
        raise RecordingError(f"{path}: depth has shape {depth.shape}, frames.csv {len(frames)} frames")
    number = {row.seq: i for i, row in enumerate(frames)}
    if strange := [int(seq) for seq in pairs.seq if int(seq) not in number]:
        raise RecordingError(
            f"{recording.folder}: the detections have a frame {strange[0]}, frames.csv has not: they are of another"
            " recording; run `phalanx-slave run -o` again"
        )
    index = np.array([number[int(seq)] for seq in pairs.seq], np.int64)
    return _single(pairs, depth[index])


def by_list(pairs: Pairs, distances: Float) -> Sweep:
    """Assign distances (N,) in order, to each pair or else to each still stretch.

    Raises:
        CalibrationError: The numbers fit neither.
    """
    if distances.size == pairs.t_ns.size:
        return _single(pairs, distances)
    runs = still_runs(pairs)
    if len(runs) != distances.size:
        raise CalibrationError(
            f"--distances names {distances.size} places, but the recording has {pairs.t_ns.size} frame pairs and the"
            f" target stands still (for {STILL_S} s) {len(runs)} times: {_times(pairs, runs)}; give as many, or a file"
            " with the columns t_s,distance_m"
        )
    return _averaged(pairs, runs, distances)


def by_file(pairs: Pairs, path: Path) -> Sweep:
    """Read the distances of the pairs from a CSV.

    Columns: `distance_m`, and one of `t_s` (since the first pair), `frame` (pair, from 0), `seq`. A time
    takes the pairs within a quarter of a second of it.

    Raises:
        CalibrationError: The file cannot be read, or names what the recording has not; with file and line.
    """
    columns, rows = rows_of(path)
    keys = [key for key in ("t_s", "frame", "seq") if key in columns]
    if "distance_m" not in columns or len(keys) != 1:
        raise CalibrationError(
            f"{path}: the columns must be distance_m and one of t_s, frame, seq; it has {', '.join(columns)}"
        )
    key = keys[0]
    since_s = (pairs.t_ns - pairs.t_ns[0]) * 1e-9
    number_of = np.arange(since_s.size, dtype=np.float64)
    of_pair = {"t_s": since_s, "frame": number_of, "seq": pairs.seq.astype(np.float64)}[key]
    around_s = 0.25  # frames before and after a time that `--distances FILE` names
    around = around_s if key == "t_s" else 0.0
    runs: list[Int] = []
    for (number, _), v in zip(rows, column(path, rows, key).tolist(), strict=True):
        run = np.flatnonzero(np.abs(of_pair - v) <= around)
        if run.size == 0:
            raise CalibrationError(
                f"{path}: line {number}: no frame pair with {key} {v:g}; the recording has {since_s.size} pairs,"
                f" seq {pairs.seq[0]}...{pairs.seq[-1]}, 0...{since_s[-1]:.2f} s"
            )
        if run.size > 1 and not _near(pairs, run, run):
            raise CalibrationError(
                f"{path}: line {number}: the target moves within {around_s} s of t_s {v:g}; still are"
                f" {_times(pairs, still_runs(pairs))}"
            )
        runs.append(run)
    return _averaged(pairs, runs, column(path, rows, "distance_m"))


def still_runs(pairs: Pairs) -> list[Int]:
    """The stretches, as indices of pairs, in which the target stands in both images.

    A pair joins the stretch before it while its centroids lie within six standard deviations, 1.2 px at most,
    of the stretch's mean. A tenth is cut off each end, where the target may be settling, or be touched.
    """
    runs: list[Int] = []
    start = 0
    for i in range(1, pairs.t_ns.size + 1):
        run = np.arange(start, i)
        if i < pairs.t_ns.size and _near(pairs, run, i):
            continue
        if run.size >= STILL_FRAMES and pairs.t_ns[run[-1]] - pairs.t_ns[run[0]] >= STILL_S * 1e9:
            runs.append(run[run.size // 10 : run.size - run.size // 10])
        start = i
    return runs


def _near(pairs: Pairs, run: Int, new: int | Int) -> bool:
    """Whether pairs `new` lie at the mean place of pairs `run`; not: one is not seen."""
    off = np.abs(pairs.uv[:, new] - pairs.uv[:, run].mean(axis=1).reshape(2, *([1] * np.ndim(new)), 2))
    noise_px = 0.1  # of a centroid whose sigma is not stated
    # of a target at rest; more is stated of what moves suddenly, and must not excuse that it moves
    unsure_px = 0.2
    sigma = np.minimum(np.fmax(pairs.sigma_px[:, new], noise_px), unsure_px)[..., None]
    return bool((off <= 6.0 * sigma).all())  # distance of a frame's centroid from the mean of its stretch


def _times(pairs: Pairs, runs: Sequence[Int]) -> str:
    since_s = (pairs.t_ns - pairs.t_ns[0]) * 1e-9
    return ", ".join(f"{since_s[run[0]]:.1f}-{since_s[run[-1]]:.1f} s" for run in runs) or "never"


def _single(pairs: Pairs, distance: Float) -> Sweep:
    return _averaged(pairs, [np.array([i]) for i in range(distance.size)], distance)


def _averaged(pairs: Pairs, runs: Sequence[Int], distance: Float) -> Sweep:
    """One place for each run of pairs."""
    disparity = pairs.uv[0, :, 0] - pairs.uv[1, :, 0]
    stated = np.hypot(pairs.sigma_px[0], pairs.sigma_px[1])
    return Sweep.joined(
        [
            place_of(
                list(pairs.uv[:, run]),
                list(pairs.area_px2[:, run]),
                float(disparity[run].std(ddof=1) if run.size >= STILL_FRAMES else stated[run].mean()),
                f"frame {run[0]}" if run.size == 1 else f"frames {run[0]}-{run[-1]}",
                d,
            )
            for run, d in zip(runs, distance.tolist(), strict=True)
        ]
    )


def _target(messages: Sequence[MarkerDetections], names: tuple[str, ...]) -> int:
    """The one marker that is seen in at least half of the messages."""
    share = np.isfinite([message.uv[:, 0] for message in messages]).mean(axis=0)
    seen = np.flatnonzero(share >= 0.5).tolist()
    if len(seen) != 1:
        visible = ", ".join(names[i] for i in seen) or "none"
        raise CalibrationError(f"--marker is missing: markers seen in half of the frames: {visible}")
    return seen[0]


def _nearest_pairs(
    first: Sequence[MarkerDetections], second: Sequence[MarkerDetections], limit_ns: int
) -> list[tuple[MarkerDetections, MarkerDetections]]:
    """Messages of the first camera with the second's nearest, within `limit_ns`."""
    if not second:
        return []
    times = np.array([message.t_ns for message in second], np.int64)
    out: list[tuple[MarkerDetections, MarkerDetections]] = []
    for message in first:
        nearest = int(np.argmin(np.abs(times - message.t_ns)))
        if abs(int(times[nearest]) - message.t_ns) <= limit_ns:
            out.append((message, second[nearest]))
    return out


_LEFT_RIGHT = ("left", "right")


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two cameras and the rig they belong to."""

    rig: RigCalibration | None = None  # the rig file; None: nothing is known but the numbers of a table
    file_name: str = ""  # of the rig file in a calib_json tree, without .json
    cameras: tuple[str, str] = _LEFT_RIGHT  # names, first the left one
    # this and models: their camera files, and the same as camera models; None: intrinsics are missing
    files: tuple[CameraCalibration, ...] = ()
    models: tuple[CameraModel, CameraModel] | None = None
    origin: str = "the recording"  # where the camera files come from

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Width and height of the images."""
        return (self.files[0].width_px, self.files[0].height_px) if self.files else None


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A sweep, how it was made, and with what."""

    sweep: Sweep  # unchecked, as measured but for the lens' shift of the centroids
    pair: Pair
    data: str  # name of what it was read from, for the provenance
    about: str  # one line that describes it


def pair_of(
    rig: RigCalibration,
    files: Mapping[str, CameraCalibration],
    file_name: str = "",
    origin: str = "the recording",
) -> Pair:
    """The first two cameras of a rig; without models where one has no intrinsics.

    Raises:
        CalibrationError: The rig has fewer than two cameras, is none of markers, or a file of them is missing.
    """
    if rig.kind != "markers" or len(rig.cameras) < 2:
        raise CalibrationError(f"rig {rig.name!r}: a depth needs a rig of kind 'markers' with two cameras")
    first, second = rig.cameras[:2]
    if missing := [name for name in (first, second) if name not in files]:
        raise CalibrationError(
            f"rig {rig.name!r} has the camera {missing[0]!r}, {origin} has not; it has {', '.join(files)}: record both"
            " cameras of the rig, or name the rig that was recorded with --rig"
        )
    two, models = (files[first], files[second]), None
    if all(file.intrinsics is not None for file in two):
        left, right = (CameraModel.of(file, rig.camera_pose(file.name)) for file in two)
        models = left, right
    return Pair(rig, file_name or rig.name, (first, second), two, models, origin)


def load_pair(
    calibration: Path,
    rig_name: str,
    fov_deg: float | None = None,
    recorded: Mapping[str, CameraCalibration] | None = None,
) -> Pair:
    """The pair of CALIBRATION/rigs/<rig>.json with its camera files.

    Args:
        fov_deg: Nominal horizontal field of view, for camera files without intrinsics.
        recorded: Camera files of a recording; the tree's are taken where they were measured (provenance).

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
        files, origin = dict(recorded), "the recording"
    return pair_of(rig, {name: _with_view(file, fov_deg) for name, file in files.items()}, rig_name, origin)


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
    """The sweep with projections of the target's centre, and a note to print."""
    if pair.models is None or np.isnan(sweep.area_px2).all():
        return sweep, ""
    seen = zip(pair.models, np.moveaxis(sweep.uv, 1, 0), sweep.area_px2.T, strict=True)
    uv = np.stack([centre_of_blob(model, uv, area, outline) for model, uv, area in seen], axis=1)
    shift = float(np.nanmax(np.abs(uv - sweep.uv), initial=0.0))
    noted_px = 0.02  # shift of a centroid worth a line
    note = f"; the lens shifts its centroid by up to {shift:.2f} px, corrected" if shift > noted_px else ""
    return replace(sweep, uv=uv, disparity_px=uv[:, 0, 0] - uv[:, 1, 0]), note


def measured_from(options: Namespace, outline: Float) -> Measured:
    """The sweep of a recording, by its detections, or of a table.

    `outline` is the target's, of `parse_target`.

    Raises:
        PhalanxError: What the user gave does not make one; the message states what is missing.
    """
    source: Path | None = options.source
    if source is None:
        raise CalibrationError("what to read is missing: give the folder of a recording, a .csv, or --live")
    if source.is_dir():
        return _recorded(options, source, outline)
    if source.suffix.lower() != ".csv":
        there = source.exists()
        raise CalibrationError(
            f"{source}: {'neither' if there else 'does not exist; give'} the folder of a recording"
            f" {'nor' if there else 'or'} a .csv"
        )
    idle = {name: vars(options)[name] for name in ("detections", "marker", "distances")}
    refuse_idle(f"{source}, a table", **idle)
    pair = Pair() if options.rig is None else load_pair(options.calibration, options.rig, options.fov_deg)
    sweep, note = straightened(read_table(source), pair, outline)
    return Measured(sweep, pair, source.name, f"{sweep.size} rows of {source}{note}")


def _recorded(options: Namespace, folder: Path, outline: Float) -> Measured:
    recording = open_recording(folder)
    cameras = recording.manifest.cameras
    if options.rig is None:
        pair = pair_of(recording.manifest.marker_rig(), cameras)
    else:
        pair = load_pair(options.calibration, options.rig, options.fov_deg, cameras)
    if options.detections is None:
        lines = "; ".join(
            f"phalanx-slave run --name {camera} --camera replay:{folder} -o DIR/detections_{camera}.npz"
            for camera in pair.cameras
        )
        raise CalibrationError(
            f"{folder}: --detections DIR is missing; make it with: {lines} (each with --calibration, if the recording"
            " carries no colours)"
        )
    pairs, target = read_pairs(recording, options.detections, pair.cameras, options.marker)
    distances: str | None = options.distances
    if distances is None:
        sweep, given_by = by_truth(recording, pairs), "from its truth.npz"
        if sweep is None:
            raise CalibrationError(
                f"{folder}: --distances is missing (and there is no truth.npz with depth): give FIRST:LAST:STEP in"
                " metres, such as 1.00:0.20:-0.05, or a .csv with the columns t_s,distance_m"
            )
    elif distances.endswith(".csv"):
        sweep, given_by = by_file(pairs, Path(distances)), f"from {distances}"
    else:
        sweep, given_by = by_list(pairs, parse_distances(distances)), distances
    sweep, note = straightened(sweep, pair, outline)
    frames = f"{pairs.t_ns.size} frame pairs of {folder.name}"
    about = f"{sweep.size} places of the marker {target!r} in {frames}, distances {given_by}{note}"
    return Measured(sweep, pair, folder.name, about)


def refuse_idle(where: str, **given: object) -> None:
    """Reject options that `where` does not use, rather than ignore them."""
    for name, value in given.items():
        if value:
            option = "a recording or a table" if name == "source" else f"--{name}"
            raise CalibrationError(f"{option} has no meaning with {where}: leave it out")


def _with_view(file: CameraCalibration, fov_deg: float | None) -> CameraCalibration:
    """A camera file; where it has no intrinsics, with an ideal lens of `fov_deg`."""
    if file.intrinsics is not None or fov_deg is None:
        return file
    f = 0.5 * file.width_px / float(np.tan(np.radians(0.5 * fov_deg)))
    ideal = Intrinsics(fx_px=f, fy_px=f, cx_px=0.5 * (file.width_px - 1), cy_px=0.5 * (file.height_px - 1))
    return msgspec.structs.replace(file, intrinsics=ideal)
