"""The card: both slaves' centroids at one instant, disparity, depth, 1 €, palm, FABRIK per finger: a hand."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand_model import CHAINS, HandJoints, HandModel
from master.fabrik.palm import HandTables, Mounts, PalmPrior, fit
from master.filters import PointFilter
from master.ik.attached import Attached
from master.ik.fabrik import Fabrik
from master.ik.finger import FingerSolver
from master.ik.parameters import HandParameters
from master.ik.priors import AnglePrior, Priors, hidden_belief
from common.geometry import fit_rigid, skew

_FORGET_S = 0.5
_GATE = 16.3
_BENDS = (0.1, 0.7, 1.3)


@dataclass(frozen=True, slots=True, eq=False)
class HandEstimate:
    t_ns: int
    T_rig_palm: Float
    angles_rad: Float
    joints: HandJoints
    cov_m2: Float
    seen: Bool  # (5,)
    residual_m: Float  # (5,)
    iterations: Int
    reached: Bool
    cost: float


class LineSolver:
    def __init__(self, model: HandModel, markers: tuple[str, ...], *, continuous: bool = True) -> None:
        self.model, self.markers = model, markers
        self.parameters = HandParameters.of(model)
        self.tables = HandTables.of(model, self.parameters)
        attached = Attached.markers(model, self.parameters, markers)
        self._attached = attached
        self.mounts = Mounts(
            np.where(attached.on_finger[:, 0], attached.finger, -1), attached.level, np.ascontiguousarray(attached.offset_m)
        )
        self._priors = Priors()
        self._prior = AnglePrior.of(model, self.parameters, self._priors)
        self._fingers = []
        for m, name in enumerate(markers):
            mount = model.mount(name)
            if mount.finger is not None:
                closed = FingerSolver.of(model, mount.finger, mount.offset_m)
                self._fingers.append((m, mount.finger, closed, Fabrik.of(closed.chain, 1e-4, 10, 0)))
        bent = np.zeros((len(_BENDS), 5, 4))
        bent[:, 1:, 1:3] = np.multiply.outer(_BENDS, (0.6, 1.0))[:, None]
        self._postures = np.array([self.parameters.of_angles(angles) for angles in bent])
        self._shapes = attached.place(model.chains(self.parameters.angles(self._postures)))
        self._continuous = continuous
        self.last: HandEstimate | None = None
        self._T = np.eye(4)
        self._x = np.zeros(len(self.parameters.free))
        n = 6 + len(self._x)
        self._normal = np.empty((n, n))
        self.hypothesis = 0
        self.calls = 0

    def solve(self, t_ns: int, points: Float, cov: Float, facing: Float | None) -> HandEstimate | None:
        seen = np.isfinite(points[:, 0])
        age_s = np.inf if self.last is None else (t_ns - self.last.t_ns) * 1e-9
        information = np.zeros((len(points), 3, 3))
        information[seen] = np.linalg.inv(cov[seen] + self._priors.model_m**2 * np.eye(3))
        best = None
        if self._continuous and 0.0 < age_s <= _FORGET_S:
            best = self._fit(points, information, seen, facing, self._T, self._x, age_s)
        if best is None or self._surprised(best, points, information, seen):
            for T, x in self._starts(points, seen, facing):
                found = self._fit(points, information, seen, facing, T, x, np.inf)
                if best is None or found[0] < best[0]:
                    best = found
        if best is None:
            return None
        cost, T, x, normal = best
        self._T, self._x = T, x
        return self._fingers_of(t_ns, points, cov, seen, cost, T, x, normal)

    def _surprised(self, found, points, information, seen):
        _, T, x, _ = found
        local = self._attached.place(self.model.chains(self.parameters.angles(x)))
        off = (local @ T[:3, :3].T + T[:3, 3] - points)[seen]
        return bool((np.einsum("mi,mij,mj->m", off, information[seen], off) > _GATE).any())

    def _starts(self, points, seen, facing):
        if seen.sum() < 2 or (seen.sum() == 2 and facing is None):
            return
        weight = np.where(self._attached.on_finger[seen, 0], 1.0, 3.0)
        observed, expected = points[seen], self._shapes[:, seen]
        if facing is not None:
            above = expected.mean(axis=1, keepdims=True) + np.array([0.0, 0.05, 0.0])
            observed = np.vstack([observed, observed.mean(axis=0) + 0.05 * facing])
            expected, weight = np.concatenate([expected, above], axis=1), np.append(weight, 0.3)
        for T, x in zip(fit_rigid(observed, expected, weight), self._postures, strict=True):
            yield T, x

    def _fit(self, points, information, seen, facing, T, x, age_s):
        h = self.hypothesis
        normal, pull = self._prior.normal[h].copy(), self._prior.pull[h].copy()
        fingers = frozenset(self._attached.finger[seen & self._attached.on_finger[:, 0]].tolist())
        warm = np.isfinite(age_s)
        weight = np.zeros(6)
        if warm:
            w = np.full(len(x), 1.0 / (self._priors.walk_rad_s * max(age_s, 1e-3)))
            hidden = ~np.isin(self.parameters.free // 4, list(fingers))
            w[hidden] = 1.0 / np.radians(10.0)
            normal.reshape(-1)[:: len(x) + 1] += w * w
            pull += w * w * x
            weight = self._priors.palm_weight(age_s)
        else:
            w, mean = hidden_belief(self.parameters, self._priors, fingers, None)
            normal.reshape(-1)[:: len(x) + 1] += w * w
            pull += w * w * mean
        prior = PalmPrior(
            normal,
            pull,
            np.ascontiguousarray(T),
            weight,
            np.zeros(3) if facing is None else facing,
            0.0 if facing is None else 1.0 / self._priors.facing,
        )
        T, x = np.ascontiguousarray(T).copy(), x.copy()
        out = np.empty_like(self._normal)
        cost, _ = fit(self.tables, self.mounts, prior, points, information, seen, T, x, out, 1e-3)
        self.calls += 1
        return cost, T, x, out

    def _fingers_of(self, t_ns, points, cov, seen, cost, T, x, normal):
        angles = self.parameters.angles(x)
        residual, reached, iterations = np.full(5, np.nan), np.zeros(5, np.bool_), np.zeros(5, np.int64)
        R = T[:3, :3]
        local = (points - T[:3, 3]) @ R
        for m, finger, closed, fabrik in self._fingers:
            if not seen[m]:
                continue
            target = tuple(local[m].tolist())
            if finger == 0:
                a, f, pip, dip = angles[0].tolist()
            else:
                a, f, pip, dip = closed.solve(target)[:4]
            found = fabrik.solve(target, ((a, f), (pip,), (dip,)), closed.root)
            residual[finger], reached[finger], iterations[finger] = found.residual_m, found.reached, found.iterations
            if found.reached:
                angles[finger] = [v for joint in found.angles for v in joint]
        angles = self.model.clamp(angles)
        joints = self.model.joints(T, self.model.chains(angles))
        hand = HandEstimate(t_ns, T, angles, joints, np.zeros((26, 3, 3)), ~np.isnan(residual), residual, iterations, reached, cost)
        self.last = hand
        return hand
