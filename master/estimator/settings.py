"""All tuning numbers of the estimator, with unit, range and source."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from math import isfinite, radians
from typing import NamedTuple, Self, cast

import numpy as np

from common.errors import CalibrationError

_HANDS = "round value for hands at work; a handful compared on simulated and recorded hands, nothing fitted"
_COORDINATION = "Hager-Ross, Schieber 2000; Ingram et al. 2008: fingers move together"
_GROWTH = (
    "how far joint angles get in a time: hands that handle things, by motion capture, and Leap recordings"
)
_CHI = "quantile of chi square"


@dataclass(frozen=True, slots=True)
class Range:
    """What a setting may be, and where the value is from."""

    unit: str
    low: float
    high: float
    source: str


def _setting(value: float, unit: str, low: float, high: float, source: str) -> float:
    """Declare a setting, with what it may be and where the value is from."""
    return field(default=value, metadata={"range": Range(unit, low, high, source)})


def _deg(value_deg: float, low_rad: float, high_rad: float, source: str) -> float:
    """Declare an angle [rad] by its value in degrees."""
    return _setting(radians(value_deg), "rad", low_rad, high_rad, source)


def _number(value: float, low: float, high: float, source: str) -> float:
    """Declare a number without a unit."""
    return _setting(value, "1", low, high, source)


def _s(value: float, low: float, high: float, source: str) -> float:
    """Declare a time [s]."""
    return _setting(value, "s", low, high, source)


def _m(value: float, low: float, high: float, source: str) -> float:
    """Declare a length [m]."""
    return _setting(value, "m", low, high, source)


def _gate(value: float, low: float, high: float, source: str) -> float:
    """Declare a gate on a chi square."""
    return _setting(value, "chi square", low, high, source)


@dataclass(frozen=True, slots=True)
class Settings:
    """The estimator's settings."""

    # fmt: off
    # Posture prior of a natural hand: standard deviations and means of its angles.
    abduction_rad: float = _deg(7.0, 0.01, 1.0, _HANDS)
    natural_flexion_rad: float = _deg(14.0, 0.01, 2.0, _HANDS)
    neighbour_flexion_rad: float = _deg(30.0, 0.01, 3.0, _HANDS)
    neighbour_pip_rad: float = _deg(35.0, 0.01, 3.0, _HANDS)
    pip_rad: float = _deg(50.0, 0.01, 3.0, _HANDS)
    pip_mean_rad: float = _deg(12.0, 0.0, 1.5, _HANDS)
    loose_dip_rad: float = _deg(15.0, 0.01, 1.0, _HANDS)
    loose_dip_per_pip: float = _number(2.0 / 3.0, 0.0, 1.5, "Kalbfleisch: DIP = 2/3 PIP")
    thumb_rad: float = _deg(20.0, 0.01, 2.0, _HANDS)
    thumb_abduction_mean_rad: float = _deg(8.0, -1.0, 1.0, _HANDS)
    thumb_flexion_mean_rad: float = _deg(8.0, -1.0, 1.0, _HANDS)
    thumb_mcp_mean_rad: float = _deg(10.0, -1.0, 1.0, _HANDS)
    thumb_ip_mean_rad: float = _deg(15.0, -1.0, 1.0, _HANDS)
    # A free hand, which has none: flexions anywhere within limits, a PIP rather in the lower half of its range.
    free_pip_rad: float = _deg(40.0, 0.1, 3.0, _HANDS)
    free_pip_mean_rad: float = _deg(30.0, 0.0, 1.5, _HANDS)
    natural_prior_weight: float = _number(1.0 / 3.0, 0.01, 0.99,
        "small: posture priors that fit win by their narrowness")
    posture_widened: float = _number(3.0, 1.0, 10.0,
        "by which a measured posture is wider of a hand that defies it")
    # A finger that was never seen is curled out of sight: a stretched one would show.
    curled_rad: float = _deg(15.0, 0.01, 1.5, _HANDS)
    curled_flexion_rad: float = _deg(65.0, 0.0, 1.6, _HANDS)
    curled_pip_rad: float = _deg(88.0, 0.0, 1.9, _HANDS)
    curled_thumb_abduction_rad: float = _deg(20.0, -1.0, 1.0, _HANDS)
    curled_thumb_flexion_rad: float = _deg(30.0, -1.0, 1.0, _HANDS)
    curled_thumb_mcp_rad: float = _deg(25.0, -1.0, 1.5, _HANDS)
    curled_thumb_ip_rad: float = _deg(30.0, -1.0, 1.5, _HANDS)
    shows_rad: float = _deg(45.0, 0.1, 3.0, "a finger bent by less in all its joints shows its end from behind")
    # What is wrong with markers, bones and caps.
    back_normal_rad: float = _deg(22.0, 0.05, 1.5, "a marker on the back that is seen well faces the cameras")
    bones_m: float = _m(1.0e-3, 1e-4, 1e-2, "bones and caps are known to about 1 mm")
    # How far a hand that is seen moves in a time, as a random walk: wide, so that what is seen decides.
    process_noise_rad_s: float = _setting(8.0, "rad/s", 0.5, 50.0, _HANDS)
    palm_process_noise_rad_s: float = _setting(2.5, "rad/s", 0.1, 50.0, _HANDS)
    palm_held_rad_s: float = _setting(0.9, "rad/s", 0.05, 50.0,
        "with a hidden thumb little determines how the palm turns")
    palm_process_noise_m_s: float = _setting(2.0, "m/s", 0.05, 20.0, _HANDS)
    shortest_s: float = _s(1e-3, 1e-5, 1e-2, "a shorter step would weld the hand to its last pose")
    component_memory_s: float = _s(0.3, 0.0, 5.0, "how fast a hand may change from posture priors to none")
    # Fingers that nobody sees.
    coast_s: float = _s(0.16, 0.01, 1.0, _COORDINATION)
    rate_memory_s: float = _s(0.024, 1e-3, 1.0, "half of a new rate counts at 60 frames a second")
    growth_rad: float = _deg(36.0, 0.05, 2.0, _GROWTH)
    growth_abduction_rad: float = _deg(14.0, 0.02, 2.0, _GROWTH)
    growth_thumb_rad: float = _deg(20.0, 0.02, 2.0, _GROWTH)
    growth_s: float = _s(1.0, 0.05, 10.0, _GROWTH)
    alike: float = _number(0.7, 0.0, 0.99, _COORDINATION)
    held_rad: float = _deg(3.0, 0.001, 0.5, "a finger that was just lost")
    # A palm without markers.
    lost_rotation_rad_s: float = _setting(radians(20.0), "rad/s", 0.01, 5.0, _HANDS)
    lost_shift_m_s: float = _setting(0.02, "m/s", 0.001, 1.0, _HANDS)
    lost_goes_on: float = _number(0.35, 0.0, 2.0, "share of its speed, along each axis")
    speed_memory_s: float = _s(0.047, 1e-3, 1.0, "three tenths of a new one count at 60 frames a second")
    # One camera alone: perspective constrains depth poorly, so it is held.
    held_depth_m: float = _m(0.004, 1e-4, 0.1, "a step of depth of a hand that one camera sees")
    unobserved_depth_m_s: float = _setting(0.08, "m/s", 0.001, 1.0,
        "simulated hands that one camera saw: 20 to 30 mm off after 0.6 s")
    unobserved_depth_most_m: float = _m(0.15, 0.01, 1.0, "as far as the volume goes")
    # Both hypotheses.
    certain: float = _number(12.0, 1.0, 50.0, "log odds that count as certain")
    negligible: float = _number(0.03, 0.0, 0.5, "weight of a hypothesis that changes next to nothing")
    noticed: float = _number(0.15, 0.0, 1.0, "of one of less weight the likeliest hand is taken, not its mean")
    stiff: float = _number(1e-2, 1e-6, 1.0, "how much less than the markers the mean of hypotheses holds")
    # Covariance.
    claimed: float = _number(1.0, 0.1, 100.0,
        "observations that the widths of posture priors count as; Kass, Wasserman 1995")
    straight_rad: float = _deg(3.0, 0.0, 1.0,
        "a turn by less is 0.2 mm off the tangent at the far end of a hand")
    rotation_most_rad: float = _setting(1.0, "rad", 0.1, 3.0, "a turn less sure leads nowhere farther")
    # Gates.
    marker_gate: float = _gate(16.3, 5.0, 50.0, _CHI + " of three numbers, 1 in 1000")
    misled: float = _gate(32.6, 5.0, 200.0, "twice that: another hand explains the markers better")
    sure_palm_rad: float = _deg(5.0, 0.01, 0.5, "about each axis: a palm that markers determine well")
    sure_rad: float = _deg(15.0, 0.01, 1.0, "about every axis: better known than this, it determines the palm")
    lost_m: float = _m(0.1, 0.01, 1.0, "about each axis: a hand that is known no better than this is lost")
    forget_s: float = _s(0.5, 0.05, 10.0, "after so long without a marker nothing is known of the hand")
    tracked_m: float = _m(0.022, 0.002, 0.1,
        "half the largest axis of the 95 % region of a joint that is TRACKED")
    tracked_pip_rad: float = _deg(15.0, 0.02, 1.0, "standard deviation of the PIP of a finger that is TRACKED")
    tracked_age_s: float = _s(0.03, 0.0, 1.0, "how old the newest measurement of a TRACKED finger may be")
    tracked_cycle_s: float = _s(0.055, 0.0, 1.0,
        "the same where a wrist device measured it, whose strobe cycles come at 30 Hz")
    # What is shown; `led`: of a hand that several kinds of sensors watch.
    blend_s: float = _s(0.1, 0.01, 1.0, "as long as a leap is seen as a motion")
    led_leap_m: float = _m(3e-3, 1e-4, 0.1, "from one epoch to the next, beside motion")
    led_step_m: float = _m(5e-3, 1e-4, 0.1, "the most that is led between two poses")
    led_off_m: float = _m(1e-3, 1e-5, 0.1, "a part that is led by more is not yet where its markers are")
    led_stale_s: float = _s(0.1, 0.01, 1.0, "after such a gap nothing of a speed is left")
    led_fades_s: float = _s(0.04, 0.001, 1.0, "in which the last of what is led fades")
    led_speed_s: float = _s(0.03, 0.001, 1.0, "memory of the speed of the shown hand, which is smooth")
    # A hand that begins anew.
    begin_mcp_per_pip: float = _number(0.6, 0.0, 1.5, "of hands from which a search begins; " + _HANDS)
    begin_above_m: float = _m(0.05, 0.005, 0.5, "a point above the wrist stands for where the back faces")
    begin_above_weight: float = _number(0.3, 0.0, 10.0, "of that point")
    begin_palm_weight: float = _number(3.0, 0.1, 100.0, "of markers on the palm, by those on fingers")
    line_width_m: float = _m(5e-3, 1e-4, 0.05, "markers nearer to one line do not turn a hand about it")
    line_length_m: float = _m(20e-3, 1e-3, 0.1, "a shorter line of markers has no direction")
    line_across: float = _number(0.9, 0.1, 1.0, "most cosine of a line of markers to the line of sight")
    # Fingers that a wrist device sees.
    dip_rad: float = _deg(3.0, 0.005, 1.0, "of a DIP about its share of the PIP, of straight fingers")
    dip_share: float = _number(0.13, 0.01, 1.0, "and by so much of the PIP more; the papers' ratios")
    coupled_rad: float = _deg(5.0, 0.005, 1.0,
        "of a natural MCP about its share of the PIP, of straight fingers")
    coupled_spread: float = _number(0.2, 0.0, 1.0,
        "share of the PIP besides, of a hand of which nothing is known")
    coupled_fingers: float = _number(60.0, 1.0, 1e5,
        "half bent fingers seen that this counts as, once each strobe cycle")
    coupled_s: float = _s(60.0, 1.0, 3600.0, "as long as a hand keeps to its own share")
    thumb_coupled_rad: float = _deg(12.0, 0.01, 1.0, "of a thumb's IP about what goes with its MCP")
    natural_finger_weight: float = _number(0.8, 0.01, 0.99, "hands before anything of them is seen")
    straight_pip_rad: float = _deg(10.0, 0.02, 1.0, "by which fingers are bent that are stretched")
    unseen: float = _number(2.3, 0.0, 10.0, "log odds against a pose whose fingertip would be seen, and is not")
    unseen_again: float = _number(0.7, 0.0, 10.0,
        "the same of a finger that was seen a moment ago: misses come in rows")
    parted: float = _number(0.4, 0.05, 0.95, "of the lower top, between two parts of a density")
    other_part: float = _number(0.05, 0.001, 0.5, "less probability than this is no other part")
    branch_rad: float = _deg(95.0, 0.5, 2.5,
        "PIP beyond which a laser point on the last phalanx fits two poses")
    goes_on_rad: float = _deg(8.0, 0.02, 2.0,
        "by which a PIP may have moved at least since the finger was seen")
    window_rad: float = _deg(32.0, 0.1, 3.0,
        "about its last PIP in which a finger that is well known is searched")
    search_again: float = _number(6.0, 1.0, 100.0, "strobe cycles after which all is searched")
    hinge_rad: float = _deg(4.0, 0.001, 0.5, "by which real hinges lie askew to those of a hand file")
    refused: float = _gate(14.0, 4.0, 100.0, "of laser point and fingertip of a finger, beside any pose")
    refused_unlit: float = _gate(8.0, 3.0, 100.0, "the same where the light of the fingertip fits no pose")
    contrary: float = _gate(30.0, 5.0, 200.0,
        "of a palm against the IMU on the forearm, beside any bend and heading")
    light_rad: float = _number(0.045, 0.01, 1.0,
        "of a distance by light: skin inclined by 25 degrees looks 5 % farther")
    light_share: float = _number(0.15, 0.0, 1.0,
        "of what distances by light measure, used to fit their unit: fingers err together")
    teaching_gate: float = _gate(5.0, 1.0, 100.0,
        "of laser point and fingertip of a finger that teaches nothing")
    led_scale: float = _number(3.0, 0.1, 10.0, "of the unit's logarithm, which may be any")
    flexion_rad: float = _deg(14.0, 0.01, 1.5, "of wrists; Palmer et al. 1985")
    deviation_rad: float = _deg(11.0, 0.01, 1.5, "of wrists; Palmer et al. 1985")
    calibrated_palm_rad: float = _deg(1.0, 0.001, 0.5, "of a palm that was calibrated before its device")
    wrist_share: float = _number(0.6, 0.0, 1.0,
        "of what fingers measure of the wrist's bend: they err together")
    stiff_rad: float = _deg(1.0, 0.01, 0.5, "of fingers that are taken to bend as their PIP does")
    bent_rad: float = _deg(45.0, 0.1, 1.5, "PIP of one of the half bent fingers of `coupled_fingers`")
    stands_m: float = _m(1e-4, 1e-6, 1e-2, "of a palm before the wrist device alone, whose frame is the rig's")
    stands_rad: float = _setting(1e-3, "rad", 1e-5, 0.1, "the same, of its turn")
    strap_rad: float = _deg(1.5, 0.001, 0.5, "of a palm by markers, and of how IMU and camera are mounted")
    wrist_rate_1_s: float = _setting(1.5, "1/s", 0.1, 30.0, "of wrists; Hansson et al. 2009")
    wrist_mean_s: float = _s(20.0, 1.0, 600.0, "as long as a posture of the wrist is kept")
    tilt_s: float = _s(5.0, 0.1, 600.0, "as long as an IMU has the vertical off")
    tilt_least_rad: float = _setting(1e-3, "rad", 1e-6, 0.1, "of any IMU's vertical")
    constant_s: float = _s(1e4, 1.0, 1e6, "correlation time of what is constant")
    long_s: float = _s(10.0, 0.1, 100.0, "an epoch owes nothing to one so long before")
    sample_reach_s: float = _s(0.05, 1e-3, 1.0, "farther from an epoch a sample of an IMU does not constrain it")
    samples: float = _number(512.0, 16.0, 1e5, "of an IMU that are kept: half a second of the fastest")
    heading_free_rad: float = _setting(10.0, "rad", 3.0, 100.0, "constrains nothing beside any marker")
    heading_lost_rad: float = _setting(1.0, "rad", 0.1, 1.8, "less sure it may be any: a uniform circle has 1.8")
    heading_least_rad_s: float = _deg(0.2, 1e-4, 0.1, "what a heading walks in a second at least")
    heading_most_rad_s: float = _deg(5.0, 1e-3, 1.0, "and at most, unless evenly")
    restarted_s: float = _s(0.25, 0.01, 10.0, "silence of an IMU that begins anew, until it has the vertical")
    contrary_s: float = _s(0.5, 0.01, 10.0, "what contradicts an IMU for longer is right")
    contrary_palms: float = _number(5.0, 1.0, 100.0, "if it does so as often")
    silent_frames: float = _number(2.2, 1.0, 100.0, "without an epoch strobe cycles lead")
    cycles: float = _number(8.0, 1.0, 1000.0, "strobe cycles that may wait for an epoch")
    cycle_age_s: float = _s(0.07, 0.01, 1.0, "an older strobe cycle constrains no finger now")
    cycle_apart_s: float = _s(0.017, 1e-3, 1.0, "half a period: a strobe cycle of an unrelated epoch")
    errs_s: float = _s(0.5, 0.01, 60.0, "as long as errors of shape and skin stay")
    wrist_errs_s: float = _s(0.05, 0.001, 60.0,
        "as long as errors of a palm by markers stay, of what a wrist moves meanwhile")
    # The search.
    tolerance: float = _setting(1e-7, "half chi square", 1e-12, 1.0, "what a step may leave")
    tolerance_share: float = _number(1e-4, 0.0, 0.1, "of the cost, likewise")
    coarse: float = _setting(1e-2, "half chi square", 1e-7, 1.0, "where one of several starts is to be chosen")
    # fmt: on

    @classmethod
    def ranges(cls) -> dict[str, Range]:
        """What each setting may be."""
        return {one.name: one.metadata["range"] for one in fields(cls)}

    def changed(self, name: str, value: float) -> Self:
        """The same with one setting changed.

        Raises:
            CalibrationError: There is no such setting, or the value is out of its range.
        """
        ranges = self.ranges()
        if name not in ranges:
            raise CalibrationError(f"estimator.{name}: no such setting; there are {', '.join(ranges)}")
        allowed = ranges[name]
        if not (isfinite(value) and allowed.low <= value <= allowed.high):
            raise CalibrationError(
                f"estimator.{name}: {value} is out of range: {allowed.low} to {allowed.high} {allowed.unit}"
            )
        return replace(self, **{name: value})

    @classmethod
    def of(cls, changes: Sequence[str]) -> Self:
        """The defaults with changes such as `estimator.process_noise_rad_s=6`.

        Raises:
            CalibrationError: One is malformed, there is no such setting, or the value is out of its range.
        """
        settings = cls()
        for change in changes:
            name, equals, value = change.partition("=")
            scratch, dot, name = name.partition(".")
            if not (scratch == "estimator" and dot and equals):
                raise CalibrationError(f"--set {change!r}: expected estimator.NAME=VALUE")
            try:
                number = float(value)
            except ValueError as error:
                raise CalibrationError(f"--set {change!r}: {value!r} is no number") from error
            settings = settings.changed(name, number)
        return settings

    def record(self) -> Self:
        """The same for kernels, which take it as one pointer."""
        out = np.zeros(1, [(name, "f8") for name in self.ranges()]).view(np.recarray)
        out[0] = astuple(self)
        return cast(Self, out[0])


DEFAULT = Settings()


class KernelSettings(NamedTuple):
    """Numbers that kernels have compiled in, and the laws of fingers.

    numba sees no change of another file: after one of these, `make install` compiles anew.
    """

    # Covariance.
    region_95: float = 7.815  # chi square of three numbers, 95 %
    rotations: int = (
        12  # turns that count in arcs: those of the palm, which moves all joints, then the largest
    )
    # The search.
    steps: int = 25
    first_damping: float = 1e-3
    most_damping: float = 1e6
    difference: float = 1e-4  # of a step: what a difference is taken over
    behind_chi2: float = 1e4  # half chi square of a marker behind a camera that sees it
    small_rad: float = 1e-4  # a shorter rotation vector counts as so long in the derivative
    lens_steps: int = 12  # of Newton, from a pixel to its ray
    markers: int = 16  # what a kernel has room for, in such steps
    # Limits.
    tolerances: float = 3.0  # standard deviations beyond a limit, where there is no hand
    narrowest_rad: float = 1e-3  # limits that leave an angle no room
    anywhere_m: float = 0.1  # of a hand in front of cameras, before anything is seen of it; its turn: 1 rad
    tail: float = 30.0  # standard deviations, beyond which the normal distribution underflows
    sweeps: int = 6  # of expectation propagation
    sweep_share: float = 0.8  # of a change that each makes
    # Fingers along their PIPs.
    nodes: int = 16
    fine: int = 4  # steps of a density from node to node
    tried_rad: tuple[float, float, float, float] = (0.15, 0.6, 1.05, 1.4)  # flexions
    tried_every: int = 5  # nodes
    steps_from_node: int = 3  # from the pose of the node before
    steps_from_tried: int = 5
    step_rad: float = 0.3  # the most of one step
    rolled_rad: float = 0.25  # no hinges are askew by more
    hidden_m: float = 1.5e-3  # of a fingertip behind the skin that the camera sees: its own roundness
    # The laser on the skin.
    rays: int = 16
    pulled_in: float = 0.77  # mean of a cosine over the half circle that faces the light
    cap_along: float = 0.7  # radii from the last sphere to where the skin turns away
    cap_out: float = 0.5
    level: float = 0.05  # a chain less inclined to the plane slides along it without an end
    prolonged: float = (
        6.0  # lengths of its last stretch that a chain which ends before the plane is prolonged
    )
    span_crossed: float = 1.3  # of the radius: where a cone that crosses the plane may be lit
    span_cut: float = 1.1  # of half the cut of a sphere
    chord: float = 0.5  # of the finger's breadth that one chord may span: more is a jump from part to part
    seen_m: float = 3e-4  # a lit point this near behind the first the camera sees is seen
    nearest_m: float = 1e-3  # of a fingertip to the camera
    whole: float = 0.85  # of the line that is expected: a shorter one is hidden in part
    assumed_m: float = 0.1  # distance of a fingertip of which no laser point measures it
    palm_m: float = (
        7e-4  # what calibration leaves of plane and palm: a palm pitched by 0.2 degrees, and 0.3 mm
    )


class FingerLaws(NamedTuple):
    """How fingers bend, where it is no prior of a hand's own."""

    begin_pip_rad: tuple[float, ...] = (0.1, 0.7, 1.3)  # from which a search begins: open to closed
    closed_rad: float = radians(120.0)  # PIP
    cubic_mm: float = 102.06  # range of Digits' printed law
    cubic: tuple[float, ...] = (-0.0003, 0.059, -4.07, 119.75)
    curls: int = 31  # poses of a simulated curl
    curl_share: float = 0.75  # after that the last phalanx folds into the light, and the line jumps to it
    line_points: int = 5  # of the laser on one finger that make a line
    line_range_m: float = 5e-3  # below this the direction is that of the noise
    line_straight: float = 0.25  # residual per range above which it is a cloud and no line
    dip_per_pip: float = 0.5 * (2.0 / 3.0 + 0.84)  # between the ratios of both papers
    dip_spread_rad: float = radians(7.0)
    ip_per_mcp: float = 1.1  # of thumbs: between those of grasps and the ratio of the limits
    abduction_rad: float = radians(25.0)  # limit, to both sides
    slack_rad: float = radians(8.0)  # of other limits: those of a hand file are a prior's, not a wall's
    inside_px: float = 20.0  # from the edge of the image: a fingertip there is clearly in it


KERNEL, LAWS = KernelSettings(), FingerLaws()
