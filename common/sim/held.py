"""Things that a simulated hand holds: what they are and where at a time."""

from dataclasses import dataclass

from common.arrays import Float


@dataclass(frozen=True, slots=True, eq=False)
class Cylinder:
    """Matt dark cylinder, closed at both ends.

    Its axis is its own z, its origin the middle.

    Attributes:
        T_rig_object: (4, 4) [m].
        radius_m: Its radius.
        length_m: From end to end.
        held: Whether the hand carries it.
    """

    T_rig_object: Float
    radius_m: float
    length_m: float
    held: bool
