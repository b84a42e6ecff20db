"""Solves frozen recordings by the product's own pipeline; stands alone, so that other checkouts are run by it too.

    python -P bench/oracle/solve.py OUT NAME [--solver fabrik] [--sets room,held]

Run as a process with the checkout in PYTHONPATH. It goes on by one turn for each line that it reads, and answers with
the set that it is at, with an empty line at the end.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from common.messages import HandPose, ImuSample
from common.recording.messages import open_messages
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigSetup, load_setup
from master.run.app import StageTimes

FROZEN = "frozen"
KEPT = ("position_m", "angles_rad", "cov_m2", "valid", "tracked", "source")


def solved(path: Path, solver: str | None) -> Iterator[tuple[HandPose, float] | None]:
    """The poses of one recording, each with the processor time since the one before [us]; None: a turn is over."""
    recording = open_messages(path)
    rigs = json.loads(recording.about["rigs"])
    with tempfile.TemporaryDirectory(prefix="phalanx-") as name:
        tree = Path(name)
        for file, data in recording.files.items():
            (tree / file).parent.mkdir(exist_ok=True)
            (tree / file).write_bytes(data)
        for rig_file in sorted((tree / "rigs").glob("*.json")) if solver is not None else ():
            rig_file.write_text(json.dumps(json.loads(rig_file.read_text()) | {"solver": solver}))
        setups = [load_setup(tree, rig) for rig in rigs]
    setup = setups[0] if len(setups) == 1 else RigSetup.joined(setups)
    line = pipeline_of(setup, StageTimes(), continuous=json.loads(recording.about["continuous"]))
    messages: list[Any] = [one.message for one in recording.read(["taken"])]
    turn_ns, spent_ns = messages[0].t_ns, 0
    for message in [*messages, None]:
        begun_ns = time.process_time_ns()
        if message is None:
            poses = line.flush()
        elif isinstance(message, ImuSample):
            line.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
            poses = []
        else:
            poses = line.push(message)
        spent_ns += time.process_time_ns() - begun_ns
        for one in poses:
            yield one.pose, 1e-3 * spent_ns / len(poses)
        if poses:
            spent_ns = 0
        if message is not None and message.t_ns - turn_ns > 250_000_000:
            turn_ns = message.t_ns
            yield None


def run(out: Path, name: str, sets: list[str], solver: str | None) -> Iterator[str]:
    """Solve sets of `out` and write out/NAME/SET.npz of each; yields the set it is at, turn by turn."""
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    for one in sets:
        (folder / f"{one}.npz").unlink(missing_ok=True)
        poses, spent_us, pieces = list[HandPose](), list[float](), list[str]()
        for path in sorted((out / FROZEN / one).glob("*.mcap")):
            for found in solved(path, solver):
                if found is None:
                    yield one
                    continue
                poses.append(found[0])
                spent_us.append(found[1])
                pieces.append(path.stem)
            yield one
        arrays = {key: np.array([getattr(pose, key) for pose in poses]) for key in KEPT}
        t_ns = np.array([pose.t_ns for pose in poses], np.int64)
        np.savez(
            folder / f"{one}.npz",
            allow_pickle=False,
            piece=np.array(pieces, np.str_),
            t_ns=t_ns,
            spent_us=np.array(spent_us),
            **arrays,
        )


def main() -> None:
    """Run by the command line."""
    parser = argparse.ArgumentParser(
        "oracle_solve", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("name")
    parser.add_argument("--solver", choices=("fabrik", "estimator"))
    parser.add_argument("--sets", required=True, type=lambda text: text.split(","))
    options = parser.parse_args()
    rotations = run(options.out, options.name, options.sets, options.solver)
    while sys.stdin.readline():
        at = next(rotations, "")
        print(at, flush=True)
        if not at:
            break


if __name__ == "__main__":
    main()
