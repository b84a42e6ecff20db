"""Depth of a moving hand from cameras that nobody synchronised: what pairing makes of it, by rate, offset and motion.

First exact projections with rolling shutter, exposure and noise through pairing and triangulation, many seeds; then
rendered frames through the real detector and the whole pipeline. Baseline: frames paired by their number.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from bench import sync_hands
from bench.row import Row
from bench.sync_frames import rendered
from bench.sync_rig import MOTIONS, Outcome, Shooting, Treatment, outcome

RATES_HZ = (30.0, 60.0, 90.0)
OFFSETS_MS = (0.0, 2.0, 4.2, 6.2, 8.3, 10.4, 12.5, 16.7)
POLICIES: tuple[Treatment, ...] = ("interpolate", "predict")
SEEDS = range(2)
GOAL, STRETCH = 2.0, 0.5  # %


def rows() -> list[Row]:
    """Depth errors [%], coverage [%], waiting [ms]; worst offset, with the others in the note."""
    return [*_uncorrected(), *_corrected(), *_time(), *_exposures(), *_rendered(), *sync_hands.rows()]


def at_offsets(motion: str, rate_hz: float, treatment: Treatment, seeds: range = SEEDS) -> list[Outcome]:
    """One outcome for each offset."""
    return [
        outcome(MOTIONS[motion], Shooting(rate_hz, offset_ms * 1e-3), treatment, seeds)
        for offset_ms in OFFSETS_MS
    ]


def _uncorrected() -> Iterator[Row]:
    for rate in RATES_HZ:
        for treatment in ("uncorrected", "row time ignored"):
            found = at_offsets("crossing", rate, treatment, range(1))
            yield _errors(f"{rate:.0f} Hz, crossing at 1 m/s, {treatment}", found, "baseline")
            across = np.concatenate([one.across_mm for one in found])
            yield Row("  error across the sight, p95", float(np.percentile(across, 95)), "mm", "")


def _corrected() -> Iterator[Row]:
    for policy in POLICIES:
        for rate in RATES_HZ:
            for motion in MOTIONS:
                found = at_offsets(motion, rate, policy)
                yield _errors(
                    f"{rate:.0f} Hz, {motion}, {policy}", found, f"goal {GOAL:g}, stretch {STRETCH:g}"
                )
                covered = [one.covered for one in found]
                yield Row(
                    "  95 % regions cover, least",
                    min(covered),
                    "%",
                    f"most {max(covered):.1f}; goal 90 to 98",
                )
                if motion == "rest":
                    yield _jitter(found)
                    waited = 1e3 * np.concatenate([one.waited_s for one in found])
                    yield Row(
                        "  waits for the other camera, mean",
                        float(waited.mean()),
                        "ms",
                        f"most {waited.max():.1f}",
                    )


def _errors(name: str, found: Sequence[Outcome], goal: str) -> Row:
    p95 = [float(np.percentile(np.abs(one.depth), 95)) for one in found]
    every = np.abs(np.concatenate([one.depth for one in found]))
    note = f"median {np.median(every):.2f}, max {every.max():.2f}; {goal}; p95 by offset " + " ".join(
        f"{value:.2f}" for value in p95
    )
    return Row(f"{name}: p95", max(p95), "%", note)


def _jitter(found: Sequence[Outcome]) -> Row:
    """Of a hand laid down: standard deviation of its depth at half a metre."""
    spread = [float(one.depth.std()) * 5.0 for one in found]
    plain = outcome(MOTIONS["rest"], Shooting(60.0, 0.0), "uncorrected", SEEDS)
    return Row(
        "  depth jitter, worst offset",
        max(spread),
        "mm",
        f"least {min(spread):.2f}; of single frames {plain.depth.std() * 5:.2f}",
    )


def _time() -> Iterator[Row]:
    for t_sigma_ms in (0.1, 0.3, 1.0):
        for motion in ("crossing", "swing 10 cm"):
            shooting = Shooting(60.0, 6e-3, t_sigma_s=t_sigma_ms * 1e-3)
            found = outcome(MOTIONS[motion], shooting, "interpolate", range(30))
            yield Row(
                f"60 Hz, {motion}, stamps wrong by {t_sigma_ms} ms (sd): 95 % cover",
                found.covered,
                "%",
                "goal 90 to 98",
            )


def _exposures() -> Iterator[Row]:
    for exposure_ms in ((15.0, 15.0), (2.0, 15.0)):
        shooting = Shooting(60.0, 8.3e-3, exposure_s=(exposure_ms[0] * 1e-3, exposure_ms[1] * 1e-3))
        found = outcome(MOTIONS["swing 10 cm"], shooting, "interpolate", SEEDS)
        name = f"60 Hz, swing 10 cm, exposures {exposure_ms[0]:.0f} and {exposure_ms[1]:.0f} ms"
        yield _errors(name, [found], f"goal {GOAL:g}")


def _rendered() -> Iterator[Row]:
    for rate in RATES_HZ:
        for treatment in ("uncorrected", *POLICIES):
            found = {offset_ms: rendered(rate, offset_ms * 1e-3, treatment) for offset_ms in (0.0, 8.3, 16.7)}
            every = np.abs(np.concatenate(list(found.values())))
            by_offset = " ".join(f"{np.percentile(np.abs(one), 95):.2f}" for one in found.values())
            yield Row(
                f"{rate:.0f} Hz, rendered hand swinging 15 cm, {treatment}: p95",
                max(float(np.percentile(np.abs(one), 95)) for one in found.values()),
                "%",
                f"median {np.median(every):.2f}, max {every.max():.2f}; p95 at 0, 8.3, 16.7 ms {by_offset}",
            )
