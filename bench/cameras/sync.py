"""Depth of a moving hand from unsynchronised cameras: errors by rate, offset, motion and treatment.

First exact projections with rolling shutter, exposure and noise through synchronisation and triangulation
(`bench.cameras.unsynchronised`), many seeds; then rendered frames through the real detector and the whole pipeline.
Baseline: frames paired by their number. `--picture FILE` draws the error against the offset.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
from matplotlib.axes import Axes

from bench.cameras.unsynchronised import MOTIONS, SPEED_M_S, Outcome, Shooting, Treatment, outcome
from bench.played import START_NS, Watched, solve, watch
from bench.report import CALIBRATION, Row, figure, rig_files
from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.sim.motion import REST, HandState, angles_of, base_pose
from common.sim.scene import Scene, view_centre
from master.rig.setup import RigSetup, load_setup

RATES_HZ = (30.0, 60.0, 90.0)
_OFFSETS_MS = (0.0, 2.0, 4.2, 6.2, 8.3, 10.4, 12.5, 16.7)
_POLICIES: tuple[Treatment, ...] = ("interpolate", "predict")
_SEEDS = range(2)
_GOAL, _STRETCH = 2.0, 0.5  # %
_AMPLITUDE_M, _SECONDS, _WARM_S = (
    0.15,
    0.9,
    0.25,
)  # of the rendered swing; warm: until the detector has tracks
_LINES: tuple[tuple[str, Treatment, str, str], ...] = (
    ("crossing", "uncorrected", "crossing, frames paired by number", "#b0473a"),
    ("swing 10 cm", "predict", "swing of 10 cm, predict", "#e0a030"),
    ("crossing", "predict", "crossing, predict", "#7a5c00"),
    ("swing 10 cm", "interpolate", "swing of 10 cm, interpolate", "#6fb0d8"),
    ("crossing", "interpolate", "crossing, interpolate (default)", "#14507a"),
)


def rows() -> Iterator[Row]:
    """Measure depth errors [%], coverage [%] and waiting [ms]; worst offset, with the others in the note."""
    for rate in RATES_HZ:
        for treatment in ("uncorrected", "row time ignored"):
            found = _at_offsets("crossing", rate, treatment, range(1))
            across = np.percentile(np.concatenate([one.across_mm for one in found]), 95)
            note = f"baseline; across the line of sight {across:.1f} mm"
            yield _errors(f"{rate:.0f} Hz, crossing at 1 m/s, {treatment}", found, note)
    for policy in _POLICIES:
        for rate in RATES_HZ:
            yield from _corrected(policy, rate)
    for t_sigma_ms in (0.1, 0.3, 1.0):
        for motion in ("crossing", "swing 10 cm"):
            shooting = Shooting(60.0, 6e-3, t_sigma_s=t_sigma_ms * 1e-3)
            found = outcome(MOTIONS[motion], shooting, "interpolate", range(30))
            name = f"60 Hz, {motion}, stamps wrong by {t_sigma_ms} ms (sd): 95 % cover"
            yield Row(name, found.covered, "%", "goal 90 to 98")
    for exposures in ((0.015, 0.015), (0.002, 0.015)):
        found = outcome(
            MOTIONS["swing 10 cm"], Shooting(60.0, 8.3e-3, exposure_s=exposures), "interpolate", _SEEDS
        )
        name = f"60 Hz, swing 10 cm, exposures {1e3 * exposures[0]:.0f} and {1e3 * exposures[1]:.0f} ms"
        yield _errors(name, [found], f"goal {_GOAL:g}")
    for rate in RATES_HZ:
        for treatment in ("uncorrected", *_POLICIES):
            errors = [np.abs(rendered(rate, 1e-3 * ms, treatment)) for ms in (0.0, 8.3, 16.7)]
            p95 = [float(np.percentile(one, 95)) for one in errors]
            every = np.concatenate(errors)
            note = f"median {np.median(every):.2f}, max {every.max():.2f}; p95 at 0, 8.3, 16.7 ms"
            name = f"{rate:.0f} Hz, rendered hand swinging 15 cm, {treatment}: p95"
            yield Row(name, max(p95), "%", f"{note} {' '.join(f'{value:.2f}' for value in p95)}")


def _at_offsets(motion: str, rate_hz: float, treatment: Treatment, seeds: range = _SEEDS) -> list[Outcome]:
    """One outcome for each offset."""
    return [outcome(MOTIONS[motion], Shooting(rate_hz, 1e-3 * ms), treatment, seeds) for ms in _OFFSETS_MS]


def _corrected(policy: Treatment, rate: float) -> Iterator[Row]:
    for motion in MOTIONS:
        found = _at_offsets(motion, rate, policy)
        yield _errors(f"{rate:.0f} Hz, {motion}, {policy}", found, f"goal {_GOAL:g}, stretch {_STRETCH:g}")
        covered = [one.covered for one in found]
        yield Row("  95 % regions cover, least", min(covered), "%", f"most {max(covered):.1f}; goal 90 to 98")
        if motion == "rest":  # a hand laid down: standard deviation of its depth at half a metre
            spread = [float(one.depth.std()) * 5.0 for one in found]
            plain = outcome(MOTIONS["rest"], Shooting(60.0, 0.0), "uncorrected", _SEEDS).depth.std() * 5.0
            note = f"least {min(spread):.2f}; of single frames {plain:.2f}"
            yield Row("  depth jitter, worst offset", max(spread), "mm", note)
            waited = 1e3 * np.concatenate([one.waited_s for one in found])
            note = f"most {waited.max():.1f}"
            yield Row("  waits for the other camera, mean", float(waited.mean()), "ms", note)


def _errors(name: str, found: Sequence[Outcome], note: str) -> Row:
    p95 = [float(np.percentile(np.abs(one.depth), 95)) for one in found]
    every = np.abs(np.concatenate([one.depth for one in found]))
    by_offset = " ".join(f"{value:.2f}" for value in p95)
    spread = f"median {np.median(every):.2f}, max {every.max():.2f}"
    return Row(f"{name}: p95", max(p95), "%", f"{spread}; {note}; p95 by offset {by_offset}")


@dataclass(frozen=True, slots=True, eq=False)
class Swing:
    """The resting posture moved along x; the speed at the middle is SPEED_M_S."""

    setup: RigSetup

    @property
    def period_s(self) -> float:
        """Of the swing [s]."""
        return 2.0 * np.pi * _AMPLITUDE_M / SPEED_M_S

    def at(self, t_s: float) -> HandState:
        """Return the hand at time `t_s` [s]."""
        shift = np.array([_AMPLITUDE_M * np.sin(SPEED_M_S / _AMPLITUDE_M * t_s), 0.0, 0.0])
        posture = np.array(REST, dtype=np.float64)
        T = base_pose(self.setup.hand, view_centre(self.setup.rig), shift, np.zeros(3))
        return HandState(T, angles_of(self.setup.hand, posture, np.zeros((5, 4))))


@cache
def _scene(rate_hz: float) -> tuple[RigSetup, Scene]:
    setup = load_setup(CALIBRATION, "desk")
    cameras = {n: msgspec.structs.replace(c, frame_rate_hz=rate_hz) for n, c in setup.cameras.items()}
    scene = Scene.of_motion(setup.rig, cameras, rig_files("desk")[2], Swing(setup))
    return replace(setup, cameras=cameras), scene


@cache
def _monitored(rate_hz: float, offset_s: float) -> tuple[Watched, ...]:
    setup, scene = _scene(rate_hz)
    times = np.arange(round(_SECONDS * rate_hz)) / rate_hz
    return tuple(watch(scene, name, times + c * offset_s) for c, name in enumerate(setup.rig.cameras))


def rendered(rate_hz: float, offset_s: float, treatment: Treatment) -> Float:
    """Return errors of depth [%] of all caps of a rendered swing at all instants, before the filter."""
    setup, scene = _scene(rate_hz)
    watched = _monitored(rate_hz, offset_s)
    if treatment == "predict":
        setup = replace(setup, rig=msgspec.structs.replace(setup.rig, frame_sync="predict"))
    if treatment == "uncorrected":  # the k-th frame with the k-th of the other camera
        watched = tuple(_by_number(one, rate_hz) for one in watched)
        models: dict[str, CameraModel] = {n: replace(m, row_time_ns=0.0) for n, m in setup.models.items()}
        setup = replace(setup, models=models)
    errors: list[Float] = []
    for pose in solve(setup, watched)[0]:
        t_s = (pose.t_ns - START_NS) * 1e-9
        if t_s > _WARM_S:
            truth = scene.truth(t_s).markers_m[:, 2]
            error = 100.0 * (pose.markers_raw_m[:, 2] - truth) / truth
            errors.append(error[np.isfinite(error)])
    return np.concatenate(errors)


def _by_number(watched: Watched, rate_hz: float) -> Watched:
    times = [START_NS + round(m.seq * 1e9 / rate_hz) for m in watched.messages]
    pairs = zip(watched.messages, times, strict=True)
    return replace(watched, messages=tuple(msgspec.structs.replace(m, t_ns=t) for m, t in pairs))


def picture(file: Path) -> None:
    """Draw the error of depth against the offset of two cameras, by rate and treatment."""
    made = figure(11.0, 4.2)
    panels: list[Axes] = []
    for k, rate in enumerate(RATES_HZ):
        panels.append(made.add_subplot(1, len(RATES_HZ), k + 1, sharey=panels[0] if panels else None))
        _panel(panels[-1], rate)
    panels[0].set_ylabel("error of depth, 95 % of places [%]")
    panels[1].set_xlabel("second camera later by [ms]")
    lines = panels[0].get_legend_handles_labels()
    made.legend(*lines, fontsize=8, loc="outside lower center", ncols=len(_LINES))
    made.savefig(file)


def _panel(axes: Axes, rate_hz: float) -> None:
    offsets = np.linspace(0.0, 16.7, 25)
    for motion, treatment, label, colour in _LINES:
        found = [outcome(MOTIONS[motion], Shooting(rate_hz, 1e-3 * ms), treatment, _SEEDS) for ms in offsets]
        error = [float(np.percentile(np.abs(one.depth), 95)) for one in found]
        axes.plot(offsets, error, color=colour, label=label, linewidth=1.8)
    for value, name in ((_GOAL, "goal"), (_STRETCH, "stretch")):
        axes.axhline(value, color="#555555", linewidth=0.8, linestyle=":")
        axes.text(3.5, value * 1.04, f"{name} {value:g} %", fontsize=8, color="#555555")
    axes.set_yscale("log")
    axes.set_ylim(0.15, 40.0)
    axes.set_yticks([0.2, 0.5, 1, 2, 5, 10, 20], ["0.2", "0.5", "1", "2", "5", "10", "20"])
    axes.minorticks_off()
    axes.set_title(f"{rate_hz:.0f} Hz", fontsize=10)
    axes.grid(alpha=0.25)
    axes.label_outer()
