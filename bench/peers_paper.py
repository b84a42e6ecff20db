"""The hand as the papers solve it: the palm's orientation taken as fixed, and each finger on its own from its cap.

The back marker places the palm, which is believed to face the cameras. Then each finger is constrained FABRIK from
its last pose, with DIP = 2/3 PIP, without a seed from the closed form and without restarts (Kalbfleisch, with the
library Caliko, which is Java and not run here). Ours has the limits in both passes and aims the root first. Of
Caliko itself, warm, on reachable targets of a hand's five fingers, it is on record from before this project: 55 to
157 us per hand, 65 to 69 % missed by more than 1 mm, limits passed by up to 180 degrees, PIP 30 to 36 degrees RMS off.

The closed form with the same palm shows which part of an error is FABRIK's and which is the palm's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from bench.hand_draws import BACK, FACING_ROTATION, MARKERS
from common.arrays import Float
from common.geometry.transforms import rigid
from common.hand.model import HandModel
from master.fabrik.chain import Pose
from master.fabrik.fabrik import Fabrik
from master.fabrik.finger import FingerSolver
from master.fabrik.rotations import Vector, as_vector

Angles = Sequence[Sequence[float]]  # (5, 4) [rad]
Fingers = Callable[[Sequence[Vector]], Angles]  # five tips [m] in the palm frame -> angles


def finger_solvers(model: HandModel) -> list[FingerSolver]:
    """The closed form of the five fingers, each to its cap."""
    return [FingerSolver.of(model, f, model.mount(name).offset_m) for f, name in enumerate(MARKERS[:5])]


def fixed_palm(model: HandModel, points_m: Float, rotation: Float = FACING_ROTATION) -> Float:
    """Palm pose (4, 4): orientation believed, placed by the back marker of caps (M, 3) [m]."""
    return rigid(rotation, points_m[BACK] - rotation @ model.mount("back").offset_m)


def tips_in_palm(T_rig_palm: Float, points_m: Float) -> list[Vector]:
    """Caps of the five tips [m] in the palm frame, from caps (M, 3) [m]."""
    return [as_vector(p) for p in (points_m[:5] - T_rig_palm[:3, 3]) @ T_rig_palm[:3, :3]]


@dataclass(slots=True)
class PaperFingers:
    """Warm constrained FABRIK. Holds the last pose of each finger, from which the next search starts."""

    closed: list[FingerSolver]
    fabrik: list[Fabrik] = field(init=False)
    last: list[Pose | None] = field(init=False)

    def __post_init__(self) -> None:
        self.fabrik = [Fabrik.of(solver.chain, restarts=0) for solver in self.closed]
        self.last = [None] * len(self.closed)

    def push(self, tips_m: Sequence[Vector]) -> Angles:
        """Angles (5, 4) [rad] for the five tips [m] in the palm frame."""
        out: list[list[float]] = []
        for f, (fabrik, closed) in enumerate(zip(self.fabrik, self.closed, strict=True)):
            found = fabrik.solve(tips_m[f], self.last[f], closed.root)
            self.last[f] = found.angles
            out.append([q for joint in found.angles for q in joint])
        return out


def closed_form(solvers: Sequence[FingerSolver], tips_m: Sequence[Vector]) -> Angles:
    """Angles (5, 4) [rad] for the five tips [m] in the palm frame, finger by finger."""
    return [solver.solve(tip)[:4] for solver, tip in zip(solvers, tips_m, strict=True)]
