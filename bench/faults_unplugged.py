"""Measure what a camera that fails and comes back does to a running rig.

The slaves are real, with simulated cameras; it is measured what the slave of the camera and the master say.

`python -m bench.faults_unplugged [--runs 3] [--fault unplugged | raises | frozen]`, for docs/faults.md. The camera is
unplugged, its driver raises an error of its own, or it repeats one picture, for 3 s; then it takes as long as the retry
that is under way waits (1 s at most), the opening, and the first frame.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from bench.checklist_rig import Rig
from bench.local_rig import until
from common.messages.streams import MASTER

AWAY_S, PATIENCE_S = 3.0, 30.0
ABSENT = ("camera_absent", "left")


def unplug(rig: Rig, away_s: float, fault: str) -> tuple[float, float, int]:
    """Have the left camera fail, and be well again.

    Returns:
        From the fault to the line of the checklist [s], from its end to the first frame [s], poses meanwhile.
    """
    poses = rig.ask(MASTER, "report").counts["poses"]
    began = time.monotonic()
    rig.fault("left", **{fault: True})
    until(lambda: ABSENT in rig.lists.now(), PATIENCE_S)
    noticed_s = time.monotonic() - began
    time.sleep(max(0.0, away_s - noticed_s))
    counts = rig.ask(MASTER, "report").counts
    rig.fault("left")
    plugged = time.monotonic()
    until(lambda: rig.ask(MASTER, "report").counts["left.received"] > counts["left.received"], PATIENCE_S)
    back_s = time.monotonic() - plugged
    until(lambda: ABSENT not in rig.lists.now(), PATIENCE_S)
    return noticed_s, back_s, counts["poses"] - poses


def main() -> int:
    """Measure and print; 1 if a slave did not live through it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3, metavar="N")
    parser.add_argument("--fault", choices=("unplugged", "raises", "frozen"), default="unplugged")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="phalanx-faults-") as folder:
        rig = Rig(Path(folder) / "desk", "desk")
        try:
            runs = [unplug(rig, AWAY_S, options.fault) for _ in range(options.runs)]
            counts = rig.ask("left", "report").counts
            restarts = rig.ask(MASTER, "report").counts.get("left.restarts", 0)
            alive = rig.processes["left"].poll() is None
        finally:
            rig.close()
    noticed_s, back_s, poses = zip(*runs, strict=True)
    print(f"told after {statistics.median(noticed_s):.2f} s, {max(noticed_s):.2f} s")
    print(f"first frame after its end {statistics.median(back_s):.2f} s, {max(back_s):.2f} s")
    print(f"poses while it was away {statistics.median(poses):.0f} in {AWAY_S:g} s")
    print(", ".join(f"{name} {count}" for name, count in counts.items() if name.startswith("camera.")))
    print(f"left.restarts {restarts}, slave {'alive' if alive else 'gone'}")
    return 0 if alive and restarts == 0 else 1


if __name__ == "__main__":
    raise SystemExit(main())
