"""Readable report of the study's result.

Tables on the terminal and in study.md, every trial in study.json.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from common.arrays import Float
from common.calibration.replacing import replacing
from common.errors import RecordingError
from common.hand.model import FINGERS
from common.messages import SolverMode
from common.sim.motion import POSES
from master.study import paper
from master.study.one import Calibrated
from master.study.statistics import Cell, Repeated, cells_of, repeated
from master.study.trials import LETTERS, Trial

LOOP = (
    "Open loop: nobody sees the tracked hand and corrects the pose. The paper's participants did (closed loop), so"
    " their figures stand beside ours and are not the same measurement."
)
_ERRORS = (
    "Absolute error of the PIP (thumb: MCP) in degrees, mean ± sd over the trials in which the finger was tracked"
    " (tracked / trials). `not reached`: tracked in fewer than half of them; nothing is filled in there."
)
_REPEATED = (
    "Repeatability: ICC(1,1) (Shrout & Fleiss 1979) of the angle between two blocks drawn for each participant, mean"
    " of 40 draws; targets are participant x pose, of reached cells. In truth: that of the poses as they were made."
)
_CAUSES = (
    "By cause: mean absolute error in degrees over the trials in which the finger was tracked (tracked / trials). Of"
    " `known, inputs` the first says what is known of bones and mounting, the second whether laser points and tips are"
    " as detected, or exactly where they are in truth."
)
_LETTER = {pose: letter for letter, pose in LETTERS.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A study, finished.

    Attributes:
        title: What it is of.
        settings: Whatever it was made with, by name.
        judged: The condition that cells and repeatability are of: a key of `trials`.
        trials: Of each condition, such as "calibrated, detected".
        calibrated: Of each participant what calibration made of the device; empty: none was made.
        seed: Of the drawn blocks.
    """

    title: str
    settings: Mapping[str, object]
    judged: str
    trials: Mapping[str, Sequence[Trial]]
    calibrated: Mapping[str, Calibrated]
    seed: int

    def cells(self) -> list[Cell]:
        """Every finger in every pose, of the judged condition."""
        return cells_of(list(self.trials[self.judged]))

    def repeated(self) -> list[Repeated]:
        """ICC of every finger, of the judged condition."""
        return repeated(list(self.trials[self.judged]), self.seed)


def lines_of(result: Result) -> list[str]:
    """The tables as lines of Markdown, which a terminal shows as well."""
    cells, again = result.cells(), result.repeated()
    poses = [pose for pose in POSES if any(cell.pose == pose for cell in cells)]
    count = len({one.participant for one in result.trials[result.judged]})
    lines = [
        f"# {result.title}",
        "",
        LOOP,
        "",
        f"{count} participants, {len(result.trials[result.judged])} trials; condition: {result.judged}.",
        "",
        _ERRORS,
        "",
        "| finger | "
        + " | ".join(f"{_LETTER[pose]} {pose.replace('_', ' ')}" for pose in poses)
        + " | paper |",
        "|---|" + "--:|" * (len(poses) + 1),
    ]
    lines += [_error_row(finger, [cell for cell in cells if cell.finger == finger]) for finger in FINGERS]
    lines += ["", *_reach_lines(cells, poses), "", *_icc_lines(again)]
    if len(result.trials) > 1:
        lines += ["", *_cause_lines(result)]
    lines += ["", *_mode_lines(result)]
    if result.calibrated:
        lines += ["", *_calibration_lines(result.calibrated)]
    return [*lines, "", *_verdict(cells, again)]


def write_study(folder: Path, result: Result, lines: Sequence[str]) -> None:
    """Write study.md and study.json (every trial; null: NaN).

    Raises:
        RecordingError: They cannot be written.
    """
    content = {
        "title": result.title,
        "loop": "open",
        "settings": dict(result.settings),
        "judged": result.judged,
        "cells": [_named(cell) for cell in result.cells()],
        "icc": [_named(one) | {"paper": paper.ICC[one.finger]} for one in result.repeated()],
        "calibrated": dict(result.calibrated),
        "trials": {name: list(trials) for name, trials in result.trials.items()},
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / "study.json") as file:
            file.write(msgspec.json.format(msgspec.json.encode(content), indent=1) + b"\n")
        with replacing(folder / "study.md") as file:
            file.write(("\n".join(lines) + "\n").encode())
    except OSError as error:
        raise RecordingError(f"{folder}: cannot write: {error.strerror}") from error


def _named(row: Cell | Repeated) -> dict[str, object]:
    out: dict[str, object] = {}
    for name in row.__slots__:
        value = getattr(row, name)
        out[name] = None if isinstance(value, float) and math.isnan(value) else value
    if isinstance(row, Cell):
        out["is_reached"] = row.is_reached
    return out


def _error_row(finger: str, cells: list[Cell]) -> str:
    texts = [_error_text(cell) for cell in cells]
    low_high = paper.MEAN_RANGE_DEG.get(finger)
    report = f"{low_high[0]}–{low_high[1]}" if low_high else f"< {paper.MEAN_LIMIT_DEG:g}"
    return f"| {finger} | " + " | ".join(texts) + f" | {report} |"


def _error_text(cell: Cell) -> str:
    share = f"({cell.reached}/{cell.trials})"
    if not cell.is_reached:
        return f"not reached {share}"
    spread = "" if math.isnan(cell.sd_deg) else f" ± {cell.sd_deg:.1f}"
    return f"{cell.mean_deg:.1f}{spread} {share}"


def _reach_lines(cells: list[Cell], poses: list[str]) -> list[str]:
    lines = [
        "What the truth says was in sight, laser line (2 mm or more) / fingertip, of so many trials:",
        "",
        "| finger | " + " | ".join(f"{_LETTER[pose]}" for pose in poses) + " |",
        "|---|" + "--:|" * len(poses),
    ]
    for finger in FINGERS:
        own = [cell for cell in cells if cell.finger == finger]
        lines.append(
            f"| {finger} | "
            + " | ".join(f"{cell.laser_seen} / {cell.tip} of {cell.trials}" for cell in own)
            + " |"
        )
    unseen = [cell for cell in cells if cell.unseen]
    listed = ", ".join(f"{cell.finger} {_LETTER[cell.pose]} {cell.unseen}" for cell in unseen) or "none"
    return [*lines, "", f"Trials in which a finger was tracked and neither was in sight: {listed}."]


def _icc_lines(again: list[Repeated]) -> list[str]:
    lines = [
        _REPEATED,
        "",
        "| finger | ICC | in truth | targets | reached cells | paper |",
        "|---|--:|--:|--:|--:|--:|",
    ]
    for one in again:
        shown = [f"{value:.3f}" if math.isfinite(value) else "none" for value in (one.icc, one.truth_icc)]
        lines.append(
            f"| {one.finger} | {shown[0]} | {shown[1]} | {one.targets} | {_of_cells(one)}"
            f" | {paper.ICC[one.finger]:.2f} |"
        )
    return lines


def _of_cells(one: Repeated) -> str:
    """Format the number of cells that a coefficient is based on.

    It is marked where they are fewer than half of the poses.
    """
    return f"{one.cells}{' (few)' if 2 * one.cells < len(POSES) else ''}"


def _cause_lines(result: Result) -> list[str]:
    """Tabulate the mean error by finger under every condition.

    The table shows what knowledge and what sensing cost.
    """
    lines = [
        _CAUSES,
        "",
        "| known, inputs | " + " | ".join(FINGERS) + " |",
        "|---|" + "--:|" * len(FINGERS),
    ]
    for name, trials in result.trials.items():
        texts: list[str] = []
        for finger in range(len(FINGERS)):
            own = [one for one in trials if one.tracked[finger]]
            error = np.abs([one.pip_deg[finger] - one.truth_deg[finger] for one in own])
            texts.append(
                f"{error.mean():.1f} ({len(own)}/{len(trials)})" if own else f"none (0/{len(trials)})"
            )
        lines.append(f"| {name} | " + " | ".join(texts) + " |")
    return lines


def _mode_lines(result: Result) -> list[str]:
    """Tabulate the mean error of the tracked fingers by solver input.

    That is what they were solved from, and whether the solution was ambiguous.
    """
    kinds = (("laser alone (fk)", SolverMode.FK, False), ("laser and tip (ik)", SolverMode.IK, False))
    lines = [
        "By level, of the same condition: mean absolute error in degrees (trials).",
        "",
        "| solved from | " + " | ".join(FINGERS) + " |",
        "|---|" + "--:|" * len(FINGERS),
    ]
    for name, solver_mode, ambiguous in (*kinds, ("laser and tip, ambiguous", SolverMode.IK, True)):
        texts: list[str] = []
        for f in range(len(FINGERS)):
            error = [
                abs(one.pip_deg[f] - one.truth_deg[f])
                for one in result.trials[result.judged]
                if one.tracked[f] and one.solver_mode[f] == solver_mode and one.ambiguous[f] is ambiguous
            ]
            texts.append(f"{np.mean(error):.1f} ({len(error)})" if error else "none")
        lines.append(f"| {name} | " + " | ".join(texts) + " |")
    return lines


def _calibration_lines(calibrated: Mapping[str, Calibrated]) -> list[str]:
    rotations = np.array([(one.nominal_rotation_deg, one.rotation_deg) for one in calibrated.values()])
    shifts = np.array([(one.nominal_shift_mm, one.shift_mm) for one in calibrated.values()])
    before, after = (f"{_rms(rotations[:, k]):.1f}° and {_rms(shifts[:, k]):.1f} mm" for k in (0, 1))
    lines = [
        f"How far the palm's pose is off (shift at the knuckles): rms {before} in the rig file, {after} calibrated.",
        "",
        "| participant | file | calibrated | |",
        "|---|--:|--:|---|",
    ]
    for name, one in calibrated.items():
        note = f"refused: {one.report[0]}" if one.refused else ""
        lines.append(
            f"| {name} | {one.nominal_rotation_deg:.1f}°, {one.nominal_shift_mm:.1f} mm"
            f" | {one.rotation_deg:.1f}°, {one.shift_mm:.1f} mm | {note} |"
        )
    return lines


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _verdict(cells: list[Cell], again: list[Repeated]) -> list[str]:
    reached = [cell for cell in cells if cell.is_reached]
    above = [cell for cell in reached if cell.mean_deg >= paper.MEAN_LIMIT_DEG]
    low = [one for one in again if not one.icc >= paper.ICC_GOAL]
    worst = ", ".join(
        f"{cell.finger} {cell.pose} {cell.mean_deg:.1f}"
        for cell in sorted(above, key=lambda cell: -cell.mean_deg)
    )
    below = ", ".join(
        f"{one.finger} {one.icc:.2f}" if math.isfinite(one.icc) else f"{one.finger} (none)" for one in low
    )
    reach = f"Reached: {len(reached)} of {len(cells)} cells."
    limits = f"Not below {paper.MEAN_LIMIT_DEG:g}°: {worst or 'none'}. ICC below {paper.ICC_GOAL}: {below or 'none'}."
    return [f"{reach} {limits}"]
