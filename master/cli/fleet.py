"""Options of `phalanx fleet status`, `keys` and `relay`.

Those of its other commands stand in `deploy.arguments`.
"""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import number
from master.commands.options import add_bus, add_calibration, add_link, add_rig, site_name


def status(command: ArgumentParser) -> None:
    """Show each process of the rig: machine, version, temperature, clock, rate.

    A row for each camera, IMU and tracker
    that has keys or reports itself; a dash where nothing is known.

    With --wait it waits until datagrams of these senders come: at the master that runs or, where none does, here; it
    ends with 1 if one of them is not received.

    Examples:
      phalanx fleet status                           once, as a table
      phalanx fleet status --watch                   again each second
      phalanx fleet status --watch --json | jq -c '.devices[] | [.name, .state]'
      phalanx fleet status --bus tls/192.168.1.2:47802 --keys ~/.config/phalanx/keys
      phalanx fleet status --wait left --wait right --keys ~/.config/phalanx/keys
      phalanx fleet status --wait wrist --wait imu --rig wrist --bind 0.0.0.0:47801 --beacon 192.168.1.255:47800
    """
    add_bus(command)
    command.add_argument(
        "--seconds",
        type=number(0.5, 3600.0),
        metavar="S",
        help="how long it listens (default: 3; with --wait at most 20)",
    )
    command.add_argument("--watch", action="store_true", help="again each second, until Ctrl-C")
    command.add_argument(
        "--json",
        dest="as_json",
        action="store_true",
        help="as JSON; with --wait datagrams a second by name, and whether a master runs",
    )
    command.add_argument(
        "--wait",
        action="append",
        default=[],
        metavar="NAME",
        help="wait for datagrams of this camera or IMU; once for each",
    )
    add_rig(command)
    add_calibration(command)
    add_link(command)


def keys(command: ArgumentParser) -> None:
    """Make the secrets of a rig: keys for datagrams, certificates for its bus.

    docs/keys.md lists who has which.

    Prints who has a certificate, what for, until when, and which device has no secret for its datagrams. --make
    makes a keys folder, or adds what is missing: what is there stays as it is. `phalanx fleet deploy` does that, and
    brings each device its part.

    --renew makes all keys anew, for everybody; then deploy again and restart the programs of the PC. With --device it
    makes only a new certificate for that device; its old one stays valid and its secret stays, so not for a lost one.

    --revoke locks out devices that were lost, sold or stolen: all keys are made anew, and these get none. A lost device
    reads and forges nothing of the others. But it has the rig key and a certificate, and counts as itself: nothing
    less keeps it out.

    Examples:
      phalanx fleet keys ~/.config/phalanx/keys
      phalanx fleet keys ~/.config/phalanx/keys --make
      phalanx fleet keys ~/.config/phalanx/keys --make --device left --device right
      phalanx fleet keys ~/.config/phalanx/keys --renew
      phalanx fleet keys ~/.config/phalanx/keys --renew --device left
      phalanx fleet keys ~/.config/phalanx/keys --revoke --device left
    """
    command.add_argument(
        "folder", type=Path, metavar="DIR", help="keys folder; keep it private, and out of calib_json"
    )
    command.add_argument(
        "--device",
        dest="devices",
        action="append",
        default=[],
        metavar="NAME",
        help="name of a camera, IMU or tracker as the rig has it; once for each",
    )
    what = command.add_mutually_exclusive_group()
    what.add_argument("--make", action="store_true", help="make the folder, or add what is missing")
    what.add_argument("--renew", action="store_true", help="make all keys anew, or one certificate")
    what.add_argument("--revoke", action="store_true", help="make all keys anew, and lock out --device")


def relay(command: ArgumentParser) -> None:
    """Show several masters in one place, and let nothing reach down to them.

    Two of these programs work together:

    At that place, with --listen, a router: it passes on what several masters publish, each under the name of its site,
    and readers name the site. Routers that are connected are one: a reader at any of them sees every site. One that was
    away is joined again by itself, and so is everybody at it. docs/scale.md describes when one is needed.

    Beside each master, with --site and --router, a relay: it repeats at the router what the master publishes: hands,
    objects, contact, gestures, health and the checklist. No command comes down, nothing that cameras send goes up. A
    process of its own; it waits for both, goes on when either was away, and counts what a slow link had no room for.

    Examples:
      phalanx fleet relay --listen tls/0.0.0.0:47810 --keys DIR
      phalanx fleet relay --listen tls/0.0.0.0:47810 --connect tls/192.168.2.1:47810 --keys DIR
      phalanx fleet relay --site room-a --router tls/192.168.2.1:47810 --keys DIR
      phalanx view --site room-a --bus tls/192.168.2.1:47810 --keys DIR --rig desk
    """
    role = command.add_mutually_exclusive_group(required=True)
    role.add_argument(
        "--listen", metavar="ENDPOINT", help="be a router: where relays, readers and other routers connect"
    )
    role.add_argument(
        "--site", type=site_name, metavar="NAME", help="be a relay: name of the site, as readers give it"
    )
    command.add_argument(
        "--connect",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="of a router: another one to be joined with; once for each",
    )
    command.add_argument("--router", metavar="ENDPOINT", help="of a relay: the router")
    add_bus(command)
