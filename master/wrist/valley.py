"""What is believed of a finger along its valley: for every PIP the best of the other angles, and how likely each is.

Of a finger's three unknowns laser and tip hold two well. The third, the PIP, often lies in a valley: near the turn of a
fingertip's way in the image straighter and more bent fingers show almost the same, and without a tip nothing but habit
tells. A Gauss curve about the lowest point is no description of that. So for every PIP of the table's grid flexion and
abduction are brought to the least misfit (a few Gauss-Newton steps in the table), what is left of the misfit is
interpolated between the nodes, and the density over the PIP is

    exp(-misfit / 2) |R|^-1/2 |S|^1/2 p(flexion, PIP)       S: covariance of flexion and abduction at that PIP

with flexion and abduction integrated out (Laplace; MacKay, "Information Theory, Inference, and Learning Algorithms",
27). p is a mixture of three hands: a *natural* one, whose flexion follows the PIP within 14 degrees, a *straight* one,
whose fingers are stretched while they bend in their knuckles, as lumbricals and interossei do it (the "intrinsic plus"
posture of hand surgery), and a *free* one, whose joints know nothing of each other (`master.estimator.priors`).

**The jump.** Where the last phalanx comes into the light the laser point jumps, and at which PIP is known as badly as
the DIP is: R of a node holds what a DIP off by its coupling's spread makes of the laser point. Elsewhere that is
nothing.
"""

from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.hand_limits import ABDUCTION, FLEXION
from master.estimator.settings import Settings
from master.wrist.finger_poses import SEEN, UNKNOWNS, FingerPoses
from master.wrist.forward import DIP, PIP
from master.wrist.pose_table import Forward

_FINE = 4  # steps of the density from node to node
_STEPS = 4
_ROUGH_STEPS, _MENDED_STEPS = 2, 2  # before the laser's cut is asked, and after it
_HOPELESS = 300.0  # it is not asked of poses whose misfit is worse than the best by so much
_FARTHEST_RAD = np.radians(15.0)  # of one step
RATIOS = 0.5 * (
    0.84 - 2.0 / 3.0
)  # the papers' DIP per PIP lie by this to both sides of their middle (row I12)
STIFF_RAD = np.radians(1.0)
_LOOSE = 1e-2
_STRAIGHT_RAD = np.radians(10.0)  # by which stretched fingers are bent
_NUDGE_RAD = np.radians(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Valley:
    """Of five fingers, over P poses of rising PIP.

    Attributes:
        x_rad: (5, P, 3) the best pose of each PIP; NaN: none.
        side_rad2: (5, P, 2, 2) covariance of abduction and flexion at that PIP.
        length_px: (5, P) of the laser line there.
        misfit: (5, P) chi-square; inf: none.
        likely: (5, P) logarithm of the likelihood; -inf: none.
        log: (3, 5, P) logarithm of likelihood times density: of a natural hand, a straight and a free one; -inf: none.
    """

    x_rad: Float
    side_rad2: Float
    length_px: Float
    misfit: Float
    likely: Float
    log: Float

    @property
    def evidence(self) -> Float:
        """(3, 5) logarithms of what these hands together with every PIP explain."""
        top = self.log.max(axis=-1)
        known = np.isfinite(top)
        with np.errstate(divide="ignore", invalid="ignore"):
            total = np.log(np.exp(self.log - top[..., None]).sum(axis=-1)) + top
        return np.where(known, total, -np.inf)


class Valleys:
    """Finds them for one device and hand. What it holds was prepared by the constructor."""

    def __init__(self, poses: FingerPoses, settings: Settings) -> None:
        self._low, self._high = poses.low, poses.high
        self._range = 12.0 / (poses.high - poses.low)[:, None, :2] ** 2
        slope, base = poses.habit
        self._slope, self._base = slope[:, None], base[:, None]
        span = poses.high - poses.low
        self._free_flexion = -np.log(span[:, FLEXION])[:, None]
        natural = settings.pip_mean_rad, settings.pip_rad
        self._pip = natural, (settings.free_pip_mean_rad, settings.free_pip_rad)
        self._stray = np.full((5, 1), settings.natural_flexion_rad)
        self._stray[0] = settings.thumb_rad

    def __call__(self, poses: FingerPoses, table: Forward, start_rad: Float, seen: Float, R: Float) -> Valley:
        """Valleys.

        Args:
            poses, table: What is seen of the fingers, at the bend of their wrist.
            start_rad: (5, P, 3) poses at the PIP of the table's nodes; NaN: of this one nothing is to be said.
            seen: (5, M) the first M numbers that were seen: 4, or 2 where no tip was.
            R: (5, M, M) their covariance, finite.
        """
        numbers = seen.shape[1]
        finger, node = np.nonzero(np.isfinite(start_rad[..., 0]) & np.isfinite(seen.sum(axis=1))[:, None])
        x = start_rad[finger, node]
        side = np.array([ABDUCTION, FLEXION])
        low, high = self._low[finger][:, side], self._high[finger][:, side]
        white = np.asarray(np.linalg.inv(np.linalg.cholesky(R)), np.float64)[finger]

        def stepped(x: Float, y: Float, J: Float) -> Float:
            to, _ = self._to(white, np.nan_to_num(seen[finger] - y[:, :numbers]), J[:, :numbers, :2], finger)
            out = x.copy()
            out[:, side] = np.clip(x[:, side] + np.clip(to, -_FARTHEST_RAD, _FARTHEST_RAD), low, high)
            return out

        y, J, length_px = table.views(x, finger)
        for _ in range(_STEPS if table.exact else _ROUGH_STEPS):
            x = stepped(x, y, J)
            y, J, length_px = table.views(x, finger)
        if not table.exact:
            off = (white @ np.nan_to_num(seen[finger] - y[:, :numbers])[..., None])[..., 0]
            near = _near(np.vecdot(off, off), finger)
            finger, node = finger[near], node[near]
            x, y, J = x[near], y[near], J[near]
            white, low, high = white[near], low[near], high[near]
            table, y = table.mended(x, finger, y)
            for _ in range(_MENDED_STEPS):
                x = stepped(x, y, J)
                y, J, length_px = table.views(x, finger)
        # What a DIP that is not where the coupling has it does to the laser point.
        wide = R[finger].copy()
        moved = np.zeros((len(x), numbers))
        dip = np.hypot(STIFF_RAD, RATIOS * x[:, PIP])[:, None]
        moved[:, :2] = np.nan_to_num(self._jump(table, x, finger, y)) * dip
        if numbers == SEEN:
            moved[:, 2:] = _by_dip(poses, x, finger) * dip
        wide += moved[:, :, None] * moved[:, None]
        root = np.linalg.cholesky(wide)
        white = np.asarray(np.linalg.inv(root), np.float64)
        off = (white @ (seen[finger] - y[:, :numbers])[..., None])[..., 0]
        _, S = self._to(white, seen[finger] - y[:, :numbers], J[:, :numbers, :2], finger)
        log_R = np.log(np.einsum("nii->ni", root)).sum(axis=1)
        return self._fine(start_rad.shape[1], finger, node, (x, off, S, log_R, length_px))

    def _jump(self, table: Forward, x: Float, finger: Int, y: Float) -> Float:
        """How the laser point moves with the PIP alone (N, 2) [m/rad], over a node to both sides."""
        step = table.step[finger, PIP]
        low, high = self._low[finger, PIP], self._high[finger, PIP]
        ends: list[Float] = []
        for sign in (-1.0, 1.0):
            near = x.copy()
            near[:, PIP] = np.clip(x[:, PIP] + sign * step, low, high)
            ends.append(np.abs(table.points(near, finger) - y[:, :2]))
        return np.maximum(ends[0], ends[1]) / step[:, None]

    def _to(self, white: Float, off: Float, J: Float, finger: Int) -> tuple[Float, Float]:
        slope = white @ J
        H = np.swapaxes(slope, 1, 2) @ slope
        np.einsum("nii->ni", H)[...] += _LOOSE * self._range[finger, 0]
        down = np.swapaxes(slope, 1, 2) @ (white @ off[..., None])
        det = H[:, 0, 0] * H[:, 1, 1] - H[:, 0, 1] ** 2
        S = np.empty(H.shape)
        S[:, 0, 0], S[:, 1, 1] = H[:, 1, 1], H[:, 0, 0]
        S[:, 0, 1] = S[:, 1, 0] = -H[:, 0, 1]
        S /= det[:, None, None]
        return (S @ down)[..., 0], S

    def _fine(self, nodes: int, finger: Int, node: Int, found: tuple[Float, ...]) -> Valley:
        """The valley from poses (N, 3), their residuals (N, M), covariances (N, 2, 2), log |R| / 2 and lines (N,)."""
        x, off, S, log_R, length_px = found
        numbers = off.shape[1]
        rows = np.full((5, nodes, UNKNOWNS + numbers + 6), np.nan)
        rows[finger, node] = np.concatenate(
            [x, off, S.reshape(-1, 4), log_R[:, None], length_px[:, None]], axis=1
        )
        share = np.arange(_FINE)[:, None] / _FINE
        between = (1.0 - share) * rows[:, :-1, None] + share * rows[:, 1:, None]
        rows = np.concatenate([between.reshape(5, -1, rows.shape[-1]), rows[:, -1:]], axis=1)
        x, off = rows[..., :UNKNOWNS], rows[..., UNKNOWNS : UNKNOWNS + numbers]
        S = rows[..., UNKNOWNS + numbers : -2].reshape(*x.shape[:2], 2, 2)
        misfit = np.nan_to_num((off * off).sum(axis=-1), nan=np.inf)
        det = np.maximum(S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2, 1e-30)
        log = -0.5 * misfit - rows[..., -2] + 0.5 * np.log(det)
        log = np.nan_to_num(log, nan=-np.inf, neginf=-np.inf)
        step = np.log((self._high - self._low)[:, None, PIP] / (nodes - 1.0) / _FINE)
        hands = np.stack([log + step + habit for habit in self._habits(x, S)])
        return Valley(x, S, rows[..., -1], misfit, log, hands)

    def _habits(self, x: Float, S: Float) -> tuple[Float, ...]:
        """Logarithms of the densities (5, P) of a natural hand, a straight and a free one, abduction left out."""
        ones = np.ones(x.shape[:2])
        (mean, sigma), (free_mean, free_sigma) = self._pip
        strayed = x[..., FLEXION] - self._base - self._slope * x[..., PIP]
        flexion = _normal(strayed, np.sqrt(self._stray**2 + np.nan_to_num(S[..., 1, 1], nan=1.0)))
        natural = _normal(x[..., PIP] - mean, sigma * ones) + flexion
        free = _normal(x[..., PIP] - free_mean, free_sigma * ones) + self._free_flexion
        straight = np.log(2.0) + _normal(x[..., PIP], _STRAIGHT_RAD * ones) + self._free_flexion
        straight[0] = free[0]
        return tuple(np.nan_to_num(part, nan=-np.inf) for part in (natural, straight, free))


def _normal(off: Float, sigma: Float) -> Float:
    return -0.5 * (off / sigma) ** 2 - np.log(sigma * np.sqrt(2.0 * np.pi))


def _near(misfit: Float, finger: Int) -> Int:
    """Which of poses (N,) of fingers (N,) are not hopeless."""
    least = np.full(5, np.inf)
    np.minimum.at(least, finger, misfit)
    return np.flatnonzero(misfit < least[finger] + _HOPELESS)


def _by_dip(poses: FingerPoses, x: Float, finger: Int) -> Float:
    """How tips move with the DIP alone (N, 2) [1/rad]."""
    angles, _ = poses.angles_of(np.concatenate([x, x]), np.concatenate([finger, finger]))
    angles[len(x) :, DIP] += _NUDGE_RAD
    before, after = poses.tips_of(angles, np.concatenate([finger, finger])).reshape(2, -1, 3)
    return (after[:, :2] / after[:, 2:] - before[:, :2] / before[:, 2:]) / _NUDGE_RAD
