"""One finger at a time, the palm known: our solvers and others on the same reachable targets.

Targets are the caps of hands whose angles are independent and uniform within the limits, the DIP coupled exactly.
The papers' way begins at its last pose, which is another random one, scipy amid the limits.
"""

import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from bench.hands import draws
from bench.hands.draws import MARKERS, Angles, Draw, Fingers, Score
from bench.report import Row, rms
from common.hand.model import HandModel
from master.fabrik.linear_algebra import Vector
from master.fabrik.solver import Finger

CLOSED, WARM_STARTED, PAPER = "closed form", "FABRIK, seeded", "papers' way"
_SLOW = {PAPER: 10, "scipy": 40}  # one hand in so many
_STRICT_MM = {CLOSED: 1e-3, WARM_STARTED: 0.1}  # by how much these two may miss


def rows(hands: int = 2000) -> list[Row]:
    """Return time per hand of five fingers, targets missed, limits passed and error of the PIP of each way."""
    model = draws.bench_model()
    truth = draws.draw(model, 2, hands, coupling_off_rad=0.0)
    out: list[Row] = []
    for name, way in ways(model).items():
        found, us = timed(model, way, truth.every(_SLOW.get(name, 1)))
        pip = f"PIP {rms(found.pip_deg):.2g} deg RMS, limits passed by {found.worst_deg:.1g} deg"
        out.append(Row(f"{name}: hand of five fingers", us, "us", pip))
        out.append(Row(f"{name}: missed by > 1 mm", found.missed_percent, "%", f"of {found.miss_mm.size}"))
        if (bound_mm := _STRICT_MM.get(name)) is not None:
            missed = float((~(found.miss_mm <= bound_mm)).sum())
            note = f"of {found.miss_mm.size}, goal 0; limit violations {found.violations}, goal 0"
            out.append(Row(f"{name}: missed by > {1e3 * bound_mm:g} um", missed, "targets", note))
    return out


def ways(model: HandModel) -> dict[str, Fingers]:
    """Return every solver by name; each begins afresh."""
    fingers = draws.finger_solvers(model)
    return {
        CLOSED: partial(draws.closed_form, fingers),
        WARM_STARTED: _seeded(model),
        PAPER: draws.PaperFingers(fingers).push,
        "scipy": lambda tips: [draws.scipy_finger(one, tip) for one, tip in zip(fingers, tips, strict=True)],
    }


def _seeded(model: HandModel) -> Fingers:
    fingers = [Finger.of(model, f, model.mount(name).offset_m) for f, name in enumerate(MARKERS[:5])]

    def way(tips: Sequence[Vector]) -> Angles:
        angles = np.full((5, 4), np.nan)
        for finger, tip, row in zip(fingers, tips, angles, strict=True):
            finger.solve(np.array(tip), row)
        return angles.tolist()

    return way


def timed(model: HandModel, way: Fingers, truth: Draw) -> tuple[Score, float]:
    """Return the errors of a way, and its median processor time per hand, of ten parts [us]."""
    targets = [draws.tips_in_palm(T, caps) for T, caps in zip(truth.T_rig_palm, truth.caps_m, strict=True)]
    found: list[Angles] = []
    times: list[float] = []
    parts = 10
    size = max(1, len(targets) // parts)
    for k in range(0, len(targets), size):
        start = time.thread_time()
        found += [way(tips) for tips in targets[k : k + size]]
        times.append(1e6 * (time.thread_time() - start) / len(targets[k : k + size]))
    found_score = draws.score(model, truth, truth.T_rig_palm, np.array(found), truth.caps_m)
    return found_score, float(np.median(times))
