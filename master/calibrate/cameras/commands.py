"""Calibration of lenses and camera poses from images of a board.

`phalanx calibrate cameras intrinsics | stereo`.
"""

from argparse import Namespace
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from common.arrays import Float
from common.calibration import CameraCalibration
from common.errors import FitError
from common.terminal import echo
from master.calibrate.cameras.boards import Board
from master.calibrate.cameras.files import (
    camera_with_lens,
    check_size,
    known_camera,
    known_rig,
    lens_provenance,
    places_provenance,
    rig_with_places,
    without_wrong_law,
    write_files,
)
from master.calibrate.cameras.fit import CamerasFit, fit_cameras
from master.calibrate.cameras.image_sets import image_sets
from master.calibrate.cameras.lens_files import lens_of
from master.calibrate.cameras.options import board_of
from master.calibrate.cameras.report import report_json, report_lines
from master.calibrate.cameras.result import CamerasResult, result
from master.calibrate.cameras.views import BoardViews, View, look
from master.commands.summary import write_summary


def intrinsics(options: Namespace) -> None:
    """Measure the lens of each camera by itself."""
    views = _views(
        options.source,
        board_of(options.board, options.square_mm, options.marker_mm, options.dictionary),
        options.camera,
    )
    known = _known_cameras(views, options.calibration, options.out)
    results: dict[str, CamerasResult] = {}
    for name in views.cameras:
        fit = fit_cameras(_only(views, name), bent=_bent(flat=options.flat_board, bent=options.bent_board))
        results[name] = result(fit, {})
        _print_all(report_lines(results[name]))
        _draw(options.picture if len(views.cameras) == 1 else _named(options.picture, name), fit)
    files: dict[str, CameraCalibration] = {}
    for name, own in results.items():
        how = lens_provenance(own, name, "calibrate cameras intrinsics", (_source_name(options.source),))
        lens = own.lenses[name].intrinsics
        files[name] = camera_with_lens(known[name], name, views.sizes_px[name], lens, how)
    if options.json_file is not None:
        write_summary(
            options.json_file, {"cameras": {name: report_json(own) for name, own in results.items()}}
        )
    _written([] if options.out is None else write_files(options.out, files, {}), known)


def stereo(options: Namespace) -> None:
    """Calibrate the poses and lenses of all cameras of a rig in one bundle.

    Two cameras or more.
    """
    rig_known = known_rig(options.rig, options.calibration, options.out)
    views = _views(
        options.source,
        board_of(options.board, options.square_mm, options.marker_mm, options.dictionary),
        options.camera,
    )
    if rig_known is not None:
        order = sorted(views.cameras, key=[*rig_known.cameras, *views.cameras].index)
        views = replace(views, sizes_px={name: views.sizes_px[name] for name in order})
    if len(views.cameras) < 2:
        raise FitError(
            f"stereo needs at least two cameras; there are images of {', '.join(views.cameras)} only"
        )
    known = _known_cameras(views, options.calibration, options.out)
    held: dict[str, Float] = {}
    for name, file in known.items():
        if options.keep_intrinsics and file is not None and file.intrinsics is not None:
            held[name] = lens_of(file.intrinsics)
    fit = fit_cameras(views, held, bent=_bent(flat=options.flat_board, bent=options.bent_board))
    found = result(fit, held)
    _print_all(report_lines(found))
    _draw(options.picture, fit)
    data = (_source_name(options.source),)
    files = {
        name: camera_with_lens(
            known[name],
            name,
            views.sizes_px[name],
            found.lenses[name].intrinsics,
            lens_provenance(found, name, "calibrate cameras stereo", data),
        )
        for name in views.cameras
        if name not in held
    }
    how = places_provenance(found, "calibrate cameras stereo", data)
    new, dropped = without_wrong_law(
        rig_with_places(rig_known, options.rig, dict(found.T_rig_camera), how), {**known, **files}
    )
    if options.json_file is not None:
        write_summary(options.json_file, report_json(found) | {"rig": options.rig})
    written = [] if options.out is None else write_files(options.out, files, {options.rig: new})
    if rig_known is None and written:
        echo(f"rig {options.rig!r} is new: its hand is 'default-right', its frame that of {views.cameras[0]}")
    if dropped and written:
        echo(dropped)
    _written(written, known)


def _bent(*, flat: bool, bent: bool) -> bool | None:
    """Return whether the options declare the board bent.

    None: views held out decide.

    Raises:
        FitError: It is both.
    """
    if flat and bent:
        raise FitError("--flat-board and --bent-board: a board is one of both")
    return bent if flat or bent else None


def _views(source: Path, board: Board, cameras: list[str] | None) -> BoardViews:
    sets = image_sets(source, cameras or ())
    images = sum(len(own) for _, own in sets)
    done = 0

    def progress(_: str) -> None:
        nonlocal done
        done += 1
        if done % 10 == 0 or done == images:
            echo(f"looking for the {board}: {done} of {images} images", error=True)

    views = look(board, sets, progress)
    if views.unseen:
        echo(f"no board in {len(views.unseen)} of {images} images: {', '.join(views.unseen)}")
    return views


def _known_cameras(
    views: BoardViews, calibration: Path, out: Path | None
) -> dict[str, CameraCalibration | None]:
    known = {name: known_camera(name, calibration, out) for name in views.cameras}
    for name, file in known.items():
        if file is not None:
            check_size(file, views.sizes_px[name])
    return known


def _only(views: BoardViews, camera: str) -> BoardViews:
    """The views of one camera."""
    own = tuple(View(name, {camera: observation}) for name, observation in views.of(camera))
    return replace(views, views=own, sizes_px={camera: views.sizes_px[camera]})


def _source_name(source: Path) -> str:
    """Return the folder's name as data are named in provenance.

    Its own name, not where this machine keeps it.
    """
    return source.resolve().name


def _named(picture: Path | None, camera: str) -> Path | None:
    return None if picture is None else picture.with_stem(f"{picture.stem}_{camera}")


def _draw(picture: Path | None, fit: CamerasFit) -> None:
    if picture is None:
        return
    from master.calibrate.cameras.picture import draw_views  # matplotlib takes a second to import

    draw_views(picture, fit)
    echo(f"drew {picture}")


def _print_all(lines: Iterable[str]) -> None:
    for line in lines:
        echo(line)


def _written(paths: list[Path], known: dict[str, CameraCalibration | None]) -> None:
    if not paths:
        echo("nothing written: give --out DIR")
    for path in paths:
        new = path.parent.name == "cameras" and known.get(path.stem) is None
        echo(f"wrote {path}{' (new: mode, exposure and gains are neutral values)' * new}")
