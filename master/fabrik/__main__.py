"""Compile the kernels ahead of time: `python -m master.fabrik`."""

import time
from pathlib import Path

from master.rig.setup import load_setups
from master.run.dispatcher import new_dispatcher


def main() -> None:
    """Compile what the shipped rigs of one hand and of two call, or find it compiled."""
    rigs, began_s = (
        [load_setups(Path("calib_json"), (name,)) for name in ("desk", "desk-both")],
        time.process_time(),
    )
    for setups in rigs:
        new_dispatcher(setups)
    print(f"kernels are compiled ({time.process_time() - began_s:.0f} s)")


if __name__ == "__main__":
    main()
