"""All sixteen faults of the checklist on real processes: each is listed within two reports, alone, and goes as soon."""

from collections.abc import Iterator

import pytest

from tests.lag import Lag
from tests.loopback.checklist_faults import Fault, of_markers, of_wrist, rehearsed
from tests.slaves_rig import SlavesRig


@pytest.fixture(scope="module")
def lag() -> Iterator[Lag]:
    made = Lag()
    yield made
    made.close()


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlavesRig]:
    made = SlavesRig(tmp_path_factory.mktemp("checklist") / "desk", "desk")
    yield made
    made.close()


@pytest.fixture(scope="module")
def wrist(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlavesRig]:
    made = SlavesRig(tmp_path_factory.mktemp("checklist") / "wrist", "wrist")
    yield made
    made.close()


@pytest.mark.parametrize("fault", of_markers(), ids=lambda fault: fault.code)
def test_a_fault_of_marker_cameras_is_listed_alone_and_goes(fault: Fault, desk: SlavesRig, lag: Lag) -> None:
    rehearsed(desk, fault, lag)


@pytest.mark.parametrize("fault", of_wrist(), ids=lambda fault: fault.code)
def test_a_fault_of_a_wrist_device_is_listed_alone_and_goes(fault: Fault, wrist: SlavesRig, lag: Lag) -> None:
    rehearsed(wrist, fault, lag)
