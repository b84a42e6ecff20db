"""Choice of the code for the inner loops of a wrist device, by name alone."""

from collections.abc import Callable
from dataclasses import dataclass

from common.arrays import Bool, Float32, Image, Int
from slave.drivers import engine_of
from slave.wrist.fingertips import Search, candidates
from slave.wrist.runs import FingerLines, Runs, lines, measure
from slave.wrist.seams import energy, minimum_cost_paths


@dataclass(frozen=True, slots=True)
class Engine:
    """The steps in which much is done with few numbers: functions of those names."""

    energy: Callable[[Image, int], Float32]
    minimum_cost_paths: Callable[[Float32, tuple[int, ...]], Int]
    lines: Callable[[Image, int], tuple[Runs, Bool]]
    measure: Callable[[Runs, Int, int], FingerLines]
    candidates: Search


NUMPY = Engine(energy, minimum_cost_paths, lines, measure, candidates)


def engine_named(name: str) -> Engine:
    """The engine of a name, ready to go; raises what `engine_of` raises."""
    return engine_of(name, NUMPY, _numba)


def _numba() -> Engine:
    from slave.wrist.fast import NUMBA, prepare

    prepare()
    return NUMBA
