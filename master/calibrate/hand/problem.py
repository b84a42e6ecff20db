"""The hand routine is one least-squares problem, fitted with uncertainties.

One shape, and curves of 26 channels: palm rotation (3, rotation vector about the palm's middle, against the
first pose), palm shift (3), then the angles (20). Deviations from what the routine asks for are
Ornstein-Uhlenbeck processes: they live for about a second, so that many frames of one bend count as one trial
and not as many. The adjustment engine solves it: the shape is shared, each knot owns its coefficients.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.errors import FitError
from common.geometry.transforms import rotation_vector_to_matrix, skew, transform
from common.hand.model import HandModel
from master.calibrate.adjust import Normal, huber, minimise
from master.calibrate.hand.shape import (
    BIAS,
    LENGTH,
    PER_FINGER,
    RATIO,
    ROOT,
    ROTATION,
    Priors,
    RoutineTargets,
    Shape,
    caps_of,
)

CHANNELS = 26
_PALM = 6
_DIP = 3
_LOSS = huber(3.0)
_SLACK_RAD = float(np.radians(10.0))  # hands bend farther than the published limits


_WIDTH = 4  # coefficients that one epoch depends on


@dataclass(frozen=True, slots=True, eq=False)
class Knots:
    """Angles and the palm's pose over T epochs, as uniform cubic B-splines.

    So frames need no common rate and no averaging (trajectory estimation in continuous time: Furgale, Barfoot &
    Sibley, ICRA 2012).
    """

    spacing_s: float  # between coefficients [s]
    time_s: Float  # (K,) middle of each coefficient's bump [s]
    first: Int  # (T,) first of the four coefficients of each epoch
    weight: Float  # (T, 4) theirs; they add up to one

    @classmethod
    def over(cls, t_s: Float, spacing_s: float) -> "Knots":
        """Knots that cover rising times (T,) [s]."""
        x = (t_s - t_s[0]) / spacing_s
        first = np.floor(x).astype(np.int64)
        u = x - first
        weight = np.stack(
            [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=1
        )
        count = int(first[-1]) + _WIDTH
        return cls(spacing_s, t_s[0] + spacing_s * (np.arange(count) - 1.0), first, weight / 6.0)

    def at(self, coefficients: Float) -> Float:
        """Values (T, n) of curves with coefficients (K, n)."""
        picked = coefficients[self.first[:, None] + np.arange(_WIDTH)]
        return np.einsum("tw,twn->tn", self.weight, picked)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A guess: the shape and the coefficients (K, 26)."""

    shape: Shape
    coefficients: Float


@dataclass(frozen=True, slots=True, eq=False)
class HandRoutineProblem:
    """Observations and priors of the routine."""

    model: HandModel  # template
    cap_m: Float  # (5, 3) offsets of the caps in the frames of the tip joints
    prior: Shape
    # (T, 5 + B, 3) caps thumb ... little, then the markers on the back, rig frame; NaN: not seen
    points_m: Float
    whiten: Float  # (T, 5 + B, 3, 3): whiten @ off has unit covariance
    knots: Knots
    targets: RoutineTargets  # what the routine asks for at each of the knots
    start: Float  # (4, 4) palm pose about which the curves are
    palm_free: bool  # the palm may move, since it is measured
    priors: Priors  # widths

    def guess(self) -> State:
        """The scripted routine with the prior shape."""
        coefficients = np.zeros((len(self.knots.time_s), CHANNELS))
        angles = coefficients[:, _PALM:].reshape(-1, 5, 4)
        angles[..., :3] = self.targets.posture_rad
        angles[..., 3] = self.prior.dip_ratio * angles[..., 2]
        return State(self.prior, coefficients)

    def stepped(self, state: State, constants: Float, coefficients: Float) -> State:
        """After a step, kept where hands can be."""
        moved = state.coefficients + coefficients
        np.clip(moved[:, _PALM:], *self._limits(), out=moved[:, _PALM:])
        return State(state.shape.stepped(constants), moved)

    def _limits(self) -> tuple[Float, Float]:
        """Where angles (20,) can be."""
        limits = self.model.limits_rad.reshape(-1, 2)
        return limits[:, 0] - _SLACK_RAD, limits[:, 1] + _SLACK_RAD

    def equations(self, state: State) -> Normal:
        """Normal equations at a guess; angles at their limits are held."""
        knots, x, size = self.knots, state.coefficients, state.shape.size
        normal = Normal(size, len(x), CHANNELS, reach=4)
        by_curve, by_shape, off = self._markers(state)
        normal.add(off, by_shape, by_curve, epochs=knots.first, weights=knots.weight, loss=_LOSS, group=3)
        self._add_curve_priors(normal, state)
        weight, away = self._shape_prior(state.shape)
        normal.add_prior(away, 1.0 / weight)
        held = np.zeros(x.shape, np.bool_)
        low, high = self._limits()
        angles = x[:, _PALM:]
        held[:, _PALM:] = np.where(normal.own_gradient[:, _PALM:] > 0.0, angles <= low, angles >= high)
        normal.hold(held)
        return normal

    def residuals(self, state: State) -> Float:
        """(T, 5 + B, 3) [m] observed less predicted, NaN where not seen."""
        return self.points_m - self._predicted(state)[0]

    def shape_sd(self) -> Float:
        """Standard deviations (size,) of the prior shape."""
        return 1.0 / self._shape_prior(self.prior)[0]

    def _predicted(self, state: State) -> tuple[Float, Float, Float]:
        """Markers (T, M, 3), by the curves (T, M, 3, 26), by the shape (T, M, 3, size)."""
        curves = self.knots.at(state.coefficients)
        count, markers = self.points_m.shape[:2]
        caps = caps_of(self.model, self.cap_m, state.shape, curves[:, _PALM:].reshape(-1, 5, 4))
        back = np.broadcast_to(state.shape.back_m, (count, markers - 5, 3))
        palm = np.concatenate([caps.place_m, back], axis=1)
        change = rotation_vector_to_matrix(curves[:, :3])
        rotation = change @ self.start[:3, :3]
        middle = 0.5 * self.model.rest_position_m.max(axis=0) * [0.0, 0.0, 1.0]
        arm = (palm - middle) @ np.swapaxes(rotation, -1, -2)
        predicted = arm + (transform(self.start, middle) + curves[:, 3:6])[:, None]
        by_curve = np.zeros((count, markers, 3, CHANNELS))
        by_shape = np.zeros((count, markers, 3, state.shape.size))
        by_curve[..., :3] = -skew(arm) @ _left_jacobian(curves[:, :3])[:, None]
        by_curve[..., 3:6] = np.eye(3)
        rotated = rotation[:, None]
        by_angle, by_own = rotated @ caps.by_angle, rotated @ caps.by_shape
        for f in range(5):
            by_curve[:, f, :, _PALM + 4 * f : _PALM + 4 * f + 4] = by_angle[:, f]
            by_shape[:, f, :, PER_FINGER * f : PER_FINGER * (f + 1)] = by_own[:, f]
        for b in range(markers - 5):
            at = 5 * PER_FINGER + 3 * b
            by_shape[:, 5 + b, :, at : at + 3] = rotation
        return predicted, by_curve, by_shape

    def _markers(self, state: State) -> tuple[Float, Float, Float]:
        """Whitened Jacobians by curves and shape; predicted less observed, NaN: not seen."""
        predicted, by_curve, by_shape = self._predicted(state)
        off = self.whiten @ (predicted - self.points_m)[..., None]
        rows = len(off), -1
        by_curve, by_shape = (self.whiten @ by_curve).reshape(*rows, CHANNELS), self.whiten @ by_shape
        return by_curve, by_shape.reshape(*rows, state.shape.size), off.reshape(rows)

    def _add_curve_priors(self, normal: Normal, state: State) -> None:
        """Add priors of palm, angles about the routine and DIPs about their PIPs."""
        x, shape = state.coefficients, state.shape
        change, mean, level = self._widths()
        lever, by_lever = self._levers(shape)
        dip = _PALM + np.arange(5) * 4 + _DIP
        pip, own = dip - 1, np.arange(5) * PER_FINGER
        about = x.copy()  # the curves; of a DIP what its PIP does not account for
        about[:, dip] -= shape.dip_ratio * x[:, pip]
        by_curve = np.tile(np.eye(CHANNELS), (len(change), 1, 1))
        by_curve[:, dip, pip] = -shape.dip_ratio
        changed = np.diff(about, axis=0)
        by_change, by_level = changed[..., None] * by_lever, np.zeros((len(change), *by_lever.shape))
        by_change[:, dip, own + RATIO] = -lever[dip] * np.diff(x[:, pip], axis=0)
        by_level[:, dip, own + RATIO], by_level[:, dip, own + BIAS] = -x[:-1, pip], -1.0
        mean[:, dip] = shape.dip_bias_rad
        neighbours = np.tile([-1.0, 1.0], (len(change), 1))
        for off, by_shape, by, sharpness, weights in (
            (lever * changed, by_change, lever[:, None] * by_curve, change, neighbours),
            (about[:-1] - mean, by_level, by_curve, level, None),
        ):
            share = sharpness[..., None]
            normal.add(sharpness * off, share * by_shape, share * by, epochs=slice(-1), weights=weights)

    def _levers(self, shape: Shape) -> tuple[Float, Float]:
        """Lengths (26,) that channels turn, as shares of the prior's; their derivatives.

        The derivatives (26, size) are by the shape. Priors of changes are about the way of a tip, not about
        angles: else a longer bone, which follows the noise by smaller angles, would cost less, and all would
        come out long (Neyman & Scott, 1948).
        """
        lever, by_shape = np.ones(CHANNELS), np.zeros((CHANNELS, shape.size))
        for f in range(5):
            for angle, bone in enumerate((0, 0, 1, 2)):  # the first bone that it turns
                usual_m = self.prior.length_m[f, bone:].sum()
                row, own = _PALM + 4 * f + angle, PER_FINGER * f
                lever[row] = shape.length_m[f, bone:].sum() / usual_m
                by_shape[row, own + bone : own + 3] = 1.0 / usual_m
        return lever, by_shape

    def _widths(self) -> tuple[Float, Float, Float]:
        """Inverse sd of changes, means, inverse sd of levels, each (K - 1, 26)."""
        b, h = self.priors, self.knots.spacing_s
        count = len(self.knots.time_s) - 1
        moving = (self.targets.moving[1:] | self.targets.moving[:-1]).reshape(count, 5, 3)
        straight = self.targets.straight[:-1]
        wander = np.empty((count, CHANNELS))  # [1/sqrt(s)]
        mean, sigma = np.zeros((count, CHANNELS)), np.full((count, CHANNELS), np.inf)
        wander[:, :3] = b.free_palm_rad_s if self.palm_free else b.palm_rad_s
        wander[:, 3:6] = b.free_palm_m_s if self.palm_free else b.palm_m_s
        angles, means, sigmas = (a[:, _PALM:].reshape(count, 5, 4) for a in (wander, mean, sigma))
        angles[..., :3] = np.where(moving, b.moving_rad_s, b.held_rad_s)
        means[..., :3] = self.targets.posture_rad[:-1]
        sigmas[..., :3] = np.where(moving, b.moving_level_rad, b.level_rad)
        pip = 2
        means[..., pip] = np.where(straight, b.straight_rad[0], means[..., pip])
        sigmas[..., pip] = np.where(straight, b.straight_rad[1], sigmas[..., pip])
        dip = np.tile([b.thumb_dip_rad, *[b.dip_rad] * 4], (count, 1))
        dip[:, 1:] = np.where(straight[:, 1:], b.straight_dip_rad, dip[:, 1:])
        angles[..., _DIP], sigmas[..., _DIP] = dip * np.sqrt(2.0 / b.slow_s), dip
        return 1.0 / (wander * np.sqrt(h)), mean, np.sqrt(h / (2.0 * b.slow_s)) / sigma

    def _shape_prior(self, shape: Shape) -> tuple[Float, Float]:
        """Inverse sd (size,) and deviation (size,) from the prior shape."""
        b, prior = self.priors, self.prior
        sd, away = np.empty(shape.size), np.empty(shape.size)
        own_sd, own = (a[: 5 * PER_FINGER].reshape(5, PER_FINGER) for a in (sd, away))
        own_sd[:, LENGTH], own[:, LENGTH] = b.bone * prior.length_m, shape.length_m - prior.length_m
        own_sd[:, ROOT], own[:, ROOT] = b.root_m, shape.root_m - prior.root_m
        own_sd[:, ROTATION] = np.array([b.thumb_rad, *[b.root_rad] * 4])[:, None]
        own[:, ROTATION] = _rotation_between(shape.root_rotation, prior.root_rotation)
        own_sd[:, RATIO] = np.array([b.thumb_ratio[1], *[b.dip_ratio[1]] * 4])
        own[:, RATIO] = shape.dip_ratio - prior.dip_ratio
        own_sd[:, BIAS], own[:, BIAS] = b.dip_bias_rad, shape.dip_bias_rad - prior.dip_bias_rad
        sd[5 * PER_FINGER :] = b.back_m
        away[5 * PER_FINGER :] = (shape.back_m - prior.back_m).ravel()
        return 1.0 / sd, away


def _rotation_between(rotation: Float, other: Float) -> Float:
    """(5, 3) small turns about the palm's axes from `other` to `rotation` (5, 3, 3)."""
    r = rotation @ np.swapaxes(other, -1, -2)
    return 0.5 * np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)


def _left_jacobian(vector: Float) -> Float:
    """Left Jacobian (T, 3, 3) of rotation vectors (Barfoot, 2017, eq. 7.77)."""
    angle = np.maximum(np.linalg.norm(vector, axis=-1), 1e-6)[:, None, None]
    k = skew(vector)
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * (k @ k)


@dataclass(frozen=True, slots=True, eq=False)
class ShapeFit:
    """A fitted shape."""

    shape: Shape
    cov: Float  # (size, size) posterior covariance, residuals' spread included
    residual_m: Float  # (T, 5 + B, 3) observed less predicted; NaN: not seen
    palm: Float  # (K, 6) rotation [rad] and shift [m] of the palm against its first pose
    spread: float  # root of the mean squared whitened residual: 1 where the stated covariances are true


def fit_shape(
    problem: HandRoutineProblem, progress: Callable[[float], None] = lambda share: None
) -> ShapeFit:
    """Minimise from the routine as it was asked for.

    Raises:
        FitError: The search does not settle.
    """
    steps, gain = 60, 0.1  # gain in chi square, against thousands
    found = minimise(
        problem.equations, problem.stepped, problem.guess(), steps=steps, gain=gain, progress=progress
    )
    if not found.settled:
        raise FitError(
            f"the fit does not settle in {steps} steps: the palm did not rest, or it is not this routine or hand;"
            " record it again, or begin with --length-mm"
        )
    residual = problem.residuals(found.x)
    spread, alike = _spread(problem, residual)
    cov = found.normal.covariance() * (max(spread, 1.0) * alike) ** 2
    return ShapeFit(found.x.shape, cov, residual, found.x.coefficients[:, :_PALM], spread)


def _spread(problem: HandRoutineProblem, residual_m: Float) -> tuple[float, float]:
    """Root mean squared whitened residual, and the sigmas' factor by its correlation.

    Errors that last, such as a cap's hidden part, do not average out: with a correlation r from frame to
    frame, n frames carry as much information as n (1 - r) / (1 + r) independent ones.
    """
    whitened = (problem.whiten @ np.nan_to_num(residual_m)[..., None])[..., 0]
    seen = np.isfinite(residual_m[..., 0])
    both = seen[1:] & seen[:-1]
    mean_square = float((whitened[seen] ** 2).mean())
    correlation = float((whitened[1:][both] * whitened[:-1][both]).mean()) / mean_square
    r = min(max(correlation, 0.0), 0.95)
    return float(np.sqrt(mean_square)), float(np.sqrt((1.0 + r) / (1.0 - r)))
