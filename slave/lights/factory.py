"""The lights behind `--lights`: which there are for which camera, and how they are opened. None is chosen silently."""

from common.calibration import RigCalibration
from common.errors import LightsError
from common.strobe_calibration import StrobeCalibration
from slave.drivers import LIGHTS, SWITCHED_LIGHTS
from slave.lights.interlock import Interlock

ELSEWHERE = ("camera", "external")
SYNTHETIC = "synthetic"


def choose(lights: str | None, rig: RigCalibration, camera: str) -> str | None:
    """What lights the frames of a camera.

    Args:
        lights: The value of `--lights`; None: not given.
        rig: Whose camera it is.
        camera: The value of `--camera`.

    Returns:
        The choice; None where the slave switches nothing, as the camera or another controller does.

    Raises:
        LightsError: Not given where it must be, given where there is nothing to light, or unknown.
    """
    kind = camera.partition(":")[0]
    if rig.kind != "wrist" or kind == "replay":
        if lights is not None:
            what = "a recording is lit already" if kind == "replay" else f"rig {rig.name!r} sees markers"
            raise LightsError(f"--lights {lights}: {what}; only the camera of a wrist device has lights")
        return None
    if lights is None:
        if kind == SYNTHETIC:
            return SYNTHETIC
        raise LightsError(
            f"rig {rig.name!r} is a wrist device: say who switches its laser and LEDs, --lights {LIGHTS};"
            " the last two: the camera's own strobe output, or another controller, within limits of its own"
        )
    name, colon, _ = lights.partition(":")
    if lights in ELSEWHERE:
        return None
    if lights == SYNTHETIC and kind != SYNTHETIC:
        raise LightsError(f"--lights synthetic: lights nothing before --camera {camera}; there are {LIGHTS}")
    if lights != SYNTHETIC and kind == SYNTHETIC:
        raise LightsError(f"--lights {lights}: a simulated hand is lit by synthetic, or by camera")
    if lights != SYNTHETIC and not (colon and name in ("gpio", "i2c")):
        raise LightsError(f"--lights {lights}: no such lights; there are {LIGHTS}")
    return lights


def limits_for(lights: str, rig: RigCalibration) -> StrobeCalibration:
    """The limits within which lights are switched.

    Raises:
        LightsError: The rig file has none.
    """
    if rig.strobe is None:
        raise LightsError(
            f"--lights {lights}: rig {rig.name!r}: strobe: missing; laser and LEDs are only switched within limits:"
            " power, pulse, duty (docs/safety.md); --lights camera where others switch them"
        )
    return rig.strobe


def open_guarded(lights: str, rig: RigCalibration) -> Interlock:
    """Open real lights, dark, within the limits of the rig file.

    Raises:
        LightsError: They cannot be opened, or the rig file has no limits for them.
    """
    strobe = limits_for(lights, rig)
    kind, _, place = lights.partition(":")
    if kind == "gpio":
        from slave.lights.gpio import GpioLights

        return Interlock(GpioLights(place, strobe.max_pulse_us * 1e-6), strobe)
    if kind == "i2c":
        from slave.lights.i2c_led import FlashDriverLights

        return Interlock(FlashDriverLights(place, strobe), strobe)
    raise LightsError(f"--lights {lights}: the slave does not switch these; it does {SWITCHED_LIGHTS}")
