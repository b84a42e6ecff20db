"""The budget of a strobe as text, and a test of its lights without a camera.

This is what `doctor --lights` prints and does.
"""

import threading

from common.calibration import CameraCalibration, RigCalibration
from common.calibration.strobe import Limit, StrobeCalibration, limits_of
from common.clock import SystemClock
from common.errors import LightsError
from common.recording.frame_recording import Illumination
from slave.lights.interlock import Interlock
from slave.lights.schedule import CYCLE
from slave.lights.strobed import check_pulses, schedule_of

SHOWN = {"J": (1e6, "uJ"), "W": (1e3, "mW"), "W/m2/sr": (1e-3, "kW/m2/sr")}


def budget(rig: RigCalibration, camera: CameraCalibration) -> str:
    """Pulse, duty, power and every limit with its share, as lines.

    Raises:
        CalibrationError: The rig file has no strobe, or the exposure of the camera's file leaves no room for its light.
    """
    check_pulses(rig, camera)
    strobe, laser = rig.strobe, rig.laser
    assert strobe is not None
    assert laser is not None
    assert laser.fan_rad is not None  # the file was checked
    period_s = len(CYCLE) / camera.frame_rate_hz
    pulse_s = schedule_of(rig, camera).length_ns * 1e-9
    duty = pulse_s / period_s
    limits = limits_of(strobe, laser.fan_rad)
    return "\n".join(
        [
            f"rig {rig.name}, camera {camera.name}: {1.0 / period_s:.1f} cycles/s, exposure {camera.exposure_us:g} us",
            f"  each light  pulse {pulse_s * 1e6:.0f} us (at most {strobe.max_pulse_us:g})",
            f"              duty {duty:.3f} (at most {strobe.max_duty:g} of any second)",
            *_powers(strobe, duty),
            "",
            "at the longest pulse and the highest duty that the rig file allows:",
            *_table([limit for limit in limits if not limit.fault]),
            "",
            "after a fault that leaves a light on:",
            *_table([limit for limit in limits if limit.fault]),
            "",
            "Calculated from the numbers of the rig file; this is no certificate (docs/safety.md).",
        ]
    )


def blink(
    interlock: Interlock,
    rig: RigCalibration,
    camera: CameraCalibration,
    stop: threading.Event,
    seconds: float,
) -> int:
    """Switch laser and LEDs in turn and return the number of pulses.

    They are switched as before a camera of that rate, through the guard.

    Raises:
        LightsError: The lights fail.
    """
    clock = SystemClock()
    length_ns = schedule_of(rig, camera).length_ns
    period_ns = round(1e9 / camera.frame_rate_hz)
    next_ns = clock.now_ns()
    end_ns = next_ns + round(seconds * 1e9)
    frame = 0
    while next_ns < end_ns and not stop.is_set():
        lit = CYCLE[frame % len(CYCLE)]
        if lit is not Illumination.AMBIENT and interlock.begin(lit, length_ns):
            stop.wait(length_ns * 1e-9)
            interlock.end()
        frame, next_ns = frame + 1, max(next_ns + period_ns, clock.now_ns())
        stop.wait((next_ns - clock.now_ns()) * 1e-9)
    if interlock.counts["pulses"] == 0 and not stop.is_set():
        raise LightsError("no pulse was allowed: the limits of the rig file refuse them all")
    return interlock.counts["pulses"]


def _powers(strobe: StrobeCalibration, duty: float) -> list[str]:
    laser, led = strobe.laser, strobe.led
    on_mw, mean_mw = laser.power_w * 1e3, laser.power_w * duty * 1e3
    sr_mw, mean_sr_mw = led.intensity_w_sr * 1e3, led.intensity_w_sr * duty * 1e3
    draws = [watts * duty * 1e3 for watts in (laser.electrical_w, led.electrical_w)]
    others_mw, most_mw = strobe.others_w * 1e3, strobe.max_electrical_w * 1e3
    return [
        f"  laser       {on_mw:.3g} mW of light at {laser.wavelength_nm:g} nm while on, {mean_mw:.3g} mW in the mean",
        f"  {led.count} LEDs      {sr_mw:.3g} mW/sr each at {led.wavelength_nm:g} nm, {mean_sr_mw:.3g} in the mean",
        f"  supply      laser {draws[0]:.3g} + LEDs {draws[1]:.3g} + camera and IMU {others_mw:.3g} mW in the mean",
        f"              together {sum(draws) + others_mw:.3g} mW (at most {most_mw:g})",
    ]


def _table(limits: list[Limit]) -> list[str]:
    wide = max(len(limit.name) for limit in limits)
    lines: list[str] = []
    for limit in limits:
        scale, unit = SHOWN.get(limit.unit, (1.0, limit.unit))
        value, bound = scale * limit.value, scale * limit.bound
        lines.append(
            f"  {limit.name:<{wide}}  {value:8.3g} of {bound:8.3g} {unit:<8}{100.0 * limit.share:5.1f} %"
            f"  {limit.source}"
        )
    return lines
