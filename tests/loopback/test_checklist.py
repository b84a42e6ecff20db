"""The checklist of a real master over real slaves: each fault that is brought about is told, alone, and goes with it.

The time is counted in the master's reports, one a second: two are two seconds on a machine that keeps up. How much a
machine is behind is measured by how long a sleep of ours really takes.
"""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.rigs.local import until
from common.messages.streams import MASTER
from tests.lag import Lag
from tests.loopback.checklist_faults import (
    BEHIND,
    BEHIND_S,
    clean,
    of_markers,
    rehearsed,
    rehearsed_together,
    reports,
)
from tests.slaves_rig import SlavesRig

FAULTS = {fault.code: fault for fault in of_markers()}
# Each group at once: none of a group hides another. The others take a fresh process or a slow way to come about, or are
# the same path as one of these with another number: tests/nightly has all sixteen, one by one.
GROUPS = {
    "files and computer": ("colour_collision", "calibration_stale", "too_hot", "imu_silent"),
    "picture and network": ("background_in_range", "packet_loss"),
    "automatic": ("auto_mode",),
    "moved": ("camera_moved",),
}
BACK_S = 2.0
AFTER_S = 1.2


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlavesRig]:
    folder: Path = tmp_path_factory.mktemp("checklist") / "desk"
    made = SlavesRig(folder, "desk")
    try:
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def lag() -> Iterator[Lag]:
    made = Lag()
    yield made
    made.close()


def test_nothing_is_reported_while_nothing_is_wrong(rig: SlavesRig, lag: Lag) -> None:
    for last in (False, False, True):
        lag.late_s.clear()
        conditions = {code for code, _ in clean(rig, 4.0)} - BEHIND
        if not conditions:
            return
        assert not last, conditions
        assert lag.worst_s > BEHIND_S, conditions


@pytest.mark.parametrize("group", GROUPS)
def test_faults_are_reported_without_any_other_and_go(group: str, rig: SlavesRig, lag: Lag) -> None:
    faults = [FAULTS[code] for code in GROUPS[group]]
    rehearsed_together(rig, faults, lag, AFTER_S)
    for key, (sentence, fix) in rig.lists.sentences.items():
        if key[0] in GROUPS[group]:
            assert key[1].split(".")[0].split("-")[0] in sentence
            assert fix


def test_a_killed_slave_is_the_only_report_until_it_is_there_again(rig: SlavesRig, lag: Lag) -> None:
    assert rehearsed(rig, FAULTS["camera_absent"], lag, AFTER_S) == {"right"}


def test_a_camera_that_is_unplugged_is_reported_by_its_slave_and_is_back_with_the_plug(
    rig: SlavesRig, lag: Lag
) -> None:
    """The slave lives on, with the session it had; from the plug to frames of it: the longest wait of its retries."""
    until(lambda: not rig.lists.now() - {("rate_low", "left"), ("rate_low", "right")}, 10.0)
    lag.late_s.clear()
    before, conditions = rig.ask("left", "report").counts, rig.ask(MASTER, "report").counts
    rig.fault("left", unplugged=True)
    pulled = time.monotonic()
    assert until(lambda: ("camera_absent", "left") in rig.lists.now(), 30.0)
    assert time.monotonic() - pulled < BACK_S + reports(lag)
    away = rig.ask("left", "report").counts
    assert away["camera.lost"] == before["camera.lost"] + 1
    sent = rig.ask(MASTER, "report").counts["left.received"]
    rig.fault("left")
    plugged = time.monotonic()
    assert until(lambda: rig.ask(MASTER, "report").counts["left.received"] > sent + 3, 30.0)
    assert time.monotonic() - plugged < BACK_S + 1.0 + reports(
        lag
    )  # of retries; three frames; what the machine lacks
    back = time.monotonic()
    assert until(lambda: ("camera_absent", "left") not in rig.lists.now(), 30.0)
    assert time.monotonic() - back < BACK_S + reports(lag)
    after = rig.ask(MASTER, "report").counts
    assert rig.processes["left"].poll() is None
    assert after.get("left.restarts", 0) == conditions.get("left.restarts", 0)
    assert after["poses"] > conditions["poses"]
