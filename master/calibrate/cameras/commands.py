"""`phalanx-master calibrate intrinsics | stereo`: lenses, and where the cameras stand, from pictures of a board."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from common.arrays import Float
from common.calibration import CameraCalibration
from common.errors import FitError
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
from master.calibrate.cameras.options import Dictionary, MarkerMm, Size, SquareMm, board_of
from master.calibrate.cameras.report import report_json, report_lines
from master.calibrate.cameras.result import CamerasResult, result
from master.calibrate.cameras.views import BoardViews, View, look
from master.options import CALIB_JSON, Calibration, JsonFile, ResultTree
from master.summary import write_summary

Source = Annotated[
    Path,
    typer.Argument(
        help="Folder: CAMERA*.png|jpg, or a folder per camera, or a recording.", show_default=False
    ),
]
Cameras = Annotated[
    list[str] | None,
    typer.Option("--camera", help="A camera; may be repeated. Default: all that have images."),
]
Flat = Annotated[
    bool,
    typer.Option(
        "--flat-board",
        help="The board is exact and flat (glass, screen): do not estimate its shape. Default: as views held out say.",
    ),
]
Bent = Annotated[
    bool,
    typer.Option("--bent-board", help="Estimate the board's own shape. Default: what views held out say."),
]
Picture = Annotated[Path | None, typer.Option(help="Write a picture of corners and residuals to this .png.")]


def intrinsics(
    source: Source,
    board: Size,
    square_mm: SquareMm,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = "4X4_50",
    camera: Cameras = None,
    flat_board: Flat = False,
    bent_board: Bent = False,
    calibration: Calibration = CALIB_JSON,
    out: ResultTree = None,
    json_file: JsonFile = None,
    picture: Picture = None,
) -> None:
    """Measure the lens of each camera by itself: focal length, centre and distortion, each with its uncertainty.

    Wrong pictures are left out by themselves, each with the reason. Nothing is written without --out.

    Examples:

      phalanx-master calibrate intrinsics views --board 9x6 --square-mm 25 --out calib_json

      phalanx-master calibrate intrinsics views --camera left --board 7x5 --square-mm 30 --marker-mm 22
    """
    views = _views(source, board_of(board, square_mm, marker_mm, dictionary), camera)
    known = _known_cameras(views, calibration, out)
    results: dict[str, CamerasResult] = {}
    for name in views.cameras:
        fit = fit_cameras(_only(views, name), bent=_bent(flat=flat_board, bent=bent_board))
        results[name] = result(fit, {})
        _print_all(report_lines(results[name]))
        _draw(picture if len(views.cameras) == 1 else _named(picture, name), fit)
    files: dict[str, CameraCalibration] = {}
    for name, own in results.items():
        how = lens_provenance(own, name, "calibrate intrinsics", (_source_name(source),))
        lens = own.lenses[name].intrinsics
        files[name] = camera_with_lens(known[name], name, views.sizes_px[name], lens, how)
    if json_file is not None:
        write_summary(json_file, {"cameras": {name: report_json(own) for name, own in results.items()}})
    _written([] if out is None else write_files(out, files, {}), known)


def stereo(
    source: Source,
    board: Size,
    square_mm: SquareMm,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = "4X4_50",
    camera: Cameras = None,
    rig: Annotated[str, typer.Option(help="Name of the rig's file, without .json.")] = "desk",
    keep_intrinsics: Annotated[
        bool, typer.Option("--keep-intrinsics", help="Keep the lenses that the camera files have.")
    ] = False,
    flat_board: Flat = False,
    bent_board: Bent = False,
    calibration: Calibration = CALIB_JSON,
    out: ResultTree = None,
    json_file: JsonFile = None,
    picture: Picture = None,
) -> None:
    """Measure where all cameras of a rig stand, and their lenses, in one bundle; two cameras or more.

    Not every camera needs to see every view, as long as shared views link them all. The rig's frame stays that of its
    file. Nothing is written without --out.

    Examples:

      phalanx-master calibrate stereo views --board 9x6 --square-mm 25 --rig desk --out calib_json

      phalanx-master calibrate stereo views --camera left --camera right --board 9x6 --square-mm 25 --keep-intrinsics
    """
    rig_known = known_rig(rig, calibration, out)
    views = _views(source, board_of(board, square_mm, marker_mm, dictionary), camera)
    if rig_known is not None:
        order = sorted(views.cameras, key=[*rig_known.cameras, *views.cameras].index)
        views = replace(views, sizes_px={name: views.sizes_px[name] for name in order})
    if len(views.cameras) < 2:
        raise FitError(
            f"stereo needs at least two cameras; there are images of {', '.join(views.cameras)} only"
        )
    known = _known_cameras(views, calibration, out)
    held: dict[str, Float] = {}
    for name, file in known.items():
        if keep_intrinsics and file is not None and file.intrinsics is not None:
            held[name] = lens_of(file.intrinsics)
    fit = fit_cameras(views, held, bent=_bent(flat=flat_board, bent=bent_board))
    found = result(fit, held)
    _print_all(report_lines(found))
    _draw(picture, fit)
    data = (_source_name(source),)
    files = {
        name: camera_with_lens(
            known[name],
            name,
            views.sizes_px[name],
            found.lenses[name].intrinsics,
            lens_provenance(found, name, "calibrate stereo", data),
        )
        for name in views.cameras
        if name not in held
    }
    how = places_provenance(found, "calibrate stereo", data)
    new, dropped = without_wrong_law(
        rig_with_places(rig_known, rig, dict(found.T_rig_camera), how), {**known, **files}
    )
    if json_file is not None:
        write_summary(json_file, report_json(found) | {"rig": rig})
    written = [] if out is None else write_files(out, files, {rig: new})
    if rig_known is None and written:
        typer.echo(f"rig {rig!r} is new: its hand is 'default-right', its frame that of {views.cameras[0]}")
    if dropped and written:
        typer.echo(dropped)
    _written(written, known)


def _bent(*, flat: bool, bent: bool) -> bool | None:
    """What the options say of the board; None: views held out decide.

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
            typer.echo(f"looking for the {board}: {done} of {images} images", err=True)

    views = look(board, sets, progress)
    if views.unseen:
        typer.echo(f"no board in {len(views.unseen)} of {images} images: {', '.join(views.unseen)}")
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
    """The folder as data are named in provenance: its own name, not where this machine keeps it."""
    return source.resolve().name


def _named(picture: Path | None, camera: str) -> Path | None:
    return None if picture is None else picture.with_stem(f"{picture.stem}_{camera}")


def _draw(picture: Path | None, fit: CamerasFit) -> None:
    if picture is None:
        return
    from master.calibrate.cameras.picture import draw_views  # matplotlib takes a second to import

    draw_views(picture, fit)
    typer.echo(f"drew {picture}")


def _print_all(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line)


def _written(paths: list[Path], known: dict[str, CameraCalibration | None]) -> None:
    if not paths:
        typer.echo("nothing written: give --out DIR")
    for path in paths:
        new = path.parent.name == "cameras" and known.get(path.stem) is None
        typer.echo(f"wrote {path}{' (new: mode, exposure and gains are neutral values)' * new}")
