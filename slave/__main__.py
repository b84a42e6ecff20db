"""Entry point `phalanx-slave`."""

import sys
from collections.abc import Sequence

from slave.cli.table import PROGRAM


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command: 0 done, 1 a user can mend it, 2 wrong usage, 130 interrupted.

    Raises:
        SystemExit: With code 70, if a thread or the command itself failed.
    """
    return PROGRAM.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
