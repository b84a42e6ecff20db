"""What is seen of the fingers while the wrist is bent: as `master.wrist.pose_table`, without a table.

A table holds for one place of the palm before the camera, and takes a second. At another bend of the wrist the palm is
elsewhere, so what is seen comes in closed form (`master.wrist.ridge`), and where it matters from the laser's cut
itself: at the places where a search has come to (`mended`), from which it goes on with what the closed form lacks
there added to it.

**Where to begin.** At a given PIP a finger is a rigid body that turns about its knuckle, so its tip lies on a sphere,
and on the ray on which it is seen. That leaves two places, and each tells flexion and abduction by two arc tangents.
The laser point chooses between the two.
"""

from copy import copy

import numpy as np

from common.arrays import Bool, Float, Int
from common.hand_limits import ABDUCTION, FLEXION
from common.hand_model import CHAINS
from master.wrist.finger_poses import SEEN, UNKNOWNS, FingerPoses
from master.wrist.finger_shape import Shape, ShapedFingers
from master.wrist.forward import PIP, NaturalCurve
from master.wrist.laser_cut import LaserCut
from master.wrist.pose_table import SHAPE
from master.wrist.ridge import Crossings, Ridge
from master.wrist.setup import WristSetup

_RAYS = 24
_CLOSINGS = 25
_PLAUSIBLE_M = 0.2  # of a laser point, where the tip is where it was seen: noise of both leaves less
_OFF_RAD = 1.0  # of a tip that no flexion brings to its ray
_THE_SAME_RAD = 1e-9  # as a node: rounding
_UNKNOWN_M = 1.0  # what a closed form may be wrong by: who wants to be exact asks the cut


class BentWrist:
    """One device and hand for every bend. What it holds was prepared by the constructor."""

    def __init__(self, setup: WristSetup, poses: FingerPoses) -> None:
        self._setup, self._poses = setup, poses
        self.ridge, self._cut = Ridge(setup), LaserCut(setup, _RAYS)
        self._pip = np.linspace(poses.low[:, PIP], poses.high[:, PIP], SHAPE[PIP])
        x = np.zeros((SHAPE[PIP], 5, UNKNOWNS))
        x[..., PIP] = self._pip
        model = setup.model
        self.knuckle_m, self.root = (
            model.rest_position_m[CHAINS[:, 0]],
            model.rest_rotation[CHAINS[:, 0]],
        )
        angles = poses.angles(x)
        tips = poses.tips_in_palm(angles)
        self.reach = np.einsum("fij,pfi->pfj", self.root, tips - self.knuckle_m)
        self.path_rad, self.path = self._path(poses.curve)
        self._nodes = self.ridge.shapes(angles.reshape(-1, 4), np.tile(np.arange(5), SHAPE[PIP]))

    def at(self, bend_rad: Float) -> "BentView":
        """What is seen at a bend (2,) [rad]."""
        setup = self._setup.bent(bend_rad)
        ridge = self.ridge.bent(setup, bend_rad)
        return BentView(self, setup, self._poses.bent(setup), self._cut.bent(setup), ridge)

    def _path(self, curve: NaturalCurve) -> tuple[Float, ShapedFingers]:
        """Even steps of closing (5, C) [rad] from straight to closed, and fingers (5 C) that close so, not aside."""
        closing = curve.range_rad[:, :1] + np.linspace(0.0, 1.0, _CLOSINGS) * np.diff(curve.range_rad)
        finger = np.repeat(np.arange(5), _CLOSINGS)
        angles = curve.base_rad[finger] + closing.reshape(-1, 1) * curve.slope[finger]
        angles[:, ABDUCTION] = 0.0
        return closing, self.ridge.shapes.fingers(angles, finger)

    def shape(self, angles_rad: Float, finger: Int) -> Shape:
        """The fingers (N,) of angles (N, 4) whose DIP follows the PIP; of PIPs that are nodes from a table."""
        pip, low, high = angles_rad[:, PIP], self._pip[0, finger], self._pip[-1, finger]
        share = np.nan_to_num((pip - low) / (high - low)).clip(0.0, 1.0)
        node = np.rint((SHAPE[PIP] - 1.0) * share).astype(np.int64)
        if (np.abs(self._pip[node, finger] - pip) < _THE_SAME_RAD).all():
            return self._nodes.of(5 * node + finger)
        return self.ridge.shapes(angles_rad, finger)

    @property
    def pip(self) -> Float:
        """(P, 5) the PIP [rad] of the places that `BentView.candidates` tells of."""
        return self._pip


class BentView:
    """What is seen at one bend.

    Attributes:
        poses: Exactly, for tips and for who wants to be sure.
        first, step, met, exact: As of `PoseTable`; it is not exact before it was mended.
    """

    def __init__(
        self, wrist: BentWrist, setup: WristSetup, poses: FingerPoses, cut: LaserCut, ridge: Ridge
    ) -> None:
        self.poses = poses
        self._wrist, self._setup, self._cut, self._ridge = wrist, setup, cut, ridge
        self.first = poses.low
        self.step = (poses.high - poses.low) / (np.array(SHAPE) - 1.0)
        self.met: Bool = np.ones(5, np.bool_)
        self.exact, self._lacks = False, np.zeros((1, SEEN))
        self._length_px: Float | None = None

    def crossings(self, angles_rad: Float, finger: Int) -> Crossings:
        """What is seen of angles (N, 4) of fingers (N,) in closed form."""
        return self._ridge(self._ridge.shapes.fingers(angles_rad, finger))

    def path(self) -> tuple[Float, Crossings]:
        """Closings (5, C) [rad] of fingers that close naturally, and what is seen of them (5 C)."""
        return self._wrist.path_rad, self._ridge(self._wrist.path)

    def views(self, x: Float, finger: Int) -> tuple[Float, Float, Float]:
        """As `PoseTable.views`: (N, 4) seen, (N, 4, 3) its derivatives [1/rad], (N,) length of the line [px]."""
        angles, follows = self.poses.angles_of(x, finger)
        found = self._ridge(self._fingers(angles, finger))
        J = found.by_angles[..., :UNKNOWNS].copy()
        J[..., PIP] += follows[:, None] * found.by_angles[..., -1]
        length = found.length_px if self._length_px is None else self._length_px
        return found.seen + self._lacks, J, length

    def points(self, x: Float, finger: Int) -> Float:
        """Laser points (N, 2) [m] alone."""
        return self._points(x, finger)[0] + self._lacks[:, :2]

    def mended(self, x: Float, finger: Int, y: Float) -> tuple["BentView", Float]:
        """The same, exact at poses (N, 3) of fingers (N,): to be asked for these, or what they become, alone.

        Of these y (N, 4) is seen in closed form. Second: what is seen exactly; NaN where the laser misses the finger.
        """
        other = copy(self)
        other.exact, other._lacks = True, np.zeros((len(x), SEEN))
        angles, _ = self.poses.angles_of(x, finger)
        point, other._length_px = self.cut(self._fingers(angles, finger))
        other._lacks[:, :2] = point - y[:, :2]
        return other, y + other._lacks

    def cut(self, fingers: ShapedFingers) -> tuple[Float, Float]:
        """Laser points of fingers (N) by the cut itself: (N, 2) [m], and lines (N,) [px].

        NaN where the laser misses the finger.
        """
        line = self._cut.line(*self._ridge.spheres(fingers), fingers.finger == 0)
        return line.point_m, line.length_px

    def lacking(self, angles_rad: Float, finger: Int) -> tuple[Crossings, Float, Float]:
        """What is seen of angles (N, 4) of fingers (N,) in closed form, and what its laser points lack (N, 2) [m].

        Third: lines (N,) [px]. NaN where the laser misses the finger.
        """
        fingers = self._ridge.shapes.fingers(angles_rad, finger)
        found, (point, length) = self._ridge(fingers), self.cut(fingers)
        return found, point - found.seen[:, :2], length

    def candidates(self, seen: Float) -> tuple[Float, Float]:
        """As `PoseTable.candidates`: places (5, P, 3) [rad], and how badly their laser points fit (5, P); inf: not."""
        x, off = self._by_tip(seen[:, 2:])  # (2, P, 5, 3), (2, P, 5)
        finger = np.broadcast_to(np.arange(5), off.shape).ravel()
        flat = x.reshape(-1, UNKNOWNS)
        point, met = self._points(flat, finger)
        away = (point - seen[finger, :2]) / _PLAUSIBLE_M
        energy = (np.vecdot(away, away) + np.where(met, 0.0, 0.5)).reshape(off.shape) + (off / _OFF_RAD) ** 2
        best = energy.argmin(axis=0)[None]
        energy = np.take_along_axis(energy, best, axis=0)[0].T
        places = np.take_along_axis(x, best[..., None], axis=0)[0]
        return np.swapaxes(places, 0, 1).copy(), np.where(energy < 1.0, energy, np.inf)

    def starts(self, seen: Float, finger: int, count: int) -> Float:
        """As `PoseTable.starts`: places (N, 3) [rad], at most so many, of which one may lead to what was seen (4,)."""
        places, energy = self.candidates(np.tile(seen, (5, 1)))
        order = energy[finger].argsort()[:count]
        return places[finger][order[np.isfinite(energy[finger][order])]]

    def doubt(self, x: Float, finger: Int) -> Float:
        """As `PoseTable.doubt`, (N, 2) [m]."""
        return np.full((len(x), 2), _UNKNOWN_M)

    def _points(self, x: Float, finger: Int) -> tuple[Float, Bool]:
        angles, _ = self.poses.angles_of(x, finger)
        return self._ridge.points(self._fingers(angles, finger))

    def _fingers(self, angles_rad: Float, finger: Int) -> ShapedFingers:
        """Fingers (N) of angles (N, 4) whose DIP follows the PIP."""
        shape = self._wrist.shape(angles_rad, finger)
        return self._ridge.shapes.fingers(angles_rad, finger, shape)

    def _by_tip(self, tip: Float) -> tuple[Float, Float]:
        """Poses (2, P, 5, 3) that show tips (5, 2), the far and the near one, and how far beside (2, P, 5) [rad]."""
        T, wrist = self._setup.T_camera_palm, self._wrist
        ray = np.concatenate([tip, np.ones((5, 1))], axis=1) @ T[:3, :3]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        eye = -T[:3, 3] @ T[:3, :3]
        towards = wrist.knuckle_m - eye
        middle = np.vecdot(ray, towards)
        beside = np.vecdot(towards, towards) - middle**2
        reach = wrist.reach  # (P, 5, 3)
        room = np.vecdot(reach, reach) - beside
        half = np.sqrt(np.maximum(room, 0.0))
        far = middle + np.stack([half, -half])
        t = eye + far[..., None] * ray - wrist.knuckle_m
        t = np.einsum("fij,kpfi->kpfj", wrist.root, t)
        # The root turns by the abduction about its y, then by minus the flexion about its x.
        long = np.hypot(reach[..., 1], reach[..., 2])
        turned = np.arctan2(reach[..., 2], reach[..., 1])
        away = np.arccos(np.clip(t[..., 1] / long, -1.0, 1.0))
        flexion = turned + np.stack(
            [away, -away]
        )  # two bring the tip to that height, and one of them is a finger's
        ahead = reach[..., 2] * np.cos(flexion) - reach[..., 1] * np.sin(flexion)
        aside = np.arctan2(t[..., 0], t[..., 2]) - np.arctan2(
            np.broadcast_to(reach[..., 0], ahead.shape), ahead
        )
        x = np.empty((*ahead.shape, UNKNOWNS))
        x[..., ABDUCTION] = self._setup.model.side_sign * _wrapped(aside)
        x[..., FLEXION], x[..., PIP] = _wrapped(flexion), wrist.pip
        out = np.clip(x, self.poses.low, self.poses.high)
        beyond = np.abs(out - x).max(axis=-1)
        best = beyond.argmin(axis=0)[None]
        out = np.take_along_axis(out, best[..., None], axis=0)[0]
        beyond = np.take_along_axis(beyond, best, axis=0)[0]
        distance = np.maximum(middle, 1e-3)
        return out, beyond * long / distance + np.sqrt(np.maximum(-room, 0.0)) / distance


def _wrapped(angle: Float) -> Float:
    """Angles within half a turn of none."""
    return np.arctan2(np.sin(angle), np.cos(angle))
