"""Compiled kernels and the same functions as plain Python find the same: poses, tracks, points; one process for all."""

import json
import os
import subprocess
import sys
from inspect import isfunction
from pathlib import Path

import numpy as np
import pytest

from master.fabrik.fabrik import solve_chain
from master.fabrik.rays import correct_centres
from master.fabrik.sync import propagate
from tests.master.fabrik.poses import poses
from tests.master.fabrik.test_propagate import examples
from tests.master.fabrik.test_rays import example

KERNELS = (solve_chain, correct_centres, propagate)
Rows = list[list[float]]


def answers() -> dict[str, Rows]:
    return {"poses": poses(), "tracks": examples(), "points": example()}


@pytest.fixture(scope="module")
def both(root: Path) -> tuple[dict[str, Rows], dict[str, Rows]]:
    """Of plain Python and of machine code."""
    code = "import json; from tests.master.fabrik.test_plain import KERNELS, answers, isfunction"
    code += "; assert all(map(isfunction, KERNELS)); print(json.dumps(answers()))"
    plain = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(root)},
        cwd=root,
        check=True,
        capture_output=True,
        text=True,
    )
    assert not any(map(isfunction, KERNELS))
    return json.loads(plain.stdout), answers()


@pytest.mark.parametrize("what", ["poses", "tracks", "points"])
def test_plain_python_finds_the_same(both: tuple[dict[str, Rows], dict[str, Rows]], what: str) -> None:
    plain, compiled = (one[what] for one in both)
    for one, other in zip(plain, compiled, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 if what == "points" else 1e-9)


def test_what_is_compared_is_worked_out(both: tuple[dict[str, Rows], dict[str, Rows]]) -> None:
    compiled = both[1]
    assert len(compiled["poses"]) == 5 * 3 * 2 + 4
    iterations = np.array([row[-1] for row in compiled["poses"][-4:]])
    assert (iterations > 0).any()  # FABRIK itself, not the seeds alone
    assert sum(len(one) for one in compiled["tracks"][2::4]) > 500  # alternatives, too
    assert sum(compiled["points"][4]) == 1.0  # the knocked camera
