"""Compile the solvers ahead of time: `python -m master.fabrik`."""

import time
from pathlib import Path

from master.rig import load_setup
from master.rig_pipeline import line_of
from master.stages import StageTimes


def main() -> None:
    """Compile what the shipped rig calls, or find it compiled."""
    setup, began_s = load_setup(Path("calib_json"), "desk"), time.process_time()
    line_of(setup, StageTimes())
    print(f"solvers are compiled ({time.process_time() - began_s:.0f} s)")


if __name__ == "__main__":
    main()
