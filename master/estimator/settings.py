"""All tuning numbers of the estimator, with unit, range and source."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, radians
from typing import Annotated, NamedTuple, Self, get_type_hints

import numpy as np

from common.errors import CalibrationError
from common.records import filled

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


class Settings(NamedTuple):
    """The estimator's settings; kernels take it as it is."""

    # Posture prior of a natural hand: standard deviations and means of its angles.
    abduction_rad: Annotated[float, Range("rad", 0.01, 1.0, _HANDS)] = radians(7.0)
    natural_flexion_rad: Annotated[float, Range("rad", 0.01, 2.0, _HANDS)] = radians(14.0)
    neighbour_flexion_rad: Annotated[float, Range("rad", 0.01, 3.0, _HANDS)] = radians(30.0)
    neighbour_pip_rad: Annotated[float, Range("rad", 0.01, 3.0, _HANDS)] = radians(35.0)
    pip_rad: Annotated[float, Range("rad", 0.01, 3.0, _HANDS)] = radians(50.0)
    pip_mean_rad: Annotated[float, Range("rad", 0.0, 1.5, _HANDS)] = radians(12.0)
    loose_dip_rad: Annotated[float, Range("rad", 0.01, 1.0, _HANDS)] = radians(15.0)
    loose_dip_per_pip: Annotated[float, Range("1", 0.0, 1.5, "Kalbfleisch: DIP = 2/3 PIP")] = 2.0 / 3.0
    thumb_rad: Annotated[float, Range("rad", 0.01, 2.0, _HANDS)] = radians(20.0)
    thumb_abduction_mean_rad: Annotated[float, Range("rad", -1.0, 1.0, _HANDS)] = radians(8.0)
    thumb_flexion_mean_rad: Annotated[float, Range("rad", -1.0, 1.0, _HANDS)] = radians(8.0)
    thumb_mcp_mean_rad: Annotated[float, Range("rad", -1.0, 1.0, _HANDS)] = radians(10.0)
    thumb_ip_mean_rad: Annotated[float, Range("rad", -1.0, 1.0, _HANDS)] = radians(15.0)
    # A free hand, which has none: flexions anywhere within limits, a PIP rather in the lower half of its range.
    free_pip_rad: Annotated[float, Range("rad", 0.1, 3.0, _HANDS)] = radians(40.0)
    free_pip_mean_rad: Annotated[float, Range("rad", 0.0, 1.5, _HANDS)] = radians(30.0)
    natural_prior_weight: Annotated[
        float, Range("1", 0.01, 0.99, "small: posture priors that fit win by their narrowness")
    ] = 1.0 / 3.0
    posture_widened: Annotated[
        float, Range("1", 1.0, 10.0, "by which a measured posture is wider of a hand that defies it")
    ] = 3.0
    # A finger that was never seen is curled out of sight: a stretched one would show.
    curled_rad: Annotated[float, Range("rad", 0.01, 1.5, _HANDS)] = radians(15.0)
    curled_flexion_rad: Annotated[float, Range("rad", 0.0, 1.6, _HANDS)] = radians(65.0)
    curled_pip_rad: Annotated[float, Range("rad", 0.0, 1.9, _HANDS)] = radians(88.0)
    curled_thumb_abduction_rad: Annotated[float, Range("rad", -1.0, 1.0, _HANDS)] = radians(20.0)
    curled_thumb_flexion_rad: Annotated[float, Range("rad", -1.0, 1.0, _HANDS)] = radians(30.0)
    curled_thumb_mcp_rad: Annotated[float, Range("rad", -1.0, 1.5, _HANDS)] = radians(25.0)
    curled_thumb_ip_rad: Annotated[float, Range("rad", -1.0, 1.5, _HANDS)] = radians(30.0)
    shows_rad: Annotated[
        float, Range("rad", 0.1, 3.0, "a finger bent by less in all its joints shows its end from behind")
    ] = radians(45.0)
    # What is wrong with markers, bones and caps.
    back_normal_rad: Annotated[
        float, Range("rad", 0.05, 1.5, "a marker on the back that is seen well faces the cameras")
    ] = radians(22.0)
    bones_m: Annotated[float, Range("m", 1e-4, 1e-2, "bones and caps are known to about 1 mm")] = 1.0e-3
    # How far a hand that is seen moves in a time, as a random walk: wide, so that what is seen decides.
    process_noise_rad_s: Annotated[float, Range("rad/s", 0.5, 50.0, _HANDS)] = 8.0
    palm_process_noise_rad_s: Annotated[float, Range("rad/s", 0.1, 50.0, _HANDS)] = 2.5
    palm_held_rad_s: Annotated[
        float, Range("rad/s", 0.05, 50.0, "with a hidden thumb little determines how the palm turns")
    ] = 0.9
    palm_process_noise_m_s: Annotated[float, Range("m/s", 0.05, 20.0, _HANDS)] = 2.0
    shortest_s: Annotated[
        float, Range("s", 1e-5, 1e-2, "a shorter step would weld the hand to its last pose")
    ] = 1e-3
    component_memory_s: Annotated[
        float, Range("s", 0.0, 5.0, "how fast a hand may change from posture priors to none")
    ] = 0.3
    # Fingers that nobody sees.
    coast_s: Annotated[float, Range("s", 0.01, 1.0, _COORDINATION)] = 0.16
    rate_memory_s: Annotated[
        float, Range("s", 1e-3, 1.0, "half of a new rate counts at 60 frames a second")
    ] = 0.024
    growth_rad: Annotated[float, Range("rad", 0.05, 2.0, _GROWTH)] = radians(36.0)
    growth_aside_rad: Annotated[float, Range("rad", 0.02, 2.0, _GROWTH)] = radians(14.0)
    growth_thumb_rad: Annotated[float, Range("rad", 0.02, 2.0, _GROWTH)] = radians(20.0)
    growth_s: Annotated[float, Range("s", 0.05, 10.0, _GROWTH)] = 1.0
    alike: Annotated[float, Range("1", 0.0, 0.99, _COORDINATION)] = 0.7
    held_rad: Annotated[float, Range("rad", 0.001, 0.5, "a finger that was just lost")] = radians(3.0)
    # A palm without markers.
    lost_rotation_rad_s: Annotated[float, Range("rad/s", 0.01, 5.0, _HANDS)] = radians(20.0)
    lost_shift_m_s: Annotated[float, Range("m/s", 0.001, 1.0, _HANDS)] = 0.02
    lost_goes_on: Annotated[float, Range("1", 0.0, 2.0, "share of its speed, along each axis")] = 0.35
    speed_memory_s: Annotated[
        float, Range("s", 1e-3, 1.0, "three tenths of a new one count at 60 frames a second")
    ] = 0.047
    # One camera alone: perspective constrains depth poorly, so it is held.
    held_depth_m: Annotated[
        float, Range("m", 1e-4, 0.1, "a step of depth of a hand that one camera sees")
    ] = 0.004
    unobserved_depth_m_s: Annotated[
        float, Range("m/s", 0.001, 1.0, "simulated hands that one camera saw: 20 to 30 mm off after 0.6 s")
    ] = 0.08
    unobserved_depth_most_m: Annotated[float, Range("m", 0.01, 1.0, "as far as the volume goes")] = 0.15
    # Both hypotheses.
    certain: Annotated[float, Range("1", 1.0, 50.0, "log odds that count as certain")] = 12.0
    negligible: Annotated[
        float, Range("1", 0.0, 0.5, "weight of a hypothesis that changes next to nothing")
    ] = 0.03
    noticed: Annotated[
        float, Range("1", 0.0, 1.0, "of one of less weight the likeliest hand is taken, not its mean")
    ] = 0.15
    stiff: Annotated[
        float, Range("1", 1e-6, 1.0, "how much less than the markers the mean of hypotheses holds")
    ] = 1e-2
    # Covariance.
    claimed: Annotated[
        float,
        Range(
            "1", 0.1, 100.0, "observations that the widths of posture priors count as; Kass, Wasserman 1995"
        ),
    ] = 1.0
    straight_rad: Annotated[
        float, Range("rad", 0.0, 1.0, "a turn by less is 0.2 mm off the tangent at the far end of a hand")
    ] = radians(3.0)
    rotation_most_rad: Annotated[float, Range("rad", 0.1, 3.0, "a turn less sure leads nowhere farther")] = (
        1.0
    )
    # Gates.
    marker_gate: Annotated[float, Range("chi square", 5.0, 50.0, _CHI + " of three numbers, 1 in 1000")] = (
        16.3
    )
    misled: Annotated[
        float, Range("chi square", 5.0, 200.0, "twice that: another hand explains the markers better")
    ] = 32.6
    forget_s: Annotated[
        float, Range("s", 0.05, 10.0, "after so long without a marker nothing is known of the hand")
    ] = 0.5
    tracked_m: Annotated[
        float, Range("m", 0.002, 0.1, "half the largest axis of the 95 % region of a joint that is TRACKED")
    ] = 0.022
    tracked_pip_rad: Annotated[
        float, Range("rad", 0.02, 1.0, "standard deviation of the PIP of a finger that is TRACKED")
    ] = radians(15.0)
    tracked_age_s: Annotated[
        float, Range("s", 0.0, 1.0, "how old the newest measurement of a TRACKED finger may be")
    ] = 0.03
    tracked_cycle_s: Annotated[
        float,
        Range("s", 0.0, 1.0, "the same where a wrist device measured it, whose strobe cycles come at 30 Hz"),
    ] = 0.055
    # What is shown.
    blend_s: Annotated[float, Range("s", 0.01, 1.0, "as long as a leap is seen as a motion")] = 0.1
    # Fingers that a wrist device sees.
    dip_rad: Annotated[
        float, Range("rad", 0.005, 1.0, "of a DIP about its share of the PIP, of straight fingers")
    ] = radians(3.0)
    dip_share: Annotated[
        float, Range("1", 0.01, 1.0, "and by so much of the PIP more; the papers' ratios")
    ] = 0.13
    coupled_rad: Annotated[
        float, Range("rad", 0.005, 1.0, "of a natural MCP about its share of the PIP, of straight fingers")
    ] = radians(5.0)
    coupled_spread: Annotated[
        float, Range("1", 0.0, 1.0, "share of the PIP besides, of a hand of which nothing is known")
    ] = 0.2
    coupled_fingers: Annotated[
        float, Range("1", 1.0, 1e5, "half bent fingers seen that this counts as, once each strobe cycle")
    ] = 60.0
    coupled_s: Annotated[float, Range("s", 1.0, 3600.0, "as long as a hand keeps to its own share")] = 60.0
    thumb_coupled_rad: Annotated[
        float, Range("rad", 0.01, 1.0, "of a thumb's IP about what goes with its MCP")
    ] = radians(12.0)
    natural_finger_weight: Annotated[
        float, Range("1", 0.01, 0.99, "hands before anything of them is seen")
    ] = 0.8
    straight_pip_rad: Annotated[
        float, Range("rad", 0.02, 1.0, "by which fingers are bent that are stretched")
    ] = radians(10.0)
    unseen: Annotated[
        float, Range("1", 0.0, 10.0, "log odds against a pose whose fingertip would be seen, and is not")
    ] = 2.3
    unseen_again: Annotated[
        float, Range("1", 0.0, 10.0, "the same of a finger that was seen a moment ago: misses come in rows")
    ] = 0.7
    parted: Annotated[float, Range("1", 0.05, 0.95, "of the lower top, between two parts of a density")] = 0.4
    other_part: Annotated[float, Range("1", 0.001, 0.5, "less probability than this is no other part")] = 0.05
    branch_rad: Annotated[
        float, Range("rad", 0.5, 2.5, "PIP beyond which a laser point on the last phalanx fits two poses")
    ] = radians(95.0)
    goes_on_rad: Annotated[
        float, Range("rad", 0.02, 2.0, "by which a PIP may have moved at least since the finger was seen")
    ] = radians(8.0)
    near_rad: Annotated[
        float, Range("rad", 0.1, 3.0, "about its last PIP in which a finger that is well known is searched")
    ] = radians(32.0)
    search_again: Annotated[float, Range("1", 1.0, 100.0, "strobe cycles after which all is searched")] = 6.0
    hinge_rad: Annotated[
        float, Range("rad", 0.001, 0.5, "by which real hinges lie askew to those of a hand file")
    ] = radians(4.0)
    refused: Annotated[
        float, Range("chi square", 4.0, 100.0, "of laser point and fingertip of a finger, beside any pose")
    ] = 14.0
    refused_unlit: Annotated[
        float, Range("chi square", 3.0, 100.0, "the same where the light of the fingertip fits no pose")
    ] = 8.0
    contrary: Annotated[
        float,
        Range(
            "chi square", 5.0, 200.0, "of a palm against the IMU on the forearm, beside any bend and heading"
        ),
    ] = 30.0
    light_rad: Annotated[
        float, Range("1", 0.01, 1.0, "of a distance by light: skin inclined by 25 degrees looks 5 % farther")
    ] = 0.045
    light_share: Annotated[
        float,
        Range(
            "1", 0.0, 1.0, "of what distances by light measure, used to fit their unit: fingers err together"
        ),
    ] = 0.15
    teaching_gate: Annotated[
        float,
        Range("chi square", 1.0, 100.0, "of laser point and fingertip of a finger that teaches nothing"),
    ] = 5.0
    led_scale: Annotated[float, Range("1", 0.1, 10.0, "of the unit's logarithm, which may be any")] = 3.0
    flexion_rad: Annotated[float, Range("rad", 0.01, 1.5, "of wrists; Palmer et al. 1985")] = radians(14.0)
    deviation_rad: Annotated[float, Range("rad", 0.01, 1.5, "of wrists; Palmer et al. 1985")] = radians(11.0)
    calibrated_palm_rad: Annotated[
        float, Range("rad", 0.001, 0.5, "of a palm that was calibrated before its device")
    ] = radians(1.0)
    wrist_share: Annotated[
        float, Range("1", 0.0, 1.0, "of what fingers measure of the wrist's bend: they err together")
    ] = 0.6
    strap_rad: Annotated[
        float, Range("rad", 0.001, 0.5, "of a palm by markers, and of how IMU and camera are mounted")
    ] = radians(1.5)
    wrist_rate_1_s: Annotated[float, Range("1/s", 0.1, 30.0, "of wrists; Hansson et al. 2009")] = 1.5
    wrist_mean_s: Annotated[float, Range("s", 1.0, 600.0, "as long as a posture of the wrist is kept")] = 20.0
    tilt_s: Annotated[float, Range("s", 0.1, 600.0, "as long as an IMU has the vertical off")] = 5.0
    errs_s: Annotated[float, Range("s", 0.01, 60.0, "as long as errors of shape and skin stay")] = 0.5
    wrist_errs_s: Annotated[
        float,
        Range(
            "s", 0.001, 60.0, "as long as errors of a palm by markers stay, of what a wrist moves meanwhile"
        ),
    ] = 0.05
    # The search.
    tolerance: Annotated[float, Range("half chi square", 1e-12, 1.0, "what a step may leave")] = 1e-7
    tolerance_share: Annotated[float, Range("1", 0.0, 0.1, "of the cost, likewise")] = 1e-4
    coarse: Annotated[
        float, Range("half chi square", 1e-7, 1.0, "where one of several starts is to be chosen")
    ] = 1e-2

    @classmethod
    def ranges(cls) -> dict[str, Range]:
        """What each setting may be."""
        hints = get_type_hints(cls, include_extras=True)
        return {name: hints[name].__metadata__[0] for name in cls._fields}

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
        return self._replace(**{name: value})

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
        return filled(type(self), {name: np.float64(value) for name, value in self._asdict().items()})


DEFAULT = Settings()
