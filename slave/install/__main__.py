"""`python3 -m slave.install`: the installer before anything is installed."""

import sys

from slave.install.command import main


def say(line: str) -> None:
    """One line, at once: the PC shows it while the next step runs. The PC may be gone; the installation goes on."""
    try:
        print(line, flush=True)
    except BrokenPipeError:
        sys.stdout = sys.stderr = open("/dev/null", "w")  # noqa: PTH123, SIM115 - until the end


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], say))
