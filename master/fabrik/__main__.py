"""Compile the kernels ahead of time: `python -m master.fabrik`."""

import time
from pathlib import Path

from master.rig.setup import load_setup
from master.run.dispatcher import new_dispatcher


def main() -> None:
    """Compile what the shipped rig calls, or find it compiled."""
    setup, began_s = load_setup(Path("calib_json"), "desk"), time.process_time()
    new_dispatcher([setup])
    print(f"kernels are compiled ({time.process_time() - began_s:.0f} s)")


if __name__ == "__main__":
    main()
