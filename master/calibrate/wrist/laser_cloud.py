"""A laser plane from a point cloud that another program measured.

The points that a scanner takes in one view share the errors of that view, so thousands of them are few
measurements: where the file's order shows lines (points follow each other closely along a straight line), a
line counts as two numbers, as that of a view of a board does; points in no such order count each alone. Written is
the plane of least squares over all points, unless lines or points are outliers by the cloud's own robust scale;
then they are left out, and the plane over all is printed too where it differs by more than two standard
deviations.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.errors import FitError, RecordingError
from master.calibrate.wrist.laser_plane import Lines, PlaneFit, consensus, over_all, settled, two_points

ENDINGS = (".ply", ".csv", ".xyz", ".txt")
_UNITS = {"m": 1.0, "metre": 1.0, "meter": 1.0, "mm": 1e-3, "millimetre": 1e-3, "millimeter": 1e-3}
_STATED = re.compile(r"\bunits?\b\s*[:=]?\s*(m|mm|metre|meter|millimetre|millimeter)s?\b", re.IGNORECASE)
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_FEWEST = 10


@dataclass(frozen=True, slots=True, eq=False)
class CloudFit:
    """The plane of a cloud."""

    fit: PlaneFit  # `used` and `off_m` by line or point
    lines: Lines
    over_all: PlaneFit | None  # least squares over all, where outliers were left out and it differs

    @property
    def used(self) -> str:
        """What it is from, for a person."""
        count = [len(one) for one in self.lines.points_m]
        own = sum(n for n, good in zip(count, self.fit.used, strict=True) if good)
        what = f" on {int(self.fit.used.sum())} lines" if self.lines.dof > 1.0 else ", each counted alone"
        return f"{own} of {sum(count)} points of a cloud{what}"


def read_cloud(path: Path, unit: str | None) -> Float:
    """Points (N, 3) [m] of a file, camera frame, in its order.

    PLY, ascii or binary; or text with x, y, z in its first columns or in those that its first line names.

    Args:
        unit: "m" or "mm"; None: as a comment or the names of the columns (x_mm) state.

    Raises:
        RecordingError: The file cannot be read, is none of these, states no unit or another one, or holds
            what is no number.
    """
    if path.suffix.lower() not in ENDINGS:
        raise RecordingError(f"{path}: is neither a folder nor a cloud; expected {', '.join(ENDINGS)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from error
    if not data.strip():
        raise RecordingError(f"{path}: is empty")
    points, stated = (_ply if path.suffix.lower() == ".ply" else _text)(path, data)
    if unit is not None and stated is not None and _UNITS[unit] != _UNITS[stated]:
        raise RecordingError(f"{path}: states {stated}, and --unit {unit} contradicts it")
    named = unit or stated
    if named is None:
        raise RecordingError(f"{path}: states no unit of length: give --unit m or --unit mm")
    wrong = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(wrong):
        raise RecordingError(f"{path}: {len(wrong)} points are no numbers, the first is point {wrong[0] + 1}")
    points = _UNITS[named] * points
    if len(points):
        ahead = float(np.median(points[:, 2]))
        if ahead <= 0.0:
            raise RecordingError(
                f"{path}: points lie behind the camera: z ahead, x right, y down are expected"
            )
        nearest_m, farthest_m = 0.005, 10.0
        if not nearest_m < ahead < farthest_m:
            raise RecordingError(
                f"{path}: points lie {ahead:g} m ahead of the camera: is their unit {named}?"
            )
    return points


def _ply(path: Path, data: bytes) -> tuple[Float, str | None]:
    """Vertices (N, 3) and the unit that a comment states."""
    end = re.search(rb"^end_header\r?\n", data, re.MULTILINE)
    if not data.startswith(b"ply") or end is None:
        raise RecordingError(f"{path}: has no PLY header")
    kind, count, names, types, element, stated = "", -1, list[str](), list[str](), "", None
    for line in data[: end.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["comment"]:
            found = _STATED.search(line)
            stated = stated if found is None else found[1].lower()
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            element = words[1]
            if element == "vertex":
                count = int(words[2])
            elif count < 0:
                raise RecordingError(f"{path}: `{element}` comes before `vertex`")
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise RecordingError(f"{path}: cannot read `{line.strip()}` of a vertex")
            types.append(_PLY_TYPES[words[1]])
            names.append(words[2])
    if count < 0 or not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names):
        raise RecordingError(f"{path}: has no vertices with x, y and z")
    body, at = data[end.end() :], [names.index(axis) for axis in "xyz"]
    if kind == "ascii":
        rows = body.decode("ascii", "replace").splitlines()[:count]
        values = [row.split() for row in rows]
        if len(rows) < count or any(len(row) != len(names) for row in values):
            raise RecordingError(f"{path}: ends before its {count} vertices, or a line lacks values")
        return _numbers(path, [[row[k] for k in at] for row in values]), stated
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(kind)
    if order is None:
        raise RecordingError(f"{path}: unknown format {kind!r}")
    row = np.dtype([(name, order + code) for name, code in zip(names, types, strict=True)])
    if len(body) < count * row.itemsize:
        raise RecordingError(f"{path}: ends before its {count} vertices")
    vertices = np.frombuffer(body, dtype=row, count=count)
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1), stated


def _text(path: Path, data: bytes) -> tuple[Float, str | None]:
    """Points (N, 3) and the unit that a comment or the columns' names state."""
    stated: str | None = None
    at = [0, 1, 2]
    rows: list[list[str]] = []
    for number, line in enumerate(data.decode("utf-8-sig", "replace").splitlines(), 1):
        if line.lstrip().startswith("#"):
            found = _STATED.search(line)
            stated = stated if found is None else found[1].lower()
            continue
        words = re.split(r"[,;\s]+", line.strip().strip(",;"))
        if words == [""]:
            continue
        named = [word.strip('"').lower() for word in words]
        if not rows and (header := _columns(named)) is not None:
            at, unit = header
            stated = unit or stated
            continue
        if len(words) <= max(at):
            raise RecordingError(f"{path}: line {number} has no x, y and z")
        rows.append([words[k] for k in at])
    return _numbers(path, rows), stated


def _columns(names: list[str]) -> tuple[list[int], str | None] | None:
    """Columns of x, y, z by their names, and the unit in these; None: no such names."""
    for ending, unit in (("", None), ("_m", "m"), ("_mm", "mm")):
        wanted = [axis + ending for axis in "xyz"]
        if set(wanted) <= set(names):
            return [names.index(one) for one in wanted], unit
    return None


def _numbers(path: Path, rows: list[list[str]]) -> Float:
    try:
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise RecordingError(f"{path}: what should be a number is none: {error}") from error


def fit_cloud(points_m: Float) -> CloudFit:
    """The plane of points (N, 3) [m] in the file's order.

    Raises:
        FitError: Too few points, points on one line or on no plane.
    """
    if len(points_m) < _FEWEST:
        raise FitError(f"{len(points_m)} points, at least {_FEWEST} are needed")
    wide = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False) / np.sqrt(len(points_m))
    if wide[1] < max(5.0 * wide[2], 0.01 * wide[0]) and wide[1] < 0.1 * wide[0]:
        raise FitError(
            f"all points lie on one line (they spread {1e3 * wide[1]:.2f} mm across it): they define no plane"
        )
    lines = lines_in(points_m)
    least = over_all(lines)
    flat_m = 3e-4  # rms: a laser's plane is flat to a third of this
    fewest = int(np.ceil(2.0 * len(lines.ends_m) / 3.0))
    plane = np.array(least.plane.normal), least.plane.offset_m
    fit = settled(lines, plane, fewest)
    if fit is None or fit.rms_m > flat_m:  # so many outliers that they hide each other
        fit = settled(lines, consensus(lines, known_sigma=False), fewest)
    if fit is None or fit.rms_m > flat_m:
        raise FitError(
            f"the points are not one plane: they are {1e3 * least.rms_m:.2f} mm rms off the best one (limit"
            f" {1e3 * flat_m:.1f} mm), and no plane is that of two thirds of them"
        )
    sure_rad = np.radians(1.0)
    if fit.normal_sigma_rad > sure_rad:
        raise FitError(
            f"the plane is known to {np.degrees(fit.normal_sigma_rad):.1f} deg only: it needs points that are farther"
            " from one line"
        )
    return CloudFit(fit, lines, None if fit.used.all() or not _differ(fit, least) else least)


def _differ(fit: PlaneFit, other: PlaneFit) -> bool:
    """Whether two planes differ by more than two standard deviations of either."""
    turn = float(np.linalg.norm(np.cross(fit.plane.normal, other.plane.normal)))
    shift = abs(fit.plane.offset_m - other.plane.offset_m)
    sigmas = 2.0
    return turn > sigmas * min(fit.normal_sigma_rad, other.normal_sigma_rad) or shift > sigmas * min(
        fit.offset_sigma_m, other.offset_sigma_m
    )


def lines_in(points_m: Float) -> Lines:
    """The lines that points (N, 3) [m] follow in their order, or every point alone."""
    step = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    jump = 10.0  # of the usual step from point to point
    runs = np.split(points_m, np.flatnonzero(step > jump * max(float(np.median(step)), 1e-9)) + 1)
    fewest, straight = 8, 0.02  # points, and breadth by length
    long = [one for one in runs if len(one) >= fewest]
    sizes = [np.linalg.svd(one - one.mean(axis=0), compute_uv=False) for one in long]
    by_line = sum(len(one) for one, size in zip(long, sizes, strict=True) if size[1] < straight * size[0])
    in_lines = len(long) > 2 and by_line > 0.9 * len(points_m)
    chosen = runs if in_lines else list(points_m[:, None])
    ends = (
        np.stack([two_points(one) for one in chosen]) if in_lines else np.repeat(points_m[:, None], 2, axis=1)
    )
    count: Int = np.array([len(one) for one in chosen])
    resolution_m = 1e-5  # of files: the scale of the residuals is the cloud's own above it
    cov = np.eye(2) * (2.0 * resolution_m**2 / count)[:, None, None]
    return Lines(ends, tuple(chosen), lambda normal: cov, dof=2.0 if in_lines else 1.0)
