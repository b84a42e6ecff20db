"""How far a finger's point is from its root, as a function of PIP, and the way back: distance -> PIP.

With DIP = ratio * PIP the point lies at w(PIP) in the root joint's frame, whatever flexion and abduction are.
|w| falls monotonically with PIP except near the straight finger, where a hand whose rest pose is not quite
straight first gets longer. The range is cut there (and where the DIP meets its own limit, a kink) into branches.
Each is tabulated over s = sqrt(|w|_far^2 - |w|^2): PIP and w are smooth in s, also where d|w|/dPIP = 0.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import cos, sin, sqrt

import numpy as np

from common.arrays import Float
from master.ik.chain import Chain
from master.ik.joints import Hinge
from master.ik.vectors import Vector, dot, rotate

_CELLS = 2048
_GRID = 2001
_BISECTIONS = 52
_Row = tuple[float, float, float, float, float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """A stretch on which |w| is monotone.

    Attributes:
        near2, far2: Lowest and highest |w|^2 [m^2].
        per_cell: Cells per s [1/m].
        rows: Value and step over the cell of PIP, w_x, w_y, w_z.
    """

    near2: float
    far2: float
    per_cell: float
    rows: list[_Row]

    def at(self, distance2: float) -> tuple[float, Vector]:
        """PIP [rad] and w [m] of a squared distance [m^2], clamped to the branch."""
        u = sqrt(self.far2 - distance2) * self.per_cell if distance2 < self.far2 else 0.0
        i = min(int(u), _CELLS - 1)
        u = min(u - i, 1.0)
        pip, d_pip, x, dx, y, dy, z, dz = self.rows[i]
        return pip + u * d_pip, (x + u * dx, y + u * dy, z + u * dz)

    def slope(self, distance2: float) -> Vector:
        """dw/dPIP [m/rad] at a squared distance [m^2]; zero on a branch without extent."""
        u = sqrt(self.far2 - distance2) * self.per_cell if distance2 < self.far2 else 0.0
        _, d_pip, _, dx, _, dy, _, dz = self.rows[min(int(u), _CELLS - 1)]
        return (dx / d_pip, dy / d_pip, dz / d_pip) if d_pip != 0.0 else (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class ReachCurve:
    """w(PIP) of one finger, for many angles at once and, from the links, for single ones.

    Attributes:
        chain: The finger.
        bones: The three bone vectors (3, 3) [m], each in its joint's frame.
        turns: Rest turns (2, 3, 3) of PIP and DIP.
        ratio: DIP per PIP.
        pip, dip: Low and high [rad].
    """

    chain: Chain
    bones: Float
    turns: Float
    ratio: float
    pip: tuple[float, float]
    dip: tuple[float, float]

    @classmethod
    def of(cls, chain: Chain, ratio: float) -> "ReachCurve":
        """Of a finger's chain: a rotor, then two hinges about the joints' own x.

        Raises:
            ValueError: The chain is not a finger.
        """
        spans: list[tuple[float, float]] = []
        for link in chain.links[1:]:
            if not isinstance(link.joint, Hinge) or link.joint.axis != (-1.0, 0.0, 0.0):
                raise ValueError("a finger is a rotor and two flexion hinges")
            spans.append((link.joint.low_rad, link.joint.high_rad))
        bones = np.array([link.bone for link in chain.links])
        turns = np.array([link.turn for link in chain.links[1:]])
        return cls(chain, bones, turns, ratio, spans[0], spans[1])

    def point(self, pip: Float) -> Float:
        """w (N, 3) [m] at PIP angles (N,) [rad]."""
        dip = np.clip(self.ratio * pip, *self.dip)
        inner = self.bones[1] + _flexed(dip, self.bones[2]) @ self.turns[1].T
        return self.bones[0] + _flexed(pip, inner) @ self.turns[0].T

    def distance2(self, pip: Float) -> Float:
        """|w|^2 (N,) [m^2] at PIP angles (N,) [rad]."""
        return (self.point(pip) ** 2).sum(axis=-1)

    def place(self, pip: float, dip: float) -> Vector:
        """w [m] of one PIP and any DIP [rad], the DIP cut at its limits."""
        first, middle, last = self.chain.links
        low, high = self.dip
        x, y, z = rotate(last.turn, flexed(min(max(dip, low), high), last.bone))
        bone = middle.bone
        x, y, z = rotate(middle.turn, flexed(pip, (bone[0] + x, bone[1] + y, bone[2] + z)))
        return first.bone[0] + x, first.bone[1] + y, first.bone[2] + z

    def exact(self, branch: Branch, distance2: float) -> tuple[float, Vector]:
        """PIP and w without the table's error: two Newton steps with the table's slope."""
        pip, w = branch.at(distance2)
        low, high = self.pip
        for _ in range(2):
            dw = branch.slope(distance2)
            slope = 2.0 * dot(w, dw)
            w = self.place(pip, self.ratio * pip)
            off = min(max(distance2, branch.near2), branch.far2) - dot(w, w)
            if abs(slope) > 1e-6 * branch.far2:
                pip = min(max(pip + off / slope, low), high)
        return pip, self.place(pip, self.ratio * pip)

    def branches(self) -> tuple[Branch, ...]:
        """All monotone stretches, the most bent one first."""
        low, high = self.pip
        grid = np.linspace(low, high, _GRID)
        rising = np.diff(self.distance2(grid)) > 0.0
        cuts = {low, high}
        for i in np.flatnonzero(rising[1:] != rising[:-1]):
            cuts.add(self._extremum(float(grid[i]), float(grid[i + 2]), maximum=bool(rising[i])))
        if self.ratio > 0.0:
            cuts |= {bound / self.ratio for bound in self.dip if low < bound / self.ratio < high}
        edges = sorted(cuts)
        spans = list(pairwise(edges)) or [(low, high)]
        return tuple(self._branch(a, b) for a, b in reversed(spans))

    def _extremum(self, low: float, high: float, *, maximum: bool) -> float:
        """By thirds: the curve is smooth and has one extremum inside."""
        for _ in range(_BISECTIONS):
            third = (high - low) / 3.0
            a, b = self.distance2(np.array([low + third, high - third]))
            if (a < b) == maximum:
                low += third
            else:
                high -= third
        return 0.5 * (low + high)

    def _branch(self, low: float, high: float) -> Branch:
        ends = self.distance2(np.array([low, high]))
        near2, far2 = float(ends.min()), float(ends.max())
        straight, bent = (low, high) if ends[0] >= ends[1] else (high, low)
        s = np.linspace(0.0, sqrt(far2 - near2), _CELLS + 1)
        wanted = far2 - s * s
        a, b = np.full_like(s, straight), np.full_like(s, bent)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (a + b)
            beyond = self.distance2(middle) < wanted
            a, b = np.where(beyond, a, middle), np.where(beyond, middle, b)
        pip = 0.5 * (a + b)
        pip[0], pip[-1] = straight, bent
        values = np.column_stack([pip, self.point(pip)])
        cells = np.stack([values[:-1], np.diff(values, axis=0)], axis=2).reshape(_CELLS, 8)
        rows: list[_Row] = [(a, b, c, d, e, f, g, h) for a, b, c, d, e, f, g, h in cells.tolist()]
        return Branch(near2, far2, _CELLS / s[-1] if s[-1] > 0.0 else 0.0, rows)


def _flexed(angle: Float, vector: Float) -> Float:
    """R_x(-angle) vector: angles (N,), vector (3,) or (N, 3); (N, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = np.moveaxis(vector, -1, 0)
    return np.stack([x + 0.0 * c, c * y + s * z, c * z - s * y], axis=-1)


def flexed(angle: float, vector: Vector) -> Vector:
    """R_x(-angle) vector, single numbers."""
    c, s = cos(angle), sin(angle)
    x, y, z = vector
    return x, c * y + s * z, c * z - s * y
