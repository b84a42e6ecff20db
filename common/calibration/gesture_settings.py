"""gestures/<name>.json: what counts as which gesture.

The defaults here are those of calib_json/gestures/default.json.

A pose is a set of ranges, each of one measured quantity of the hand with a soft border. Inside its range a quantity
fits; outside, its residual is z = distance to range / border, and the pose fits by exp(-1/2 sum z^2). What the file
states is thus what is required, quantity by quantity, and a pose recorded as a template is written in the same words.
"""

from typing import Annotated, Literal

from msgspec import Meta

from common.calibration.gesture_actions import (
    DialSettings,
    PinchSettings,
    PointSettings,
    TapSettings,
    check_actions,
)
from common.calibration.parts import Duration, Part, Provenance
from common.errors import CalibrationError
from common.messages import Name

# Bends are of the bones, 0 where they lie in the palm's plane in one line; `bend` is MCP and PIP together, of the
# thumb MCP and IP. `thumb_across`, `thumb_below`, `thumb_ahead`: where its tip is from the wrist: to the thumb's side,
# out of the palm, to the fingers, as share of the palm's length. Gaps are between the skins of two tips.
# `index_ahead`: how much more than the mean of the other three the index is bent; `fingers_bend`: the mean of the four.
# Spreads are between neighbours.
Quantity = Literal[
    "index_mcp_deg", "index_pip_deg", "index_bend_deg",
    "middle_mcp_deg", "middle_pip_deg", "middle_bend_deg",
    "ring_mcp_deg", "ring_pip_deg", "ring_bend_deg",
    "little_mcp_deg", "little_pip_deg", "little_bend_deg",
    "thumb_bend_deg", "thumb_across", "thumb_below", "thumb_ahead",
    "thumb_index_gap_mm", "thumb_middle_gap_mm", "thumb_ring_gap_mm", "thumb_little_gap_mm",
    "index_ahead_deg", "fingers_bend_deg",
    "index_middle_spread_deg", "middle_ring_spread_deg", "ring_little_spread_deg",
]  # fmt: skip
Finger = Literal["thumb", "index", "middle", "ring", "little"]
Measured = Annotated[float, Meta(ge=-1e4, le=1e4)]  # degrees, mm, shares
Border = Annotated[float, Meta(ge=1e-3, le=1e4)]
Weight = Annotated[float, Meta(ge=1e-3, le=1e3)]
Score = Annotated[float, Meta(ge=0.0, le=1.0)]


class Span(Part, frozen=True):
    """Admissible range of a quantity, with soft bounds.

    From `low` to `high` without loss, beyond with one standard deviation per `soft`.
    """

    low: Measured
    high: Measured
    soft: Border


class PoseShape(Part, frozen=True):
    """One pose: its quantities, and the fingers that must be known for it to begin.

    `weight`: of two poses that fit alike, how much rather it is this one; more than 1 for a special case of another.
    """

    ranges: Annotated[dict[Quantity, Span], Meta(min_length=1)]
    needs: tuple[Finger, ...] = ()
    weight: Weight = 1.0


class HoldSettings(Part, frozen=True):
    """When a pose begins and ends.

    It begins at a confidence of `begin` that has lasted `begin_s` (`uncertain_s` where fewer than three fingers
    are known), while the fingers turn by no more than `still_deg_s`
    (a hand on its way through a pose does not hold it), or, at any speed, that has lasted `slow_s`. It ends below `end`
    that has lasted `end_s`, when another begins, `lost_s` after the hand was last known, or, where nothing that is seen
    speaks against it but too much of the hand hides, `hidden_s` after it was last confident.
    `known_share`: of the weight of a pose's quantities, how much must be known.
    """

    begin: Score = 0.45
    end: Score = 0.22
    begin_s: Duration = 0.012
    uncertain_s: Duration = 0.1
    end_s: Duration = 0.04
    still_deg_s: Annotated[float, Meta(ge=1e-3, le=1e6)] = 60.0
    slow_s: Duration = 0.25
    lost_s: Duration = 0.5
    hidden_s: Duration = 3.0
    known_share: Score = 0.5


def _most(high: float, soft: float) -> Span:
    return Span(low=-90.0, high=high, soft=soft)


def _least(low: float, soft: float) -> Span:
    return Span(low=low, high=300.0, soft=soft)


def _between(low: float, high: float, soft: float) -> Span:
    return Span(low=low, high=high, soft=soft)


def study_poses() -> dict[Name, PoseShape]:
    """The six poses of the Digits study (Kim et al., UIST 2012, A to F)."""
    return {
        "open_palm": PoseShape(
            ranges={
                "index_bend_deg": _most(18.0, 9.0),
                "middle_bend_deg": _most(18.0, 9.0),
                "ring_bend_deg": _most(18.0, 9.0),
                "little_bend_deg": _most(18.0, 9.0),
                "fingers_bend_deg": _most(15.0, 3.0),
                "thumb_across": _between(0.4, 3.0, 0.1),
            }
        ),
        "counting_two": PoseShape(
            ranges={
                "index_mcp_deg": _most(40.0, 12.0),
                "index_pip_deg": _most(30.0, 10.0),
                "middle_mcp_deg": _most(40.0, 12.0),
                "middle_pip_deg": _most(30.0, 10.0),
                "ring_bend_deg": _least(115.0, 12.0),
                "little_bend_deg": _least(110.0, 12.0),
                "thumb_across": _between(-2.0, 0.5, 0.1),
            },
        ),
        "pointing": PoseShape(
            ranges={
                "index_mcp_deg": _most(40.0, 12.0),
                "index_pip_deg": _most(30.0, 10.0),
                "middle_bend_deg": _least(115.0, 12.0),
                "ring_bend_deg": _least(115.0, 12.0),
                "little_bend_deg": _least(110.0, 12.0),
            },
        ),
        "small_grasp": PoseShape(
            ranges={
                "index_bend_deg": _least(102.0, 8.0),
                "middle_bend_deg": _least(102.0, 8.0),
                "ring_bend_deg": _least(102.0, 8.0),
                "little_bend_deg": _least(102.0, 8.0),
                "thumb_across": _between(-2.0, 0.4, 0.08),
            },
        ),
        "large_grasp": PoseShape(
            ranges={
                "index_bend_deg": _between(55.0, 95.0, 8.0),
                "middle_bend_deg": _between(55.0, 95.0, 8.0),
                "ring_bend_deg": _between(55.0, 95.0, 8.0),
                "little_bend_deg": _between(55.0, 95.0, 8.0),
                "index_pip_deg": _between(22.0, 65.0, 8.0),
                "middle_pip_deg": _between(22.0, 65.0, 8.0),
                "thumb_index_gap_mm": _least(45.0, 8.0),
            },
        ),
        "pinch": PoseShape(
            ranges={
                "index_bend_deg": _between(65.0, 135.0, 10.0),
                "index_ahead_deg": _least(25.0, 10.0),
                "thumb_index_gap_mm": _most(42.0, 6.0),
                "middle_bend_deg": _most(66.0, 12.0),
                "ring_bend_deg": _most(66.0, 12.0),
                "little_bend_deg": _most(66.0, 12.0),
            },
        ),
    }


class GestureSettings(Part, frozen=True):
    """Contents of gestures/<name>.json.

    The poses of a hand, by name, how they are held, and the thresholds of the actions.

    Of a template pose the provenance states, under its name, from what it was recorded.
    """

    version: Literal[1]
    name: Name
    poses: Annotated[dict[Name, PoseShape], Meta(max_length=64)]
    hold: HoldSettings = HoldSettings()
    pinch: PinchSettings = PinchSettings()
    dial: DialSettings = DialSettings()
    tap: TapSettings = TapSettings()
    point: PointSettings = PointSettings()
    provenance: dict[str, Provenance] = {}


def default_gestures() -> GestureSettings:
    """What holds where a rig names no file."""
    return GestureSettings(version=1, name="default", poses=study_poses())


def check_gestures(settings: GestureSettings, where: str) -> None:
    """Refuse what the types alone cannot.

    Raises:
        CalibrationError: A range is empty, or thresholds contradict each other. The text has `where` and the key.
    """
    for name, pose in settings.poses.items():
        for quantity, span in pose.ranges.items():
            if span.low > span.high:
                raise CalibrationError(f"{where}: poses.{name}.ranges.{quantity}: low is above high")
    if settings.hold.end > settings.hold.begin:
        raise CalibrationError(
            f"{where}: hold.end: {settings.hold.end:g} is above begin, {settings.hold.begin:g}"
        )
    check_actions(settings.pinch, settings.dial, settings.tap, settings.point, where)
