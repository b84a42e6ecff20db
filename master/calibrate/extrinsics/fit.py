"""Maximum a posteriori estimate of the mounting.

First fits a part of the motion from several guesses, then all of it from the best one.
"""

from collections.abc import Sequence

import numpy as np

from common.hand.model import HandModel
from master.calibrate.extrinsics.lines_of_sight import LinesOfSight
from master.calibrate.extrinsics.problem import Problem
from master.calibrate.extrinsics.seen import Fit, StrobeCycles
from master.calibrate.extrinsics.tracks import HandTrack, ImuTrack
from master.calibrate.extrinsics.unknown import Unknown

_COARSE_ROUNDS = (4, 4, 4)  # epochs and steps of a first look
_ROUNDS = (5, 5, 8)  # steps from one linearisation of the tracks to the next


def fit_extrinsics(
    lines_of_sight: LinesOfSight,
    model: HandModel,
    names: tuple[str, ...],
    hand: HandTrack,
    imu: ImuTrack,
    cycles: StrobeCycles,
    px_per_m: float,
    firsts: Sequence[Unknown],
) -> Fit:
    """Fit the mounting.

    Args:
        sights: Forward function of the device.
        model: The hand.
        names: Of the markers, in the order of the track's.
        hand, imu: What was seen of the hand, and felt.
        cycles: What was seen from the wrist.
        px_per_m: What a metre at the tips is in the image.
        firsts: First guesses, of which one is right to some 15 degrees, 15 mm and 20 ms.
    """
    # epochs and steps of a first look
    some = np.unique(np.linspace(0, len(cycles.t_s) - 1, 40).astype(np.int64))
    coarse = cycles.of(some)
    best: tuple[float, Unknown] | None = None
    for first in firsts:
        problem = Problem(lines_of_sight, model, names, hand, imu, coarse, px_per_m, first)
        unknown, hands, _ = problem.followed(first, _COARSE_ROUNDS)
        if best is None or problem.cost(unknown, hands) < best[0]:
            best = problem.cost(unknown, hands), unknown
    first = firsts[0] if best is None else best[1]
    problem = Problem(lines_of_sight, model, names, hand, imu, cycles, px_per_m, first)
    return problem.result(*problem.followed(first, _ROUNDS))
