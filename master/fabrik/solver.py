"""The card: centroids, disparity, depth, 1 €, palm, FABRIK per finger: a hand.

Push machine without clock, socket or thread. It holds what joins the cameras in time, the filter and the last hand.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from math import isfinite

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, METACARPALS, PALM, TIPS, WRIST, HandModel
from common.messages import MarkerDetections, Source
from master.estimator.epoch import Epoch, Fitted
from master.estimator.estimator import Estimator
from master.estimator.hand_tables import Mounts
from master.estimator.observation_sources import ON_MARKERS
from master.estimator.state import PALM_PART
from master.fabrik.estimate import HandEstimate, SolvedHand
from master.fabrik.finger import Finger
from master.fabrik.one_euro import PointFilter
from master.fabrik.sync import FrameSet, FrameSync
from master.fabrik.targets import back_normal_of, targets_of
from master.fabrik.triangulate import Triangulate

Stage = Callable[[str], AbstractContextManager[None]]
FORGET_S = 0.5  # after this long without markers nothing is known of the hand any more
_FIT_M2 = (3e-3) ** 2  # of a finger's marker as the palm's fit has it
_PALM_JOINTS = np.array([PALM, WRIST, *METACARPALS])
_AWAY = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))  # a hand before a camera at the origin


class FabrikSolver:
    """Solves the hand of a rig by the card's line."""

    def __init__(
        self,
        cameras: dict[str, CameraModel],
        model: HandModel,
        markers: tuple[str, ...],
        hand_markers: tuple[str, ...],
        *,
        sync: FrameSync,
        triangulate: Triangulate,
        one_euro: PointFilter | None,
        palm: Estimator,
        once: Estimator,
        stage: Stage = lambda name: nullcontext(),
    ) -> None:
        """Join the parts.

        Args:
            cameras: In the rig's order.
            model: The hand.
            markers: Names in the order of every marker array.
            hand_markers: Those of them that are on this hand.
            sync: Brings cameras to one epoch.
            triangulate: Centroids to points by the rig's depth model.
            one_euro: Filter of the points; None: epochs are unrelated, nothing is filtered or remembered.
            palm: Fits the palm, with the angles that go best with it, from the hand's markers.
            once: The same without memory; fingers that are not seen may be anywhere natural.
            stage: Opens a timer by stage name.
        """
        self._model, self.sync, self.triangulate = model, sync, triangulate
        self._one_euro, self._palm, self._once, self._stage = one_euro, palm, once, stage
        self.continuous = one_euro is not None  # epochs follow each other; else nothing is remembered
        self.on_hand = np.array([markers.index(name) for name in hand_markers], np.int64)
        self._centres = np.array([camera.centre for camera in cameras.values()])
        self._focal_px = np.array([camera.matrix[0, 0] for camera in cameras.values()])
        self._ahead = -next(iter(cameras.values())).T_rig_camera[:3, 2]
        mounts, places = [model.mount(name) for name in hand_markers], Mounts.of(model, hand_markers)
        self._count = len(markers)
        self._back = self.on_hand[places.on_back]
        self._finger_of = places.finger
        self._on_finger = self._finger_of >= 0
        at_tips = {int(self._finger_of[m]): m for m, mount in enumerate(mounts) if mount.joint in TIPS}
        on_target_m = 1e-4
        self._fingers = {
            m: (f, Finger.of(model, f, mounts[m].offset_m, on_target_m)) for f, m in at_tips.items()
        }
        self._last: SolvedHand | None = None
        self._last_ns = -(2**62)

    def push(self, message: MarkerDetections) -> list[HandEstimate]:
        """Take one camera's centroids; return the hands they complete, oldest first."""
        return [self.solve(frames) for frames in self.sync.push(message)]

    def flush(self) -> list[HandEstimate]:
        """At the end of a recording: the hands that still wait for a camera."""
        return [self.solve(frames) for frames in self.sync.flush()]

    def solve(
        self, frames: FrameSet, warm_start: SolvedHand | None = None, warm_start_age_s: float = 0.0
    ) -> HandEstimate:
        """Solve one epoch.

        Args:
            frames: What the cameras see of it.
            near: A hand that is surer than this line's last one, for the side of the caps that the cameras see; this
                line's then has its covariance to first order.
            warm_start_age_s: How long ago that held [s].
        """
        last, age_s = self._recent(frames.t_ns)
        seen_as, seen_age_s = (last, age_s) if warm_start is None else (warm_start, warm_start_age_s)
        pixels = frames.uv, frames.sigma_px, frames.area
        with self._stage("triangulate"):
            markers = self.triangulate(*pixels, seen_as, seen_age_s)
            if seen_as is None:
                first = self.solve_once(markers.points_m, markers.cov_m2, frames.area)
                markers = self.triangulate(*pixels, first, 0.0, as_seen=first is None)
        with self._stage("filter"):
            smooth = markers.points_m
            if self._one_euro is not None:
                smooth = self._one_euro.push(frames.t_ns, smooth, markers.noise_m2)
        with self._stage("fabrik"):
            back_normal = self.towards(smooth[self.on_hand], frames.area)
            out = HandEstimate.unseen(frames.t_ns, markers, smooth, back_normal)
            palm = self._palm.push(
                Epoch(
                    frames.t_ns, smooth, back_normal, cov_m2=markers.cov_m2, second_order=warm_start is None
                )
            )
            return self._estimate(out, smooth[self.on_hand], markers.cov_m2[self.on_hand], palm)

    def solve_once(self, points: Float, cov: Float, area_px2: Float) -> SolvedHand | None:
        """Solve from points alone and remember nothing.

        A finger that is not seen may be anywhere natural.

        Args:
            points, cov: (M, 3) [m] and (M, 3, 3) [m^2] of all markers; NaN: not placed.
            area_px2: (C, M) as the cameras see them.

        Returns:
            The hand; None: the points are too few.
        """
        back_normal = self.towards(points[self.on_hand], area_px2)
        return self._once.push(Epoch(0, points, back_normal, cov_m2=cov)).solution

    def rehearse(self) -> None:
        """Call every kernel once, so that none is compiled while a hand is tracked."""
        self.sync.at(0)
        _, places = self._palm.pose(_AWAY, np.full((5, 4), 0.2))
        points, cov = np.full((self._count, 3), np.nan), np.full((self._count, 3, 3), np.nan)
        points[self.on_hand], cov[self.on_hand] = places, 1e-6 * np.eye(3)
        seen = np.ones((len(self._centres), self._count))
        first = self.solve_once(points, cov, seen)
        self.triangulate(100.0 * np.stack([seen, seen], axis=-1), seen, seen, first, 0.0)
        targets = np.empty_like(places)
        targets_of(places, cov[self.on_hand], _AWAY, places, _FIT_M2, targets)
        self.sync.at(0)

    def _recent(self, t_ns: int) -> tuple[SolvedHand | None, float]:
        """Return the last hand, if it is still informative, and its age [s]."""
        age_s = (t_ns - self._last_ns) * 1e-9
        if not self.continuous or self._last is None or not 0.0 < age_s <= FORGET_S:
            return None, 0.0
        return self._last, age_s

    def towards(self, points: Float, area_px2: Float) -> Float:
        """Return the unit vector (3,) to the cameras that see most of the back.

        Of the hand's points (H, 3) [m], by the areas of all markers (C, M) [px^2].
        """
        out = self._ahead.copy()
        back_normal_of(points, area_px2[:, self._back], self._centres, self._focal_px, out)
        return out

    def _estimate(self, out: HandEstimate, points: Float, cov: Float, palm: Fitted) -> HandEstimate:
        """Bring a palm's fingers onto their markers; without a palm hold the last hand."""
        last, age_s = self._recent(out.t_ns)
        fit, triangulated = palm.solution, np.isfinite(points[:, 0])
        if fit is None or not triangulated.any():
            out.valid[:] = last is not None
            return out if last is None else replace(out, solution=_drifted(last, age_s))
        T, angles = fit.T_rig_palm, fit.angles_rad.copy()
        _, fitted = self._palm.pose(T, angles)
        targets = np.empty_like(fitted)
        targets_of(points, cov, T, fitted, _FIT_M2, targets)
        for m, (f, finger) in self._fingers.items():
            if isfinite(targets[m, 0]):
                out.residual_m[f], out.iterations[f], out.reached[f] = finger.solve(targets[m], angles[f])
        joints, _ = self._palm.pose(T, angles)
        off = joints.position_m - fit.joints.position_m
        joint_cov = fit.cov_m2 + off[:, :, None] * off[:, None, :]
        hand = SolvedHand(T, angles, joints, joint_cov, fit.tilt_cov_rad2, fit.tilt_process_noise_rad2_s2)
        self._judge(out, palm, fit.marker_chi2, triangulated)
        self._last, self._last_ns = hand, out.t_ns
        solved = bool(np.isfinite(out.residual_m).any() or out.tracked.any())
        return replace(out, solution=hand, solved=solved)

    def _judge(self, out: HandEstimate, palm: Fitted, marker_chi2: Float, triangulated: Bool) -> None:
        """Write the bits of a solved hand; `triangulated`: (H,) which markers are.

        What they explain is tracked.
        """
        out.seen[self._finger_of[triangulated & self._on_finger]] = True
        inlier = out.seen.copy()
        wrong = marker_chi2 >= self._palm.settings.marker_gate
        inlier[self._finger_of[wrong & self._on_finger]] = False
        out.valid[:] = True
        out.source[CHAINS[out.seen]] = Source.SOLVED
        out.source[TIPS[out.seen]] = Source.MEASURED
        if palm.sources[PALM_PART] & ON_MARKERS:
            out.tracked[_PALM_JOINTS], out.source[_PALM_JOINTS] = True, Source.SOLVED
            out.tracked[CHAINS[inlier]] = True
        else:
            out.tracked[TIPS[inlier]] = True


def _drifted(hand: SolvedHand, age_s: float) -> SolvedHand:
    """A hand that was solved a time ago, as much less sure as it may have moved."""
    held_m_s = 0.3  # of a hand that is held
    return replace(hand, cov_m2=hand.cov_m2 + (held_m_s * age_s) ** 2 * np.eye(3))
