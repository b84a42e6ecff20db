"""Entry point of `phalanx`, and of `phalanx-master`.

The latter is its name where it runs as a service.
"""

import logging
import sys

from master.cli.table import program


def main() -> int:
    """Run one command; return the exit code.

    0 done, 1 something the user can mend, 2 wrong usage, 70 a fault, 130 interrupted.
    """
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it logs its font cache on the first run
    return program().main()


if __name__ == "__main__":
    sys.exit(main())
