"""Observations of a hand during the routine, checked.

Places of its markers over time, from a file of poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.errors import CalibrationError, FitError, RecordingError
from common.hand.model import JOINTS, TIPS, HandModel
from common.hand.routine import ROUTINE_S
from common.recording.npz import read_npz


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Markers of one hand over time.

    Attributes:
        names: Markers: those of the tips, thumb ... little, then those of the back.
        t_s: (T,) rising [s], from nought.
        points_m: (T, 5 + B, 3) centroids of the caps, rig frame; NaN: not seen.
        cov_m2: (T, 5 + B, 3, 3); NaN: not seen.
    """

    names: tuple[str, ...]
    t_s: Float
    points_m: Float
    cov_m2: Float

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
    shortest = 0.6  # of the routine
    if span < shortest * ROUTINE_S:
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
