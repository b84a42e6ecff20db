"""The palm's pose before a wrist camera from a hand that curls: laser points and fingertips against the hand's file.

Where the laser meets a natural finger, and where its tip is seen, are functions of one closing; the table of a hand
(`master.wrist.forward`) tells both for a pose of the palm. So each sighting of a finger asks its closing and gives
up to four numbers. A palm that tilts to the fingers looks much like fingers that bend a little: it is told by the
flat hand with which a curl begins, whose closing is none, as well as people hold it. Unknown are the pose (six) and how
far each finger goes aside (four, believed to be about none). Nonlinear least squares from the pose in the rig's file,
which must be right to a centimetre and ten degrees, as a drawing of the device tells it. Skin that is thicker than the
file says moves all points of a finger together: so their standard deviation is that of skin, and all sightings of a
finger count as two.
"""

from dataclasses import replace as with_changes

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import FitError
from common.geometry import rigid, rotation_vector_to_matrix, transform
from master.calibrate.wrist.curled import Curled
from master.calibrate.wrist.palm_board import PalmFit
from master.wrist.forward import LaserCut, NaturalCurve
from master.wrist.laser_plane import PlaneAxes
from master.wrist.setup import WristSetup
from master.wrist.skin import Skin

_SIGHTINGS = 8  # of each finger
_FINGERS = slice(1, 5)  # a thumb curls as it likes
_LASER_SIGMA_M = 1.2e-3  # skin of one hand against its file
_TIP_SIGMA_PX = 8.0  # what is seen as the tip changes with the bend
_ABDUCTED_SIGMA_RAD = np.radians(4.0)
_ABDUCTED_RAD = np.radians(np.array([-8.0, 0.0, 8.0]))
_FLAT_SIGMA_RAD = np.radians(4.0)  # how straight people hold a flat hand
_INDEPENDENT = 2.0  # sightings of a finger
_CLOSINGS = 21
_JUMP = 30.0  # standard deviations from one closing to the next
_FARTHEST = 6.0  # standard deviations at which a sighting counts no more
_FEWEST = 3  # fingers
_MOVED_M = 0.015  # of the laser point of a finger that curled
_STEP = np.r_[
    np.full(3, 3e-3), np.full(3, 3e-4), np.full(4, 3e-3)
]  # of derivatives: the table is not smooth below
_ROUNDS, _SETTLED = 12, 0.02  # steps, in standard deviations
TURN_LIMIT_RAD, SHIFT_LIMIT_M = np.radians(3.0), 5e-3
_STRAYS = 3.0  # standard deviations from which a sighting is believed less (Cauchy)
_WORST_RMS = 2.5  # standard deviations


def palm_from_hand(seen: Curled, setup: WristSetup) -> PalmFit:
    """The palm's pose that explains a curl.

    Args:
        seen: Laser points and fingertips; fingertips may all be missing.
        setup: The device with a first guess of the pose, and the user's hand.

    Raises:
        FitError: Too few sightings, a pose that they do not determine (the text says which part), or none that
            explains them.
    """
    finger, row = _chosen(seen)
    problem = _Problem(seen, setup, finger, row)
    x, jacobian = _solved(problem)
    rms = problem.fits(x)
    turn_sigma, shift_sigma, worst = _uncertainty(jacobian, rms)
    if turn_sigma > TURN_LIMIT_RAD or shift_sigma > SHIFT_LIMIT_M:
        raise FitError(
            f"the palm's pose is known to {np.degrees(turn_sigma):.1f} deg and {1e3 * shift_sigma:.1f} mm only"
            f" (limits {np.degrees(TURN_LIMIT_RAD):.0f} deg, {1e3 * SHIFT_LIMIT_M:.0f} mm), least of all {worst}: curl"
            " all fingers from straight to fist, tips in sight, or lay a board on the palm (--board)"
        )
    if rms > _WORST_RMS:
        raise FitError(
            f"no pose of the palm explains what was seen: sightings are {rms:.1f} times farther off than skin"
            " explains; is the hand file that of this hand and side, and the laser plane measured?"
        )
    laser_mm, tip_px = problem.off(x)
    residual = {"laser_rms_mm": round(laser_mm, 4), "normalised_rms": round(rms, 4)}
    if np.isfinite(tip_px):
        residual["tip_rms_px"] = round(tip_px, 4)
    note = f"{len(finger)} sightings of fingers in a curl, hand {setup.model.profile.name!r}"
    return PalmFit(problem.pose(x), turn_sigma, shift_sigma, residual, note)


def _chosen(seen: Curled) -> tuple[Int, Int]:
    """Fingers (n,) and triples (n,) of the sightings that count: of each finger evenly over its curl.

    Raises:
        FitError: Fewer than three fingers moved.
    """
    finger: list[int] = []
    row: list[int] = []
    for f in range(5)[_FINGERS]:
        points = seen.laser_m[:, f]
        known = np.flatnonzero(np.isfinite(points).all(axis=1))
        if len(known) < _SIGHTINGS:
            continue
        distance = np.linalg.norm(points[known], axis=1)
        nearest, farthest = (float(np.quantile(distance, share)) for share in (0.02, 0.98))
        if farthest - nearest < _MOVED_M:
            continue
        wanted = np.linspace(nearest, farthest, _SIGHTINGS)
        near = np.unique(np.abs(distance[:, None] - wanted).argmin(axis=0))
        finger += [f] * len(near)
        row += known[near].tolist()
    if len(set(finger)) < _FEWEST:
        raise FitError(
            f"{len(set(finger))} fingers curl before the laser, at least {_FEWEST} are needed:"
            " curl all from straight to fist"
        )
    return np.array(finger, np.int64), np.array(row, np.int64)


class _Problem:
    """Residuals of sightings by pose and abduction. It holds what was seen, and the device with its first guess."""

    def __init__(self, seen: Curled, setup: WristSetup, finger: Int, row: Int) -> None:
        self._setup, self._finger = setup, finger
        self._axes, self._skin = PlaneAxes.of(setup), Skin.of(setup.model)
        self._laser = self._axes.flat(seen.laser_m[row, finger])
        self._tip = seen.tip_uv[row, finger]
        curve = NaturalCurve.of(setup.model)
        low, high = curve.range_rad.T
        closing = low[:, None] + np.linspace(0.0, 1.0, _CLOSINGS) * (high - low)[:, None]
        self._closing = closing
        self._flat = _straightest(finger, self._laser)
        self._tables: dict[bytes, tuple[Float, Float]] = {}
        shape = (_CLOSINGS, len(_ABDUCTED_RAD), 5)
        aside = np.broadcast_to(_ABDUCTED_RAD[None, :, None], shape).copy()
        self._angles = curve.angles(np.broadcast_to(closing.T[:, None], shape).copy(), aside)  # (C, 3, 5, 4)

    def pose(self, x: Float) -> Float:
        """T_camera_palm (4, 4): the first guess, turned about the knuckles and shifted, both in the camera's axes."""
        guess = self._setup.T_camera_palm
        pivot = transform(guess, np.array([0.0, 0.0, 0.08]))
        turn = rotation_vector_to_matrix(x[:3])
        return rigid(turn @ guess[:3, :3], pivot + turn @ (guess[:3, 3] - pivot) + x[3:6])

    def residuals(self, x: Float) -> Float:
        """All residuals: sightings (5 each) in standard deviations, then the abductions."""
        return np.r_[self._sightings(x).ravel(), x[6:] / _ABDUCTED_SIGMA_RAD]

    def fits(self, x: Float) -> float:
        """Rms of the sightings' numbers, in standard deviations."""
        off = self._sightings(x)[self._known()]
        return float(np.sqrt(np.mean(np.clip(off, -_FARTHEST, _FARTHEST) ** 2)))

    def off(self, x: Float) -> tuple[float, float]:
        """Rms distance of laser points [mm] and tips [px]; NaN: no tip seen."""
        off = self._sightings(x)
        laser = 1e3 * _LASER_SIGMA_M * float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))
        tips = np.isfinite(self._tip).all(axis=1)
        if not tips.any():
            return laser, float("nan")
        return laser, _TIP_SIGMA_PX * float(np.sqrt((off[tips, 2:4] ** 2).sum(axis=1).mean()))

    def _known(self) -> Bool:
        known = [np.isfinite(self._laser), np.isfinite(self._tip), self._flat[:, None]]
        return np.concatenate(known, axis=1)

    def _sightings(self, x: Float) -> Float:
        """(n, 5) laser, tip and closing of each sighting against what suits best; 0 where not seen or not known."""
        laser, tip = self._curves(x)
        out = np.zeros((len(self._finger), 5))
        for f in np.unique(self._finger):
            own = self._finger == f
            aside = float(np.clip(x[5 + f], _ABDUCTED_RAD[0], _ABDUCTED_RAD[-1]))
            point, end = _between(laser[f], aside), _between(tip[f], aside)
            closing = self._closing[f, :, None] / _FLAT_SIGMA_RAD
            curve = np.concatenate([point / _LASER_SIGMA_M, end / _TIP_SIGMA_PX, closing], axis=1)
            none = np.where(self._flat[own], 0.0, np.nan)[:, None]
            wanted = [self._laser[own] / _LASER_SIGMA_M, self._tip[own] / _TIP_SIGMA_PX, none]
            out[own] = _nearest(curve, np.concatenate(wanted, axis=1))
        return out

    def _curves(self, x: Float) -> tuple[Float, Float]:
        """Laser points (5, C, 3, 2) [m] and tips (5, C, 3, 2) [px] of a pose; kept, for abductions change none."""
        key = x[:6].tobytes()
        if key not in self._tables:
            setup = with_changes(self._setup, T_camera_palm=self.pose(x))
            self._tables = dict(list(self._tables.items())[-3:])
            self._tables[key] = LaserCut(setup)(self._angles)[0], self._tips(setup)
        return self._tables[key]

    def _tips(self, setup: WristSetup) -> Float:
        """Pixels (5, C, 3, 2) of the outermost skin along each last bone."""
        chains = setup.model.chains(self._angles)
        ahead = chains.position_m[..., -1, :] - chains.position_m[..., -2, :]
        ahead = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
        end = self._skin.spheres(chains)[..., -1, :] + self._skin.radius_m[:, -1:] * ahead
        return np.moveaxis(setup.optics.project(transform(setup.T_camera_palm, end)), 2, 0)


def _straightest(finger: Int, laser: Float) -> Bool:
    """Which sighting (n,) of each finger is that of the flat hand: its laser point is the farthest."""
    flat = np.zeros(len(finger), dtype=np.bool_)
    for f in np.unique(finger):
        own = np.flatnonzero(finger == f)
        flat[own[int(np.linalg.norm(laser[own], axis=1).argmax())]] = True
    return flat


def _between(table: Float, aside: float) -> Float:
    """Row (C, N) of a table (C, 3, N) at an abduction [rad]."""
    k = 0 if aside < _ABDUCTED_RAD[1] else 1
    share = (aside - _ABDUCTED_RAD[k]) / (_ABDUCTED_RAD[k + 1] - _ABDUCTED_RAD[k])
    return (1.0 - share) * table[:, k] + share * table[:, k + 1]


def _nearest(curve: Float, wanted: Float) -> Float:
    """Differences (n, N) between points (n, N) and the nearest point of a polyline (C, N), only in what is known.

    Steps of the polyline with an unknown end are left out; a point that none of them comes near is as far as can be.
    """
    known = np.isfinite(wanted)
    goal = np.where(known, wanted, 0.0)
    a, way = curve[:-1], np.diff(curve, axis=0)
    # Where the laser misses the finger there is no curve; a jump of the line from part to part is none either.
    hit: Bool = np.isfinite(curve[:, 0] + curve[:, 1])
    usable: Bool = hit[:-1] & hit[1:] & (np.linalg.norm(way[:, :2], axis=1) < _JUMP)
    if not usable.any():
        return np.where(known, _FARTHEST, 0.0)
    a, way = np.nan_to_num(a[usable]), np.nan_to_num(way[usable])
    mask = known[:, None, :]
    arm = np.where(mask, goal[:, None] - a, 0.0)
    along = np.where(mask, way, 0.0)
    square = np.maximum((along * along).sum(axis=2), 1e-12)
    share = np.clip((arm * along).sum(axis=2) / square, 0.0, 1.0)
    off = arm - share[..., None] * along
    best = (off * off).sum(axis=2).argmin(axis=1)
    return off[np.arange(len(goal)), best]


def _solved(problem: _Problem) -> tuple[Float, Float]:
    """Unknowns (10,) and the weighed Jacobian there, by Levenberg and Marquardt; what strays is weighed down."""
    x, damping = np.zeros(10), 1e-2
    residuals = problem.residuals(x)
    jacobian = np.zeros((len(residuals), 10))
    for _ in range(_ROUNDS):
        columns = [
            (problem.residuals(x + h) - problem.residuals(x - h)) / (2.0 * h.sum()) for h in np.diag(_STEP)
        ]
        root = (1.0 + (residuals / _STRAYS) ** 2) ** -0.5  # Cauchy's weight, its root
        jacobian = np.stack(columns, axis=1) * root[:, None]
        information, pull = jacobian.T @ jacobian, jacobian.T @ (root * residuals)
        step = np.zeros(10)
        for _ in range(6):
            step = -np.linalg.solve(information + damping * np.diag(np.diag(information)), pull)
            trial = problem.residuals(x + step)
            if _cost(trial) < _cost(residuals):
                x, residuals, damping = x + step, trial, 0.2 * damping
                break
            damping *= 8.0
        else:
            break
        if float(step @ information @ step) < _SETTLED**2:
            break
    return x, jacobian


def _cost(residuals: Float) -> float:
    return float(np.log1p((residuals / _STRAYS) ** 2).sum())


def _uncertainty(jacobian: Float, rms: float) -> tuple[float, float, str]:
    """Standard deviations of turn [rad] and shift [m] in their least certain directions, and which that is."""
    information = jacobian.T @ jacobian
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    cov = (vectors / np.maximum(values, 1e-12)) @ vectors.T * np.outer(scale, scale)
    cov *= _SIGHTINGS / _INDEPENDENT * max(rms, 1.0) ** 2
    turn, turns = np.linalg.eigh(cov[:3, :3])
    shift, shifts = np.linalg.eigh(cov[3:6, 3:6])
    of_turn, of_shift = float(np.sqrt(turn[-1])), float(np.sqrt(shift[-1]))
    axis = turns[:, -1] if of_turn / TURN_LIMIT_RAD > of_shift / SHIFT_LIMIT_M else shifts[:, -1]
    kind = "the turn about" if of_turn / TURN_LIMIT_RAD > of_shift / SHIFT_LIMIT_M else "the shift along"
    return of_turn, of_shift, f"{kind} {'xyz'[int(np.abs(axis).argmax())]}"
