"""Guide the movements of a hand's calibration, and draw its result.

Steps are announced one by one on a running master, and a step whose markers were not seen is repeated: what
was seen before is dropped and its time taken out, so that the rest is one routine.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from common.arrays import Float, Int
from common.errors import FitError
from common.hand.model import HandModel
from common.hand.routine import MOVES, STEPS, Step
from common.messages import HandPose
from master.calibrate.hand.measure import CERTAIN, WITHIN_M, HandMeasurement
from master.calibrate.hand.observed import Observed, marker_rows
from master.calibrate.observations import check_markers
from master.calibrate.picture import figure_of, save_figure
from master.calibrate.session import Session, listening

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Markers of the kept steps."""

    t_ns: list[int] = field(default_factory=list[int])  # rising [ns], without the time of dropped steps
    # this and cov_m2: for each, (M, 3) [m] and (M, 3, 3)
    points_m: list[Float] = field(default_factory=list[Float])
    cov_m2: list[Float] = field(default_factory=list[Float])

    def keep(self, poses: Sequence[HandPose]) -> None:
        """Add the poses of one step."""
        shift = (self.t_ns[-1] + 20_000_000 - poses[0].t_ns) if self.t_ns else 0
        for pose in poses:
            if self.t_ns and pose.t_ns + shift <= self.t_ns[-1]:
                continue  # a pose that came twice
            self.t_ns.append(pose.t_ns + shift)
            self.points_m.append(pose.markers_raw_m)
            self.cov_m2.append(pose.markers_cov_m2)

    def arrays(self) -> tuple[Int, Float, Float]:
        """Times (T,) [ns], places (T, M, 3) [m] and covariances (T, M, 3, 3)."""
        return np.array(self.t_ns, np.int64), np.array(self.points_m), np.array(self.cov_m2)


def guide(session: Session[HandPose], tips: Sequence[int], names: Sequence[str]) -> Track:
    """Lead a person through the routine; `tips` are the five tips' rows.

    Raises:
        FitError: No pose comes, or a step was not seen three times.
    """
    track, notify = Track(), session.person.notify
    notify("lay the back of the hand on the table, palm to the cameras; it stays there until the end")
    for count in range(3, 0, -1):
        notify(f"{count} ...")
        _during(session, 1.0)
    for number, step in enumerate(STEPS):
        tries = 3
        for _ in range(tries):
            notify(f"{number + 1} of {len(STEPS)}: {step.instruction} ({step.seconds:.0f} s)")
            poses = _during(session, step.seconds + 0.4)  # users begin after they have read
            lacking = unseen(step, number, poses, tips, names)
            if not lacking:
                track.keep(poses)
                break
            notify(f"{lacking}; back to the flat hand, and this step again")
            _during(session, 1.0)
        else:
            raise FitError(
                f"{step.name}: not seen in {tries} tries; turn the hand or a camera, and begin again"
            )
    notify("done")
    return track


def unseen(
    step: Step, number: int, poses: Sequence[HandPose], tips: Sequence[int], names: Sequence[str]
) -> str:
    """What a step lacks, or nothing."""
    if not poses:
        return f"{step.name}: no pose came; is `phalanx run` running, on this --bus, with this hand in sight"
    moving = np.any([move.moving.any(axis=1) for move in MOVES if move.step == number], axis=0)
    wanted = [f for f in range(5) if moving[f] or not moving.any()]
    seen = np.isfinite([pose.markers_raw_m[list(tips), 0] for pose in poses]).mean(axis=0)
    poor = [f"{names[tips[f]]} in {100 * seen[f]:.0f} %" for f in wanted if seen[f] < 0.6]
    return f"{step.name}: markers are seen too little: {', '.join(poor)}" if poor else ""


def _during(session: Session[HandPose], seconds: float) -> list[HandPose]:
    return [pose for pose in session.during(seconds) if pose is not None]


def observe_live(bus: str, names: tuple[str, ...], model: HandModel) -> Observed:
    """Lead the user through the routine, on the bus of a running master.

    Raises:
        BusError: Nobody listens there.
        CalibrationError: The master's poses have other markers.
        FitError: The routine was not seen.
    """
    tips = marker_rows(names, model)[:5]

    def wanted(message: object) -> HandPose | None:
        if not isinstance(message, HandPose):
            return None
        check_markers(message, names)
        return message

    with listening(bus, {"hand": None}, wanted) as receive:
        track = guide(Session(receive), tips, names)
    return Observed.of(*track.arrays(), names, model)


_BLUE, _GREY = "#2b6cb0", "#9a9a9a"


def draw_hand(path: Path, measurement: HandMeasurement) -> None:
    """Draw lengths against the scaled ones, and the residuals of each marker, as PNG.

    Raises:
        RecordingError: The file cannot be written.
    """
    figure = figure_of((13.0, 6.0))
    left, right = figure.subplots(1, 2)
    _lengths(left, measurement)
    _residuals(right, measurement)
    save_figure(figure, path)


def _lengths(axes: "Axes", measurement: HandMeasurement) -> None:
    parted = [length for finger in range(5) for length in measurement.parted(finger)]
    lengths = [one for one in measurement.lengths if len(one.bones) == 1 or one in parted]
    for row, length in enumerate(lengths):
        off, sure = 1e3 * (length.length_m - length.scaled_m), 1e3 * CERTAIN * length.sigma_m
        colour = _BLUE if length.measured else _GREY
        axes.errorbar(off, row, xerr=sure, fmt="o", markersize=5, capsize=3, color=colour)
    axes.axvspan(-1e3 * WITHIN_M, 1e3 * WITHIN_M, color="#dde7f3", zorder=0)
    axes.axvline(0.0, color=_GREY, linewidth=0.8)
    axes.set_yticks(range(len(lengths)), [length.name for length in lengths], fontsize=8)
    axes.invert_yaxis()
    axes.set(
        xlabel="longer than scaled from the hand length [mm], with 99 %; band: 1 mm",
        title="blue: measured; grey: not determined by the markers",
    )


def _residuals(axes: "Axes", measurement: HandMeasurement) -> None:
    observed, off = measurement.observed, measurement.fit.residual_m
    for m, name in enumerate(observed.names):
        off_mm = 1e3 * np.linalg.norm(off[:, m], axis=-1)
        axes.plot(observed.t_s, off_mm, ".", markersize=2, label=name, alpha=0.6)
    axes.set(
        xlabel="time [s]",
        ylabel="distance of the marker from the fitted hand [mm]",
        title=f"residuals, {1e3 * measurement.rms_m:.2f} mm rms per axis",
    )
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, markerscale=4)
