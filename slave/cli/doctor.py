"""Options of `phalanx-slave doctor`.

What is not passed is read from the files in /etc/phalanx.
"""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import positive
from slave.cli.options import BEACON_PORT
from slave.drivers import SWITCHED_LIGHTS


def doctor(command: ArgumentParser) -> None:
    """Report what of this device is well and what is not.

    Machine, clock, libraries, keys, devices, camera, service, and
    whether its master is received; each line ok, warn or fail, with what mends it; exit 1 where something fails.

    With --lights it looks at laser and LEDs of a wrist device alone: what the strobe of a rig may do, and what share of
    every limit for eyes and supply that is; and switches them, if asked to.

    Examples:
      sudo phalanx-slave doctor
            on a device with a service
      phalanx-slave doctor --name left --rig desk --camera v4l2 --calibration calib_json --keys keys --master pc.local
            before it is installed; as root it sees the keys, as another user the rest
      phalanx-slave doctor --json
            the same for programs; docs/doctor.md
      phalanx-slave doctor --ports
            where an IMU may be connected: serial ports and I2C buses
      phalanx-slave doctor --rig wrist --lights
            the budget of a rig
      phalanx-slave doctor --rig wrist --lights gpio:0:17,27 --blink 3
            three seconds of laser and LEDs in turn, as before a camera, within the limits; gpio:0:17/low,27 where low
            is on
      phalanx-slave doctor --rig wrist --lights i2c:1:0x63 --off
            dark, whatever was before: for a service that ends the slave by force
    """
    command.add_argument("--name", help="slave to look at (default: all that are installed here)")
    command.add_argument("--rig", metavar="NAME", help="its rig (default: as installed; with --lights wrist)")
    command.add_argument(
        "--camera", metavar="DRIVER", help="its camera, as `run` has it (default: as installed)"
    )
    command.add_argument(
        "--calibration",
        type=Path,
        metavar="DIR",
        help="calib_json (default: as installed; with --lights calib_json)",
    )
    command.add_argument("--keys", type=Path, metavar="DIR", help="keys folder (default: /etc/phalanx/keys)")
    command.add_argument("--master", metavar="HOST", help="the PC whose beacon and clock are expected")
    command.add_argument(
        "--beacon-port", type=int, default=BEACON_PORT, metavar="PORT", help="default: %(default)s"
    )
    command.add_argument("--json", action="store_true", help="for programs")
    command.add_argument("--ports", action="store_true", help="list where an IMU may be connected, and end")
    lights = command.add_argument_group("laser and LEDs of a wrist device").add_argument
    lights(
        "--lights",
        nargs="?",
        const="",
        metavar="DRIVER",
        help=f"the budget of the rig's strobe; with a driver, {SWITCHED_LIGHTS}, they can be switched",
    )
    lights("--blink", type=positive, metavar="S", help="laser and LEDs in turn, for so many seconds")
    lights("--off", action="store_true", help="switch both off")
