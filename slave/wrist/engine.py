"""Choice of the code for the inner loops of a wrist device, by name alone."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from common.arrays import Bool, Image, Int
from slave.drivers import engine_of
from slave.wrist.fingertips import Search, candidates
from slave.wrist.runs import FingerLines, Runs, lines, measure
from slave.wrist.seams import Float32, energy, minimum_cost_paths

Energy: TypeAlias = Callable[[Image, int], Float32]
MinimumCostPaths: TypeAlias = Callable[[Float32, tuple[int, ...]], Int]
Lines: TypeAlias = Callable[[Image, int], tuple[Runs, Bool]]
Measure: TypeAlias = Callable[[Runs, Int, int], FingerLines]


@dataclass(frozen=True, slots=True)
class Engine:
    """The steps in which much is done with few numbers: functions of those names."""

    energy: Energy
    minimum_cost_paths: MinimumCostPaths
    lines: Lines
    measure: Measure
    candidates: Search


NUMPY = Engine(energy, minimum_cost_paths, lines, measure, candidates)


def engine_named(name: str) -> Engine:
    """The engine of a name, ready to go; raises what `engine_of` raises."""
    return engine_of(name, NUMPY, _numba)


def _numba() -> Engine:
    from slave.wrist.fast import NUMBA, prepare

    prepare()
    return NUMBA
