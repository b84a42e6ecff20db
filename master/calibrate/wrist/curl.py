"""The command `wrist curl` fits the line of each finger's laser point.

A guided curl enters: laser points and fingertips of every strobe cycle. Outliers are rejected, then the
principal axis is taken: along which line the point moves, and how far.
"""

from argparse import Namespace
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from common.arrays import Bool, Float
from common.calibration.rig import FingerLine
from common.errors import FitError
from common.geometry.transforms import intersect_plane
from common.hand.model import FINGERS
from common.hand.wrist import laser_plane_of
from master.calibrate.picture import draw_curls
from master.calibrate.report import Column, Table, finish
from master.calibrate.tree_files import refusals_named
from master.calibrate.wrist.device import Device, device_of, writes_key
from master.estimator.priors import principal_line
from master.replay.recorded import recorded_cycles

MIN_POINTS = 20  # two thirds of a second of strobe cycles


@dataclass(frozen=True, slots=True, eq=False)
class FingerCurl:
    """One finger's curl."""

    finger: str
    points_m: Float  # (N, 3) the points that count [m], camera frame
    seen: int  # points seen in all
    line: FingerLine | None  # its line; None: not determined
    reason: str = ""  # why not


def fit_curls(laser_m: Float) -> tuple[FingerCurl, ...]:
    """Lines of the five fingers by laser points (T, 5, 3) [m] as of `read_curled`.

    Raises:
        FitError: No finger determines a line; the text states for each finger why.
    """
    curls = tuple(_curl(name, laser_m[:, f]) for f, name in enumerate(FINGERS))
    if all(curl.line is None for curl in curls):
        reasons = "; ".join(f"{curl.finger}: {curl.reason}" for curl in curls)
        raise FitError(f"no finger curled before the laser: {reasons}")
    off = {found.finger: 1.0 - len(found.points_m) / found.seen for found in curls if found.line is not None}
    if np.median(list(off.values())) > 0.25:
        shares = ", ".join(f"{finger} {100 * share:.0f} %" for finger, share in off.items())
        raise FitError(
            f"points of most fingers lie off the line of the others ({shares}): the device slipped on the arm, or the"
            " hand was moved sideways; fasten it, and curl again with the hand at rest"
        )
    return curls


def _curl(finger: str, laser_m: Float) -> FingerCurl:
    seen = laser_m[np.isfinite(laser_m).all(axis=1)]
    if len(seen) < MIN_POINTS:
        return FingerCurl(
            finger, seen, len(seen), None, f"{len(seen)} points, at least {MIN_POINTS} are needed"
        )
    points = seen[_on_one_line(seen)]
    axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    moved = float(np.ptp(points @ axis))
    # of 60 to 100 mm: below it was no curl, and a short line's direction is that of the noise
    least, line, reason = 0.015, None, ""
    if len(points) < MIN_POINTS or moved < least:
        reason = f"moved by {1e3 * moved:.1f} mm, at least {1e3 * least:.0f} are needed: bend it to a fist"
    else:
        try:
            line = principal_line(points)
        except FitError as error:
            reason = str(error)
    return FingerCurl(finger, points, len(seen), line, reason)


def _on_one_line(points: Float) -> Bool:
    """The points (N,) on the line that most of them share; another finger's are not."""
    rng = np.random.default_rng(0)
    pairs = 300
    a, b = points[rng.integers(0, len(points), (2, pairs))]
    way = b - a
    length = np.linalg.norm(way, axis=1)
    # Neighbours constrain no direction.
    far = length > np.quantile(length, 0.5)
    if not far.any():  # all in one place
        return np.ones(len(points), dtype=np.bool_)
    a, way = a[far], way[far] / length[far, None]
    arm = points[:, None] - a
    off = np.linalg.norm(arm - np.vecdot(arm, way)[..., None] * way, axis=2)
    outlier_m = 3e-3  # from the line: it is a little bent, and the finger goes aside by a millimetre
    near = off < outlier_m
    best = int(np.argmax(near.sum(axis=0) - 0.1 * np.minimum(off, outlier_m).sum(axis=0) / outlier_m))
    along = (points - a[best]) @ way[best]
    low, high = np.quantile(along[near[:, best]], [0.01, 0.99])
    alone_m = 3e-3  # beyond all but one per cent of the points along the line
    return near[:, best] & (along > low - alone_m) & (along < high + alone_m)


def read_curled(detections: Path, device: Device) -> Float:
    """Laser points (T, 5, 3) [m] of detections_<camera>.npz on the device's plane.

    Camera frame, fingers thumb ... little; NaN: not seen.

    Raises:
        RecordingError: The file is missing or broken.
        CalibrationError: The rig has no laser plane yet, or one that crosses no finger.
    """
    normal, offset_m = laser_plane_of(device.rig, f"rig {device.file_name!r}")
    cycles = recorded_cycles(detections, device.camera.name)
    uv = np.array([cycle.laser_uv for cycle in cycles]).reshape(-1, 5, 2)
    return intersect_plane(np.zeros(3), device.optics.ray(uv), normal, offset_m)


def curl(options: Namespace) -> None:
    """Measure the line of each finger's laser point, from a guided curl."""
    device = device_of(options.recording, options.rig, options.calibration, options.out)
    laser_m = read_curled(options.detections, device)
    with refusals_named(options.recording):
        curls = fit_curls(laser_m)
    lines = {found.finger: found.line for found in curls if found.line is not None}
    residual = {f"{finger}_mm": 1e3 * line.residual_m for finger, line in lines.items()}
    missing = ", ".join(found.finger for found in curls if found.line is None)
    note = f"not measured: {missing}" if missing else ""
    write = writes_key(device, "curl", "finger_lines", device.rig.finger_lines | lines, residual, note)
    table = curls_table(curls)
    fingers = dict(zip((found.finger for found in curls), table.json(), strict=True))
    finish(options, table.lines(), {"fingers": fingers}, partial(draw_curls, curls=curls), write)


def curls_table(curls: tuple[FingerCurl, ...]) -> Table:
    """Points, range and residual of each finger, or why it has no line."""
    known = [found.line for found in curls]
    mm = np.array([[np.nan] * 2 if line is None else [line.range_m[1], line.residual_m] for line in known])
    used, seen = np.array([[len(found.points_m), found.seen] for found in curls]).T
    return Table(
        (
            Column("finger", [found.finger for found in curls]),
            Column("points", used, "d", key="points"),
            Column("left out", seen - used, "d"),
            Column("", seen, key="seen"),
            Column("range mm", (1e3 * mm[:, 0]).round(4), ".1f", key="range_mm"),
            Column("residual mm", (1e3 * mm[:, 1]).round(4), ".2f", key="residual_mm"),
            Column("", [None if line is None else line.origin_m for line in known], key="origin_m"),
            Column("", [None if line is None else line.direction for line in known], key="direction"),
            Column(" ", [found.reason and f"left out: {found.reason}" for found in curls], key="refused"),
        )
    )
