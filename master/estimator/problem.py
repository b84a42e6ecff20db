"""Inputs of the search for a hand.

They are the rig, the prior of the hand, and scratch arrays.
"""

from typing import NamedTuple

from common.arrays import Bool, Float, Int
from common.messages.records import record
from master.estimator.cameras import CameraArrays
from master.estimator.finger_surface import Surface
from master.estimator.hand_tables import HandTables, Mounts
from master.estimator.kinematics import Scratch
from master.estimator.wrist_device import Device, LinesOfSight


class Rig(NamedTuple):
    """Everything that is the same at every epoch.

    It is the hand, its markers, the cameras, and a wrist device.
    """

    hand: HandTables
    mounts: Mounts
    cameras: CameraArrays
    device: Device


class EpochPrior:
    """Prior at one epoch beside the posture prior.

    It is filled in place.

    Attributes:
        own_w2, own: (n,) inverse variances and means of single angles, by this epoch.
        past_w2, past: (n,) the same, by the state before.
        palm: (4, 4) the palm by the state before.
        palm_w2: (6,) inverse variances of turn [rad] and shift [m] from there; 0: no prior.
        sight: (3,) unit vector along which depth is held, and `depth_w2` (1,) how firmly [1/m^2].
        back_normal: (3,) unit vector along which the back looks, and `back_normal_w2` (1,).
        z, z_info: (K,), (K, K) mean and information of the extra unknowns (`master.estimator.wrist_device`).
        orientation_info: (3, 3) [1/rad^2] information of the measured orientation, rig axes; `oriented` (1,) whether
            there is any.
        forearm: (4, 4) the palm by these in its first rows and columns; where `on_forearm` (1,) that of a straight
            wrist, and `axes` (3, 3) about which tilt and heading turn it, as rows, rig axes.
        place: (3,) [m] where the palm is, and `place_w2` (1,) how firmly; 0: not known.
        sights: What a wrist device sees of the fingers.
    """

    own_w2: Float
    own: Float
    past_w2: Float
    past: Float
    palm: Float
    palm_w2: Float
    line_of_sight: Float
    depth_w2: Float
    back_normal: Float
    back_normal_w2: Float
    z: Float
    z_info: Float
    orientation_info: Float
    oriented: Float
    forearm: Float
    on_forearm: Float
    axes: Float
    place: Float
    place_w2: Float
    lines_of_sight: LinesOfSight

    @classmethod
    def none(cls, n: int, extras: int) -> "EpochPrior":
        """Return an empty prior of a hand with n free angles.

        It has the given number of extra unknowns.
        """
        return record(
            cls,
            own_w2=n,
            own=n,
            past_w2=n,
            past=n,
            palm=(4, 4),
            palm_w2=6,
            line_of_sight=3,
            depth_w2=1,
            back_normal=3,
            back_normal_w2=1,
            z=extras,
            z_info=(extras, extras),
            orientation_info=(3, 3),
            oriented=1,
            forearm=(4, 4),
            on_forearm=1,
            axes=(3, 3),
            place=3,
            place_w2=1,
            lines_of_sight=LinesOfSight.empty(),
        )


class Search:
    """Scratch for a search, of N = 6 + n + K unknowns.

    They are the palm, n free angles and K extras.
    """

    gradient: Float  # (N,)
    normal: Float  # (N, N)
    damped: Float  # (N, N)
    L: Float  # (N, N)
    step: Float  # (N,)
    down: Float  # (N,)
    palm: Float  # (4, 4)
    next_palm: Float  # (4, 4)
    x: Float  # (n,)
    off: Float  # (6,)
    z: Float  # (K,)
    q: Float  # (3,)
    J: Float  # (3, 3)
    palm_straight: Float  # (4, 4)
    extras_jacobian: Float  # (5, 3)
    by_rotation: Float  # (8, 3)
    palm_camera: Float  # (4, 4)
    wrist_axes: Float  # (2, 3)
    twist: Float  # (5,)
    wrist_share: Float  # (1,) as of `Settings`
    local_J: Float  # (3, 8)
    local_r: Float  # (3,)
    local_w: Float  # (3,)
    at: Int  # (8,)
    surface: Surface
    held: Bool  # (N,)
    marker_chi2: Float  # (M,)
    information: Float  # (M, 3, 3)
    outliers: Float  # (1,)
    rows: Scratch

    @classmethod
    def empty(cls, n: int, extras: int, markers: int) -> "Search":
        """Allocate it."""
        N = 6 + n + extras
        scratch = record(
            cls,
            gradient=N,
            normal=(N, N),
            damped=(N, N),
            L=(N, N),
            step=N,
            down=N,
            palm=(4, 4),
            next_palm=(4, 4),
            x=n,
            off=6,
            z=extras,
            q=3,
            J=(3, 3),
            palm_straight=(4, 4),
            extras_jacobian=(5, 3),
            by_rotation=(8, 3),
            palm_camera=(4, 4),
            wrist_axes=(2, 3),
            twist=5,
            wrist_share=1,
            local_J=(3, 8),
            local_r=3,
            local_w=3,
            at=("i8", 8),
            surface=Surface.empty(),
            held=("u1", N),
            marker_chi2=markers,
            information=(markers, 3, 3),
            outliers=1,
            rows=Scratch.empty(),
        )
        scratch.wrist_share[0] = 1.0
        return scratch
