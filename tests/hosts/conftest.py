"""The two hosts are started once for all tests of this folder; what is measured on them is kept in out/hosts.json."""

from collections.abc import Iterator

import pytest

from tests.hosts.debian import why_not
from tests.hosts.deployment import Deployment, first_deployment
from tests.hosts.fleet import Fleet
from tests.hosts.measured import Measured
from tests.hosts.rig import ROOT, Rig

MEASURED = pytest.StashKey[Measured]()


@pytest.fixture(scope="session")
def measured(pytestconfig: pytest.Config) -> Measured:
    """Where numbers go."""
    return pytestconfig.stash.setdefault(MEASURED, Measured(ROOT / "out" / "hosts.json"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """What was measured, below the tests."""
    if (numbers := config.stash.get(MEASURED, None)) is not None:
        terminalreporter.section("measured on the hosts (out/hosts.json)")
        for line in numbers.lines:
            terminalreporter.line(line)


@pytest.fixture(scope="session")
def fleet(measured: Measured) -> Iterator[Fleet]:
    """Both hosts, on, with nothing of ours on them; skipped where they cannot be."""
    if (reason := why_not()) is not None:
        pytest.skip(reason)
    with Fleet() as hosts:
        measured("hosts up", max(hosts.boot_s.values()))
        yield hosts


@pytest.fixture(scope="session")
def rig(fleet: Fleet) -> Iterator[Rig]:
    """Keys and calibration of both, and a master that waits for them."""
    one = Rig(fleet, fleet.folder)
    one.start_master()
    try:
        yield one
    finally:
        one.close()


@pytest.fixture(scope="session")
def deployed(rig: Rig) -> Deployment:
    """Both hosts as the first `phalanx fleet deploy` of this run left them."""
    return first_deployment(rig)
