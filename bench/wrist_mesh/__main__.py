"""`python -m bench.wrist_mesh SET ... --out DIR`: recordings of a mesh hand before the wrist camera, exact truth.

Sets: random, left_random, curl, mcp, spread, six, motion, moving_palm; each may be followed by @dark, @indoor,
@bright or @sun. The mesh and the device are those of the rendered recordings (PHALANX_DATASETS).
"""

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from bench.wrist_mesh.sets import set_named, write_set
from common.errors import RecordingError

_ROOT = Path(__file__).resolve().parents[2]


def main(argv: Sequence[str] | None = None) -> int:
    """Render the sets that are asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.wrist_mesh",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("sets", nargs="+", metavar="SET", help="name of a set, or name@light")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="each set becomes a folder in it"
    )
    parser.add_argument("--frames", type=int, metavar="N", help="triples instead of the set's own number")
    parser.add_argument(
        "--seed", type=int, default=1, metavar="S", help="of poses, phases and noise (default 1)"
    )
    chosen = parser.parse_args(argv)
    datasets = Path(os.environ.get("PHALANX_DATASETS", str(_ROOT.parent / "shared" / "datasets")))
    if not (datasets / "webxr_hand").is_dir():
        print(f"no mesh in {datasets}: set PHALANX_DATASETS to the folder of the data sets", file=sys.stderr)
        return 1
    for name in chosen.sets:
        start = time.monotonic()
        try:
            one = set_named(name, datasets, chosen.frames, chosen.seed)
            write_set(one, datasets, chosen.out / name, chosen.seed)
        except (RecordingError, ValueError) as error:
            print(error, file=sys.stderr)
            return 1
        took = time.monotonic() - start
        print(f"{chosen.out / name}: {len(one.moments)} triples, {took / len(one.moments):.2f} s each")
    return 0


if __name__ == "__main__":
    sys.exit(main())
