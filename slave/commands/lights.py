"""`phalanx-slave lights`: what laser and LEDs of a rig may do, and a test of them."""

import argparse
from collections.abc import Callable

from common.calibration import CameraCalibration, load
from common.errors import LightsError
from slave.commands.options import add_rig, camera_path, positive, rig_of
from slave.devices import open_lights
from slave.drivers import SWITCHED_LIGHTS
from slave.stopping import stop_by_signal

PURPOSE = "budget and test of laser and LEDs"
EXAMPLES = """\
  phalanx-slave lights --rig wrist
        what the strobe of a rig may do, and what share of every limit for eyes and supply that is
  phalanx-slave lights --rig wrist --lights gpio:0:17,27 --blink 3
        three seconds of laser and LEDs in turn, as before a camera, within the limits; gpio:0:17/low,27 where low is on
  phalanx-slave lights --rig wrist --lights i2c:1:0x63 --off
        dark, whatever was before: for a service that ends the slave by force
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """The options of `lights`."""
    add_rig(command, "wrist", ", with the key strobe")
    command.add_argument("--lights", metavar="DRIVER", help=SWITCHED_LIGHTS)
    act = command.add_mutually_exclusive_group()
    act.add_argument(
        "--blink", type=positive, metavar="S", help="laser and LEDs in turn, for so many seconds"
    )
    act.add_argument("--off", action="store_true", help="switch both off")


def run(options: argparse.Namespace, notify: Callable[[str], None]) -> int:
    """Notify the budget; switch lights only where that is asked for.

    Raises:
        PhalanxError: A file is missing or broken, or the lights cannot be opened or switched.
    """
    from slave.lights.report import blink, budget

    rig = rig_of(options)
    camera = load(camera_path(options, rig.cameras[0]), CameraCalibration)
    if not (options.blink or options.off):
        notify(budget(rig, camera))
        return 0
    if options.lights is None:
        raise LightsError(f"--blink and --off need the lights: --lights {SWITCHED_LIGHTS}")
    with stop_by_signal() as stop:
        interlock = open_lights(options.lights, rig)  # dark from here on
        try:
            if options.blink:
                notify(budget(rig, camera))
                blink(interlock, rig, camera, stop, options.blink)
        finally:
            interlock.close()
    events = ", ".join(f"{event} {count}" for event, count in interlock.events().items())
    notify(events if options.blink else "dark")
    return 0
