"""Every fault that an operator meets, brought about on real processes: what is expected, and what was measured.

`python -m bench.faults [--runs 3] [--only NAME ...]` prints the table. Goal: steady and right poses again within two
seconds of the end of the cause, no false pose meanwhile, and a count that tells it.
"""

import argparse
import os
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path

from bench.faults_links import Fault, of_links
from bench.faults_measured import BEHIND_S, LEAST_HZ, Run, measured
from bench.faults_rig import FaultRig

HEAD = (
    "| fault | expected | back after (median, slowest) | poses during it | worst tracked joint | false | oldest pose"
    " | counted | checklist |\n|---|---|--:|--:|--:|--:|--:|---|---|"
)


def row(fault: Fault, runs: Sequence[Run]) -> str:
    """A line of the table."""
    back = [one.recovery_s for one in runs if one.recovery_s is not None]
    never = len(runs) - len(back)
    said = f"{statistics.median(back):.2f} s, {max(back):.2f} s" if back else "never"
    said += f" ({never} never)" if never and back else ""
    behind_s = max(one.lag_s for one in runs)
    said += f" (machine up to {behind_s:.2f} s behind)" if behind_s > BEHIND_S else ""
    counts = {name: statistics.median(one.counts.get(name, 0) for one in runs) for name in fault.counts}
    counted = ", ".join(f"`{name}` {number:.0f}" for name, number in counts.items() if number) or "–"
    codes = {code for one in runs for code in one.listed}
    listed = ", ".join(f"`{code}`" for code in sorted(codes)) or "–"
    share = statistics.median(one.share for one in runs)
    worst, beyond = (
        max((one.worst_mm for one in runs if one.worst_mm == one.worst_mm), default=float("nan")),
        max(one.beyond for one in runs),
    )
    wrong = sorted({one for run in runs for one in run.wrong(fault)})
    return (
        f"| {fault.what} | {fault.expected} | {said} | {100.0 * share:.0f} % | {_mm(worst)}, {beyond:.1f} σ"
        f" | {sum(one.false for one in runs)} | {max(one.oldest_s for one in runs):.2f} s | {counted} | {listed} |"
        + (f" **{', '.join(wrong)}**" if wrong else "")
    )


def _mm(value: float) -> str:
    return "none tracked" if value != value else f"{value:.0f} mm"


def main(arguments: Sequence[str] | None = None) -> int:
    """Bring all about, print the table; 1 if one is not as expected, 2 if this machine can show nothing."""
    faults = of_links(long=True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3, metavar="N", help="of each fault (default: 3)")
    parser.add_argument("--only", nargs="*", metavar="NAME", help=", ".join(one.name for one in faults))
    options = parser.parse_args(arguments)
    if strange := set(options.only or ()) - {one.name for one in faults}:
        parser.error(f"no fault {min(strange)!r}; there are {', '.join(one.name for one in faults)}")
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores", flush=True)
    wrong = False
    with tempfile.TemporaryDirectory(prefix="phalanx-faults-") as folder:
        rig = FaultRig(Path(folder) / "rig")
        try:
            print(
                f"before any fault: {(rate_hz := rig.own_pace(3.0).rate_hz):.0f} poses a second\n\n{HEAD}",
                flush=True,
            )
            if rate_hz < LEAST_HZ:
                print(f"fewer than {LEAST_HZ:g}: this machine has too much else to do")
                return 2
            for fault in faults:
                if options.only and fault.name not in options.only:
                    continue
                runs = [measured(rig, fault) for _ in range(options.runs)]
                wrong |= any(run.wrong(fault) for run in runs)
                print(row(fault, runs), flush=True)
        finally:
            rig.close()
    return int(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
