"""Palm and five fingers together: the hand that best explains the markers within limits and priors.

Six markers give 18 numbers for 21 unknowns and more (the palm's orientation is not among them), so the
missing ones come from what hands do: natural flexion, small abduction, neighbours that move alike, and the
last frame. All of it is one bounded least-squares problem, solved by Levenberg-Marquardt with the Jacobian in
closed form (rigid bodies turning about known axes) and an active set for the limits. The inverse of the
normal matrix is the posterior covariance of every joint.

Parameters: palm rotation (3, rotation vector about the wrist, rig frame), palm translation (3), then the free
angles: four of the thumb, and abduction, flexion, PIP (and DIP where it is not coupled) of each finger.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry import fit_rigid, rotation_vector_to_matrix
from common.hand_model import CHAINS, HandJoints, HandModel

MAX_ITERATIONS = 25


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations of the priors [rad], and where an unseen finger is believed to be.

    The values are wide, for hands at work in general; none is fitted to a recording.
    """

    abduction: float = np.radians(7.0)
    natural_flexion: float = np.radians(14.0)
    neighbour_flexion: float = np.radians(30.0)
    neighbour_pip: float = np.radians(35.0)
    pip: float = np.radians(60.0)
    thumb: float = np.radians(20.0)
    thumb_mean: tuple[float, float, float, float] = (
        float(np.radians(8.0)),
        float(np.radians(8.0)),
        float(np.radians(10.0)),
        float(np.radians(15.0)),
    )
    hidden: float = np.radians(15.0)
    curled: tuple[float, float] = (float(np.radians(65.0)), float(np.radians(88.0)))
    thumb_curled: tuple[float, float, float, float] = (
        float(np.radians(20.0)),
        float(np.radians(30.0)),
        float(np.radians(25.0)),
        float(np.radians(30.0)),
    )
    facing: float = np.radians(30.0)
    model_m: float = 1.0e-3
    walk_rad_s: float = 8.0
    palm_walk_rad_s: float = 3.0
    palm_walk_m_s: float = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class HandSolution:
    """A solved hand.

    Attributes:
        T_rig_palm: (4, 4).
        angles_rad: (5, 4), inside the limits.
        joints: Forward kinematics of the two.
        cov_m2: (26, 3, 3) [m^2] posterior covariance of the joint positions.
        residual_m: (M,) distance of each marker from its place on the model [m]; NaN: not seen.
        cost: Half the sum of squared weighted residuals.
        iterations: Steps taken.
    """

    T_rig_palm: Float
    angles_rad: Float
    joints: HandJoints
    cov_m2: Float
    residual_m: Float
    cost: float
    iterations: int


class HandSolver:
    """Bounded least squares for one hand model and one set of marker names. Holds no state between calls."""

    def __init__(self, model: HandModel, markers: tuple[str, ...], priors: Priors | None = None) -> None:
        """Prepare the constant matrices.

        Raises:
            CalibrationError: The profile mounts no marker of one of the names.
        """
        self.model = model
        self.markers = markers
        self.priors = priors or Priors()
        mounts = [model.mount(name) for name in markers]
        self._finger = np.array([-1 if m.finger is None else m.finger for m in mounts])
        self._level = np.array(
            [0 if m.finger is None else int(np.argmax(CHAINS[m.finger] == m.joint)) for m in mounts]
        )
        self.free, self._angles_of = _parameters(model)
        self._low, self._high = _bounds(model, self.free)
        self._prior, self._prior_mean = _prior_rows(model, self.free, self.priors)
        joint_finger = np.full(26, -1)
        joint_level = np.zeros(26, dtype=int)
        for f, chain in enumerate(CHAINS):
            joint_finger[chain] = f
            joint_level[chain] = range(4)
        self._joint_finger, self._joint_level = joint_finger, joint_level

    def solve(
        self,
        points_m: Float,
        cov_m2: Float,
        last: HandSolution | None = None,
        dt_s: float = 0.0,
        hidden: tuple[Float, Float] | None = None,
        facing: Float | None = None,
    ) -> HandSolution | None:
        """Fit the hand to its markers.

        Args:
            points_m: Cap centroids (M, 3) [m], rig frame; NaN row: not seen.
            cov_m2: Their covariance (M, 3, 3) [m^2].
            last: Solution of the last frame, as seed and prior; None: solve afresh.
            dt_s: Time since then [s].
            hidden: Where fingers without a marker are believed to be, angles (5, 4) [rad], and the
                standard deviation (5,) [rad] of that belief; None: curled out of sight.
            facing: (3,) unit vector, rig frame, from the hand to the cameras where a marker on the back
                of the hand is seen: that marker faces them. None: nothing known.

        Returns:
            The solution, or None where there is no last frame and too few markers: three that are not in
            one line, or two where `facing` is known.
        """
        seen: Bool = np.asarray(np.isfinite(points_m.sum(axis=1) + cov_m2.sum(axis=(1, 2))))
        if last is None and not _determined(points_m[seen], facing):
            return None
        whiten = self._whitening(cov_m2, seen)
        rows, means = self._state_prior(seen, last, dt_s, hidden)
        problem = _Problem(self, points_m, seen, whiten, (rows, means), last, dt_s, facing)
        best: tuple[float, Float, Float, Float, int] | None = None
        for T, x in self._seeds(points_m, seen, last, facing):
            found = problem.minimise(T, x)
            if best is None or found[0] < best[0]:
                best = found
        assert best is not None
        cost, T, x, normal, iterations = best
        angles = np.clip(self.angles(x), self.model.limits_rad[..., 0], self.model.limits_rad[..., 1])
        joints = self.model.forward(T, angles)
        residual = np.linalg.norm(self.model.marker_points(joints, self.markers) - points_m, axis=1)
        return HandSolution(T, angles, joints, self._joint_cov(joints, normal), residual, cost, iterations)

    def angles(self, x: Float) -> Float:
        """Angles (5, 4) of the free angle parameters (n,)."""
        return (self._angles_of @ x).reshape(5, 4)

    def jacobian(self, joints: HandJoints, points: Float, finger: Int, level: Int) -> Float:
        """Derivative (P, 3, 6 + n) of points fixed to the chain by the parameters.

        Args:
            joints: Pose at which to differentiate.
            points: (P, 3) [m], rig frame.
            finger: (P,) chain each is fixed to; -1: the palm.
            level: (P,) joint of the chain it is fixed to (0 root ... 3 tip); rotations of that joint and
                those before it move the point, the tip joint has none of its own.
        """
        axes, origins = self._axes(joints)
        count = len(points)
        full = np.zeros((count, 3, 20))
        for p in np.flatnonzero(finger >= 0):
            f = finger[p]
            arm = points[p] - origins[f]
            turn = _cross(axes[f], arm)
            # abduction and flexion belong to level 0, PIP to level 1, DIP to level 2
            used = min(int(level[p]), 2) + 2
            full[p, :, 4 * f : 4 * f + used] = turn[:used].T
        out = np.empty((count, 3, 6 + len(self.free)))
        arm = points - joints.T_rig_palm[:3, 3]
        out[:, :, :3] = _minus_skew(arm)
        out[:, :, 3:6] = np.eye(3)
        out[:, :, 6:] = full @ self._angles_of
        return out

    def _axes(self, joints: HandJoints) -> tuple[Float, Float]:
        """Axes (5, 4, 3) and origins (5, 4, 3) of abduction, flexion, PIP, DIP in the rig frame."""
        R = joints.rotation
        axes = np.empty((5, 4, 3))
        R_palm = joints.T_rig_palm[:3, :3]
        axes[1:, 0] = self.model.side_sign * R_palm[:, 1]
        axes[0, 0] = self.model.side_sign * (R_palm @ self.model.rest_rotation[CHAINS[0, 0]][:, 1])
        axes[:, 1:] = -R[CHAINS[:, :3], :, 0]
        origins = joints.position_m[CHAINS[:, [0, 0, 1, 2]]]
        return axes, origins

    def _whitening(self, cov_m2: Float, seen: Bool) -> Float:
        cov = np.where(seen[:, None, None], cov_m2, np.eye(3)) + self.priors.model_m**2 * np.eye(3)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov)), np.float64)

    def _state_prior(
        self, seen: Bool, last: HandSolution | None, dt_s: float, hidden: tuple[Float, Float] | None
    ) -> tuple[Float, Float]:
        """Rows and means of all angle priors: the constant ones, unseen fingers, and the last frame."""
        n = len(self.free)
        weight = np.zeros(n)
        mean = np.zeros(n)
        seen_fingers = set(self._finger[seen].tolist())
        for column, angle in enumerate(self.free):
            finger, kind = divmod(int(angle), 4)
            if finger in seen_fingers:
                continue
            if hidden is not None:
                mean[column], weight[column] = hidden[0][finger, kind], 1 / hidden[1][finger]
            elif finger == 0:
                mean[column], weight[column] = self.priors.thumb_curled[kind], 1 / self.priors.hidden
            elif kind in (1, 2):
                mean[column], weight[column] = self.priors.curled[kind - 1], 1 / self.priors.hidden
        rows, means = [self._prior, np.diag(weight)], [self._prior_mean, weight * mean]
        if last is not None:
            walk = 1 / (self.priors.walk_rad_s * max(dt_s, 1e-3))
            rows.append(np.eye(n) * walk)
            means.append(last.angles_rad.reshape(20)[self.free] * walk)
        return np.vstack(rows), np.concatenate(means)

    def _seeds(
        self, points: Float, seen: Bool, last: HandSolution | None, facing: Float | None
    ) -> list[tuple[Float, Float]]:
        if last is not None:
            return [(last.T_rig_palm, last.angles_rad.reshape(20)[self.free])]
        seeds: list[tuple[Float, Float]] = []
        weight = np.where(self._finger[seen] < 0, 3.0, 1.0)
        for bend in (0.1, 0.7, 1.3):
            angles = np.zeros((5, 4))
            angles[1:, 1], angles[1:, 2] = 0.6 * bend, bend
            x = np.clip(angles.reshape(20)[self.free], self._low, self._high)
            model = self.model.marker_points(self.model.forward(np.eye(4), self.angles(x)), self.markers)
            observed, expected, w = points[seen], model[seen], weight
            if facing is not None:
                # A point above the wrist stands for "the back of the hand faces the cameras".
                observed = np.vstack([observed, points[seen].mean(axis=0) + 0.05 * facing])
                expected = np.vstack([expected, model[seen].mean(axis=0) + np.array([0.0, 0.05, 0.0])])
                w = np.append(weight, 0.3)
            seeds.append((fit_rigid(observed, expected, w), x))
        return seeds

    def _joint_cov(self, joints: HandJoints, normal: Float) -> Float:
        J = self.jacobian(joints, joints.position_m, self._joint_finger, self._joint_level)
        # A joint's own rotation does not move it; the product with a zero arm says so by itself.
        return J @ np.linalg.inv(normal) @ np.swapaxes(J, 1, 2)


class _Problem:
    """The weighted residuals of one frame, and their minimisation inside the bounds."""

    def __init__(
        self,
        solver: HandSolver,
        points: Float,
        seen: Bool,
        whiten: Float,
        prior: tuple[Float, Float],
        last: HandSolution | None,
        dt_s: float,
        facing: Float | None,
    ) -> None:
        self._solver, self._points, self._seen = solver, points[seen], seen
        self._names = tuple(name for name, use in zip(solver.markers, seen, strict=True) if use)
        self._whiten = whiten[seen]
        self._rows, self._means = prior
        self._facing = facing
        self._last = None if last is None else last.T_rig_palm
        dt = max(dt_s, 1e-3)
        walk = solver.priors
        self._palm_weight = np.repeat([1 / (walk.palm_walk_rad_s * dt), 1 / (walk.palm_walk_m_s * dt)], 3)

    def minimise(self, T: Float, x: Float) -> tuple[float, Float, Float, Float, int]:
        """Levenberg-Marquardt from one seed: (cost, T_rig_palm, x, normal matrix, iterations)."""
        low, high = self._solver._low, self._solver._high  # pyright: ignore[reportPrivateUsage]
        damping = 1e-3
        residual, J = self._linearise(T, x)
        cost = 0.5 * float(residual @ residual)
        iterations = 0
        while iterations < MAX_ITERATIONS:
            iterations += 1
            gradient, normal = J.T @ residual, J.T @ J
            stuck = np.zeros(len(gradient), dtype=bool)
            stuck[6:] = ((x <= low) & (gradient[6:] > 0)) | ((x >= high) & (gradient[6:] < 0))
            move = ~stuck
            damped = normal + damping * np.diag(np.diag(normal))
            step = np.zeros(len(gradient))
            step[move] = np.linalg.solve(damped[np.ix_(move, move)], -gradient[move])
            T_new = T.copy()
            T_new[:3, :3] = rotation_vector_to_matrix(step[:3]) @ T[:3, :3]
            T_new[:3, 3] += step[3:6]
            x_new = np.clip(x + step[6:], low, high)
            residual_new, J_new = self._linearise(T_new, x_new)
            cost_new = 0.5 * float(residual_new @ residual_new)
            if cost_new >= cost:
                damping *= 8.0
                if damping > 1e6:
                    break
                continue
            gain = cost - cost_new
            T, x, residual, J, cost = T_new, x_new, residual_new, J_new, cost_new
            damping = max(damping / 8.0, 1e-9)
            if gain < 1e-4 * (1e-3 + cost):
                break
        return cost, T, x, J.T @ J, iterations

    def _linearise(self, T: Float, x: Float) -> tuple[Float, Float]:
        """Residuals (R,) and Jacobian (R, 6 + n)."""
        solver = self._solver
        joints = solver.model.forward(T, solver.angles(x))
        model = solver.model.marker_points(joints, self._names) if self._names else np.empty((0, 3))
        J = solver.jacobian(joints, model, solver._finger[self._seen], solver._level[self._seen])  # pyright: ignore[reportPrivateUsage]
        r_markers = np.einsum("mij,mj->mi", self._whiten, model - self._points).ravel()
        J_markers = (self._whiten @ J).reshape(-1, J.shape[2])
        r_prior = self._rows @ x - self._means
        J_prior = np.hstack([np.zeros((len(r_prior), 6)), self._rows])
        if self._facing is not None:
            dorsal = T[:3, 1]
            weight = 1 / solver.priors.facing
            r_markers = np.concatenate([r_markers, weight * (dorsal - self._facing)])
            J_facing = np.zeros((3, J_prior.shape[1]))
            J_facing[:, :3] = weight * _minus_skew(dorsal[None])[0]
            J_markers = np.vstack([J_markers, J_facing])
        if self._last is None:
            return np.concatenate([r_markers, r_prior]), np.vstack([J_markers, J_prior])
        turned = T[:3, :3] @ self._last[:3, :3].T
        vector = 0.5 * np.array(
            [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
        )
        r_palm = self._palm_weight * np.concatenate([vector, T[:3, 3] - self._last[:3, 3]])
        J_palm = np.hstack([np.diag(self._palm_weight), np.zeros((6, len(x)))])
        return np.concatenate([r_markers, r_prior, r_palm]), np.vstack([J_markers, J_prior, J_palm])


def _parameters(model: HandModel) -> tuple[Int, Float]:
    """Indices (n,) of the free angles in the flat (20,) table, and the matrix (20, n) that completes them."""
    coupled = model.dip_per_pip is not None
    free = [a for a in range(20) if not (coupled and a >= 4 and a % 4 == 3)]
    complete = np.zeros((20, len(free)))
    for column, angle in enumerate(free):
        complete[angle, column] = 1.0
        if model.dip_per_pip is not None and angle >= 4 and angle % 4 == 2:
            complete[angle + 1, column] = model.dip_per_pip
    return np.array(free), complete


def _bounds(model: HandModel, free: Int) -> tuple[Float, Float]:
    low, high = model.limits_rad[..., 0].copy(), model.limits_rad[..., 1].copy()
    if model.dip_per_pip is not None and model.dip_per_pip > 0:
        low[1:, 2] = np.maximum(low[1:, 2], low[1:, 3] / model.dip_per_pip)
        high[1:, 2] = np.minimum(high[1:, 2], high[1:, 3] / model.dip_per_pip)
    return low.reshape(20)[free], high.reshape(20)[free]


def _prior_rows(model: HandModel, free: Int, priors: Priors) -> tuple[Float, Float]:
    """Constant prior: rows (P, n) and means (P,), each divided by its standard deviation."""
    column = {int(angle): c for c, angle in enumerate(free)}
    rows: list[Float] = []
    means: list[float] = []

    def add(terms: dict[int, float], mean: float, sigma: float) -> None:
        row = np.zeros(len(free))
        for angle, factor in terms.items():
            row[column[angle]] = factor / sigma
        rows.append(row)
        means.append(mean / sigma)

    for k, mean in enumerate(priors.thumb_mean):
        add({k: 1.0}, mean, priors.thumb)
    add({2: -1.0, 3: 1.0}, 0.0, priors.thumb)
    for f in range(1, 5):
        a = 4 * f
        add({a: 1.0}, 0.0, priors.abduction)
        add({a + 1: 1.0, a + 2: -model.mcp_per_pip}, 0.0, priors.natural_flexion)
        add({a + 2: 1.0}, np.radians(25.0), priors.pip)
        if f < 4:
            add({a + 1: 1.0, a + 5: -1.0}, 0.0, priors.neighbour_flexion)
            add({a + 2: 1.0, a + 6: -1.0}, 0.0, priors.neighbour_pip)
    return np.array(rows), np.array(means)


def _determined(points: Float, facing: Float | None) -> bool:
    """Whether points (N, 3) fix an orientation: not all in one line, or in a line with `facing` to turn about it."""
    if len(points) < 2:
        return False
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(singular[0] > 2e-2) if facing is not None else len(points) > 2 and bool(singular[1] > 5e-3)


def _cross(a: Float, b: Float) -> Float:
    """Cross products of (..., 3) arrays; several times faster than numpy's for small ones."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def _minus_skew(vectors: Float) -> Float:
    """(P, 3, 3) with `m[p] @ w == cross(w, vectors[p])`."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    out[:, 0, 1], out[:, 0, 2] = z, -y
    out[:, 1, 0], out[:, 1, 2] = -z, x
    out[:, 2, 0], out[:, 2, 1] = y, -x
    return out
