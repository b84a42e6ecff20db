"""What a wrist device would see of a hand of given angles: by the exact cut, without errors of any kind."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from common.arrays import Bool, Float
from common.hand.model import CHAINS
from common.hand.wrist import STRAIGHT
from common.messages import HandPose, WristDetections
from common.records import boxed, record
from master.estimator.finger_surface import Surface
from master.estimator.parameters import HandParameters, HandTables
from master.estimator.priors import WristModel, loosened
from master.estimator.sensors import Device
from master.estimator.wrist_pipeline import WristPipeline
from master.rig.setup import WristSetup
from tests.master.estimator.kernels import laser_centroid_at, look_at
from tests.wrist_run import wrist_setup

CYCLE_NS = 33_333_333
PIP, DIP = 2, 3
LIT_PX = 0.2
NO_TWIST = np.zeros(5)


@dataclass(frozen=True, eq=False)
class Seen:
    """What is seen of five fingers; x, y are those of undistorted rays (x, y, 1).

    Attributes:
        laser: (5, 2) by the exact cut; NaN: the laser misses the finger, or it is not seen.
        length_px: (5,) of the line.
        predicted_laser: (5, 2) by the ridge.
        tip: (5, 2) fingertips, and `depth_m` (5,) how far they are along the camera's axis.
        by: (5, 5, 7) derivatives of ridge, tip and logarithm of its distance (`master.estimator.finger_surface.look`).
    """

    laser: Float
    length_px: Float
    predicted_laser: Float
    tip: Float
    depth_m: Float
    by: Float


class WristCase:
    """A wrist device and the hand before it."""

    def __init__(self, setup: WristSetup) -> None:
        self.setup = setup
        self.model = loosened(setup.model)
        self.wrist = WristModel.of(setup, loose=True)
        self.tables = HandTables.of(self.model, HandParameters.of(self.model))
        self.device = Device.of(setup)

    @classmethod
    def of(cls, root: Path, rig: str = "wrist") -> "WristCase":
        """That of a shipped rig."""
        wrist = wrist_setup(root, rig).wrist
        assert wrist is not None
        return cls(wrist)

    def looks(self, angles: Float, wrist_angles: Float = STRAIGHT, twist: Float = NO_TWIST) -> Seen:
        """What is seen of angles (5, 4) [rad], at a bend (2,) and with hinges rolled by (5,) [rad]."""
        work, flat = record(Surface), np.ascontiguousarray(angles).reshape(20)
        laser, predicted_laser, tip = (np.full((5, 2), np.nan) for _ in range(3))
        length, depth, by = np.zeros(5), np.zeros(5), np.zeros((5, 5, 7))
        for f in range(5):
            boxes = boxed(self.tables), boxed(self.device)
            look_at(*boxes, np.asarray(wrist_angles), np.asarray(twist), flat, f, boxed(work))
            predicted_laser[f], tip[f], depth[f], by[f] = work.seen[:2], work.seen[2:4], work.tip[2], work.J
            length[f] = laser_centroid_at(boxed(self.device), f, boxed(work))
            if length[f] > 0.0:
                laser[f] = work.laser_centroid[:2] / work.laser_centroid[2]
        return Seen(laser, length, predicted_laser, tip, depth, by)

    def message(
        self,
        angles: Float,
        t_ns: int = CYCLE_NS,
        *,
        tips: Bool | bool = True,
        unit: float | None = None,
        wrist_angles: Float = STRAIGHT,
        twist: Float = NO_TWIST,
        lines: bool = False,
    ) -> WristDetections:
        """The triple of such a hand.

        Args:
            angles: (5, 4) [rad].
            t_ns: When.
            tips: (5,) which fingertips are seen.
            unit: Of distances by light; None: there are none.
            wrist_angles, twist: As of `looks`.
            lines: Whether lengths of the lines are reported.
        """
        seen, optics = self.looks(angles, wrist_angles, twist), self.setup.optics
        laser = optics.distort(seen.laser)
        tip = np.where((np.ones(5, np.bool_) & tips)[:, None], optics.distort(seen.tip), np.nan)
        depth = np.full(5, np.nan) if unit is None else unit * seen.depth_m
        return message(laser, tip, t_ns, depth=depth, length=seen.length_px if lines else None)


def message(
    laser: Float,
    tip: Float,
    t_ns: int = CYCLE_NS,
    *,
    laser_px: float = LIT_PX,
    tip_px: float = 2.0,
    depth: Float | None = None,
    length: Float | None = None,
) -> WristDetections:
    """A triple with these pixels (5, 2), and standard deviations."""
    return WristDetections(
        camera="wrist",
        session=1,
        seq=t_ns // CYCLE_NS,
        t_ns=t_ns,
        ready_t_ns=t_ns + 1,
        laser_uv=laser,
        laser_sigma_px=np.where(np.isnan(laser).any(axis=1), np.nan, laser_px),
        laser_px=np.full(5, np.nan) if length is None else length,
        tip_uv=tip,
        tip_sigma_px=np.where(np.isnan(tip).any(axis=1), np.nan, tip_px),
        tip_depth=np.full(5, np.nan) if depth is None else np.where(np.isnan(tip[:, 0]), np.nan, depth),
    )


def pipeline(
    wrist_case: WristCase, solver_mode: Literal["fk", "ik", "auto"] = "auto", *, continuous: bool = False
) -> WristPipeline:
    """The device alone."""
    return WristPipeline(replace(wrist_case.setup, solver_mode=solver_mode), continuous=continuous)


def pushed(line: WristPipeline, cycle: WristDetections) -> HandPose:
    """The one pose of a triple."""
    (only,) = line.push(cycle)
    return only.pose


def bent(mcp_deg: float, pip_deg: float, aside_deg: float = 0.0) -> Float:
    """Angles (5, 4) of a hand whose knuckles and PIPs are bent like that; the DIP 0.75 of the PIP."""
    angles = np.tile(np.radians([aside_deg, mcp_deg, pip_deg, 0.7533 * pip_deg]), (5, 1))
    angles[2, 0] = 0.0  # the middle finger of this hand does not move aside
    angles[0] = np.radians([5.0, 10.0, 20.0, 30.0])
    return angles


def natural(pip_deg: float, aside_deg: float = 0.0) -> Float:
    """Angles (5, 4) of a finger that closes as Digits has it: MCP 0.54 and DIP 0.84 of the PIP."""
    pip = np.radians(pip_deg)
    angles = np.zeros((5, 4))
    angles[1:] = np.radians(aside_deg), 0.54 * pip, pip, 0.84 * pip
    angles[0] = np.radians([0.0, 15.0, 20.0, 30.0])
    return angles


def chi_square(pose: HandPose, exact_m: Float, f: int) -> Float:
    """Of the joints beyond the knuckle of finger f (3,), by their own covariances."""
    joints = CHAINS[f, 1:]
    off = (pose.position_m - exact_m)[joints]
    return np.vecdot(off, np.linalg.solve(pose.cov_m2[joints], off[..., None])[..., 0])
