"""A depth sweep is one target at known distances, also kept as a table.

Both cameras of a pair see the target. Refused is what would give a law that looks well and is not: see
`checked`. Every refusal names the points and states what to do.
"""

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from common.arrays import Bool, Float, Int
from common.calibration.files import replacing
from common.errors import CalibrationError, FitError

RANGE = 2.5  # farthest over nearest distance; the paper has 5
FARTHEST_M = 10.0  # beyond it, 75 mm of baseline give less than 4 px: these are centimetres


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """N places of the target: the first axis of every field; cameras: left, right."""

    distance_m: Float  # (N,) of the target's centre along the first camera's axis [m]
    disparity_px: Float  # (N,) u of the first camera minus u of the second [px]
    # (N, 2, 2) centroids in both cameras [px], distorted images; NaN: only the disparity is known, or not seen
    uv: Float
    area_px2: Float  # (N, 2) [px^2]; NaN: not known
    sigma_px: Float  # (N,) standard deviation of one frame pair's disparity [px]; NaN: not known
    frames: Int  # (N,) frame pairs that were averaged
    place: tuple[str, ...]  # (N,) where each point comes from, for messages: "line 5", "frame 12"

    @classmethod
    def of(
        cls,
        distance_m: Float,
        uv: Float,
        area_px2: Float,
        place: Sequence[str],
        sigma_px: Float | None = None,
        frames: Int | None = None,
    ) -> "Sweep":
        """A sweep by centroids, each of one frame pair where nothing else is given."""
        n = len(place)
        sigma, one = np.full(n, np.nan), np.ones(n, np.int64)
        return cls(
            distance_m,
            uv[:, 0, 0] - uv[:, 1, 0],
            uv,
            area_px2,
            sigma if sigma_px is None else sigma_px,
            one if frames is None else frames,
            tuple(place),
        )

    @classmethod
    def of_disparity(cls, distance_m: Float, disparity_px: Float, place: Sequence[str]) -> "Sweep":
        """A sweep of which nothing but distances and disparities is known."""
        nan = np.full((len(place), 2, 2), np.nan)
        return replace(cls.of(distance_m, nan, nan[..., 0], place), disparity_px=disparity_px)

    @property
    def size(self) -> int:
        """N."""
        return self.distance_m.size

    def at(self, chosen: Bool | Int) -> "Sweep":
        """The chosen places, by mask (N,) or by index (K,)."""
        index: Int = np.arange(self.size)[chosen]
        order: list[int] = index.tolist()
        return self._each(lambda array: array[index], self.frames[index], tuple(self.place[i] for i in order))

    def mean(self) -> "Sweep":
        """One place: the mean of all, which stand at the same distance."""
        place = ("mean of " + ", ".join(self.place),)
        return self._each(
            lambda array: array.mean(axis=0, keepdims=True), self.frames.sum(keepdims=True), place
        )

    def _each(self, change: Callable[[Float], Float], frames: Int, place: tuple[str, ...]) -> "Sweep":
        arrays = (self.distance_m, self.disparity_px, self.uv, self.area_px2, self.sigma_px)
        distance, disparity, uv, area, sigma = map(change, arrays)
        return Sweep(distance, disparity, uv, area, sigma, frames, place)

    @staticmethod
    def joined(parts: Sequence["Sweep"]) -> "Sweep":
        """All places of several sweeps, in their order."""
        if not parts:
            return Sweep.of_disparity(np.empty(0), np.empty(0), ())
        rows = [(one.distance_m, one.disparity_px, one.uv, one.area_px2, one.sigma_px) for one in parts]
        distance, disparity, uv, area, sigma = (np.concatenate(column) for column in zip(*rows, strict=True))
        frames = np.concatenate([one.frames for one in parts])
        places = tuple(name for one in parts for name in one.place)
        return Sweep(distance, disparity, uv, area, sigma, frames, places)

    def names(self, chosen: Bool | Int) -> str:
        """The chosen places in words: "0.45 m (line 12), 0.5 m (line 13)"."""
        index: list[int] = np.arange(self.size)[chosen].tolist()
        return ", ".join(f"{self.distance_m[i]:.4g} m ({self.place[i]})" for i in index)


def place_of(
    uv: Sequence[Float], area_px2: Sequence[Float], sigma_px: float, place: str, distance_m: float
) -> Sweep:
    """The place of a target at rest, by the mean of each camera's frames.

    Args:
        uv, area_px2: Centroids (T, 2) [px] and areas (T,) [px^2] of each camera's own T frames.
        sigma_px: Standard deviation of one frame pair's disparity [px].
    """
    return Sweep.of(
        np.array([distance_m], np.float64),
        np.array([[one.mean(axis=0) for one in uv]]),
        np.array([[one.mean() for one in area_px2]]),
        (place,),
        np.array([sigma_px]),
        np.array([min(map(len, uv))], np.int64),
    )


def checked(sweep: Sweep, cameras: tuple[str, str], size_px: tuple[int, int] | None = None) -> Sweep:
    """The sweep by distance, nearest first, repeated distances averaged.

    `size_px` is the size of both images, where the sweep has centroids and areas.

    Raises:
        FitError: A target that is not seen, or partly outside an image; NaN; swapped cameras; a repeated
            distance that disagrees; too few points, too narrow or one-sided a range; disparities that do not
            fall with the distance.
    """
    merged = _merged(check_places(sweep, cameras, size_px))
    _check_falls(merged)
    check_enough(merged)
    return merged


def check_places(sweep: Sweep, cameras: tuple[str, str], size_px: tuple[int, int] | None = None) -> Sweep:
    """Sort the sweep by distance, nearest first, and check each place on its own.

    Raises:
        FitError: As `checked`, without what concerns all places together.
    """
    _check_seen(sweep, cameras)
    _check_signs(sweep, cameras)
    if size_px is not None:
        _check_whole(sweep, cameras, size_px)
    return sweep.at(np.argsort(sweep.distance_m, kind="stable"))


def check_enough(sweep: Sweep) -> None:
    """Refuse points that do not determine a law over a range.

    Raises:
        FitError: Too few, too near each other, or all at one end; the message states what is missing.
    """
    # two constants, and enough points to distinguish a wrong one from the others; the paper has 17
    points = 8
    if sweep.size < points:
        raise FitError(
            f"{sweep.size} usable distances, {points} are needed and the published fit has 17: measure from 1.00 m"
            f" to 0.20 m in steps of 0.05 m"
        )
    near, far = float(sweep.distance_m.min()), float(sweep.distance_m.max())
    if far < RANGE * near:
        raise FitError(
            f"all distances lie within {near:.3g}...{far:.3g} m, the farthest must be {RANGE} times the nearest: a law"
            f" from a narrow range is wrong outside it; measure the whole range of use, such as 0.20...1.00 m"
        )
    middle = float(np.sqrt(near * far))
    nearer, farther = int((sweep.distance_m < middle).sum()), int((sweep.distance_m > middle).sum())
    in_each_half = 2  # points nearer, and farther, than the geometric middle of the range
    if min(nearer, farther) < in_each_half:
        side, count = ("nearer", nearer) if nearer < farther else ("farther", farther)
        raise FitError(
            f"one-sided: only {count} of {sweep.size} distances is {side} than {middle:.3g} m (the geometric middle"
            f" of {near:.3g}...{far:.3g} m), {in_each_half} are needed: measure more that are {side}"
        )


def _check_seen(sweep: Sweep, cameras: tuple[str, str]) -> None:
    bad = ~((sweep.distance_m > 0.0) & (sweep.distance_m < FARTHEST_M))  # NaN too
    if bad.any():
        places = (
            "all places" if bad.all() else ", ".join(sweep.place[i] for i in np.flatnonzero(bad).tolist())
        )
        raise FitError(
            f"{places}: distance_m must be metres, above 0 and below {FARTHEST_M:g}: not centimetres or millimetres"
        )
    lost = np.isnan(sweep.disparity_px)
    if not lost.any():
        return
    for index, camera in enumerate(cameras):
        unseen = np.isnan(sweep.uv[:, index, 0]) & lost
        other = np.isfinite(sweep.uv[:, 1 - index, 0])
        if (unseen & other).any():
            raise FitError(
                f"camera {camera!r} does not see the target at {sweep.names(unseen & other)}: it is outside that image,"
                " hidden, or not of the marker's colour; put it where both cameras see it, or leave the distance out"
            )
    raise FitError(f"no disparity at {sweep.names(lost)}: the target was not seen, or the value is NaN")


def _check_signs(sweep: Sweep, cameras: tuple[str, str]) -> None:
    wrong = sweep.disparity_px <= 0.0
    if wrong.sum() > sweep.size / 2:
        raise FitError(
            f"disparities u_{cameras[0]} - u_{cameras[1]} are not positive ({sweep.disparity_px[0]:.1f} px at"
            f" {sweep.distance_m[0]:.4g} m): left and right are swapped; the first camera must be the left one"
        )
    if wrong.any():
        raise FitError(
            f"disparities are not positive at {sweep.names(wrong)}: another thing of the marker's colour was taken for"
            " the target there; measure again or leave them out"
        )


def _check_whole(sweep: Sweep, cameras: tuple[str, str], size_px: tuple[int, int]) -> None:
    """Refuse targets cut by the image's border: their centroid lies inward."""
    nominal = sweep.area_px2 * sweep.distance_m[:, None] ** 2
    if sweep.size == 0 or not np.isfinite(nominal).all():
        return
    typical = np.median(nominal, axis=0)
    gap = np.minimum(sweep.uv, np.array(size_px) - 1.0 - sweep.uv).min(axis=2)
    # area x distance^2 of a target that faces the cameras is constant; a tilt by 30 deg costs 13 %
    whole = 0.85
    half_length = 0.62  # of the published target (75 x 50 mm), in square roots of its area
    cut = (nominal < whole * typical) & (gap < half_length * np.sqrt(typical) / sweep.distance_m[:, None])
    for index, camera in enumerate(cameras):
        if cut[:, index].any():
            raise FitError(
                f"the target is partly outside the image of camera {camera!r} at {sweep.names(cut[:, index])}: its area"
                " there is too small for the distance; put it where both cameras see all of it, or take a smaller one"
            )


def _merged(sweep: Sweep) -> Sweep:
    """Equal distances averaged, unless ruler and noise do not explain the spread."""
    same_m = 0.0005  # distances that a ruler does not distinguish
    group = np.concatenate([[0], np.cumsum(np.diff(sweep.distance_m) > same_m)]).astype(np.int64)
    parts: list[Sweep] = []
    for g in range(int(group[-1]) + 1 if sweep.size else 0):
        same = sweep.at(group == g)
        spread = float(np.ptp(same.disparity_px))
        x, d = float(same.disparity_px.mean()), float(same.distance_m.mean())
        ruler_m = 0.002  # to which a target can be put back to a mark
        disagree_px = 0.5  # five standard deviations of a disparity from two centroids of 0.07 px
        if spread > disagree_px + x * ruler_m / d:
            listed = ", ".join(
                f"{p}: {v:.2f} px" for p, v in zip(same.place, same.disparity_px.tolist(), strict=True)
            )
            raise FitError(
                f"the same distance {d:.4g} m was measured with disparities that disagree ({listed}): more than"
                f" {1e3 * ruler_m:.0f} mm on the ruler explain; measure it again or leave one out"
            )
        parts.append(same if same.size == 1 else same.mean())
    return Sweep.joined(parts)


def _check_falls(sweep: Sweep) -> None:
    """Disparity must fall as the distance grows; `sweep` is sorted by distance."""
    rises = np.diff(sweep.disparity_px) >= 0.0
    if not rises.any():
        return
    if sweep.size > 2 and rises.all():
        raise FitError(
            "disparities grow with the distance: the distances stand in the reverse order of the frames (the published"
            " sweep runs 1.00:0.20:-0.05)"
        )
    pairs = ", ".join(
        f"{sweep.distance_m[i]:.4g} m {sweep.disparity_px[i]:.2f} px -> {sweep.distance_m[i + 1]:.4g} m"
        f" {sweep.disparity_px[i + 1]:.2f} px"
        for i in np.flatnonzero(rises).tolist()
    )
    raise FitError(
        f"not monotone: the disparity must fall as the distance grows, but {pairs}: a distance was noted wrongly, or"
        " something else was seen; measure these again or leave them out"
    )


_MORE = "\0"  # key of what a row has beyond its columns; no name of a column


def read_table(path: Path) -> Sweep:
    """Read a sweep from a CSV.

    Columns: distance_m and disparity_px, or distance_m, u_left_px and u_right_px. With v_left_px and
    v_right_px the full stereo model can be verified too; area_left_px2 and area_right_px2 reveal a target
    that is partly outside an image.

    Raises:
        CalibrationError: The file cannot be read, or lacks a column; the text names file, line and column.
    """
    columns, rows = rows_of(path)
    if "distance_m" not in columns:
        raise CalibrationError(
            f"{path}: column distance_m is missing; it has {', '.join(columns)} (separated by commas?)"
        )
    place = [f"line {number}" for number, _ in rows]
    distance = column(path, rows, "distance_m")
    u = [f"u_{side}_px" for side in ("left", "right")]
    if "disparity_px" in columns:
        return Sweep.of_disparity(distance, column(path, rows, "disparity_px"), place)
    if not set(u) <= set(columns):
        raise CalibrationError(
            f"{path}: columns disparity_px, or u_left_px and u_right_px, are missing; it has {', '.join(columns)}"
        )

    def of(kind: str) -> Float:
        names = [kind.format(side) for side in ("left", "right")]
        nan = np.full(len(rows), np.nan)
        return np.stack([column(path, rows, name) if name in columns else nan for name in names], axis=-1)

    uv = np.stack([of("u_{}_px"), of("v_{}_px")], axis=-1)
    return Sweep.of(distance, uv, of("area_{}_px2"), place)


def write_table(path: Path, sweep: Sweep) -> None:
    """Write a sweep as a CSV that `read_table` reads.

    Raises:
        CalibrationError: The file cannot be written; the old one is untouched.
    """
    lines = ["distance_m,u_left_px,v_left_px,u_right_px,v_right_px,area_left_px2,area_right_px2"]
    for i in range(sweep.size):
        (ul, vl), (ur, vr) = sweep.uv[i]
        al, ar = sweep.area_px2[i]
        lines.append(f"{sweep.distance_m[i]:.5f},{ul:.4f},{vl:.4f},{ur:.4f},{vr:.4f},{al:.1f},{ar:.1f}")
    try:
        with replacing(path) as file:
            file.write("\n".join([*lines, ""]).encode())
    except OSError as error:
        raise CalibrationError(f"{path}: cannot write: {error.strerror}") from error


def parse_distances(text: str) -> Float:
    """Distances [m] of a range `1.00:0.20:-0.05` (first, last, step), or a list.

    Raises:
        CalibrationError: Neither of the two, a step that does not lead to the last, or no metres.
    """
    distances = parse_numbers(
        text, "--distances", "FIRST:LAST:STEP in metres, such as 1.00:0.20:-0.05, or a list 1.0,0.8,0.6"
    )
    if not ((distances > 0.0) & (distances < FARTHEST_M)).all():
        raise CalibrationError(
            f"--distances {text!r}: distances must be metres, above 0 and below {FARTHEST_M:g}: not centimetres"
        )
    return distances


def parse_numbers(text: str, option: str, wanted: str) -> Float:
    """Numbers of FIRST:LAST:STEP, or of a list with commas.

    Messages name `option` and what is `wanted`.

    Raises:
        CalibrationError: Neither of the two, or a step that does not lead from the first to the last.
    """
    try:
        numbers = [float(part) for part in text.split(":" if ":" in text else ",")]
    except ValueError:
        numbers = []
    ranged = ":" in text
    if (
        not numbers
        or not all(map(math.isfinite, numbers))
        or (ranged and (len(numbers) != 3 or not numbers[2]))
    ):
        raise CalibrationError(f"{option} {text!r}: expected {wanted}")
    if not ranged:
        return np.array(numbers)
    first, last, step = numbers
    count = (last - first) / step
    if count < 0.0 or abs(count - round(count)) > 1e-6 * max(count, 1.0) or count > 10_000:
        raise CalibrationError(f"{option} {text!r}: steps of {step:g} do not lead from {first:g} to {last:g}")
    return np.array([first + step * i for i in range(round(count) + 1)])


def rows_of(path: Path) -> tuple[tuple[str, ...], list[tuple[int, dict[str, str]]]]:
    """Column names, and (line number, row) of a CSV with a header."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restkey=_MORE, restval="", skipinitialspace=True)
            columns = tuple(name.strip() for name in reader.fieldnames or ())
            reader.fieldnames = list(columns)
            rows = [(reader.line_num, row) for row in reader]
    except OSError as error:
        raise CalibrationError(f"{path}: cannot read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: not a table of text: {error}") from error
    if not rows:
        raise CalibrationError(
            f"{path}: no rows; the first line must name the columns, such as distance_m,disparity_px"
        )
    if doubled := {name for name in columns if columns.count(name) > 1}:
        raise CalibrationError(f"{path}: column {', '.join(sorted(doubled))} stands there twice")
    for number, row in rows:
        if any(row.get(_MORE, ())):
            raise CalibrationError(
                f"{path}: line {number}: more cells than columns; commas separate cells, numbers have a decimal point"
            )
    return columns, rows


def column(path: Path, rows: Sequence[tuple[int, dict[str, str]]], name: str) -> Float:
    """One column as finite numbers."""
    out = np.empty(len(rows))
    for i, (number, row) in enumerate(rows):
        text = row[name]
        try:
            out[i] = float(text)
        except ValueError as error:
            raise CalibrationError(f"{path}: line {number}: {name}: {text!r} is not a number") from error
        if not math.isfinite(out[i]):
            raise CalibrationError(
                f"{path}: line {number}: {name} is {text}: the target was not seen there? measure again or leave the"
                " line out"
            )
    return out
