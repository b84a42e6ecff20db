"""The commands `intrinsics` and `stereo` fit cameras and write their files.

Images of a board enter; lenses into cameras/NAME.json and poses into rigs/RIG.json leave, each with its
provenance.
"""

from argparse import Namespace
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, Intrinsics, Matrix4, Provenance, RigCalibration, check, load
from common.command_line import echo
from common.errors import CalibrationError, FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import invert
from master.calibrate.cameras.boards import Board, board_in
from master.calibrate.cameras.coverage import draw_views
from master.calibrate.cameras.fit import CamerasFit, fit_cameras, fit_tracks
from master.calibrate.cameras.result import CamerasResult, report_json, report_lines, result
from master.calibrate.cameras.tracks import Tracks, streams_of, track
from master.calibrate.cameras.views import BoardViews, View, image_sets, look
from master.calibrate.report import finish
from master.calibrate.tree_files import lens_of, matrix_of, provenance, write_camera, write_rig
from master.fabrik.depth import law_contradicts

NEUTRAL = "mode, exposure, gain, colours and row time are neutral values, not measured"


def known_camera(name: str, calibration: Path, out: Path | None) -> CameraCalibration | None:
    """The camera's file of `out`, else of `calibration`; None: there is none."""
    path = _known(f"cameras/{name}.json", calibration, out)
    return None if path is None else load(path, CameraCalibration)


def known_rig(name: str, calibration: Path, out: Path | None) -> RigCalibration | None:
    """The rig's file of `out`, else of `calibration`; None: there is none."""
    path = _known(f"rigs/{name}.json", calibration, out)
    return None if path is None else load(path, RigCalibration)


def _known(file: str, calibration: Path, out: Path | None) -> Path | None:
    return next(
        (tree / file for tree in (out, calibration) if tree is not None and (tree / file).exists()), None
    )


def check_size(camera: CameraCalibration, size_px: tuple[int, int]) -> None:
    """Refuse images of another mode than the file's: a lens holds for one."""
    if (camera.width_px, camera.height_px) != size_px:
        raise CalibrationError(
            f"camera {camera.name!r}: the images are {size_px[0]} x {size_px[1]} px, its file says"
            f" {camera.width_px} x {camera.height_px}: take them in the mode that will be used"
        )


def camera_with_lens(
    known: CameraCalibration | None, name: str, size_px: tuple[int, int], lens: Intrinsics, how: Provenance
) -> CameraCalibration:
    """The camera's file with a new lens; a new one has neutral settings."""
    if known is None:
        how = msgspec.structs.replace(how, note=f"{how.note}; new file: {NEUTRAL}")
        return CameraCalibration(
            version=1,
            name=name,
            width_px=size_px[0],
            height_px=size_px[1],
            frame_rate_hz=30.0,
            exposure_us=10000.0,
            analogue_gain=1.0,
            colour_gains=(1.0, 1.0),
            row_time_us=0.0,
            intrinsics=lens,
            provenance={"intrinsics": how},
        )
    return msgspec.structs.replace(known, intrinsics=lens, provenance=known.provenance | {"intrinsics": how})


def rig_with_places(
    known: RigCalibration | None, name: str, places: dict[str, Matrix4], how: Provenance
) -> RigCalibration:
    """The rig's file with new camera poses; all else stays, and so does its frame.

    `places` are camera -> T_first_camera (4, 4), of all cameras measured; `known` None: a new marker rig.
    """
    if known is None:
        return RigCalibration(
            version=1,
            name=name,
            kind="markers",
            cameras=tuple(places),
            hand="default-right",
            T_rig_camera=places,
            provenance={"T_rig_camera": how},
        )
    # The rig's frame is wherever the file has it: there the first camera of both stays.
    anchor = next((camera for camera in known.cameras if camera in places), None)
    if anchor is None:
        raise CalibrationError(_other_rig(name, known.cameras, tuple(places)))
    T_rig_first = invert(_array(places[anchor]))
    if anchor in known.T_rig_camera:
        T_rig_first = known.camera_pose(anchor) @ T_rig_first
    new = {camera: matrix_of(T_rig_first @ _array(place)) for camera, place in places.items()}
    if anchor in known.T_rig_camera:
        new[anchor] = known.T_rig_camera[anchor]
    return msgspec.structs.replace(
        known,
        cameras=known.cameras + tuple(camera for camera in places if camera not in known.cameras),
        T_rig_camera=known.T_rig_camera | new,
        provenance=known.provenance | {"T_rig_camera": how},
    )


def _other_rig(name: str, cameras: tuple[str, ...], seen: tuple[str, ...]) -> str:
    return (
        f"rig {name!r} has the cameras {', '.join(cameras)}, the images are of {', '.join(seen)}:"
        " give the name of another rig, or of a new one (--rig NAME)"
    )


def without_wrong_law(
    rig: RigCalibration, cameras: Mapping[str, CameraCalibration | None]
) -> tuple[RigCalibration, str]:
    """The rig without a depth law that contradicts its camera poses, and why.

    Its `depth_model` is "stereo" then; the numbers of the law stay. A camera file may be None.
    """
    files = [cameras.get(name) for name in rig.cameras]
    if rig.depth_model == "stereo" or any(file is None or file.intrinsics is None for file in files):
        return rig, ""
    models = [CameraModel.of(file, rig.camera_pose(file.name)) for file in files if file is not None]
    try:
        wrong = law_contradicts(rig, models)
        then = f"; `phalanx calibrate depth --use {rig.depth_model}` fits it anew"
    except CalibrationError as error:  # these cameras can have no such law
        wrong, then = str(error), ""
    if not wrong:
        return rig, ""
    return msgspec.structs.replace(rig, depth_model="stereo"), f"{wrong}: depth_model is 'stereo' now{then}"


def lens_provenance(result: CamerasResult, camera: str, tool: str, data: tuple[str, ...]) -> Provenance:
    """Provenance of one camera's lens."""
    lens = result.lenses[camera]
    residual = {
        "rms_px": round(lens.rms_px, 4),
        "fx_sd_px": round(float(lens.sd[0]), 4),
        "cx_sd_px": round(float(lens.sd[2]), 4),
        "cy_sd_px": round(float(lens.sd[3]), 4),
    }
    note = f"{lens.views} images, {sum(no.camera in (camera, '') for no in result.rejected)} with a part left out"
    return provenance(tool, data, residual, note)


def places_provenance(result: CamerasResult, tool: str, data: tuple[str, ...]) -> Provenance:
    """Provenance of the camera poses."""
    residual = {"rms_px": round(result.rms_px, 4)}
    for pair in result.pairs:
        names = f"{pair.first}_{pair.second}"
        residual[f"{names}_baseline_m"] = round(pair.baseline_m, 6)
        residual[f"{names}_epipolar_rms_px"] = round(pair.epipolar_rms_px, 4)
        residual[f"{names}_edge_mean_mm"] = round(pair.edge_mean_mm, 4)
        residual[f"{names}_edge_sd_mm"] = round(pair.edge_sd_mm, 4)
    for camera, sd in result.baseline_sd_m.items():
        if sd > 0.0:
            residual[f"{camera}_baseline_sd_m"] = round(sd, 7)
    rejected = "; ".join(str(no) for no in result.rejected)
    note = f"{result.views} views shared{'; left out: ' * bool(rejected)}{rejected}"
    return provenance(tool, data, residual, note)


def write_files(
    out: Path, cameras: Mapping[str, CameraCalibration], rigs: Mapping[str, RigCalibration]
) -> list[Path]:
    """Save files by their names in the tree; none is written where one is invalid.

    Raises:
        CalibrationError: A folder or file cannot be written, or a measured value is invalid.
    """
    for folder, files in (("cameras", cameras), ("rigs", rigs)):
        for name, value in files.items():
            check(value, str(out / folder / f"{name}.json"))
    written = [write_camera(out, name, camera) for name, camera in cameras.items()]
    return written + [write_rig(out, name, rig) for name, rig in rigs.items()]


def _array(matrix: Matrix4) -> Float:
    return np.array(matrix, dtype=np.float64)


def intrinsics(options: Namespace) -> None:
    """Measure the lens of each camera by itself."""
    seen = _seen(options)
    views = seen if isinstance(seen, BoardViews) else seen.views(dict.fromkeys(seen.cameras, 0.0))
    known = _known_cameras(views, options.calibration, options.out)
    bent = _bent(flat=options.flat_board, bent=options.bent_board)
    fits = {name: fit_cameras(_only(views, name), bent=bent) for name in views.cameras}
    results = {name: result(fit, {}) for name, fit in fits.items()}

    def write(out: Path) -> dict[Path, str]:
        files = _with_lenses(views, known, results, "calibrate cameras intrinsics", options.source)
        return _named(write_files(out, files, {}), known)

    finish(
        options,
        (line for own in results.values() for line in report_lines(own)),
        {"cameras": {name: report_json(own) for name, own in results.items()}},
        lambda path: draw_views(path, tuple(fits.values())),
        write,
    )


def stereo(options: Namespace) -> None:
    """Calibrate poses and lenses of a rig's cameras, two or more, in one bundle."""
    rig_known = known_rig(options.rig, options.calibration, options.out)
    views = _seen(options)
    if rig_known is not None:
        order = sorted(views.cameras, key=[*rig_known.cameras, *views.cameras].index)
        views = replace(views, sizes_px={name: views.sizes_px[name] for name in order})
    if len(views.cameras) < 2:
        raise FitError(
            f"stereo needs at least two cameras; there are images of {', '.join(views.cameras)} only"
        )
    if options.out is not None and rig_known is not None and not set(rig_known.cameras) & set(views.cameras):
        raise CalibrationError(_other_rig(options.rig, rig_known.cameras, views.cameras))
    known = _known_cameras(views, options.calibration, options.out)
    held: dict[str, Float] = {}
    for name, file in known.items():
        if options.keep_intrinsics and file is not None and file.intrinsics is not None:
            held[name] = lens_of(file.intrinsics)
    fit = _fit(views, held, options)
    found = result(fit, held)
    tool = "calibrate cameras stereo"

    def write(out: Path) -> dict[Path, str]:
        results = {name: found for name in views.cameras if name not in held}
        files = _with_lenses(views, known, results, tool, options.source)
        how = places_provenance(found, tool, (_source_name(options.source),))
        rig = rig_with_places(rig_known, options.rig, dict(found.T_rig_camera), how)
        new, dropped = without_wrong_law(rig, {**known, **files})
        written = _named(write_files(out, files, {options.rig: new}), known)
        if rig_known is None:
            echo(
                f"rig {options.rig!r} is new: its hand is 'default-right', its frame that of {views.cameras[0]}"
            )
        if dropped:
            echo(dropped)
        return written

    numbers = report_json(found) | {"rig": options.rig}
    finish(options, report_lines(found), numbers, lambda path: draw_views(path, (fit,)), write)


def _with_lenses(
    views: BoardViews | Tracks,
    known: Mapping[str, CameraCalibration | None],
    results: Mapping[str, CamerasResult],
    tool: str,
    source: Path,
) -> dict[str, CameraCalibration]:
    """The files of cameras with the lenses that were found."""
    files: dict[str, CameraCalibration] = {}
    for name, own in results.items():
        how = lens_provenance(own, name, tool, (_source_name(source),))
        files[name] = camera_with_lens(
            known[name], name, views.sizes_px[name], own.lenses[name].intrinsics, how
        )
    return files


def _bent(*, flat: bool, bent: bool) -> bool | None:
    """Whether the options declare the board bent; None: held-out views decide."""
    if flat and bent:
        raise FitError("--flat-board and --bent-board: a board is one of both")
    return bent if flat or bent else None


def _seen(options: Namespace) -> BoardViews | Tracks:
    """What the cameras saw of the board, in frames with times or in pictures."""
    board = board_in(options)
    streams = streams_of(options.source, options.camera or (), echo)
    if streams is None:
        return _views(options)
    tracks = track(board, streams, lambda text: echo(text, error=True))
    _name_layout(tracks.board, board)
    return tracks


def _fit(seen: BoardViews | Tracks, held: Mapping[str, Float], options: Namespace) -> CamerasFit:
    bent = _bent(flat=options.flat_board, bent=options.bent_board)
    if isinstance(seen, BoardViews):
        return fit_cameras(seen, held, bent=bent)
    return fit_tracks(seen, held, bent=bent)


def _name_layout(found: Board, asked: Board) -> None:
    if found != asked:
        echo(f"the pictures show a {found}")


def _views(options: Namespace) -> BoardViews:
    board, sets = board_in(options), image_sets(options.source, options.camera or ())
    images = sum(len(own) for _, own in sets)
    done = 0

    def progress(_: str) -> None:
        nonlocal done
        done += 1
        if done % 10 == 0 or done == images:
            echo(f"looking for the {board}: {done} of {images} images", error=True)

    views = look(board, sets, progress)
    _name_layout(views.board, board)
    if views.unseen:
        echo(f"no board in {len(views.unseen)} of {images} images: {', '.join(views.unseen)}")
    return views


def _known_cameras(
    views: BoardViews | Tracks, calibration: Path, out: Path | None
) -> dict[str, CameraCalibration | None]:
    known = {name: known_camera(name, calibration, out) for name in views.cameras}
    for name, file in known.items():
        if file is not None:
            check_size(file, views.sizes_px[name])
    return known


def _only(views: BoardViews, camera: str) -> BoardViews:
    own = tuple(View(name, {camera: observation}) for name, observation in views.of(camera))
    return replace(views, views=own, sizes_px={camera: views.sizes_px[camera]})


def _source_name(source: Path) -> str:
    """The folder's own name: provenance does not name where this machine keeps it."""
    return source.resolve().name


def _named(paths: list[Path], known: Mapping[str, CameraCalibration | None]) -> dict[Path, str]:
    """What was written to each file."""
    what: dict[Path, str] = {}
    for path in paths:
        lens = path.parent.name == "cameras"
        new = lens and known.get(path.stem) is None
        what[path] = (
            f"{'lens' if lens else 'places'}{' (new: mode, exposure and gains are neutral values)' * new}"
        )
    return what
