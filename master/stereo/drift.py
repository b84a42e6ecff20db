"""How far a hand may have drifted along the sight while nothing placed it: every marker was seen by one camera alone.

Each marker is then put on its ray as deep as it was believed a moment ago (`MarkerPipeline`), so the fit is as sure of
its depth as of the last frame's, for ever. It is no witness: perspective tells the depth of a hand to centimetres only,
and a hand moves towards a camera as it moves anywhere else. So what was known when two cameras last placed a marker
grows old: by `SPEED_M_S` along the sight. A joint that is known no better than `OBSERVED_M` is not tracked any more.
"""

from dataclasses import replace

import numpy as np

from common.arrays import Float
from master.ik.tracker import TrackedHand

SPEED_M_S = (
    0.08  # simulated hands that one camera saw were 20 to 30 mm off after 0.6 s, 60 mm after some seconds
)
LONGEST_M = 0.15  # as far as the volume goes
OBSERVED_M = 0.03


class DepthDrift:
    """Push machine. Holds when a marker was last placed by two cameras."""

    def __init__(self) -> None:
        """Nothing was placed yet."""
        self._placed_ns: int | None = None

    def push(self, t_ns: int, hand: TrackedHand, *, placed: bool, seen: bool, sight: Float) -> TrackedHand:
        """Return the hand with covariances and bits as honest as its depth is known.

        Args:
            t_ns: The instant.
            hand: As solved.
            placed: Whether two cameras placed a marker of it at this instant.
            seen: Whether any camera saw one. A hand that nobody sees is doubted elsewhere.
            sight: (3,) unit vector along which it may drift, rig frame.
        """
        if placed or self._placed_ns is None:
            self._placed_ns = t_ns
        if placed or not seen or hand.solution is None:
            return hand
        sigma_m = min(SPEED_M_S * (t_ns - self._placed_ns) * 1e-9, LONGEST_M)
        cov = hand.solution.cov_m2 + sigma_m**2 * np.outer(sight, sight)
        tracked = hand.tracked & (sigma_m < OBSERVED_M)
        return replace(hand, solution=replace(hand.solution, cov_m2=cov), tracked=tracked)
