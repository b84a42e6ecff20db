"""Options of `phalanx view`, `console`, `check` and `info`."""

from argparse import ArgumentParser
from pathlib import Path

from common.option_types import whole
from master.commands.options import add_bus, add_calibration, add_hand, add_link, add_rigs, add_site


def view(command: ArgumentParser) -> None:
    """Show a running master in Rerun.

    A process of its own, which may come and go; it waits for the master.

    Examples:
      phalanx view --rig desk
      phalanx view --rig desk --rig wrist
      phalanx view --rig desk --keys DIR --bus tls/192.168.1.2:47802 --web
      phalanx view --rig desk --keys DIR --bus tls/192.168.2.1:47810 --site room-a
    """
    add_rigs(command)
    add_calibration(command)
    add_hand(command)
    add_bus(command)
    add_site(command)
    command.add_argument(
        "--web", action="store_true", help="serve the viewer to a browser on 127.0.0.1 instead of a window"
    )
    command.add_argument(
        "--web-port",
        type=whole(1, 65535),
        default=9090,
        metavar="PORT",
        help="TCP port of that page (default: %(default)s)",
    )
    command.add_argument(
        "--save", type=Path, metavar="FILE", help="write an .rrd instead of showing anything"
    )


def console(command: ArgumentParser) -> None:
    """Serve the console: watch, tune, record and set up in a browser.

    A process of its own, which may come and go.

    Needs no master and no file: the page sets a rig up from nothing. --beacon, --bind and the key are those of the
    processes that the page starts.

    Examples:
      phalanx console
      phalanx console --rig desk --rig wrist --port 8081
      phalanx console --keys DIR --bus tls/192.168.1.2:47802
      phalanx console --host 0.0.0.0
    """
    add_calibration(command)
    command.add_argument(
        "--rig",
        action="append",
        metavar="NAME",
        help="rig that runs, once for each (default: desk, once its file is there)",
    )
    add_bus(command)
    add_link(command)
    command.add_argument(
        "--port",
        type=whole(0, 65535),
        default=8080,
        metavar="PORT",
        help="TCP port of the page; 0: a free one (default: %(default)s)",
    )
    command.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to serve on; elsewhere than on this machine the page asks for a password (default: "
        "%(default)s)",
    )
    command.add_argument(
        "--password-file",
        type=Path,
        metavar="FILE",
        help="ask for the password in the first line of this file (default: one is made and printed once)",
    )


def check(command: ArgumentParser) -> None:
    """Print what is not as it should be.

    Exit code 1 if there is anything, 0 if all is well.

    What each line means, how it is measured and what to do: docs/checklist.md.

    Examples:
      phalanx check
      phalanx check --watch
      phalanx check --keys DIR --bus tls/192.168.1.2:47802 && echo ready
    """
    add_bus(command)
    add_site(command)
    command.add_argument(
        "--watch", action="store_true", help="go on until Ctrl-C, and print the list whenever it changes"
    )


def info(command: ArgumentParser) -> None:
    """Show what is in a recording of messages.

    Streams, rates, length, files, and what happened.

    Examples:
      phalanx info out/wave.mcap
    """
    command.add_argument("file", type=Path, metavar="FILE.mcap", help="the recording")
