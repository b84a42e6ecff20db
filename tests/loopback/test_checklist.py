"""The checklist of a real master over real slaves: each fault that is brought about is told, alone, and goes with it.

The time is counted in the master's reports, one a second: two are two seconds on a machine that keeps up. How much a
machine is behind is measured by how long a sleep of ours really takes.
"""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.rigs.local import Lag, until
from common.messages.streams import MASTER
from tests.loopback.checklist_faults import (
    BEHIND,
    BEHIND_S,
    clean,
    of_markers,
    rehearsed,
    reports,
)
from tests.slaves_rig import SlavesRig

FAULTS = {fault.code: fault for fault in of_markers()}
# The others take a fresh process or a slow way to come about, or are the same path as one of these with another number:
# tests/nightly has all sixteen.
LIVE = ("auto_mode", "colour_collision", "background_in_range", "calibration_stale", "camera_moved", "packet_loss",
        "too_hot", "imu_silent")  # fmt: skip
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


@pytest.mark.parametrize("code", LIVE)
def test_a_fault_is_reported_alone_and_goes(code: str, rig: SlavesRig, lag: Lag) -> None:
    rehearsed(rig, FAULTS[code], lag, AFTER_S)
    for key, (sentence, fix) in rig.lists.sentences.items():
        if key[0] == code:
            assert key[1].split(".")[0].split("-")[0] in sentence
            assert fix


def test_a_killed_slave_is_the_only_report_until_it_is_there_again(rig: SlavesRig, lag: Lag) -> None:
    assert rehearsed(rig, FAULTS["camera_absent"], lag, AFTER_S).subjects == {"right"}


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


@pytest.mark.parametrize(("fault", "counted"), [("raises", "camera.raised"), ("frozen", "camera.frozen")])
def test_a_camera_whose_driver_fails_or_repeats_one_picture_is_absent_until_it_is_well(
    fault: str, counted: str, rig: SlavesRig, lag: Lag
) -> None:
    """Its slave lives on; what it has no new picture of is not measured."""
    until(lambda: not rig.lists.now() - {("rate_low", "left"), ("rate_low", "right")}, 10.0)
    lag.late_s.clear()
    before = rig.ask("left", "report").counts
    rig.fault("left", **{fault: True})
    began = time.monotonic()
    assert until(lambda: ("camera_absent", "left") in rig.lists.now(), 30.0), rig.lists.now()
    assert time.monotonic() - began < BACK_S + reports(lag)
    sent = rig.ask(MASTER, "report").counts["left.received"]
    during = rig.ask("left", "report").counts
    assert during[counted] > before[counted]
    assert until(lambda: rig.ask("left", "report").counts["camera.lost"] > during["camera.lost"], 30.0)
    assert rig.ask(MASTER, "report").counts["left.received"] == sent, (
        "nothing is measured in the same picture"
    )
    rig.fault("left")
    assert until(lambda: rig.ask(MASTER, "report").counts["left.received"] > sent + 3, 30.0)
    assert until(lambda: ("camera_absent", "left") not in rig.lists.now(), 30.0)
    assert rig.processes["left"].poll() is None
    assert rig.ask(MASTER, "report").counts.get("left.restarts", 0) == 0
