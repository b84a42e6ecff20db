"""The command line of `phalanx-slave install` as text.

It is all of the installer that a slave which only runs loads.
"""

import argparse
from pathlib import Path

from slave.install.options import READY_S, SETTLE_S, add_options


def add_install(parser: argparse.ArgumentParser) -> None:
    """Installs slaves as services of this machine, each with what it needs; as root.

    Examples:
      sudo phalanx-slave install --master 192.168.1.2 --rig desk --name left --keys keys --calibration calib_json
            on the Raspberry Pi itself, out of an environment that sees the system's packages (docs/deploy.md); keys and
            calib_json are copied from the PC. From the PC, for all machines at once: phalanx fleet deploy
      sudo phalanx-slave install --master 192.168.1.2 --rig wrist --imu lsm6dsox:1 --lights gpio:0:17,27 --keys keys
            a wrist device: its camera and its IMU, each a service
      sudo phalanx-slave install --master 192.168.1.2 --rig desk --name left --dry-run
            only print what would be changed; the keys that are there stay
      sudo phalanx-slave install --rollback
            go back to what was before the last installation
      sudo phalanx-slave install --uninstall
            take everything away again but the packages of apt
    """
    add_options(parser)
    parser.add_argument(
        "--keys", type=Path, metavar="DIR", help="keys folder of the PC; default: those that are there stay"
    )
    parser.add_argument(
        "--calibration", type=Path, default=Path("calib_json"), metavar="DIR", help="default: %(default)s"
    )
    parser.add_argument(
        "--wheelhouse",
        type=Path,
        metavar="DIR",
        help="install these wheels (default: what this command runs from)",
    )
    parser.add_argument("--no-apt", action="store_true", help="install no packages of the system")
    parser.add_argument("--dry-run", action="store_true", help="write nothing; report what would be changed")
    ends = parser.add_mutually_exclusive_group()
    ends.add_argument(
        "--rollback",
        action="store_true",
        help="go back to release, options, keys and calibration as they were before the last installation",
    )
    ends.add_argument("--uninstall", action="store_true", help="take everything away again")
    parser.add_argument(
        "--ready-s",
        type=float,
        default=READY_S,
        metavar="S",
        help="until slaves are ready (default: %(default)g)",
    )
    parser.add_argument("--settle-s", type=float, default=SETTLE_S, help=argparse.SUPPRESS)
    parser.add_argument("--root", type=Path, default=Path("/"), help=argparse.SUPPRESS)
    parser.add_argument("--bundle", type=Path, help=argparse.SUPPRESS)  # keys and calibration, from the PC
    parser.add_argument("--release", help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true", help=argparse.SUPPRESS)
