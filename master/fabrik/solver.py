"""The card: both slaves' centroids at one instant, disparity, depth, 1 €, palm, FABRIK per finger: a hand.

Push machine without clock, socket or thread. It holds what joins the cameras in time, the filter and the last hand.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import numpy as np

from common.arrays import Float
from common.camera_model import CameraModel
from common.hand_model import CHAINS, METACARPALS, PALM, TIPS, WRIST, HandModel
from common.messages import MarkerDetections, Source
from master.fabrik.estimate import HandEstimate, MarkerPositions, SolvedHand
from master.fabrik.finger import Finger
from master.fabrik.palm import Palm, PalmFitter
from master.fabrik.triangulate import Triangulate
from master.filters import PointFilter
from master.ik.hand import EXPLAINED
from master.ik.hidden import FingerMemory, HiddenFingers
from master.stereo.pairing import Instant, Pairing

Stage = Callable[[str], AbstractContextManager[None]]
FORGET_S = 0.5  # after this long without markers nothing is known of the hand any more
_ON_TARGET_M = 1e-4
_FIT_M2 = (3e-3) ** 2 * np.eye(3)  # of a finger's marker as the palm's fit has it
_DRIFT_M_S = 0.3  # of a hand that is held
_PALM_JOINTS = np.array([PALM, WRIST, *METACARPALS])
_PALM_MARKERS = 3
_NATURAL = 1.0  # the line knows no hand without habits
_ANYWHERE = HiddenFingers(np.zeros((5, 4)), np.full(5, np.inf), np.zeros(5), np.ones(5))


class FabrikSolver:
    """Solves the hand of a rig by the card's line."""

    def __init__(
        self,
        cameras: dict[str, CameraModel],
        model: HandModel,
        markers: tuple[str, ...],
        hand_markers: tuple[str, ...],
        *,
        sync: Pairing,
        triangulate: Triangulate,
        one_euro: PointFilter | None,
        palm: PalmFitter,
        stage: Stage = lambda name: nullcontext(),
    ) -> None:
        """Join the parts.

        Args:
            cameras: In the rig's order.
            model: The hand.
            markers: Names in the order of every marker array.
            hand_markers: Those of them that are on this hand.
            sync: Brings cameras to one instant.
            triangulate: Centroids to points by the rig's depth model.
            one_euro: Filter of the points; None: instants are unrelated, nothing is filtered or remembered.
            palm: Fits the palm from the hand's markers.
            stage: Opens a timer by stage name.
        """
        self._model, self.sync, self._triangulate = model, sync, triangulate
        self._one_euro, self._palm, self._stage = one_euro, palm, stage
        self.on_hand = np.array([markers.index(name) for name in hand_markers], np.int64)
        self._centres = np.array([camera.centre for camera in cameras.values()])
        self._focal_px = np.array([camera.matrix[0, 0] for camera in cameras.values()])
        self._ahead = -np.array([camera.T_rig_camera[:3, 2] for camera in cameras.values()])[0]
        mounts = [model.mount(name) for name in hand_markers]
        self._on_palm = np.array([mount.joint is None for mount in mounts], np.bool_)
        self._fingers = {
            m: (mount.finger, Finger.of(model, mount.finger, mount.offset_m, _ON_TARGET_M))
            for m, mount in enumerate(mounts)
            if mount.finger is not None
        }
        self._memory = FingerMemory(model)
        self._last: SolvedHand | None = None
        self._last_palm: Palm | None = None
        self._last_ns = self._seen_ns = -(2**62)

    def push(self, message: MarkerDetections) -> list[HandEstimate]:
        """Take one camera's centroids; return the hands of the instants that they complete, oldest first."""
        return [self.solve(instant) for instant in self.sync.push(message)]

    def flush(self) -> list[HandEstimate]:
        """At the end of a recording: the hands that still wait for a camera."""
        return [self.solve(instant) for instant in self.sync.flush()]

    def solve(self, instant: Instant, near: SolvedHand | None = None) -> HandEstimate:
        """Solve one instant.

        Args:
            instant: What the cameras see of it.
            near: A hand that is surer than this line's last one, for the side of the caps that the cameras see.
        """
        last, age_s = self._recent(instant.t_ns)
        seen_as, pixels = near or last, (instant.uv, instant.sigma_px, instant.area)
        with self._stage("triangulate"):
            markers = self._triangulate(*pixels, seen_as, age_s)
            if seen_as is None and (first := self._fit(markers.points_m, markers.cov_m2, instant, None, 0.0)):
                self._memory = FingerMemory(self._model)
                markers = self._triangulate(*pixels, self._hand_of(first), 0.0)
        with self._stage("filter"):
            smooth = markers.points_m
            if self._one_euro is not None:
                smooth = self._one_euro.push(instant.t_ns, smooth, markers.noise_m2)
        with self._stage("fabrik"):
            palm = self._fit(smooth, markers.cov_m2, instant, last, age_s)
            return self._estimate(instant, markers, smooth, palm)

    def peek(self, points: Float, cov: Float, area_px2: Float) -> SolvedHand | None:
        """The hand by points alone, and nothing remembered; a finger that is not seen may be anywhere natural.

        Args:
            points, cov: (M, 3) [m] and (M, 3, 3) [m^2] of all markers; NaN: not placed.
            area_px2: (C, M) as the cameras see them.

        Returns:
            The hand; None: the points are too few.
        """
        points, cov = points[self.on_hand], cov[self.on_hand]
        palm = self._palm(points, cov, self._facing_of(points, area_px2), hidden=_ANYWHERE)
        return None if palm is None else self._hand_of(palm)

    def _recent(self, t_ns: int) -> tuple[SolvedHand | None, float]:
        """The last hand, if it still says anything, and how long ago it held [s]."""
        age_s = (t_ns - self._last_ns) * 1e-9
        if self._one_euro is None or self._last is None or not 0.0 < age_s <= FORGET_S:
            return None, 0.0
        return self._last, age_s

    def _fit(
        self, points: Float, cov: Float, instant: Instant, last: SolvedHand | None, age_s: float
    ) -> Palm | None:
        """The palm of an instant; `last` as of `_recent`."""
        points, cov = points[self.on_hand], cov[self.on_hand]
        seen = np.isfinite(points[:, 0])
        facing = self._facing_of(points, instant.area)
        if last is None:
            return self._palm(points, cov, facing)
        shown = frozenset(f for m, (f, _) in self._fingers.items() if seen[m])
        hidden = self._memory.belief(instant.t_ns, self._last_ns, last.angles_rad, _NATURAL, shown)
        return self._palm(points, cov, facing, self._last_palm, age_s, hidden)

    def _facing_of(self, points: Float, area_px2: Float) -> Float | None:
        """As `facing`; None: nothing of the back is seen."""
        return self.facing(points, area_px2) if np.isfinite(points[self._on_palm, 0]).any() else None

    def facing(self, points: Float, area_px2: Float) -> Float:
        """Unit vector (3,) from what is seen of the hand to the cameras that see the back of it.

        A flat marker shows each camera its area times the cosine of its tilt, so the directions to the cameras,
        weighed by what each sees, add up to where it faces, as far as they tell.

        Args:
            points: (H, 3) [m] markers of the hand; NaN: not placed.
            area_px2: (C, M) of all markers.
        """
        found = points[np.isfinite(points[:, 0])]
        if not len(found):
            return self._ahead
        back = self._centres - found.mean(axis=0)
        distance = np.linalg.norm(back, axis=1)
        shown = np.nansum(area_px2[:, self.on_hand[self._on_palm]], axis=1) * (distance / self._focal_px) ** 2
        towards = (shown if shown.any() else np.ones(len(shown))) @ (back / distance[:, None])
        length = float(np.linalg.norm(towards))
        return towards / length if length > 0.0 else back[0] / distance[0]

    def _hand_of(self, palm: Palm) -> SolvedHand:
        """The hand as the palm's fit has it."""
        angles = self._model.clamp(self._palm.parameters.angles(palm.x))
        joints = self._model.joints(palm.T, self._model.chains(angles))
        cov, tilt = self._palm.covariances(palm)
        return SolvedHand(palm.T, angles, joints, cov, tilt, np.zeros((5, 3, 3)))

    def _estimate(
        self, instant: Instant, markers: MarkerPositions, smooth: Float, palm: Palm | None
    ) -> HandEstimate:
        """Bring the fingers of a palm onto their markers; without a palm the last hand is held."""
        points = smooth[self.on_hand]
        seen, reached = np.zeros(5, np.bool_), np.zeros(5, np.bool_)
        residual, iterations = np.full(5, np.nan), np.zeros(5, np.int64)
        explained = np.zeros(5, np.bool_)
        facing = self.facing(points, instant.area)
        valid, tracked = np.zeros(26, np.bool_), np.zeros(26, np.bool_)
        source = np.full(26, Source.HELD, np.uint8)
        if palm is None:
            hand = self._held(instant.t_ns)
            valid[:] = hand is not None
            return HandEstimate(
                instant.t_ns,
                markers,
                smooth,
                facing,
                hand,
                valid,
                tracked,
                source,
                seen,
                residual,
                iterations,
                reached,
            )
        fitted = self._hand_of(palm)
        R, origin = palm.T[:3, :3], palm.T[:3, 3]
        targets = (points - origin) @ R
        places = self._palm.attached.place(self._model.chains(fitted.angles_rad))
        angles = fitted.angles_rad.copy()
        gain = _FIT_M2 @ np.linalg.inv(_FIT_M2 + np.nan_to_num(R.T @ markers.cov_m2[self.on_hand] @ R))
        targets = places + (gain @ (targets - places)[..., None])[..., 0]
        for m, (f, finger) in self._fingers.items():
            if np.isfinite(targets[m, 0]):
                residual[f], iterations[f], reached[f] = finger.solve(targets[m], angles[f])
                seen[f], explained[f] = True, palm.surprise[m] < EXPLAINED
        angles = self._model.clamp(angles)
        joints = self._model.joints(palm.T, self._model.chains(angles))
        off = joints.position_m - fitted.joints.position_m
        cov = fitted.cov_m2 + off[:, :, None] * off[:, None, :]
        hand = SolvedHand(palm.T, angles, joints, cov, fitted.tilt_cov_rad2, fitted.tilt_walk_rad2_s2)
        count = int(np.isfinite(points[:, 0]).sum())
        placed = count >= _PALM_MARKERS or (count == 2 and np.isfinite(points[self._on_palm, 0]).any())
        valid[:] = True
        tracked[(CHAINS if placed else TIPS)[explained]] = True
        source[CHAINS[seen]] = Source.SOLVED
        source[TIPS[seen]] = Source.MEASURED
        if placed:
            tracked[_PALM_JOINTS], source[_PALM_JOINTS] = True, Source.SOLVED
        last, age_s = self._recent(instant.t_ns)
        if last is not None:
            self._memory.moved(last.angles_rad, angles, age_s)
        self._last, self._last_palm, self._last_ns = hand, palm, instant.t_ns
        return HandEstimate(
            instant.t_ns,
            markers,
            smooth,
            facing,
            hand,
            valid,
            tracked,
            source,
            seen,
            residual,
            iterations,
            reached,
        )

    def _held(self, t_ns: int) -> SolvedHand | None:
        """The last hand while it says anything, as much less sure as it may have moved."""
        last, age_s = self._recent(t_ns)
        if last is None:
            return None
        cov = last.cov_m2 + (_DRIFT_M_S * age_s) ** 2 * np.eye(3)
        return SolvedHand(
            last.T_rig_palm, last.angles_rad, last.joints, cov, last.tilt_cov_rad2, last.tilt_walk_rad2_s2
        )
