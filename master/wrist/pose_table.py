"""What would be seen of every finger over a grid of its poses, and which nodes of it explain best what was seen.

Row D16 asks for the global minimum of an energy: brute force over a grid, then refinement. A node stands for its cell,
so what was seen may differ from the node's by what half a step makes of it: that variance is part of the node's
weight, and much more than the noise. So the weights are constants of the table, and the energy of all nodes, a sum of
squares, is one product of matrices:  sum w (y - o)^2 = sum w y^2 - 2 (w y) o + w o^2.
"""

from typing import Protocol

import numpy as np
import numpy.typing as npt

from common.arrays import Bool, Float, Int
from master.wrist.finger_poses import SEEN, UNKNOWNS, FingerPoses
from master.wrist.forward import continued
from master.wrist.laser_cut import LaserCut
from master.wrist.setup import WristSetup

SHAPE = (7, 21, 25)  # nodes of abduction, flexion, PIP: the latter two every five degrees
_RAYS = 24
_LEAST = np.array([1e-3, 1e-3, 1e-2, 1e-2])  # of a cell's deviation: 1 mm on the plane, 1 cm of a tip at 1 m
_MISSED = 1e6
_PLAUSIBLE = (
    40.0  # of the energy of a node next to which a pose may lie: half a step aside in all directions is 36
)
_CORNERS = np.array(np.unravel_index(np.arange(8), (2, 2, 2))).T  # (8, 3)
_LAST_CELL = np.array(SHAPE) - 2.0


class Forward(Protocol):
    """What is seen of every finger in any of its poses, from a table or in closed form. As of `PoseTable`."""

    first: Float
    step: Float
    met: Bool
    exact: bool

    def candidates(self, seen: Float) -> tuple[Float, Float]:
        """Poses that may explain what was seen, one for each PIP."""
        ...

    def starts(self, seen: Float, finger: int, count: int) -> Float:
        """More of them, of one finger."""
        ...

    def views(self, x: Float, finger: Int) -> tuple[Float, Float, Float]:
        """What is seen of poses, its derivatives, and the length of the line."""
        ...

    def points(self, x: Float, finger: Int) -> Float:
        """Laser points alone."""
        ...

    def mended(self, x: Float, finger: Int, y: Float) -> tuple["Forward", Float]:
        """The same, as exact as a valley asks for at these poses, and what is seen of them then."""
        ...

    def doubt(self, x: Float, finger: Int) -> Float:
        """By how much the laser points may be wrong, twice."""
        ...


class PoseTable:
    """The table of one device and hand. What it holds was prepared by the constructor, which takes about a second.

    Attributes:
        first, step: (5, 3) [rad] the lowest node, and from node to node.
        met: (5,) whether the laser meets the finger in any pose.
        exact: It is as exact as a valley asks for.
    """

    def __init__(self, setup: WristSetup, poses: FingerPoses) -> None:
        self.exact = True
        self.first = poses.low
        self.step = (poses.high - poses.low) / (np.array(SHAPE) - 1.0)
        cut = LaserCut(setup, _RAYS)
        wanted = np.ones((SHAPE[1] * SHAPE[2], 5), np.bool_)
        rest = np.moveaxis(np.indices(SHAPE[1:]), 0, -1).reshape(-1, 2)
        seen = np.empty((5, *SHAPE, SEEN + 1))
        for a in range(SHAPE[0]):
            nodes = np.concatenate([np.full((len(rest), 1), a), rest], axis=1)
            views = poses.views(self.first + nodes[:, None] * self.step, wanted, cut)
            of_all = np.concatenate([views.seen, views.length_px[..., None]], axis=-1)
            seen[:, a] = np.moveaxis(of_all, 1, 0).reshape(5, *SHAPE[1:], SEEN + 1)
        missed = np.isnan(seen[..., 0])
        self.met: Bool = (~missed).reshape(5, -1).sum(axis=1) > 0
        seen = _filled(seen)
        by_step = [np.gradient(seen[..., :SEEN], axis=axis) for axis in (1, 2, 3)]
        self._values = np.concatenate([seen, *by_step], axis=-1).reshape(-1, SEEN * (1 + UNKNOWNS) + 1)
        spread = sum(_difference(seen[..., :SEEN], axis) ** 2 for axis in (1, 2, 3)) / 12.0
        weight = 1.0 / (spread + _LEAST**2)
        y = seen[..., :SEEN]
        linear = np.concatenate([weight, -2.0 * weight * y], axis=-1).reshape(5, -1, 2 * SEEN)
        self._linear: npt.NDArray[np.float32] = linear.astype(np.float32)
        constant = (weight * y * y).sum(axis=-1) + np.where(missed, _MISSED, 0.0)
        self._constant = constant.reshape(5, -1).astype(np.float32)
        self._strides: Int = np.array([SHAPE[1] * SHAPE[2], SHAPE[2], 1])
        self._offset = _CORNERS @ self._strides

    def candidates(self, seen: Float) -> tuple[Float, Float]:
        """For each PIP of the grid the node that explains best what was seen.

        Args:
            seen: (5, 4) what was seen of each finger, finite.

        Returns:
            The places of these nodes (5, P, 3) [rad], and their energies (5, P), inf where that is not plausible.
        """
        told = np.concatenate([seen * seen, seen], axis=1).astype(np.float32)
        energy = (self._constant + (self._linear @ told[..., None])[..., 0]).reshape(5, -1, SHAPE[2])
        best = energy.argmin(axis=1)
        value = np.take_along_axis(energy, best[:, None], axis=1)[:, 0]
        node = np.empty((*best.shape, UNKNOWNS))
        node[..., 0], node[..., 1] = np.divmod(best, SHAPE[1])
        node[..., 2] = np.arange(SHAPE[2])
        return self.first[:, None] + node * self.step[:, None], np.where(value < _PLAUSIBLE, value, np.inf)

    def starts(self, seen: Float, finger: int, count: int) -> Float:
        """Nodes (N, 3) [rad], at most so many, from which a pose may be sought that explains what was seen (4,) of one.

        The best one for every flexion and for every PIP, and of these the best.
        """
        told = np.concatenate([seen * seen, seen]).astype(np.float32)
        energy: Float = np.asarray(self._constant[finger] + self._linear[finger] @ told, np.float64)
        order: Int = energy.argsort()
        of_flexion = np.unique(order // SHAPE[2] % SHAPE[1], return_index=True)[1]
        of_pip = np.unique(order % SHAPE[2], return_index=True)[1]
        best = np.unique(np.concatenate([of_flexion, of_pip]))[:count]
        node = np.stack(np.unravel_index(order[best], SHAPE), axis=-1)
        return self.first[finger] + node * self.step[finger]

    def views(self, x: Float, finger: Int) -> tuple[Float, Float, Float]:
        """What is seen of poses (N, 3) [rad] of fingers (N,), interpolated between nodes.

        Each corner of a cell adds its value and half of what its derivatives say of the way from there, which is exact
        for polynomials of the second degree.

        Returns:
            (N, 4) as in `Views`, its derivatives (N, 4, 3) [1/rad], and the length of the line (N,) [px].
        """
        step = self.step[finger]
        at = (x - self.first[finger]) / step
        cell: Int = np.clip(at, 0.0, _LAST_CELL).astype(np.int64)
        share = at - cell
        away = share[:, None] - _CORNERS  # (N, 8, 3)
        weight = np.abs(away - 1.0 + 2.0 * _CORNERS).prod(axis=-1)
        node = finger * (SHAPE[0] * self._strides[0]) + cell @ self._strides
        corners = self._values[node[:, None] + self._offset]
        by_step = corners[..., SEEN + 1 :].reshape(-1, 8, UNKNOWNS, SEEN)
        weighed = weight[:, None]
        towards = (0.5 * weight[..., None] * away).reshape(-1, 1, 8 * UNKNOWNS)
        found = (weighed @ corners)[:, 0]
        found[:, :SEEN] += (towards @ by_step.reshape(-1, 8 * UNKNOWNS, SEEN))[:, 0]
        J = found[:, SEEN + 1 :].reshape(-1, UNKNOWNS, SEEN) / step[..., None]
        return found[:, :SEEN], np.swapaxes(J, 1, 2), found[:, SEEN]

    def points(self, x: Float, finger: Int) -> Float:
        """Laser points (N, 2) [m] alone."""
        return self.views(x, finger)[0][:, :2]

    def mended(self, x: Float, finger: Int, y: Float) -> tuple["PoseTable", Float]:
        """Itself, and y: for what is read along a valley a table is exact enough."""
        return self, y

    def doubt(self, x: Float, finger: Int) -> Float:
        """How far the corners of a cell differ in what they say of the laser point (N, 2) [m] of poses (N, 3).

        The table is wrong by half of that or less.
        """
        at = (x - self.first[finger]) / self.step[finger]
        cell: Int = np.clip(at, 0.0, _LAST_CELL).astype(np.int64)
        away = (at - cell)[:, None] - _CORNERS
        weight = np.abs(away - 1.0 + 2.0 * _CORNERS).prod(axis=-1)[:, None]
        node = finger * (SHAPE[0] * self._strides[0]) + cell @ self._strides
        corners = self._values[node[:, None] + self._offset]
        by_step = corners[..., SEEN + 1 :].reshape(-1, 8, UNKNOWNS, SEEN)
        said = corners[..., :2] + (away[:, :, None] @ by_step[..., :2])[:, :, 0]
        off = said - weight @ said
        return np.sqrt((weight @ (off * off))[:, 0])


def _filled(seen: Float) -> Float:
    """Values (5, A, M, P, N) with straight lines along M, and then the nearest along P, in place of NaN."""
    out = np.moveaxis(seen, 2, 1)  # (5, M, A, P, N)
    shape = out.shape
    flat = out.reshape(5, shape[1], -1, shape[-1])
    known = np.isfinite(flat).sum(axis=1) > 1
    flat = np.where(known[:, None], continued(flat), np.nan).reshape(shape)
    for _ in range(shape[3]):
        if not np.isnan(flat).any():
            break
        flat[..., 1:, :] = np.where(np.isnan(flat[..., 1:, :]), flat[..., :-1, :], flat[..., 1:, :])
        flat[..., :-1, :] = np.where(np.isnan(flat[..., :-1, :]), flat[..., 1:, :], flat[..., :-1, :])
    return np.nan_to_num(np.moveaxis(flat, 1, 2))


def _difference(values: Float, axis: int) -> Float:
    """From node to node along an axis, the larger of both sides."""
    step = np.abs(np.diff(values, axis=axis))
    edge = [(0, 0)] * values.ndim
    before, after = edge.copy(), edge.copy()
    before[axis], after[axis] = (1, 0), (0, 1)
    return np.maximum(np.pad(step, before), np.pad(step, after))
