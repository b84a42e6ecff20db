"""Hands painted alike are told apart by where each is expected.

A slave names the blobs of a paint in no particular order. Of each camera's frame, before it goes to the hands' lines:
each hand's markers are expected where its last pose and their velocity have them, with the pose's covariance and
what an acceleration adds. A blob costs a hand its squared distance in that covariance and the logarithm of its
determinant (likelihood of a normal distribution; Bar-Shalom, "Estimation with Applications", 2001, 1.4); a hand that
is not there has a constant density over the image. Of the ways to give the blobs of a paint to the hands the least
costly counts if it is clearly so; else none of them does, for this frame.

A hand begins, and begins anew when it was lost, where blobs that are no other hand's meet in two cameras: points
close together, one of each paint, that have the hand's side. The back marker shows which face of the hand is turned
to the cameras, so that thumb, fingers and line of sight form a right- or a left-handed frame. Until several frames
agree, the hand is not published.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import log
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from common.arrays import Bool, Float, Int
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import WRIST, HandModel
from common.kernels import inner, kernel
from common.messages import HandPose, MarkerDetections
from master.estimator.sensors import CameraArrays, project
from master.fabrik.intersection import triangulate
from master.rig.setup import RigSetup


class AlikeSettings(NamedTuple):
    """Numbers of the association of two hands.

    Costs are -2 log likelihood, so that a hand's own blob costs about 2 + log det [px^4]. `absent`: of the density of
    one blob anywhere in the image, 640 x 480, and 1 in 10 that a hand comes.
    """

    absent: float = 30.0  # cost of a blob for a hand that is not there
    most: float = 45.0  # of a blob that is not where the hand is expected
    change: float = 4.0  # of a marker that comes or goes: one frame in twenty
    clear: float = 6.0  # by which a way must be better: 20 to 1
    known_s: float = 0.7  # after a pose; then the hand is not there
    velocity_s: float = 0.1  # between poses from which a velocity is taken
    acceleration_m_s2: float = 15.0  # of a marker, standard deviation
    sigma_px: float = 1.0  # of a blob that states none
    place_m: float = 0.003  # by which the part of a cap that is seen lies off its centroid, at most about
    begin_m: float = 0.015  # of points of two frames that are not of one instant
    apart_periods: float = 1.5  # between the frames of two cameras that show one hand
    meet_px: float = 8.0  # by which their rays may miss each other: 1 m/s between the frames
    least: int = 4  # markers from which a hand can begin
    hand_m: float = 0.15  # of a marker from the middle of its hand's
    hand_m2: float = 0.03  # sum of squared distances from the middle that a second hand must save
    ambiguous_m2: float = 0.004  # by which the next grouping must be worse
    side: float = 1.0  # sum over frames of how surely the hands have their sides


ALIKE = AlikeSettings()

_LEFT, _UNCLEAR = 2, 3
# Whose the two blobs of a paint may be, by how many hands are known; of one: of the first -1, of the second -2.
_WAYS = {
    0: np.array([[_LEFT, _LEFT]]),
    -1: np.array([[0, _LEFT], [_LEFT, 0], [_LEFT, _LEFT]]),
    -2: np.array([[1, _LEFT], [_LEFT, 1], [_LEFT, _LEFT]]),
    2: np.array([[0, 1], [1, 0]]),
}


@inner
def _cost(a: float, b: float, c: float, x: float, y: float) -> float:
    """-2 log likelihood, but for a constant, of (x, y) with covariance a, b; b, c."""
    det = a * c - b * b
    return (c * x * x - 2.0 * b * x * y + a * y * y) / det + log(det)


@kernel
def costs(
    cameras: CameraArrays,
    which: Int,
    since_s: Float,
    row_s: Float,
    points: Float,
    velocity: Float,
    cov: Float,
    uv: Float,
    variance_px2: Float,
    out: Float,
) -> None:
    """Write what it costs that blobs i and j of two frames are a hand's.

    Args:
        which: (2,) the cameras of the two frames.
        since_s: (2,) from the points' time to the frames' first row [s]; row_s: (2,) from row to row.
        points, velocity, cov: (K, 3) [m], (K, 3) [m/s], (K, 3, 3) [m^2] of the hand's markers.
        uv: (2, K, 2, 2) [px] blobs of the frames, NaN: none; variance_px2: (2, K) of them.
        out: (K, 3, 3); i or j 2: none, which costs nothing.
    """
    px, J, S, point = np.empty((2, 2)), np.empty((2, 2, 3)), np.empty((4, 4)), np.empty(3)
    for k in range(len(points)):
        known, process = np.isfinite(cov[k, 0, 0]), 0.0
        for n in range(2):
            known = known and project(cameras, which[n], points[k], px[n], J[n])
            tau = since_s[n] + row_s[n] * px[n, 1]
            for axis in range(3):
                ahead_s = min(max(tau, -ALIKE.velocity_s), ALIKE.velocity_s)
                point[axis] = points[k, axis] + ahead_s * velocity[k, axis]
            known = known and project(cameras, which[n], point, px[n], J[n])
            process = max(process, ALIKE.place_m**2 + (0.5 * ALIKE.acceleration_m_s2 * tau * tau) ** 2)
        for i in range(4):
            for j in range(4):
                total = variance_px2[i // 2, k] if i == j else 0.0
                for m in range(3):
                    for n in range(3):
                        noise = process if m == n else 0.0
                        total += J[i // 2, i % 2, m] * (cov[k, m, n] + noise) * J[j // 2, j % 2, n]
                S[i, j] = total
        out[k] = 0.0
        for n in range(2):
            for i in range(2):
                x, y = uv[n, k, i, 0] - px[n, 0], uv[n, k, i, 1] - px[n, 1]
                a, b, c = S[2 * n, 2 * n], S[2 * n, 2 * n + 1], S[2 * n + 1, 2 * n + 1]
                value = min(_cost(a, b, c, x, y), ALIKE.most) if known else ALIKE.absent
                if np.isfinite(uv[n, k, i, 0]):
                    out[k, i if n == 0 else 2, i if n == 1 else 2] = value
        det = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
        for i in range(2):
            for j in range(2):
                out[k, i, j] = out[k, i, 2] + out[k, 2, j]
                x, y = uv[0, k, i, 0] - px[0, 0], uv[0, k, i, 1] - px[0, 1]
                if not known or not np.isfinite(x + uv[1, k, j, 0]):
                    continue
                # of the second, what the first leaves open
                u, v = (S[1, 1] * x - S[0, 1] * y) / det, (S[0, 0] * y - S[0, 1] * x) / det
                x2 = uv[1, k, j, 0] - px[1, 0] - S[2, 0] * u - S[2, 1] * v
                y2 = uv[1, k, j, 1] - px[1, 1] - S[3, 0] * u - S[3, 1] * v
                a = S[2, 2] - _through(S, det, 2, 2)
                b = S[2, 3] - _through(S, det, 2, 3)
                c = S[3, 3] - _through(S, det, 3, 3)
                both = _cost(S[0, 0], S[0, 1], S[1, 1], x, y) + _cost(a, b, c, x2, y2)
                apart = ALIKE.most + min(out[k, i, 2], out[k, 2, j])  # one of them is something else
                out[k, i, j] = min(both, apart)


@inner
def _through(S: Float, det: float, i: int, j: int) -> float:
    """S_i A^-1 S_j of rows i and j with the first two, whose covariance is A."""
    return (
        S[1, 1] * S[i, 0] * S[j, 0]
        - S[0, 1] * (S[i, 0] * S[j, 1] + S[i, 1] * S[j, 0])
        + S[0, 0] * S[i, 1] * S[j, 1]
    ) / det


@dataclass(slots=True)
class _Hand:
    """One of the hands, and where its markers were last."""

    model: HandModel
    joint: Int  # (M,) that carries each marker
    offset_m: Float  # (M, 3) in that joint's frame
    finger: Int  # (M,) thumb 0 ... little 4; -1: on the palm
    t_ns: int | None = None  # None: it is not there
    points_m: Float = field(default_factory=lambda: np.empty((0, 3)))
    cov_m2: Float = field(default_factory=lambda: np.empty((0, 3, 3)))
    velocity_m_s: Float = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def of(cls, setup: RigSetup) -> "_Hand":
        model, mounts = setup.hand, [setup.hand.mount(name) for name in setup.hand_markers]
        turn, place = model.rest_rotation[WRIST].T, model.rest_position_m[WRIST]
        offset = [one.offset_m if one.joint is not None else turn @ (one.offset_m - place) for one in mounts]
        joint = [WRIST if one.joint is None else one.joint for one in mounts]
        finger = [-1 if one.finger is None else one.finger for one in mounts]
        return cls(model, np.array(joint), np.array(offset), np.array(finger))

    def take(self, pose: HandPose) -> None:
        """Go on from a pose; one that is not valid is none."""
        if not pose.valid.all():
            return
        R = quaternion_to_matrix(pose.orientation_wxyz[self.joint])
        points = pose.position_m[self.joint] + (R @ self.offset_m[:, :, None])[..., 0]
        velocity = np.zeros_like(points)
        if self.t_ns is not None and 0 < pose.t_ns - self.t_ns <= ALIKE.velocity_s * 1e9:
            moved = (points - self.points_m) / ((pose.t_ns - self.t_ns) * 1e-9)
            share = 0.5  # of what is new in it
            velocity = self.velocity_m_s + share * (np.nan_to_num(moved) - self.velocity_m_s)
        self.t_ns, self.points_m, self.velocity_m_s = pose.t_ns, points, velocity
        self.cov_m2 = pose.cov_m2[self.joint]

    def begin(self, t_ns: int, points_m: Float) -> None:
        """Begin at points (M, 3) [m]; NaN: not seen."""
        self.t_ns, self.points_m, self.velocity_m_s = t_ns, points_m, np.zeros_like(points_m)
        self.cov_m2 = np.tile(ALIKE.begin_m**2 * np.eye(3), (len(points_m), 1, 1))

    def of_paints(self, points_m: Float, marker: Int) -> Float:
        """Points (M, 3) of the hand's markers from those (K, 3) of paints."""
        out = np.full((len(self.joint), 3), np.nan)
        out[marker] = points_m
        return out

    def costs(self, cameras: CameraArrays, now: "_Frame", other: "_Frame | None", h: int) -> Float:
        """As `costs` (K, 3, 3), of the rig's hand `h`; `other` None: no other frame."""
        assert self.t_ns is not None
        frames, marker = (now, other or now), now.camera.marker[:, h]
        uv = np.stack([now.uv, np.full_like(now.uv, np.nan) if other is None else other.uv])
        out = np.empty((len(marker), 3, 3))
        costs(
            cameras,
            np.array([one.camera.place for one in frames]),
            np.array([one.t_ns - self.t_ns for one in frames]) * 1e-9,
            np.array([one.camera.model.row_time_ns for one in frames]) * 1e-9,
            self.points_m[marker],
            self.velocity_m_s[marker],
            self.cov_m2[marker],
            uv,
            np.stack([one.variance_px2 for one in frames]),
            out,
        )
        return out

    def side_of(self, points_m: Float, towards: Float) -> float:
        """How surely points (M, 3) are of this hand's side, 1, or of the other's, -1.

        `towards`: (3,) from them to the cameras. 0: nothing shows it.
        """
        seen = np.isfinite(points_m[:, 0])
        palm, fingers = points_m[seen & (self.finger < 0)], points_m[seen & (self.finger >= 0)]
        if not len(palm) or len(fingers) < ALIKE.least - 1:
            return 0.0
        order = self.finger[seen & (self.finger >= 0)]
        across = fingers[order.argmin()] - fingers[order.argmax()]
        along = fingers[order > 0].mean(axis=0) - palm.mean(axis=0)
        volume = float(np.cross(across, along) @ towards)
        size = np.linalg.norm(across) * np.linalg.norm(along) * np.linalg.norm(towards)
        return -self.model.side_sign * volume / max(float(size), 1e-9)


@dataclass(frozen=True, slots=True, eq=False)
class _Watching:
    """One camera that sees both hands."""

    model: CameraModel
    late_ns: int
    place: int  # among the cameras
    slots: Int  # (K, 2) rows of the messages that share a paint: the first hand's, the second hand's
    marker: Int  # (K, 2) which marker of each hand that is


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """Two blobs of each paint in one camera's frame; NaN: none."""

    t_ns: int
    uv: Float  # (K, 2, 2)
    variance_px2: Float  # (K,)
    camera: _Watching


class AlikeHands:
    """Push machine that holds two hands' last poses and each camera's left blobs."""

    def __init__(self, setups: Sequence[RigSetup], counts: Counter[str]) -> None:
        """Of two hands before the same cameras; use `of`."""
        self._counts, self._names = counts, tuple(one.hand.profile.name for one in setups)
        self._hands = tuple(_Hand.of(one) for one in setups)
        models = setups[0].models
        self._cameras, self._centres = (
            CameraArrays.of(tuple(models.values())),
            np.array([m.centre for m in models.values()]),
        )
        self._watching: dict[str, _Watching] = {}
        for place, (name, model) in enumerate(models.items()):
            first, second = (one.paints[name] for one in setups)
            pairs = [
                (a, second.index(paint))
                for a, paint in enumerate(first)
                if paint is not None and paint in second
            ]
            rows = [(setups[0].rows[name][a], setups[1].rows[name][b]) for a, b in pairs]
            late_ns = round(1e3 * setups[0].rig.stamp_offset_us.get(name, 0.0))
            self._watching[name] = _Watching(
                model, late_ns, place, np.array(rows).reshape(-1, 2), np.array(pairs).reshape(-1, 2)
            )
        self._period_ns = max(1e9 / one.frame_rate_hz for one in setups[0].cameras.values())
        self._left: dict[int, _Frame] = {}  # camera -> what was over in its last frame
        self._last: dict[int, _Frame] = {}
        self._seen: dict[int, Bool] = {}  # camera -> (K, 2) whether it saw each hand's marker of a paint
        self._lean, self._lean_ns, self._lean_places = 0.0, 0, np.zeros((2, 3))
        point, at = np.full((1, 3), np.nan), np.zeros(2)
        seen, out = (np.zeros((2, 1, 2, 2)), np.ones((2, 1))), np.empty((1, 3, 3))
        costs(
            self._cameras, np.zeros(2, np.intp), at, at, point, point, np.eye(3)[None], *seen, out
        )  # compiled now

    @classmethod
    def of(cls, setups: Sequence[RigSetup], counts: Counter[str]) -> "AlikeHands | None":
        """Associate the hands painted alike; None: there are none.

        Raises:
            CalibrationError: There are more than two, or they are of one side.
        """
        alike = [one for one in setups if any(_shared(one, other) for other in setups if other is not one)]
        if not alike:
            return None
        where = f"rig {alike[0].rig.name!r}: other_hands"
        if len(alike) > 2:
            raise CalibrationError(f"{where}: {len(alike)} hands are painted alike; two can be told apart")
        if alike[0].hand.side_sign == alike[1].hand.side_sign:
            raise CalibrationError(
                f"{where}: two {alike[0].hand.profile.side} hands are painted alike: paint one in other colours"
            )
        return cls(alike, counts)

    def push(self, message: MarkerDetections) -> MarkerDetections:
        """Return a camera's message with each hand's blobs in that hand's rows."""
        camera = self._watching.get(message.camera)
        if camera is None or not len(camera.slots):
            return message
        uv, sigma = message.uv[camera.slots], message.sigma_px[camera.slots]
        variance = np.nan_to_num(sigma, nan=ALIKE.sigma_px).max(axis=1) ** 2
        now = _Frame(message.t_ns + camera.late_ns, uv, variance, camera)
        owner = self._owners(now)
        if not all(known := self._known(now.t_ns)):
            left = np.where((owner == _LEFT)[..., None], uv, np.nan)
            self._left[camera.place] = _Frame(now.t_ns, left, variance, camera)
            if self._begin(self._left[camera.place], known):
                owner = self._owners(now)
        self._last[camera.place] = now
        return self._ordered(message, camera, owner)

    def _nearest_frame(self, frames: Mapping[int, _Frame], now: _Frame) -> _Frame | None:
        """The nearest frame of another camera; None: too long ago, or of other paints."""
        others = [one for place, one in frames.items() if place != now.camera.place]
        other = min(others, key=lambda one: abs(one.t_ns - now.t_ns), default=now)
        near = abs(other.t_ns - now.t_ns) <= ALIKE.apart_periods * self._period_ns
        alike = np.array_equal(other.camera.marker, now.camera.marker)
        return other if near and alike and other is not now else None

    def take(self, pose: HandPose) -> None:
        """Take a pose of one of the hands, or of another."""
        if pose.hand in self._names:
            self._hands[self._names.index(pose.hand)].take(pose)

    def _known(self, t_ns: int) -> list[bool]:
        return [h.t_ns is not None and abs(t_ns - h.t_ns) <= ALIKE.known_s * 1e9 for h in self._hands]

    def _owners(self, now: _Frame) -> Int:
        """Whose each blob (K, 2) is: a hand's, `_LEFT` over, or `_UNCLEAR`."""
        known, other = self._known(now.t_ns), self._nearest_frame(self._last, now)
        ways = _WAYS[sum(known) if sum(known) != 1 else -1 - known.index(True)]
        seen, row = np.isfinite(now.uv[..., 0]), np.arange(len(now.uv))
        left = (ways == _LEFT).astype(np.float64).T * ALIKE.absent
        total = (seen @ left)[..., None]  # (K, ways, ways in the other frame)
        if other is not None:
            total = total + (np.isfinite(other.uv[..., 0]) @ left)[:, None]
        own = np.zeros((*seen.shape, 2))
        for h, hand in enumerate(self._hands):
            if known[h]:
                cost = hand.costs(self._cameras, now, other, h)
                own[..., h] = cost[:, :2, 2]
                blob = np.where((ways == h).any(axis=1), (ways == h).argmax(axis=1), 2)
                total = total + (cost[:, blob][:, :, blob] if other is not None else cost[:, blob, 2:])
        total = total.min(axis=2)
        was = self._seen.setdefault(now.camera.place, np.zeros(seen.shape, np.bool_))
        shows = ((ways[None, ..., None] == (0, 1)) & seen[:, None, :, None]).any(axis=2)  # (K, ways, 2 hands)
        total += ALIKE.change * (shows != was[:, None]).sum(axis=2)
        best = total.argmin(axis=1)
        # ways that give the blobs that are there to the same hands are one
        differs = ((ways[None] != ways[best][:, None]) & seen[:, None]).any(axis=2)
        second = np.where(differs, total, np.inf).min(axis=1)
        clear = second - total[row, best] >= ALIKE.clear
        if all(known):  # blobs that are all where no hand is expected say nothing
            fits = np.take_along_axis(own, ways[best][..., None], axis=2)[..., 0] < ALIKE.most
            clear &= (seen & fits).any(axis=1)
        was[clear] = shows[row, best][clear]
        self._counts["alike.unclear"] += int((seen & ~clear[:, None]).sum())
        return np.where(clear[:, None], ways[best], _UNCLEAR)

    def _ordered(self, message: MarkerDetections, camera: _Watching, owner: Int) -> MarkerDetections:
        """The message with each blob in its owner's row, and no others of these paints."""
        source = np.arange(len(message.area))
        source[camera.slots] = -1
        for h in (0, 1):
            for k, i in np.argwhere(owner == h):
                source[camera.slots[k, h]] = camera.slots[k, i]
        if (source == np.arange(len(source))).all():
            return message
        fields = {
            name: getattr(message, name)[source] for name in ("uv", "area", "quality", "sigma_px", "alt_uv")
        }
        for array in fields.values():
            array[source < 0] = np.nan
        return replace(message, **fields)

    def _begin(self, now: _Frame, known: Sequence[bool]) -> bool:
        """Let hands that are not known begin with what is left over, if that is clear."""
        if (other := self._nearest_frame(self._left, now)) is None:
            return False
        groups, marker = self._groups(now, other, 2 - sum(known))
        if not np.isfinite(groups).any():
            return False
        towards = self._centres.mean(axis=0) - np.nanmean(groups, axis=(0, 1))
        order = [0, 1] if not any(known) else [known.index(False), known.index(True)]  # whose the groups are
        points = [self._hands[h].of_paints(one, marker[:, h]) for h, one in zip(order, groups, strict=True)]
        score = sum(self._hands[h].side_of(one, towards) for h, one in zip(order, points, strict=True))
        if score < 0.0 and not any(known):
            order, score = order[::-1], -score
            points = [
                self._hands[h].of_paints(one, marker[:, h]) for h, one in zip(order, groups, strict=True)
            ]
        places = np.zeros((2, 3))
        for h, one in zip(order, groups, strict=True):
            shown = one[np.isfinite(one[:, 0])]
            places[h] = shown.mean(axis=0) if len(shown) else 0.0
        same_m, same_ns = 0.08, 2e8  # by which a hand moves between two looks, and how far apart these are
        moved = np.linalg.norm(places - self._lean_places, axis=1)
        if now.t_ns - self._lean_ns > same_ns or (moved > same_m).any():
            self._lean = 0.0
        self._lean, self._lean_ns, self._lean_places = self._lean + score, now.t_ns, places
        if (
            self._lean <= -ALIKE.side
        ):  # what is left over has the side of the hand that is known: that was lost
            self._hands[order[1]].t_ns, self._lean = None, 0.0
        if self._lean < ALIKE.side:
            return False
        for h, one in zip(order, points, strict=True):
            if not known[h] and np.isfinite(one[:, 0]).sum() >= ALIKE.least:
                self._hands[h].begin(now.t_ns, one)
                self._counts[f"alike.begun.{self._names[h]}"] += 1
        self._lean = 0.0
        return True

    def _groups(self, now: _Frame, other: _Frame, hands: int) -> tuple[Float, Int]:
        """Points (2, K, 3) [m] of two hands in two frames, and their markers (K, 2).

        NaN: not seen. All NaN: nothing, or it is not clear what belongs together.
        """
        marker = now.camera.marker
        uv = np.full(
            (len(self._centres), len(marker), 2, 2, 2), np.nan
        )  # camera, paint, blob here, blob there
        uv[now.camera.place], uv[other.camera.place] = now.uv[:, :, None], other.uv[:, None]
        found = triangulate(self._cameras, uv.reshape(len(uv), -1, 2), 1.0)
        met = np.where((found.residual_px < ALIKE.meet_px)[:, None], found.points_m, np.nan)
        options = [_options(one, hands) for one in met.reshape(len(marker), 2, 2, 3)]
        if first := next((some for some in options if len(some) > 1 and hands == 2), None):
            del first[len(first) // 2 :]  # the rest is the same with the groups in the other order
        unclear = np.full((2, len(marker), 3), np.nan), marker
        count = np.prod([len(some) for some in options])
        most = 20_000
        if not 0 < count <= most:
            return unclear
        ways = np.array(list(product(*(range(len(some)) for some in options))))
        points = np.stack(
            [np.array(some)[ways[:, k]] for k, some in enumerate(options)], axis=2
        )  # (N, 2, K, 3)
        seen = np.isfinite(points[..., :1])
        number = seen.sum(axis=2, keepdims=True)
        middle = np.where(seen, points, 0.0).sum(axis=2, keepdims=True) / np.maximum(number, 1)
        spread = (np.where(seen, points - middle, 0.0) ** 2).sum(axis=(1, 2, 3))
        spread += ALIKE.hand_m2 * (number > 0).sum(axis=(1, 2, 3))
        best, *rest = np.sort(spread)[:2].tolist()
        if rest and rest[0] - best < ALIKE.ambiguous_m2:
            return unclear
        groups = points[spread.argmin()]
        if not np.isfinite(groups[..., 0]).any(axis=1).all():
            return groups, marker
        # What one of two hands shows alone may be a blob of each: then it lies beside both, or as near to the other.
        away = np.linalg.norm(groups[:, None] - np.nanmean(groups, axis=1)[None, :, None], axis=3)
        nearest, farthest = (
            np.nanmin(away, axis=(0, 1), initial=np.inf),
            np.nanmax(away, axis=(0, 1), initial=0.0),
        )
        lone = np.isnan(groups[..., 0]).any(axis=0)
        lone &= (nearest > ALIKE.hand_m) | (farthest < nearest + ALIKE.hand_m / 2.0)
        return np.where(lone[:, None], np.nan, groups), marker


def _options(P: Float, hands: int) -> list[Float]:
    """Points (2, 3) of two hands that one paint may show.

    `P`: (2, 2, 3) where a blob of one camera meets one of the other; NaN: nowhere.
    """
    nothing = np.full(3, np.nan)
    pairs = [(i, j) for i in (0, 1) for j in (0, 1) if np.isfinite(P[i, j, 0])]
    both = [np.stack([P[i, j], P[1 - i, 1 - j]]) for i, j in pairs if np.isfinite(P[1 - i, 1 - j, 0])]
    if hands == 2 and both:
        return both
    first = [np.stack([P[i, j], nothing]) for i, j in pairs]
    second = [one[::-1] for one in first[::-1]] if hands == 2 else []
    return [*first, *second] or [np.stack([nothing, nothing])]


def _shared(one: RigSetup, other: RigSetup) -> bool:
    """Whether two hands have a paint in common before one camera."""
    return any(
        paint is not None and paint in other.paints.get(camera, ())
        for camera, paints in one.paints.items()
        for paint in paints
    )
