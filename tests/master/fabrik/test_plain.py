"""Compiled kernels and the same functions as plain Python find the same poses."""

import json
import os
import subprocess
import sys
from inspect import isfunction
from pathlib import Path

import numpy as np
import pytest

from master.fabrik.fabrik import solve_chain
from tests.master.fabrik.poses import poses

ROOT = Path(__file__).resolve().parents[3]


def test_plain_python_finds_the_same_poses() -> None:
    plain = subprocess.run(
        [sys.executable, "-m", "tests.master.fabrik.poses"],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    answer, compiled = json.loads(plain.stdout), poses()
    assert answer["plain"]
    assert not isfunction(solve_chain)
    found = answer["poses"]
    assert len(found) == len(compiled) == 5 * 3 * 2 + 4
    for one, other in zip(found, compiled, strict=True):
        assert one == pytest.approx(other, abs=1e-9)
    iterations = np.array([row[-1] for row in compiled[-4:]])
    assert (iterations > 0).any()  # FABRIK itself was compared, not the seeds alone
