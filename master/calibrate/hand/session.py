"""Guide the movements of a hand's calibration, and draw its result.

A session guides a person through the hand routine on a running master.

Guided hand routine with a person.

Steps are announced one by one, and a step whose markers were not seen is repeated.

What was seen in a step that is done again is dropped and its time taken out, so that the rest is one routine.

The routine with the master that runs: opens the bus and a person's terminal.

Plot of a measured hand.

Lengths against the scaled ones with their uncertainty, and the residuals of each marker.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from common.arrays import Float, Int
from common.calibration.files import replacing
from common.clock import Clock, SystemClock
from common.command_line import echo
from common.errors import CalibrationError, FitError, RecordingError
from common.hand.model import HandModel
from common.hand.routine import MOVES, STEPS, Step
from common.messages import HandPose
from master.calibrate.hand.measure import CERTAIN, WITHIN_M, HandMeasurement
from master.calibrate.hand.observed import Observed, marker_rows
from master.run.process import join_bus

Receive = Callable[[float], HandPose | None]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Markers of the kept steps.

    Attributes:
        t_ns: Rising [ns], without the time of dropped steps.
        points_m: For each, (M, 3) [m].
        cov_m2: For each, (M, 3, 3).
    """

    t_ns: list[int] = field(default_factory=list[int])
    points_m: list[Float] = field(default_factory=list[Float])
    cov_m2: list[Float] = field(default_factory=list[Float])

    def keep(self, poses: Sequence[HandPose]) -> None:
        """Add the poses of one step."""
        gap_ns = 20_000_000
        shift = (self.t_ns[-1] + gap_ns - poses[0].t_ns) if self.t_ns else 0
        for pose in poses:
            if self.t_ns and pose.t_ns + shift <= self.t_ns[-1]:
                continue  # a pose that came twice
            self.t_ns.append(pose.t_ns + shift)
            self.points_m.append(pose.markers_raw_m)
            self.cov_m2.append(pose.markers_cov_m2)

    def arrays(self) -> tuple[Int, Float, Float]:
        """Times (T,) [ns], places (T, M, 3) [m] and covariances (T, M, 3, 3)."""
        return np.array(self.t_ns, np.int64), np.array(self.points_m), np.array(self.cov_m2)


def guide(
    receive: Receive, tips: Sequence[int], names: Sequence[str], clock: Clock, notify: Callable[[str], None]
) -> Track:
    """Lead a person through the routine.

    Args:
        receive: The next pose of the running master, waiting at most so long [s].
        tips: Rows of the five tips among the markers.
        names: Of the markers.
        clock: For the steps.
        notify: Called with one line at a time.

    Raises:
        FitError: No pose comes, or a step was not seen three times.
    """
    track = Track()
    notify("lay the back of the hand on the table, palm to the cameras; it stays there until the end")
    count_down_s = 3
    for count in range(count_down_s, 0, -1):
        notify(f"{count} ...")
        _during(receive, clock, 1.0)
    for number, step in enumerate(STEPS):
        tries = 3
        for _ in range(tries):
            notify(f"{number + 1} of {len(STEPS)}: {step.instruction} ({step.seconds:.0f} s)")
            late_s = 0.4  # users begin after they have read
            poses = _during(receive, clock, step.seconds + late_s)
            lacking = unseen(step, number, poses, tips, names)
            if not lacking:
                track.keep(poses)
                break
            notify(f"{lacking}; back to the flat hand, and this step again")
            _during(receive, clock, 1.0)
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
    # of a step's poses each tip must be in
    poor = [f"{names[tips[f]]} in {100 * seen[f]:.0f} %" for f in wanted if seen[f] < 0.6]
    return f"{step.name}: markers are seen too little: {', '.join(poor)}" if poor else ""


def _during(receive: Receive, clock: Clock, seconds: float) -> list[HandPose]:
    """The poses that come within a time."""
    until = clock.now_ns() + round(1e9 * seconds)
    poses: list[HandPose] = []
    while clock.now_ns() < until:
        wait_s = 0.05
        pose = receive(wait_s)
        if pose is not None:
            poses.append(pose)
    return poses


def observe_live(bus: str, names: tuple[str, ...], model: HandModel) -> Observed:
    """Lead the user through the routine.

    Args:
        bus: Endpoint of the running master's bus.
        names: The rig's markers.
        model: The hand to begin with.

    Raises:
        BusError: Nobody listens there.
        CalibrationError: The master's poses have other markers.
        FitError: The routine was not seen.
    """
    tips = marker_rows(names, model)[:5]
    link = join_bus(bus)
    try:
        depth = 256  # poses that may wait while a line is printed
        poses = link.subscribe("hand", depth=depth)

        def receive(timeout_s: float) -> HandPose | None:
            message = poses.get(timeout_s)
            if message is None or not isinstance(message, HandPose):
                return None
            if len(message.markers_raw_m) != len(names):
                raise CalibrationError(
                    f"the running master has {len(message.markers_raw_m)} markers, the rig {len(names)}: name its"
                    " rig with --rig"
                )
            return message

        track = guide(receive, tips, names, SystemClock(), echo)
    finally:
        link.close()
    return Observed.of(*track.arrays(), names, model)


_BLUE, _GREY = "#2b6cb0", "#9a9a9a"


def draw_hand(path: Path, measurement: HandMeasurement) -> None:
    """Write the picture as PNG.

    Raises:
        RecordingError: The file cannot be written.
    """
    figure = Figure(figsize=(13.0, 6.0), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    _lengths(left, measurement)
    _residuals(right, measurement)
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png")
    except OSError as error:
        raise RecordingError(f"{path}: cannot write the picture: {error.strerror}") from error


def _lengths(axes: Axes, measurement: HandMeasurement) -> None:
    lengths = [
        length
        for length in measurement.lengths
        if len(length.bones) == 1 or length in measurement.parted(length.finger)
    ]
    for row, length in enumerate(lengths):
        axes.errorbar(
            1e3 * (length.length_m - length.scaled_m),
            row,
            xerr=1e3 * CERTAIN * length.sigma_m,
            fmt="o",
            markersize=5,
            capsize=3,
            color=_BLUE if length.measured else _GREY,
        )
    axes.axvspan(-1e3 * WITHIN_M, 1e3 * WITHIN_M, color="#dde7f3", zorder=0)
    axes.axvline(0.0, color=_GREY, linewidth=0.8)
    axes.set_yticks(range(len(lengths)), [length.name for length in lengths], fontsize=8)
    axes.invert_yaxis()
    axes.set(
        xlabel="longer than scaled from the hand length [mm], with 99 %; band: 1 mm",
        title="blue: measured; grey: not determined by the markers",
    )


def _residuals(axes: Axes, measurement: HandMeasurement) -> None:
    observed, off = measurement.observed, measurement.fit.residual_m
    for m, name in enumerate(observed.names):
        axes.plot(
            observed.t_s, 1e3 * np.linalg.norm(off[:, m], axis=-1), ".", markersize=2, label=name, alpha=0.6
        )
    axes.set(
        xlabel="time [s]",
        ylabel="distance of the marker from the fitted hand [mm]",
        title=f"residuals, {1e3 * measurement.rms_m:.2f} mm rms per axis",
    )
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8, markerscale=4)
