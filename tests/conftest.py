"""What all tests share: where the data are, and random tests that are the same on every run."""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parents[1]

# A test keeps to one core, as do the processes that it starts: on as many cores as there are, the matrix products of
# one would hold up those beside it. Read by the library when numpy is first imported, which is after this file.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Seeded and without deadlines: a test fails because the code is wrong, never because the machine was slow.
settings.register_profile(
    "house", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("house")


@pytest.fixture(scope="session")
def root() -> Path:
    """Folder of the project."""
    return ROOT


@pytest.fixture(scope="session")
def datasets() -> Path:
    """Folder of recorded and rendered data with truth; the test is skipped where it is absent."""
    folder = Path(os.environ.get("PHALANX_DATASETS", ROOT / "../shared/datasets")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no data sets at {folder}: set PHALANX_DATASETS to the folder that holds them")
    return folder
