"""gestures/<name>.json defines what counts as which gesture.

A pose is a set of ranges, each of one measured quantity of the hand with a soft border: outside, its residual is z =
distance to range / border, and the pose fits by exp(-1/2 sum z^2). A template is written in the same words. All
distances of actions are between skins, of round cones about the bones as the hand's profile has them: 0 is touch, and
what is beyond it presses. Thresholds come in pairs, to begin and to end, so that nothing flickers between. The
defaults are those of calib_json/gestures/default.json.
"""

import math
from typing import Annotated, Literal

from msgspec import Meta

from common.calibration.files import (
    Angle,
    Distance,
    Duration,
    Length,
    NonNegative,
    Part,
    Positive,
    Provenance,
)
from common.calibration.hand import Finger
from common.errors import CalibrationError
from common.messages import Name


class PinchSettings(Part, frozen=True):
    """Thumb and one finger, pad to pad.

    `begin_gap_m`, `end_gap_m`: skin to skin at which it begins and ends. `closed_gap_m`, `open_gap_m`: where the
    strength is 1 and 0. `clear_m`: how much nearer than the finger next to it the finger is to the thumb; less is a
    fist or a bunch. `away_m`: as far beyond, nothing else is asked. `apart_rad`: how far the pads may be turned from
    facing each other, uncertainty included. `fist_curl`: of 0..1, the other fingers together are curled less.
    `sigma_most_m`: of the gap, above which it is not known; `lost_s`: how long a pinch lasts without it.
    """

    begin_gap_m: Length = 0.009
    end_gap_m: Length = 0.015
    closed_gap_m: Distance = 0.001
    open_gap_m: Length = 0.040
    clear_m: Distance = 0.006
    away_m: Length = 0.025
    apart_rad: Angle = math.radians(105.0)
    fist_curl: Positive = 0.75
    sigma_most_m: Length = 0.005
    lost_s: Duration = 0.35


class DialSettings(Part, frozen=True):
    """A grip about something round, thumb against fingers, that turns.

    `hold_s`: how long the grip is held until it begins, no tip going in or out by more than `still_m`; `again_s`: the
    same for a hand that grips again. `radius_low_m`, `radius_high_m`: of the circle on which the middles of the tips
    lie; `curl_least`: of 0..1, the four fingers together are curled at least: others are a relaxed hand. `across_m`:
    between the skins of the thumb and any finger at least, and `aslant_rad`: between the circle and the plane of the
    palm at most: others are a thumb over a row of fingers. `fingers_least`: how many of the four lie on it.
    `round_m`: how far from it they may be; `opposed_rad`: at least so far round it is the thumb from each of them.
    `quick_m`: fingers that have gone apart by this within a tenth of a second turn nothing, for they let go;
    `loose_m`: nor do they in a grip that is wider or narrower by this, and `open_m`: by this it is none.
    `regrip_s`: how long an open hand may take to grip again; the angle goes on where it was. `lost_s`: how long tips
    may be unknown; `sigma_most_m`: of a tip, above which it is.
    """

    hold_s: Duration = 0.2
    again_s: Duration = 0.08
    still_m: Length = 0.004
    radius_low_m: Length = 0.014
    radius_high_m: Length = 0.042
    curl_least: NonNegative = 0.3
    across_m: Distance = 0.018
    aslant_rad: Angle = math.radians(55.0)
    fingers_least: Annotated[int, Meta(ge=2, le=4)] = 3
    round_m: Length = 0.012
    opposed_rad: Angle = math.radians(75.0)
    quick_m: Length = 0.0009
    loose_m: Length = 0.0025
    open_m: Length = 0.006
    regrip_s: Duration = 0.8
    lost_s: Duration = 0.5
    sigma_most_m: Length = 0.015


class TapSettings(Part, frozen=True):
    """Taps of the thumb's tip on finger segments: twelve keys on adjacent fingers.

    Index to ring finger, from the tip: 1 2 3, 4 5 6, 7 8 9; little finger: star, 0, hash (docs/gestures.md).
    `touch_gap_m`, `leave_gap_m`: between the skins of thumb and finger at which it touches and leaves; it leaves
    earlier where it has gone away by `rise_m` from where it was nearest. `down_gap_m`: as near as this it comes at
    least, or has only passed. `pressed_m`: deeper than flesh gives way is no tap but a hand that closes. `approach_s`:
    within so long it comes from beyond `leave_gap_m`; slower is no tap. `shortest_s`, `longest_s`: how long a touch is
    a tap. `apart_s`: between two taps. `level_rad`: how differently the fingers of a pad are bent at most, MCP and PIP
    together; `curl_most`: of 0..1, how far at most. `quiet_rad`: how far the four may bend together from when the
    thumb comes until it goes: more is a hand that closes. `nearer_m`: how much nearer the thumb is to the finger of
    this key than to another, over the whole touch; less is none. `sigma_most_m`, `place_sigma_m`: of the gap, and of
    the finger's PIP, above which nothing is reported.
    """

    touch_gap_m: Length = 0.005
    leave_gap_m: Length = 0.0085
    rise_m: Length = 0.005
    down_gap_m: Length = 0.003
    pressed_m: Length = 0.007
    approach_s: Duration = 0.4
    shortest_s: Duration = 0.03
    longest_s: Duration = 0.6
    apart_s: Duration = 0.08
    level_rad: Angle = math.radians(50.0)
    curl_most: Positive = 0.8
    quiet_rad: Angle = math.radians(25.0)
    nearer_m: Distance = 0.0002
    sigma_most_m: Length = 0.006
    place_sigma_m: Length = 0.008


class PointSettings(Part, frozen=True):
    """The index finger stretched, the three after it bent.

    `stretched_rad`, `bent_rad`: sums of the flexions of PIP and DIP, of the index at most and of each of the others at
    least. `slack_rad`: by how much both are wider for one that has begun. `hold_s`: how long until it begins, and how
    long the shape may be lost. `sigma_most_m`: of a finger's tip, above which it is not known; `ray_sigma_rad`: of the
    ray, above which it is not published (half as much again for one that has begun).
    """

    stretched_rad: Angle = math.radians(45.0)
    bent_rad: Angle = math.radians(85.0)
    slack_rad: Annotated[float, Meta(ge=0.0, le=6.2832)] = math.radians(20.0)
    hold_s: Duration = 0.12
    sigma_most_m: Length = 0.015
    ray_sigma_rad: Angle = math.radians(6.0)


def check_actions(
    pinch: PinchSettings, dial: DialSettings, tap: TapSettings, point: PointSettings, where: str
) -> None:
    """Refuse thresholds that contradict each other: CalibrationError with the key."""
    rising = (
        ("pinch.end_gap_m", pinch.begin_gap_m, pinch.end_gap_m, "begin_gap_m"),
        ("pinch.away_m", pinch.clear_m, pinch.away_m, "clear_m"),
        ("pinch.open_gap_m", pinch.closed_gap_m, pinch.open_gap_m, "closed_gap_m"),
        ("dial.radius_high_m", dial.radius_low_m, dial.radius_high_m, "radius_low_m"),
        ("dial.open_m", dial.loose_m, dial.open_m, "loose_m"),
        ("tap.leave_gap_m", tap.touch_gap_m, tap.leave_gap_m, "touch_gap_m"),
        ("tap.longest_s", tap.shortest_s, tap.longest_s, "shortest_s"),
        ("point.bent_rad", point.stretched_rad, point.bent_rad, "stretched_rad"),
    )
    for key, low, high, other in rising:
        if not high > low:
            raise CalibrationError(f"{where}: {key}: {high:g} must be more than {other}, {low:g}")


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
Measured = Annotated[float, Meta(ge=-1e4, le=1e4)]  # degrees, mm, shares
Border = Annotated[float, Meta(ge=1e-3, le=1e4)]
Weight = Annotated[float, Meta(ge=1e-3, le=1e3)]
Score = Annotated[float, Meta(ge=0.0, le=1.0)]


class Span(Part, frozen=True):
    """Admissible range of a quantity; outside, `soft` is one standard deviation."""

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

    It begins at a confidence of `begin` that has lasted `begin_s` (`uncertain_s` where fewer than three fingers are
    known), while the fingers turn by no more than `still_deg_s` (a hand on its way through a pose does not hold it),
    or, at any speed, that has lasted `slow_s`. It ends below `end` that has lasted `end_s`, when another begins,
    `lost_s` after the hand was last known, or, where nothing that is seen speaks against it but too much of the hand
    hides, `hidden_s` after it was last confident. `known_share`: of the weight of a pose's quantities, how much must
    be known.
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
        "open_palm": PoseShape(ranges={
            "index_bend_deg": _most(18.0, 9.0), "middle_bend_deg": _most(18.0, 9.0),
            "ring_bend_deg": _most(18.0, 9.0), "little_bend_deg": _most(18.0, 9.0),
            "fingers_bend_deg": _most(15.0, 3.0), "thumb_across": _between(0.4, 3.0, 0.1),
        }),
        "counting_two": PoseShape(ranges={
            "index_mcp_deg": _most(40.0, 12.0), "index_pip_deg": _most(30.0, 10.0),
            "middle_mcp_deg": _most(40.0, 12.0), "middle_pip_deg": _most(30.0, 10.0),
            "ring_bend_deg": _least(115.0, 12.0), "little_bend_deg": _least(110.0, 12.0),
            "thumb_across": _between(-2.0, 0.5, 0.1),
        }),
        "pointing": PoseShape(ranges={
            "index_mcp_deg": _most(40.0, 12.0), "index_pip_deg": _most(30.0, 10.0),
            "middle_bend_deg": _least(115.0, 12.0), "ring_bend_deg": _least(115.0, 12.0),
            "little_bend_deg": _least(110.0, 12.0),
        }),
        "small_grasp": PoseShape(ranges={
            "index_bend_deg": _least(102.0, 8.0), "middle_bend_deg": _least(102.0, 8.0),
            "ring_bend_deg": _least(102.0, 8.0), "little_bend_deg": _least(102.0, 8.0),
            "thumb_across": _between(-2.0, 0.4, 0.08),
        }),
        "large_grasp": PoseShape(ranges={
            "index_bend_deg": _between(55.0, 95.0, 8.0), "middle_bend_deg": _between(55.0, 95.0, 8.0),
            "ring_bend_deg": _between(55.0, 95.0, 8.0), "little_bend_deg": _between(55.0, 95.0, 8.0),
            "index_pip_deg": _between(22.0, 65.0, 8.0), "middle_pip_deg": _between(22.0, 65.0, 8.0),
            "thumb_index_gap_mm": _least(45.0, 8.0),
        }),
        "pinch": PoseShape(ranges={
            "index_bend_deg": _between(65.0, 135.0, 10.0), "index_ahead_deg": _least(25.0, 10.0),
            "thumb_index_gap_mm": _most(42.0, 6.0), "middle_bend_deg": _most(66.0, 12.0),
            "ring_bend_deg": _most(66.0, 12.0), "little_bend_deg": _most(66.0, 12.0),
        }),
    }  # fmt: skip


class GestureSettings(Part, frozen=True):
    """gestures/<name>.json: poses by name, how they are held, thresholds of actions.

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
    """Refuse empty ranges and contradictory thresholds: CalibrationError."""
    for name, pose in settings.poses.items():
        for quantity, span in pose.ranges.items():
            if span.low > span.high:
                raise CalibrationError(f"{where}: poses.{name}.ranges.{quantity}: low is above high")
    if settings.hold.end > settings.hold.begin:
        raise CalibrationError(
            f"{where}: hold.end: {settings.hold.end:g} is above begin, {settings.hold.begin:g}"
        )
    check_actions(settings.pinch, settings.dial, settings.tap, settings.point, where)
