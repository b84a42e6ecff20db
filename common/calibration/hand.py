"""Typed files of hands: bones and markers of one hand, its limits and couplings."""

import math
from itertools import combinations
from typing import Annotated, Literal

from msgspec import Meta

from common.calibration.files import Part, Provenance, Quaternion, check_quaternion
from common.errors import CalibrationError
from common.messages import MAX_MARKERS, Name

HandCoordinate = Annotated[float, Meta(ge=-0.5, le=0.5)]  # [m] twice the longest hand, from its wrist
HandPlace = tuple[HandCoordinate, HandCoordinate, HandCoordinate]
Thickness = Annotated[float, Meta(ge=5e-4, le=0.2)]  # [m] radius at a joint, painted length of a cap


class RestJoint(Part, frozen=True):
    """One joint of the flat hand, palm frame: -z along the bone to the tip, y dorsal."""

    position_m: HandPlace
    orientation_wxyz: Quaternion


class MarkerMount(Part, frozen=True):
    """Mounting of a painted cap: its joint (or palm_frame), centroid in that frame."""

    joint: str
    offset_m: HandPlace
    painted_m: Thickness = 0.016


HandAngle = Annotated[float, Meta(ge=-6.2832, le=6.2832)]  # [rad] a turn
Span = tuple[HandAngle, HandAngle]
Ratio = Annotated[float, Meta(ge=0.0, le=10.0)]  # of two angles of one finger
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Tolerance = Annotated[float, Meta(ge=0.0, le=1.0)]  # [rad]


class FingerLimits(Part, frozen=True):
    """Lower and upper limits of a finger's four angles [rad], zero in the rest pose.

    Of the thumb: CMC, CMC, MCP, IP. `spread_at_full_flexion`: share of the abduction range that is left at the highest
    flexion, less on the way there; 1: the range stays. `tolerance_rad`: standard deviation by which people differ from
    these limits, for each angle; 0: a wall.
    """

    abduction_rad: Span
    flexion_rad: Span
    pip_rad: Span
    dip_rad: Span
    spread_at_full_flexion: Share = 1.0
    tolerance_rad: tuple[Tolerance, Tolerance, Tolerance, Tolerance] = (0.0, 0.0, 0.0, 0.0)


class Limits(Part, frozen=True):
    """Limits of the five fingers."""

    thumb: FingerLimits
    index: FingerLimits
    middle: FingerLimits
    ring: FingerLimits
    little: FingerLimits


class Couplings(Part, frozen=True):
    """Natural joint couplings between the angles of index ... little.

    `dip_per_pip` None: the DIP is free. `dip_spread_rad`: standard deviation of the DIP about that ratio; 0: it is
    kept exactly. `mcp_per_pip` None: no natural flexion. `neighbours`: fingers side by side tend to bend alike.
    """

    dip_per_pip: Ratio | None = 2.0 / 3.0
    dip_spread_rad: Annotated[float, Meta(ge=0.0, le=3.2)] = 0.0
    mcp_per_pip: Ratio | None = 0.54
    neighbours: bool = True


Variance = Annotated[float, Meta(ge=-10.0, le=10.0)]  # [rad^2] or covariance


class Posture(Part, frozen=True):
    """Posture prior of a person, fitted to motion: a normal distribution of angles.

    Attributes:
        mean_rad: Abduction, flexion, PIP, DIP (thumb CMC, CMC, MCP, IP) of thumb ... little, columns of `HandModel`.
        cov_rad2: (20, 20) covariance, for fingers move together.
    """

    mean_rad: Annotated[tuple[HandAngle, ...], Meta(min_length=20, max_length=20)]
    cov_rad2: Annotated[
        tuple[Annotated[tuple[Variance, ...], Meta(min_length=20, max_length=20)], ...],
        Meta(min_length=20, max_length=20),
    ]


Preset = Literal["K", "D"]
Side = Literal["left", "right"]
Finger = Literal["thumb", "index", "middle", "ring", "little"]
PalmarScale = Annotated[float, Meta(ge=0.5, le=2.0)]


class HandProfile(Part, frozen=True):
    """hands/<name>.json: bones, markers, and optionally skin, limits and couplings.

    Limits and couplings may be the name of a preset: K (Kalbfleisch; also where there are none) or D (Digits).
    `posture`: how this person holds the fingers, in place of the couplings' prior; DIPs are free then.
    `palmar_scale`: finger -> how thick its palmar flesh is against that which the radii or the size of the hand give,
    as a wrist device measures it; 1 where a finger is not named.
    """

    version: Literal[1]
    name: Name
    side: Side
    rest_joints: Annotated[dict[str, RestJoint], Meta(max_length=64)]
    markers: Annotated[dict[Name, MarkerMount], Meta(max_length=MAX_MARKERS)]
    radius_m: dict[str, Thickness] | None = None
    palmar_scale: dict[Finger, PalmarScale] = {}
    limits_rad: Limits | Preset | None = None
    couplings: Couplings | Preset | None = None
    posture: Posture | None = None
    provenance: dict[str, Provenance] = {}


def check_hand(hand: HandProfile, where: str) -> None:
    """Refuse orientations that are no rotation and coinciding joints."""
    for name, joint in hand.rest_joints.items():
        check_quaternion(joint.orientation_wxyz, f"{where}: rest_joints.{name}.orientation_wxyz")
    for (one, a), (other, b) in combinations(hand.rest_joints.items(), 2):
        min_bone_m = 1e-3
        if math.dist(a.position_m, b.position_m) < min_bone_m:
            raise CalibrationError(
                f"{where}: rest_joints.{other}.position_m: where {one} is; a bone has a length, 1 mm or more"
            )
