"""What a pose costs the master, stage by stage: processor time of one thread, no socket; or in turns with other code.

    python -m bench.pose_cost                    each rig, stage by stage
    python -m bench.pose_cost --functions desk   where in the code, by the profiler (its own cost is in it)
    python -m bench.pose_cost --against DIR      this code and that of another checkout, some poses each in turns

Times of a machine that does other things change from minute to minute. Two processes that take turns every few poses
meet the same minutes, so the ratio of their times says what the figures themselves do not.
"""

import argparse
import cProfile
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.fusion_shown import shown
from bench.row import Row
from bench.scale_rig import ROOM, in_order, room, told
from common.messages import ImuSample
from master.rig import load_setups
from master.rig_pipeline import pipeline_of
from master.stages import StageTimes
from master.tuning import LivePipeline
from master.world import World

RIGS = {
    "desk": "two cameras at 60 Hz",
    "room": "16 cameras at 90 Hz",
    "fused": "two cameras and a wrist device with its IMU",
}
_POSES, _TURN = 300, 10
_SCENE, _SEED = "grasp", 7

Feed = Callable[[Any], Iterable[object]]


def fed(rig: str, stages: StageTimes) -> tuple[Feed, Sequence[Any]]:
    """What takes the messages of a rig and gives poses, and the messages of about `_POSES` poses.

    Gestures are part of a rig of cameras alone; of the fused one the line to the hand is measured.
    """
    if rig == "fused":
        both = shown(_SCENE, _POSES / 60.0, _SEED)
        setup = both.both.fused
        line = pipeline_of(setup, stages)

        def push(message: Any) -> Iterable[object]:
            if not isinstance(message, ImuSample):
                return line.push(message)
            line.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
            return ()

        known = setup.cameras.keys() | setup.imus
        return push, [m for m in both.messages if getattr(m, "source", getattr(m, "camera", "")) in known]
    cameras, rate_hz = (16, 90.0) if rig == "room" else (2, 60.0)
    with tempfile.TemporaryDirectory() as name:
        setups = load_setups(room(Path(name), cameras, rate_hz), [ROOM])
    world = World(setups, [LivePipeline(setup, stages) for setup in setups], stages)
    return world.push, in_order(told(setups[0], rate_hz))[: cameras * _POSES]


def turns(push: Feed, messages: Sequence[Any]) -> Iterator[tuple[int, float]]:
    """Poses of a turn and its processor time [ms], turn by turn."""
    count, begun_ns = 0, time.thread_time_ns()
    for message in messages:
        count += sum(hasattr(one, "ready_t_ns") for one in push(message))
        if count >= _TURN:
            yield count, 1e-6 * (time.thread_time_ns() - begun_ns)
            count, begun_ns = 0, time.thread_time_ns()


def rows() -> Iterator[Row]:
    """Each rig, and its stages."""
    for rig, what in RIGS.items():
        stages = StageTimes(time.thread_time_ns)
        each = np.array([spent / poses for poses, spent in turns(*fed(rig, stages))][1:])
        low, middle, high = np.percentile(each, [25, 50, 75])
        yield Row(f"a pose, {what}", float(middle), "ms", f"middle half of turns {low:.2f} to {high:.2f}")
        for stage, total_us in stages.total_us().items():
            yield Row(f"  {stage}", total_us / (_TURN * (len(each) + 1)), "us", "")


def against(checkout: Path) -> None:
    """Print the processor time of a pose of another checkout and of this one, and their ratio, in alternating turns."""
    here = Path(__file__).resolve()
    for rig, what in RIGS.items():
        both = [_child(rig, root) for root in (checkout.resolve(), here.parents[1])]
        each: list[tuple[float, float]] = []
        while True:
            order = both if len(each) % 2 else both[::-1]
            said = {id(one): _next(one) for one in order}
            spent = [said[id(one)] for one in both]
            if "" in spent:
                break
            each.append((float(spent[0]), float(spent[1])))
        for one in both:
            one.kill()
            one.wait()
        then, now = np.array(each[1:]).T
        print(f"{what}: {_spread(then)} -> {_spread(now)} ms a pose, ratio {_spread(now / then)}")


def _child(rig: str, root: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-P", __file__, "--turns", rig]
    environment = os.environ | {"PYTHONPATH": str(root)}
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def _next(child: subprocess.Popen[str]) -> str:
    """What a pose of its next turn took [ms], empty at the end."""
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdin.write("\n")
    child.stdin.flush()
    return child.stdout.readline().strip()


def _spread(values: Any) -> str:
    low, middle, high = np.percentile(values, [25, 50, 75])
    return f"{middle:.3f} ({low:.3f} to {high:.3f})"


def main() -> None:
    """Run by the command line."""
    parser = argparse.ArgumentParser(
        "python -m bench.pose_cost",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--functions", choices=RIGS)
    parser.add_argument("--against", type=Path, metavar="DIR")
    parser.add_argument("--turns", choices=RIGS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.against is not None:
        against(options.against)
    elif options.turns is not None:
        spent = turns(*fed(options.turns, StageTimes()))
        while sys.stdin.readline():
            poses, ms = next(spent, (0, 0.0))
            print(f"{ms / poses:.6f}" if poses else "", flush=True)
            if not poses:
                break
    elif options.functions is not None:
        push, messages = fed(options.functions, StageTimes())
        profile = cProfile.Profile(time.thread_time)
        profile.runcall(lambda: sum(poses for poses, _ in turns(push, messages)))
        pstats.Stats(profile).sort_stats("tottime").print_stats(50)
    else:
        for row in rows():
            print(f"{row.name:50s} {row.value:10.2f} {row.unit:4s} {row.note}")


if __name__ == "__main__":
    main()
