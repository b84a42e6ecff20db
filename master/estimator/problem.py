"""What a search for a hand works on: the rig, what is believed of the hand, and room."""

from typing import NamedTuple

from common.arrays import Bool, Float
from common.records import record
from master.estimator.cameras import CameraArrays
from master.estimator.hand_tables import HandTables, Mounts
from master.estimator.kinematics import Scratch


class Rig(NamedTuple):
    """What is the same at every epoch: the hand, its markers and the cameras."""

    hand: HandTables
    mounts: Mounts
    cameras: CameraArrays


class Belief:
    """What is believed at one epoch beside habits; filled in place.

    Attributes:
        own_w2, own: (n,) inverse variances and means of single angles, by this instant.
        past_w2, past: (n,) the same, by the state before.
        palm: (4, 4) the palm by the state before.
        palm_w2: (6,) inverse variances of turn [rad] and shift [m] from there; 0: nothing is believed.
        sight: (3,) unit vector along which depth is held, and `depth_w2` (1,) how firmly [1/m^2].
        facing: (3,) unit vector along which the back looks, and `facing_w2` (1,).
        turn: (3, 3) the palm's rotation by other sensors.
        sensed: (3 + n, 3 + n) information of turn from there and free angles, `sensed_pull` (3 + n,) and
            `sensed_constant` (1,) as of `Habits`; `sensed_known` (1,) 1: there is any.
    """

    own_w2: Float
    own: Float
    past_w2: Float
    past: Float
    palm: Float
    palm_w2: Float
    sight: Float
    depth_w2: Float
    facing: Float
    facing_w2: Float
    turn: Float
    sensed: Float
    sensed_pull: Float
    sensed_constant: Float
    sensed_known: Float

    @classmethod
    def none(cls, n: int) -> "Belief":
        """Nothing is believed of a hand with n free angles."""
        return record(
            cls,
            own_w2=n,
            own=n,
            past_w2=n,
            past=n,
            palm=(4, 4),
            palm_w2=6,
            sight=3,
            depth_w2=1,
            facing=3,
            facing_w2=1,
            turn=(3, 3),
            sensed=(3 + n, 3 + n),
            sensed_pull=3 + n,
            sensed_constant=1,
            sensed_known=1,
        )


class Search:
    """Room for a search, of N = 6 + n unknowns."""

    gradient: Float  # (N,)
    normal: Float  # (N, N)
    damped: Float  # (N, N)
    L: Float  # (N, N)
    step: Float  # (N,)
    down: Float  # (N,)
    palm: Float  # (4, 4)
    x: Float  # (n,)
    off: Float  # (6,)
    q: Float  # (3 + n,)
    J: Float  # (3, 3)
    held: Bool  # (N,)
    surprise: Float  # (M,)
    information: Float  # (M, 3, 3)
    apart: Float  # (1,)
    rows: Scratch

    @classmethod
    def empty(cls, n: int, markers: int) -> "Search":
        """Allocate it."""
        N = 6 + n
        return record(
            cls,
            gradient=N,
            normal=(N, N),
            damped=(N, N),
            L=(N, N),
            step=N,
            down=N,
            palm=(4, 4),
            x=n,
            off=6,
            q=3 + n,
            J=(3, 3),
            held=("u1", N),
            surprise=markers,
            information=(markers, 3, 3),
            apart=1,
            rows=Scratch.empty(),
        )
