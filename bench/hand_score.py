"""How far found hands are from the truth: one ruler for every solver in the benchmark."""

from dataclasses import dataclass

import numpy as np

from bench.hand_draws import Draw
from common.arrays import Float
from common.hand.model import HandModel

MISSED_MM = 1.0
_TIPS = ("thumb", "index", "middle", "ring", "little")


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Errors of N hands, those without a finite answer left out.

    Attributes:
        joints_mm: (N,) mean distance of the 26 joints of a hand.
        pip_deg: (N, 4) index ... little; the thumb has no PIP.
        miss_mm: (N, 5) distance of each tip's cap to the cap that was asked for.
        violations: Angles outside their limits.
        worst_deg: By how much the worst of them is outside.
        not_finite: Hands without a finite answer.
        hands: Those included.
    """

    joints_mm: Float
    pip_deg: Float
    miss_mm: Float
    violations: int
    worst_deg: float
    not_finite: int
    hands: int

    @property
    def missed_percent(self) -> float:
        """Tips farther than 1 mm from their cap [%]."""
        return 100.0 * float((self.miss_mm > MISSED_MM).mean())

    @property
    def pip_rms_deg(self) -> float:
        """Root mean square of the errors of the PIP."""
        return float(np.sqrt(np.square(self.pip_deg).mean()))


def score(model: HandModel, truth: Draw, T_rig_palm: Float, angles_rad: Float, asked_m: Float) -> Score:
    """Hold found palms (N, 4, 4) and angles (N, 5, 4) [rad] against the truth and the caps (N, M, 3) [m] asked for.

    A solver that found nothing gives NaN.
    """
    numbers = np.concatenate([angles_rad.reshape(-1, 20), T_rig_palm.reshape(-1, 16)], axis=1)
    finite = np.isfinite(numbers.sum(axis=1))
    angles, T = angles_rad[finite], T_rig_palm[finite]
    joints = model.forward(T, angles)
    off_m = joints.position_m - truth.joints_m[finite]
    miss_m = model.marker_points(joints, _TIPS) - asked_m[finite, : len(_TIPS)]
    return Score(
        joints_mm=1e3 * np.sqrt(np.vecdot(off_m, off_m)).mean(axis=-1),
        pip_deg=np.degrees(np.abs(angles[:, 1:, 2] - truth.angles_rad[finite, 1:, 2])),
        miss_mm=1e3 * np.sqrt(np.vecdot(miss_m, miss_m)),
        violations=int((~model.within_limits(angles)).sum()),
        worst_deg=float(np.degrees(np.abs(angles - model.clamp(angles)).max(initial=0.0))),
        not_finite=int((~finite).sum()),
        hands=len(finite),
    )
