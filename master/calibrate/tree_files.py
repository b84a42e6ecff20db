"""A calibration tree keeps cameras, rigs and hands as files.

Which rig file gets a result, its provenance, and the conversion between fit arrays and file types. A file is
written whole or not at all; numbers are rounded as they are written.
"""

from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import (
    CameraCalibration,
    HandProfile,
    Intrinsics,
    Matrix4,
    Provenance,
    RigCalibration,
    Vector3,
    load,
    save,
)
from common.calibration.files import date_now
from common.calibration.object_profile import ObjectProfile
from common.command_line import echo
from common.errors import CalibrationError, FitError
from common.geometry.camera_model import CameraModel


def provenance(tool: str, data: tuple[str, ...], residual: dict[str, float], note: str = "") -> Provenance:
    """Provenance of a result that was made now, by a command as "calibrate depth".

    `data` are names of what it was measured from, `residual` a quantity with its unit -> value.
    """
    rounded = {quantity: round(value, 6) for quantity, value in residual.items()}
    return Provenance(date=date_now(), tool=tool, data=data, residual=rounded, note=note)


def load_marker_rig(calibration: Path, name: str) -> RigCalibration:
    """rigs/<name>.json of a tree, for what is measured by markers.

    Raises:
        CalibrationError: The file is missing or broken, or the rig is of another kind.
    """
    path = _path(calibration, "rigs", name)
    rig = load(path, RigCalibration)
    if rig.kind != "markers":
        raise CalibrationError(f"{path}: kind is {rig.kind!r}, this needs a rig of 'markers'")
    return rig


def rig_in_tree(out: Path | None, file_name: str, rig: RigCalibration) -> RigCalibration:
    """The rig file that gets a result: the one in `out` if there, else `rig` itself.

    Raises:
        CalibrationError: The one in `out` is broken, or has other cameras, or another first one.
    """
    if out is None or not (path := _path(out, "rigs", file_name)).exists():
        return rig
    there = load(path, RigCalibration)
    if there.cameras != rig.cameras:
        raise CalibrationError(
            f"{path}: cameras are {', '.join(there.cameras)}, it was measured with {', '.join(rig.cameras)}:"
            " they must be the same, and the first one too, which is the reference; give another --out"
        )
    return there


def write_rig(out: Path, file_name: str, rig: RigCalibration) -> Path:
    """Write rigs/<file_name>.json of the tree `out`; return its path.

    Raises:
        CalibrationError: The folder or the file cannot be written; an old file is untouched.
    """
    return _write(_path(out, "rigs", file_name), rig)


def write_object(out: Path, profile: ObjectProfile) -> Path:
    """Write objects/<name>.json of the tree `out`; as `write_rig`."""
    return _write(_path(out, "objects", profile.name), profile)


def write_camera(out: Path, file_name: str, camera: CameraCalibration) -> Path:
    """Write cameras/<file_name>.json of the tree `out`; as `write_rig`."""
    return _write(_path(out, "cameras", file_name), camera)


def write_hand(out: Path, hand: HandProfile) -> Path:
    """Write hands/<name>.json of the tree `out`; as `write_rig`."""
    return _write(_path(out, "hands", hand.name), hand)


def _path(out: Path, folder: str, name: str) -> Path:
    return out / folder / f"{name}.json"


def _write(path: Path, value: RigCalibration | CameraCalibration | HandProfile | ObjectProfile) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"--out: cannot make the folder {path.parent}: {error.strerror}") from error
    save(path, value)
    return path


def write_into_rig(
    out: Path, file_name: str, rig: RigCalibration, how: Mapping[str, Provenance], **values: object
) -> dict[Path, str]:
    """Write `values` of keys, and how they were measured, into a rig file.

    That is rigs/<file_name>.json of the tree `out`. The file there is kept but for these keys; where there is
    none, a new one is like `rig`.

    Returns:
        Its path, and the keys.

    Raises:
        CalibrationError: As `rig_in_tree` and `write_rig`.
    """
    there = rig_in_tree(out, file_name, rig)
    new = replace(there, provenance=there.provenance | dict(how), **values)
    return {write_rig(out, file_name, new): ", ".join(values)}


def print_lines(lines: Iterable[str]) -> None:
    """Print lines for a person."""
    for line in lines:
        echo(line)


@contextmanager
def refusals_named(where: object, reasons: Iterable[str] = ()) -> Generator[None, None, None]:
    """Refusals (FitError) in the block begin with `where`, and end with `reasons`."""
    try:
        yield
    except FitError as error:
        raise FitError("\n  ".join([f"{where}: {error}", *reasons])) from error


def vector_of(value: Float) -> Vector3:
    """A position (3,) [m], rounded to a tenth of a micrometre."""
    x, y, z = (round(float(number), 7) + 0.0 for number in value)
    return x, y, z


_FIGURES = 9  # decimals: nanometres, and far below any standard deviation


def intrinsics_of(lens: Float) -> Intrinsics:
    """A lens (9,) in the order of `bundle.LENS`."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (round(float(x), _FIGURES) for x in lens)
    return Intrinsics(fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, distortion=(k1, k2, p1, p2, k3))


def lens_of(intrinsics: Intrinsics) -> Float:
    """The lens (9,) in the order of `bundle.LENS`."""
    return np.array(
        [intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px, *intrinsics.distortion]
    )


def matrix_of(T: Float) -> Matrix4:
    """A rigid transform (4, 4) as rows."""
    rows = [tuple(round(float(x), _FIGURES) for x in row) for row in T]
    (a, b, c, d) = [(row[0], row[1], row[2], row[3]) for row in rows]
    return a, b, c, d


def camera_model(intrinsics: Intrinsics, size_px: tuple[int, int], T_rig_camera: Matrix4) -> CameraModel:
    """The camera that a file with these values describes."""
    lens = lens_of(intrinsics)
    return CameraModel(
        matrix=np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]]),
        distortion=lens[4:],
        T_rig_camera=np.array(T_rig_camera, dtype=np.float64),
        width_px=size_px[0],
        height_px=size_px[1],
        row_time_ns=0.0,
    )
