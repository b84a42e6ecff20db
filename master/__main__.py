"""Entry point `phalanx-master`: its commands, and the errors that end them."""

import logging
import os
import sys

try:
    from master.commands import command_line
    from master.key_options import program
except ModuleNotFoundError as error:  # a slave's machine has the scripts of both, and the packages of one
    raise SystemExit(
        f"phalanx-master: {error.name} is missing: install the master's packages, pip install '.[master]'"
    ) from error

from common.errors import PhalanxError
from common.service_manager import ServiceManager, one_line
from common.supervisor import supervised_threads


def main() -> None:
    """Run one command, and end the process with its exit code.

    0 done, 1 something the user can mend, 2 wrong usage, 70 a fault.
    """
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it tells of its font cache on the first run
    with supervised_threads():
        try:
            program(command_line(next(iter(sys.argv[1:]), None)))()
        except PhalanxError as error:
            ServiceManager(os.environ).send(f"STATUS=failed: {one_line(str(error))}")
            print(f"phalanx-master: {error}", file=sys.stderr)
            sys.exit(1)


if __name__ == "__main__":
    main()
