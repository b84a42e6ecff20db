"""Loop subdivision of a triangle mesh (Loop, 1987): rounds it without losing its folds."""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int


@dataclass(frozen=True, slots=True, eq=False)
class Subdivision:
    """One step: every triangle becomes four.

    Attributes:
        edges: (E, 2) vertices of each edge; the new vertices stand behind the old in this order.
        opposite: (E, 2) vertices opposite to each edge; at a border twice the same.
        border: (E,) whether the edge has one triangle only.
        faces: (4 F, 3) of the finer mesh.
        count: Vertices of the coarser mesh.
        beta: (V,) weight of each neighbour of an old vertex.
        valence: (V,) how many it has.
        at_border: (V,).
    """

    edges: Int
    opposite: Int
    border: Bool
    faces: Int
    count: int
    beta: Float
    valence: Int
    at_border: Bool

    @classmethod
    def of(cls, faces: Int, count: int) -> "Subdivision":
        """Of triangles (F, 3) of vertices 0 … count - 1."""
        sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        across = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
        edges, first, which, often = np.unique(
            np.sort(sides, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
        )
        which = which.ravel()
        last = np.zeros(len(edges), dtype=np.int64)
        last[which] = np.arange(len(which))
        opposite = np.stack([across[first], across[last]], axis=1)
        ab, bc, ca = (which.reshape(3, -1) + count).astype(np.int64)
        a, b, c = faces.T
        fine = np.concatenate(
            [np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
        valence = np.bincount(edges.ravel(), minlength=count)
        turn = np.cos(2.0 * np.pi / np.maximum(valence, 1))
        beta = (0.625 - (0.375 + 0.25 * turn) ** 2) / np.maximum(valence, 1)
        border = often == 1
        at_border = np.zeros(count, dtype=np.bool_)
        at_border[edges[border]] = True
        return cls(edges, opposite, border, fine, count, beta, valence, at_border)

    def __call__(self, values: Float) -> Float:
        """Values (V + E, K) of the finer mesh, of those of the coarser one (V, K)."""
        a, b = values[self.edges[:, 0]], values[self.edges[:, 1]]
        other = values[self.opposite].sum(axis=1)
        new = np.where(self.border[:, None], 0.5 * (a + b), 0.375 * (a + b) + 0.125 * other)
        around = _sums(self.edges, values, self.count)
        beta = self.beta[:, None]
        old = (1.0 - self.valence[:, None] * beta) * values + beta * around
        rim = _sums(self.edges[self.border], values, self.count)
        old = np.where(self.at_border[:, None], 0.75 * values + 0.125 * rim, old)
        return np.concatenate([old, new])


def _sums(edges: Int, values: Float, count: int) -> Float:
    """Of each vertex, the sum (V, K) of the values of those that edges (E, 2) lead to."""
    start, stop = np.concatenate([edges, edges[:, ::-1]]).T
    sums = [np.bincount(start, column[stop], count).astype(np.float64) for column in values.T]
    return np.stack(sums, axis=1)
