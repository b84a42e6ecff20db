"""Observations of a hand are checked, and aligned in time with the routine.

Markers over time enter, from a file of poses; when the user did what leaves. Users begin late and vary their
pace. So the markers are compared with those of a template hand that does the routine, and the two are matched
monotonously in time (dynamic time warping: Sakoe & Chiba, 1978). The palm of the template is put where the
flat hand is: the still stretch whose markers fit the flat template best.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.errors import CalibrationError, FitError, RecordingError
from common.geometry.transforms import fit_rigid, transform
from common.hand.model import JOINTS, TIPS, HandModel
from common.hand.routine import MOVES, ROUTINE_S, STEPS, posture_at
from common.recording.recorded_files import read_npz


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Markers of one hand over time."""

    names: tuple[str, ...]  # markers: those of the tips, thumb ... little, then those of the back
    t_s: Float  # (T,) rising [s], from 0
    points_m: Float  # (T, 5 + B, 3) centroids of the caps, rig frame; NaN: not seen
    cov_m2: Float  # (T, 5 + B, 3, 3); NaN: not seen

    @classmethod
    def of(
        cls, t_ns: Int, points_m: Float, cov_m2: Float, names: Sequence[str], model: HandModel
    ) -> "Observed":
        """Take the markers on a hand's tips and back, in their order, and check them.

        Raises:
            CalibrationError: A finger tip has no marker in `names`.
            FitError: Too short, too few frames, or a marker was never seen.
        """
        rows = marker_rows(names, model)
        picked = np.asarray(points_m, np.float64)[:, rows]
        cov = np.asarray(cov_m2, np.float64)[:, rows]
        finite = np.isfinite(picked).all(axis=-1) & np.isfinite(cov).all(axis=(-2, -1))
        known = np.asarray(finite, np.bool_)
        t_s = 1e-9 * (t_ns - t_ns[0]) if len(t_ns) else np.empty(0)
        if (np.diff(t_s) <= 0).any():
            raise FitError("times do not rise: poses of one recording are needed, in their order")
        some = np.asarray(known.any(axis=1), np.bool_)
        _check_length(t_s[some])
        out = cls(
            tuple(names[row] for row in rows),
            t_s[some] - t_s[some][0],
            np.where(known[..., None], picked, np.nan)[some],
            np.where(known[..., None, None], cov, np.nan)[some],
        )
        for name, seen in zip(out.names[:5], known[some].mean(axis=0).tolist(), strict=False):
            if seen < 0.2:
                raise FitError(
                    f"the marker {name!r} is seen in {100 * seen:.0f} % of the routine: turn the hand so that the"
                    " cameras see all finger tips (the palm towards them is best), or calibrate its colour again"
                )
        return out


def marker_rows(names: Sequence[str], model: HandModel) -> list[int]:
    """Rows of the five tips, then of the markers that sit on the palm.

    Raises:
        CalibrationError: A tip has none.
    """
    mounts = {name: model.mount(name).joint for name in names if name in model.mounts}
    rows: list[int] = []
    for tip in TIPS.tolist():
        own = [row for row, name in enumerate(names) if mounts.get(name, -1) == tip]
        if not own:
            raise CalibrationError(
                f"hand {model.profile.name!r}: no marker of the rig ({', '.join(names)}) sits on the tip of"
                f" {JOINTS[tip]!r}; the routine needs one on each of five fingers"
            )
        rows.append(own[0])
    return rows + [row for row, name in enumerate(names) if name in mounts and mounts[name] is None]


def read_observed(path: Path, names: Sequence[str], model: HandModel) -> Observed:
    """Markers of a poses.npz, as the master and `phalanx replay` write it.

    Raises:
        RecordingError: The file is missing or broken, or has other markers than the rig.
        CalibrationError, FitError: As `Observed.of`.
    """
    fix = "write it with `phalanx replay` or `phalanx run --poses`"
    arrays = read_npz(path, ("t_ns", "markers_raw_m", "markers_cov_m2"), fix)
    t_ns, points, cov = (arrays[name] for name in ("t_ns", "markers_raw_m", "markers_cov_m2"))
    if points.shape != (len(t_ns), len(names), 3) or cov.shape != (*points.shape, 3):
        raise RecordingError(
            f"{path}: markers_raw_m has shape {points.shape}, the rig needs ({len(t_ns)}, {len(names)}, 3): name its"
            " rig with --rig"
        )
    try:
        return Observed.of(t_ns.astype(np.int64), points, cov, names, model)
    except FitError as error:
        raise FitError(f"{path}: {error}") from error


def _check_length(t_s: Float) -> None:
    span = float(t_s[-1] - t_s[0]) if len(t_s) else 0.0
    if span < 0.6 * ROUTINE_S:  # shortest of the routine
        raise FitError(
            f"markers are seen over {span:.1f} s, the routine takes {ROUTINE_S:.0f} s: do all of it, and record from"
            " its beginning to its end"
        )
    fewest_hz = 15.0
    if len(t_s) / span < fewest_hz:
        raise FitError(
            f"markers are seen {len(t_s) / span:.1f} times a second, {fewest_hz:.0f} are needed: the cameras lose the"
            " hand most of the time, or run too slowly"
        )


GRID_S = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The routine laid over the observations."""

    T_rig_palm: Float  # (4, 4) of the flat hand
    time_s: Float  # (N,) grid of observed times [s]
    script_s: Float  # (N,) where in the routine the user was
    cost_m: float  # rms distance between the markers and the template's

    def at(self, t_s: Float) -> Float:
        """Routine times of observed times (N,) [s]."""
        return np.interp(t_s, self.time_s, self.script_s)


def align(observed: Observed, model: HandModel) -> Alignment:
    """Lay the routine over what was seen of a hand.

    Raises:
        FitError: No moment of stillness with four finger tips and more.
    """
    time_s, points = _gridded(observed)
    script = np.arange(0.0, ROUTINE_S + 0.5 * GRID_S, GRID_S)
    angles = np.array([posture_angles(t) for t in script])
    hands = model.forward(np.broadcast_to(np.eye(4), (len(script), 4, 4)), angles)
    template = model.marker_points(hands, observed.names)
    tried = [_warped(pose, time_s, points, script, template) for pose in _flat_poses(points, template[0])]
    return min(tried, key=lambda alignment: alignment.cost_m)


def posture_angles(script_s: float) -> Float:
    """Angles (5, 4) [rad] that the routine asks for."""
    posture = np.radians(posture_at(script_s))
    return np.column_stack([posture, 0.75 * posture[:, 2]])


def flat_scale(observed: Observed, model: HandModel) -> float:
    """How much larger the hand is than the template, by the markers of the flat hand.

    Raises:
        FitError: As `align`.
    """
    _, points = _gridded(observed)
    flat = model.marker_points(model.forward(np.eye(4), posture_angles(0.0)), observed.names)
    best: list[tuple[float, float]] = []
    for window in _still(points):
        seen = np.isfinite(window[:, 0])
        own, shown = window[seen] - window[seen].mean(axis=0), flat[seen] - flat[seen].mean(axis=0)
        shown = transform(fit_rigid(own, shown), shown)  # of a centred hand the rotation is that of any size
        scale = float((own * shown).sum() / (shown**2).sum())  # |own| / |shown| also counts other proportions
        best.append((float(((own - scale * shown) ** 2).mean()), scale))
    return min(best)[1]


def missing_steps(observed: Observed, alignment: Alignment, model: HandModel) -> list[str]:
    """What was not done, or not seen: one line for each step and finger concerned."""
    script = alignment.at(observed.t_s)
    lines: list[str] = []
    flat = observed.points_m[script <= MOVES[0].stop_s]
    if not len(flat):
        return ["flat: not seen"]
    home = np.array([_median(flat[:, f]) for f in range(5)])
    asked = _reach(model)
    for number, step in enumerate(STEPS):
        moves = [move for move in MOVES if move.step == number]
        inside = (script > moves[0].start_s) & (script <= max(move.stop_s for move in moves))
        for f, finger in enumerate(observed.names[:5]):
            if asked[number, f] < 0.02:
                continue
            track = observed.points_m[inside, f]
            seen = np.isfinite(track[:, 0])
            if seen.sum() < 0.5 * max(len(track), 1) or not len(track):
                lines.append(
                    f"{step.name}: the marker {finger!r} is seen in {100 * seen.mean() if len(seen) else 0:.0f} % of it"
                )
                continue
            reach = float(np.linalg.norm(track[seen] - home[f], axis=1).max())
            if not reach > 0.4 * asked[number, f]:
                lines.append(
                    f"{step.name}: the marker {finger!r} moved by {1e3 * reach:.0f} mm, about"
                    f" {1e3 * asked[number, f]:.0f} mm are asked for"
                )
    return lines


def _reach(model: HandModel) -> Float:
    """(steps, 5) [m] by how much each tip is to move away from the flat hand."""

    def tips(script_s: float) -> Float:
        return model.forward(np.eye(4), posture_angles(script_s)).position_m[TIPS]

    home = tips(0.0)
    out = np.zeros((len(STEPS), 5))
    for move in MOVES:
        away = np.linalg.norm(tips(move.stop_s - 1e-6) - home, axis=1)
        out[move.step] = np.maximum(out[move.step], away)
    return out


def _median(points: Float) -> Float:
    seen = points[np.isfinite(points[:, 0])]
    return np.median(seen, axis=0) if len(seen) else np.full(3, np.nan)


def _gridded(observed: Observed) -> tuple[Float, Float]:
    """Times (N,) and mean places (N, M, 3) of the markers around them; NaN: not seen."""
    t = observed.t_s
    grid = np.arange(t[0], t[-1], GRID_S)
    cell = np.minimum(((t - t[0]) / GRID_S).astype(np.int64), len(grid) - 1)
    seen = np.isfinite(observed.points_m[..., 0])
    total = np.zeros((len(grid), *observed.points_m.shape[1:]))
    count = np.zeros((len(grid), len(observed.names)))
    np.add.at(total, cell, np.nan_to_num(observed.points_m))
    np.add.at(count, cell, seen)
    with np.errstate(invalid="ignore"):
        return grid + 0.5 * GRID_S, total / count[..., None]


def _still(points: Float) -> list[Float]:
    """Mean places (M, 3) of every stretch in which all that is seen, 4 tips, rests."""
    still_s, still_m = 0.4, 4e-3
    length = round(still_s / GRID_S)
    out: list[Float] = []
    for start in range(0, len(points) - length, 2):
        window = points[start : start + length]
        seen = np.asarray(np.isfinite(window[..., 0]).all(axis=0), np.bool_)
        if seen[:5].sum() >= 4 and np.ptp(window[:, seen], axis=0).max() < still_m:
            out.append(np.where(seen[:, None], window.mean(axis=0), np.nan))
    if not out:
        raise FitError(
            "no moment in which the hand is still and four finger tips are seen: begin with the flat hand, held still"
            " for a second, where all cameras see its tips"
        )
    return out


def _flat_poses(points: Float, flat: Float) -> list[Float]:
    """Palm poses (4, 4) of the flattest stretches, the best first."""
    poses: list[tuple[float, int, Float]] = []
    for number, window in enumerate(_still(points)):
        seen = np.isfinite(window[:, 0])
        pose = fit_rigid(window[seen], flat[seen])
        off = window[seen] - transform(pose, flat[seen])
        poses.append((float((off**2).mean()), number, pose))
    return [pose for _, _, pose in sorted(poses, key=lambda entry: entry[:2])[:4]]  # stretches of stillness


def _warped(pose: Float, time_s: Float, points: Float, script: Float, template: Float) -> Alignment:
    """The cheapest path through the (N, S) distances of observed and scripted epochs."""
    asked = transform(pose, template)
    square = ((points[:, None] - asked[None]) ** 2).sum(axis=-1)  # (N, S, M)
    seen = np.isfinite(square)
    far_m = 0.08  # farther off than this carries no more information
    near = np.where(seen, np.minimum(square, far_m**2), 0.0)
    cost = near.sum(axis=-1) / np.maximum(seen.sum(axis=-1), 1)
    count = len(script)
    total = np.where(np.arange(count) == 0, cost[0], np.inf)
    came = np.zeros((len(time_s), count), np.int64)
    for i in range(1, len(time_s)):
        tempo = 3  # the user's fastest, times the routine's
        ways = np.full((tempo + 1, count), np.inf)
        for k in range(tempo + 1):
            ways[k, k:] = total[: count - k] + 1e-5 * abs(k - 1)  # [m^2] of leaving the routine's tempo
        came[i] = ways.argmin(axis=0)
        total = ways.min(axis=0) + cost[i]
    way = np.empty(len(time_s), np.int64)
    way[-1] = count - 1
    for i in range(len(time_s) - 1, 0, -1):
        way[i - 1] = way[i] - came[i, way[i]]
    return Alignment(pose, time_s, script[way], float(np.sqrt(total[-1] / len(time_s))))
