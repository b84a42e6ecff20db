"""What a pipeline makes of the messages of a scene, beside the exact truth; all of them, or with streams cut off.

A wrist device alone knows no place: its hand is put where the wrist joint truly is, turned as the palm truly is. What
it says of joints is then that of the fingers alone, with an exact palm, which nothing that must find it can have.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from bench.both.scene import Both, Observed
from bench.played import START_NS
from common.arrays import Bool, Float
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import CHAINS, WRIST
from common.messages import HandPose, ImuSample, MarkerDetections
from master.outputs.poses import Poses
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigSetup
from master.run.app import StageTimes

_FOLLOWS_S = 0.1  # poses farther apart are a new beginning, not a step
_SETTLED_S = 1.0  # of every scene's beginning: filters and IMU find their feet


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """What a pipeline made of a scene, in the rig frame, and the truth at the same N instants.

    Attributes:
        poses: As published, but a hand that only a wrist device knows put where it truly is.
        t_s: (N,) scene times [s].
        truth_m: (N, 26, 3) joints [m].
        placed_m: (N, 26, 3) joints of the poses, were the palm where it truly is [m].
        truth_rad: (N, 5, 4) angles.
        markers, wrist: Which sensors the pipeline has; the IMU comes with the wrist device.
    """

    poses: Poses
    t_s: Float
    truth_m: Float
    placed_m: Float
    truth_rad: Float
    markers: bool
    wrist: bool

    @classmethod
    def of(cls, both: Both, poses: list[HandPose], setup: RigSetup) -> Self:
        """Judge these poses of a rig; those of the first second are left out."""
        kept = [pose for pose in poses if pose.t_ns >= START_NS + round(_SETTLED_S * 1e9)]
        found = Poses.of(kept)
        t_s = np.asarray((found.t_ns - START_NS) * 1e-9, np.float64)
        states = [both.scene.motion.at(t) for t in t_s.tolist()]
        angles = np.array([state.angles_rad for state in states])
        truth = both.scene.model.forward(np.array([state.T_rig_palm for state in states]), angles)
        placed = _placed(found, truth.position_m[:, WRIST], truth.rotation[:, WRIST])
        return cls(
            poses=found if setup.markers else placed,
            t_s=t_s,
            truth_m=truth.position_m,
            placed_m=placed.position_m,
            truth_rad=angles,
            markers=bool(setup.markers),
            wrist=setup.wrist is not None,
        )

    @property
    def off_mm(self) -> Float:
        """(N, 25) errors of all joints but the palm's [mm]; NaN where not valid."""
        off = 1e3 * np.linalg.norm(self.poses.position_m - self.truth_m, axis=2)
        return np.where(self.poses.valid, off, np.nan)[:, 1:]

    @property
    def fingers_mm(self) -> Float:
        """(N, 15) errors of the joints beyond the knuckles, were the palm where it truly is [mm]; NaN: not valid."""
        off = 1e3 * np.linalg.norm(self.placed_m - self.truth_m, axis=2)
        return np.where(self.poses.valid, off, np.nan)[:, CHAINS[:, 1:].ravel()]

    @property
    def pip_deg(self) -> Float:
        """(N, 5) errors of the PIP, of the thumb its MCP [deg]; NaN where the finger is not valid."""
        off = np.degrees(np.abs(self.poses.angles_rad - self.truth_rad)[..., 2])
        return np.where(self.poses.valid[:, CHAINS[:, 1]], off, np.nan)

    @property
    def joint_chi2(self) -> Float:
        """(N, 25) chi square of every joint by its own covariance; NaN where not valid or without one."""
        off = (self.poses.position_m - self.truth_m)[:, 1:]
        cov = self.poses.cov_m2[:, 1:]
        known = self.poses.valid[:, 1:] & np.isfinite(cov).all(axis=(2, 3)) & np.isfinite(off).all(axis=2)
        safe = np.where(known[..., None, None], cov, np.eye(3))
        chi = np.vecdot(off, np.linalg.solve(safe, off[..., None])[..., 0])
        return np.where(known, chi, np.nan)

    @property
    def steps_mm(self) -> Float:
        """(N - 1, 25) step from pose to pose beyond the truth's own [mm]; NaN where it is no step."""
        step = np.diff(self.poses.position_m, axis=0) - np.diff(self.truth_m, axis=0)
        valid = self.poses.valid[1:] & self.poses.valid[:-1]
        valid &= (np.diff(self.t_s) <= _FOLLOWS_S)[:, None]
        return np.where(valid, 1e3 * np.linalg.norm(step, axis=2), np.nan)[:, 1:]


def _placed(found: Poses, wrist_m: Float, wrist_rotation: Float) -> Poses:
    """A hand with the wrist joint there (N, 3) and turned so (N, 3, 3)."""
    own = quaternion_to_matrix(found.orientation_wxyz[:, WRIST])
    rotation = wrist_rotation @ np.swapaxes(own, 1, 2)
    beyond = found.position_m - found.position_m[:, WRIST, None]
    place = wrist_m[:, None] + np.einsum("nab,njb->nja", rotation, beyond)
    cov = rotation[:, None] @ found.cov_m2 @ np.swapaxes(rotation, 1, 2)[:, None]
    return replace(found, position_m=place, cov_m2=cov)


def solve(setup: RigSetup, messages: Iterable[Observed]) -> list[HandPose]:
    """The poses that a rig's pipeline makes of those messages that are of its sensors."""
    pipeline = pipeline_of(setup, StageTimes())
    poses: list[HandPose] = []
    for message in messages:
        if isinstance(message, ImuSample):
            if message.source in setup.imus:
                pipeline.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
        elif message.camera in setup.cameras:
            poses += [one.pose for one in pipeline.push(message)]
    return poses + [one.pose for one in pipeline.flush()]


@dataclass(frozen=True, slots=True)
class RejectedPeer:
    """Which streams are cut off when: every so many seconds one of the two, for a while, in turn.

    Attributes:
        every_s: From one cut to the next.
        lasts_s: How long each lasts.
    """

    every_s: float = 2.0
    lasts_s: float = 1.0

    def at(self, t_s: Float) -> tuple[Bool, Bool]:
        """(N,) whether the markers are away at the scene times (N,), and the wrist device with its IMU."""
        rotation, since = np.divmod(np.asarray(t_s) - self.every_s / 2, self.every_s)
        gone = (since < self.lasts_s) & (rotation >= 0)
        return gone & (rotation % 2 == 0), gone & (rotation % 2 == 1)

    def left(self, messages: list[Observed]) -> list[Observed]:
        """The messages that still come."""
        markers, wrist = self.at(np.array([1e-9 * (message.t_ns - START_NS) for message in messages]))
        of_markers = np.array([isinstance(message, MarkerDetections) for message in messages])
        gone = np.where(of_markers, markers, wrist)
        return [message for message, lost in zip(messages, gone.tolist(), strict=True) if not lost]
