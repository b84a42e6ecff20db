"""What the doctor can be told; what it is not, the files in /etc/phalanx say."""

import argparse
from pathlib import Path

PURPOSE = "what of this device is well, and what is not"
EXAMPLES = """\
  sudo phalanx-slave doctor
        on a device with a service: machine, clock, libraries, keys, devices, camera, service, and whether its master
        is heard; each line ok, warn or fail, with what mends it; exit 1 where something fails
  phalanx-slave doctor --name left --rig desk --camera v4l2 --calibration calib_json --keys keys --master pc.local
        before it is installed; as root it sees the keys, as another user the rest
  phalanx-slave doctor --json
        the same for programs; docs/doctor.md
"""


def add_options(parser: argparse.ArgumentParser, beacon_port: int) -> None:
    """Add the options of `phalanx-slave doctor`."""
    parser.add_argument("--name", help="slave to look at (default: all that are installed here)")
    parser.add_argument("--rig", help="its rig (default: as installed)")
    parser.add_argument(
        "--camera", metavar="DRIVER", help="its camera, as `run` has it (default: as installed)"
    )
    parser.add_argument("--calibration", type=Path, metavar="DIR", help="calib_json (default: as installed)")
    parser.add_argument("--keys", type=Path, metavar="DIR", help="keys folder (default: /etc/phalanx/keys)")
    parser.add_argument("--master", metavar="HOST", help="the PC whose beacon and clock are expected")
    parser.add_argument(
        "--beacon-port", type=int, default=beacon_port, metavar="PORT", help="default: %(default)s"
    )
    parser.add_argument("--json", action="store_true", help="for programs")
