"""Poses of every solver, to compare kernels with plain Python."""

import numpy as np

from bench.hands.chains import Fabrik
from common.hand.model import FINGERS, HandModel
from common.hand.profiles import generated_profile
from master.fabrik.fabrik import Chain, Link
from master.fabrik.joints import Hinge, Rotor
from master.fabrik.linear_algebra import IDENTITY, as_vector
from master.fabrik.solver import Finger

_SPREAD_M = (0.0, 0.01, 0.04)
"""How far a target is beside a legal one; the last is out of reach for most fingers."""


def poses() -> list[list[float]]:
    """Angles, residual and iterations of each target."""
    return [*_fingers(), *_chains()]


def _fingers() -> list[list[float]]:
    model, rng, found = HandModel.of(generated_profile("made", "left")), np.random.default_rng(8), []
    for k, name in enumerate(FINGERS):
        finger = Finger.of(model, k, model.mounts[name].offset_m)
        low, high = finger.chain.spans.T
        for spread in _SPREAD_M:
            a, f, pip, dip = (low + rng.uniform(0.1, 0.9, 4) * (high - low)).tolist()
            target = np.array(finger.forward((a, f, pip, dip))) + rng.normal(0.0, spread, 3)
            for start in (np.full(4, np.nan), np.array([0.0, 0.4, 0.5, 0.3])):
                residual, iterations, reached = finger.solve(target, start)
                found.append([*start.tolist(), residual, iterations, float(reached)])
    return found


def _chains() -> list[list[float]]:
    links = (
        Link(IDENTITY, Rotor((-1.0, 1.0), (-1.0, 1.0)), (0.0, 0.0, -0.2)),
        Link(IDENTITY, Rotor((-0.4, 0.4), (-0.5, 0.9), shape="ellipse"), (0.0, 0.0, -0.2)),
        Link(IDENTITY, Hinge(-0.6, 0.6, (0.0, 1.0, 0.0), frame="world"), (0.0, 0.0, -0.15)),
        Link(IDENTITY, Hinge(0.0, 1.5), (0.0, 0.0, -0.1)),
    )
    chain, rng, found = Chain(links), np.random.default_rng(3), []
    fabrik = Fabrik.of(chain, 1e-4, max_iterations=10)
    for _ in range(4):
        pose = chain.clamp(rng.uniform(-0.6, 0.9, 6))
        result = fabrik.solve(as_vector(chain.forward(pose)[0][-1]))
        found.append([*result.angles.tolist(), result.residual_m, result.iterations])
    return found
