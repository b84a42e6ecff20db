"""Kernels of the coupling between MCP and PIP of a hand.

It is learnt from the fingers whose tips are seen.

A natural MCP is a share of the PIP (`master.estimator.flexion_synergy`). But each hand has its own share, and keeps
to it more closely or less. Both are those of a regression through the origin,

    e = MCP - natural MCP,   share = sum(PIP e) / sum(PIP^2),   spread^2 = sum(e^2) / sum(PIP^2) - share^2,

of expected squares, so that a finger that is hardly known feigns no closeness. The sums begin as if some fingers
of usual hands had been seen, and fade back to that.
"""

from math import exp, radians, sqrt

from common.kernels import inner
from master.estimator.finger_scan import Prior, Scan
from master.estimator.settings import Settings
from master.estimator.state import HandState

_BENT_RAD2 = radians(45.0) ** 2  # of a finger that counts as one


@inner
def expect_coupling(settings: Settings, state: HandState, dt_s: float, prior: Prior) -> None:
    """Write the expected coupling share and spread.

    They hold for a time after the last strobe cycle.
    """
    kept, sums = exp(-dt_s / settings.coupled_s), state.coupling
    for i in range(3):
        sums[i] *= kept
    stationary = settings.coupled_fingers * _BENT_RAD2
    squared = stationary + sums[0]
    share = sums[1] / squared
    spread2 = (stationary * settings.coupled_spread**2 + sums[2]) / squared - share * share
    prior.coupled_share[0], prior.coupled_spread[0] = share, sqrt(max(spread2, 0.0))


@inner
def learn_coupling(prior: Prior, f: int, scan: Scan, state: HandState) -> None:
    """Add a finger that laser and tip measure unambiguously."""
    pip, pip2, sums = scan.out[f, 2], scan.pip2[f], state.coupling
    off = scan.out[f, 1] - prior.base_rad[f, 1] - prior.per_pip[f, 1] * pip
    way = scan.way[f, 1] - prior.per_pip[f, 1]
    sums[0] += pip * pip + pip2
    sums[1] += pip * off + way * pip2
    sums[2] += off * off + way * way * pip2
