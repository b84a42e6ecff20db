"""What all tests share: where the data are, and random tests that are the same on every run."""

import hashlib
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling

ROOT = Path(__file__).resolve().parents[1]

# A test keeps to one core, as do the processes that it starts: on as many cores as there are, the matrix products of
# one would hold up those beside it. Read by the library when numpy is first imported, which is after this file.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Seeded and without deadlines: a test fails because the code is wrong, never because the machine was slow.
settings.register_profile(
    "house", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("house")


# Several processes or a browser each: beside one another they would starve, so one worker has them all, from the start.
LIVE = (
    "tests/loopback/",
    "tests/aarch64/",
    "tests/docs/examples/test_subscriber.py",
    "tests/docs/examples/test_volume_dial.py",
    "tests/master/console/",
    "tests/master/commands/test_installed_master.py",
    "tests/master/run/test_live",
    "tests/master/outputs/web/test_page.py",
    "tests/master/recording/export/test_export_gltf.py",
)

# In simulated time: any worker may have these.
_SIMULATED = ("handshake", "hostile_solver", "million", "stolen", "twins", "vive_lines", "kinds_link")
SIMULATED = tuple(f"tests/loopback/test_{name}.py" for name in _SIMULATED)

# These solve hands of more free angles, whose kernels no other test needs: two workers would compile them twice.
OTHER_HANDS = ("tests/master/estimator/", "tests/master/fabrik/test_any_input.py")

_KERNELS = (
    "common/kernels.py",
    "common/records.py",
    "common/hand/skin.py",
    "master/fabrik/*.py",
    "master/estimator/*.py",
    "master/gestures/*.py",
    "tests/master/estimator/kernels.py",
)


def pytest_configure(config: pytest.Config) -> None:
    """Drop machine code of kernels where any of their files has changed: numba asks only for the one it is in."""
    if hasattr(config, "workerinput"):
        return
    files = sorted(path for pattern in _KERNELS for path in ROOT.glob(pattern))
    now = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    known = ROOT / ".pytest_cache" / "kernels"
    if known.is_file() and known.read_text() == now:
        return
    if known.is_file():
        for pattern in ("master/[efg]*", "common", "tests/master/estimator"):
            for code in ROOT.glob(f"{pattern}/__pycache__/*.nb[ci]"):
                code.unlink(missing_ok=True)
    known.parent.mkdir(exist_ok=True)
    known.write_text(now)


BEHIND = 10  # niceness of the workers whose tests are not live


def is_live(nodeid: str) -> bool:
    """Whether a test is one of those that one worker has."""
    return nodeid.startswith(LIVE) and not nodeid.startswith(SIMULATED)


class LiveScheduling(LoadFileScheduling):
    """Each file goes to one worker whole, all that is live to the same one, and what compiles for other hands, too."""

    def _split_scope(self, nodeid: str) -> str:
        if is_live(nodeid):
            return "live"
        if nodeid.startswith(OTHER_HANDS):
            return "hands"
        return super()._split_scope(nodeid)

    def mark_test_pending(self, item: str) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Try a test again whose worker ended in it: `remove_node` has given its file to another already."""


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LiveScheduling:
    """What spreads the tests over the workers."""
    return LiveScheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What is live begins first: it lasts longest."""
    items.sort(key=lambda item: not is_live(item.nodeid))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let what is live have the processor first: there are more workers than cores, and its clock runs on."""
    if "PYTEST_XDIST_WORKER" in os.environ and not is_live(item.nodeid) and os.nice(0) < BEHIND:
        os.nice(BEHIND)


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
