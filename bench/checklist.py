"""Rehearsal of the checklist with real processes: every fault is brought about, and taken away again.

`python -m bench.checklist [--clean 60] [--only CODE ...]` prints how long after a fault its line was on the list, how
long after its end it was gone, and what else was told meanwhile; then how often anything was told in a clean minute.
Goal: two seconds, nothing else, and nothing.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.checklist_faults import Fault, of_markers, of_wrist, settle
from bench.checklist_rig import Key, Rig
from bench.local_rig import until

WAIT_S = 30.0
AFTER_S = 2.5  # what follows from a fault would be told by then


@dataclass(frozen=True, slots=True)
class Shown:
    """What became of one fault.

    Attributes:
        shown_s, cleared_s: From the fault to the list that has it, from its end to the list that has it no more [s];
            None: never.
        shown_reports, cleared_reports: How many of the master's reports, one a second, came in that time.
        others: What else was told from the fault to the end of what could follow.
        subjects: Whom it named.
    """

    fault: Fault
    shown_s: float | None
    cleared_s: float | None
    shown_reports: int
    cleared_reports: int
    others: frozenset[Key]
    subjects: frozenset[str]


def rehearse(rig: Rig, fault: Fault, after_s: float = AFTER_S) -> Shown:
    """Bring it about and away; `after_s` is waited for what may follow."""
    settle(rig, after_s)
    fault.put(rig)
    put = time.monotonic()
    reports = rig.lists.reports
    shown_s = _wait(rig, fault, put, True)
    shown_reports = rig.lists.reports - reports
    time.sleep(after_s)
    subjects = frozenset(subject for code, subject in rig.lists.now() if code == fault.code)
    fault.take(rig)
    taken, reports = time.monotonic(), rig.lists.reports
    cleared_s = _wait(rig, fault, taken, False)
    cleared_reports = rig.lists.reports - reports
    time.sleep(after_s)
    others = {key for _, keys in rig.lists.since(put) for key in keys if key[0] != fault.code}
    return Shown(fault, shown_s, cleared_s, shown_reports, cleared_reports, frozenset(others), subjects)


def _wait(rig: Rig, fault: Fault, since: float, there: bool) -> float | None:
    def holds() -> bool:
        lists = rig.lists.since(since)
        return bool(lists) and any(code == fault.code for code, _ in lists[-1][1]) == there

    return time.monotonic() - since if until(holds, WAIT_S) else None


def clean(rig: Rig, seconds: float) -> frozenset[Key]:
    """What is told while nothing is wrong."""
    settle(rig, AFTER_S)
    since = time.monotonic()
    time.sleep(seconds)
    return frozenset(key for _, keys in rig.lists.since(since) for key in keys)


def row(shown: Shown) -> str:
    """A line of the table."""

    def seconds(value: float | None) -> str:
        return "never" if value is None else f"{value:.1f} s"

    others = ", ".join(sorted(f"{code} {subject}" for code, subject in shown.others)) or "none"
    return (
        f"| `{shown.fault.code}` | {shown.fault.what} | {seconds(shown.shown_s)} | {seconds(shown.cleared_s)}"
        f" | {', '.join(sorted(shown.subjects))} | {others} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Rehearse all, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--clean", type=float, default=60.0, metavar="S", help="seconds in which nothing is wrong"
    )
    parser.add_argument("--only", nargs="*", metavar="CODE", help="these codes alone")
    options = parser.parse_args(arguments)
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(
        "| code | what is done | shown after | gone after | subjects | what else was told |\n|---|---|--:|--:|---|---|"
    )
    with tempfile.TemporaryDirectory(prefix="phalanx-checklist-") as folder:
        for name, faults in (("desk", of_markers()), ("wrist", of_wrist())):
            wanted = [one for one in faults if not options.only or one.code in options.only]
            if not wanted:
                continue
            rig = Rig(Path(folder) / name, name)
            try:
                for fault in wanted:
                    print(row(rehearse(rig, fault)), flush=True)
                if options.clean > 0.0:
                    reported = clean(rig, options.clean)
                    words = ", ".join(f"{code} {subject}" for code, subject in sorted(reported)) or "nothing"
                    print(f"rig {name}, {options.clean:g} s with nothing wrong: told {words}", flush=True)
            finally:
                rig.close()


if __name__ == "__main__":
    main()
