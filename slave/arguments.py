"""The slave's command line as text: commands, options, help. Each command's help shows its own examples."""

import argparse
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from slave.commands import colours, detect, importing, imu, join, lights, record, run, tracker
from slave.commands.options import BEACON_PORT
from slave.doctor import options as doctor
from slave.install import arguments as install

ABOUT = (
    "The slave stands beside a camera: it finds the painted markers, or the fingers before a wrist device, and sends\n"
    "where they are.\n"
    "Images leave it only as small previews, on request, while somebody looks."
)


class Help(NamedTuple):
    """What a command is for, in the list of commands; its examples; and what adds its options."""

    purpose: str
    examples: str
    add_options: Callable[[argparse.ArgumentParser], None]


HELP = {
    "run": Help(run.PURPOSE, run.EXAMPLES, run.add_options),
    "imu": Help(imu.PURPOSE, imu.EXAMPLES, imu.add_options),
    "tracker": Help(tracker.PURPOSE, tracker.EXAMPLES, tracker.add_options),
    "lights": Help(lights.PURPOSE, lights.EXAMPLES, lights.add_options),
    "record": Help(record.PURPOSE, record.EXAMPLES, record.add_options),
    "join": Help(join.PURPOSE, join.EXAMPLES, join.add_options),
    "import": Help(importing.PURPOSE, importing.EXAMPLES, importing.add_options),
    "detect": Help(detect.PURPOSE, detect.EXAMPLES, detect.add_options),
    "install": Help(install.PURPOSE, install.EXAMPLES, install.add_install),
    "doctor": Help(doctor.PURPOSE, doctor.EXAMPLES, partial(doctor.add_options, beacon_port=BEACON_PORT)),
    "colours": Help(colours.PURPOSE, colours.EXAMPLES, colours.add_options),
}


def parser() -> argparse.ArgumentParser:
    """The parser of `phalanx-slave`; the command is in `command`."""
    whole = argparse.ArgumentParser(
        "phalanx-slave",
        description=ABOUT,
        epilog="`phalanx-slave COMMAND --help` shows its examples.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in HELP.items():
        command = commands.add_parser(
            name,
            help=text.purpose,
            epilog=f"examples:\n{text.examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        text.add_options(command)
    return whole
