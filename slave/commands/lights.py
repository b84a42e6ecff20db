"""`phalanx-slave doctor --lights`: limits and test of a rig's lights.

It shows what laser and LEDs may do, and tests them.
"""

import argparse

from common.calibration import CameraCalibration, load
from common.errors import LightsError
from common.terminal import echo
from slave.commands.options import camera_path, rig_of
from slave.devices import open_lights
from slave.drivers import SWITCHED_LIGHTS
from slave.stopping import stop_by_signal

USUAL_RIG = "wrist"


def look_at_lights(options: argparse.Namespace) -> int:
    """Notify the budget; switch lights only where that is asked for.

    Raises:
        PhalanxError: A file is missing or broken, or the lights cannot be opened or switched.
    """
    from slave.lights.report import blink, budget

    rig = rig_of(options, USUAL_RIG)
    camera = load(camera_path(options, rig.cameras[0]), CameraCalibration)
    if not (options.blink or options.off):
        echo(budget(rig, camera))
        return 0
    if not options.lights:
        raise LightsError(f"--blink and --off need the lights: --lights {SWITCHED_LIGHTS}")
    with stop_by_signal() as stop:
        interlock = open_lights(options.lights, rig)  # dark from here on
        try:
            if options.blink:
                echo(budget(rig, camera))
                blink(interlock, rig, camera, stop, options.blink)
        finally:
            interlock.close()
    events = ", ".join(f"{event} {count}" for event, count in interlock.events().items())
    echo(events if options.blink else "dark")
    return 0
