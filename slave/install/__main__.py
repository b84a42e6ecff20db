"""`python3 -m slave.install`: the installer before anything is installed."""

import json
import sys

from slave.install.probe import OLDEST, judge, probe


def print_line(line: str) -> None:
    """Print one line at once for the PC; it may be gone, the installation goes on."""
    try:
        print(line, flush=True)
    except BrokenPipeError:
        sys.stdout = sys.stderr = open("/dev/null", "w")  # noqa: PTH123, SIM115 - until the end


def refuse(action: str) -> int:
    """Report that this Python is too old, which cannot read the installer itself."""
    facts = probe()
    why = judge(facts)
    print_line(
        json.dumps({"result": {**facts, "why_not": why}}) if action == "probe" else f"phalanx-slave: {why}"
    )
    return 0 if action == "probe" else 1


def main() -> int:
    """Hand on what is asked for; the exit code."""
    if sys.version_info[:2] < OLDEST:
        return refuse("".join(sys.argv[1:2]))
    from slave.install import command

    return command.main(sys.argv[1:], print_line)


if __name__ == "__main__":
    sys.exit(main())
