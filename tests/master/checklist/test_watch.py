"""Each rule of the checklist: its fault shows within two seconds, alone, says whom and what to do, and goes with it."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest

from common.messages import CheckItem
from master.checklist.facts import Verdict
from master.checklist.publisher import CODES
from master.checklist.slave_rules import MovedRule
from master.run.link_senders import MarkerCounts, RejectedPeer
from tests.master.checklist.checked import MARKERS, Bench

WITHIN_S = 2.0


@dataclass(frozen=True)
class Case:
    """A fault: how it comes and goes, and what must be told."""

    code: str
    subject: str
    put: Callable[[Bench], object]
    take: Callable[[Bench], object]
    expected: str
    fix: str


def _metrics(name: str, metrics: dict[str, float]) -> Callable[[Bench], object]:
    return lambda bench: bench.metrics.setdefault(name, {}).update(metrics)


def _metric(name: str, **metrics: float) -> Callable[[Bench], object]:
    return _metrics(name, metrics)


def _event(name: str, event: str, per_s: float) -> Callable[[Bench], object]:
    return lambda bench: bench.per_s.setdefault(name, {}).update({event: per_s})


def _set(what: str, name: str, value: object) -> Callable[[Bench], object]:
    return lambda bench: getattr(bench, what).update({name: value})


def _unseen(bench: Bench) -> None:
    """Another range for the index finger, in which nothing is."""
    bench.seconds(0.25)  # between two reports: in the next one there are frames of before
    bench.metrics.setdefault("left", {})["colour.index"] = 2.0
    _event("left", "seen.index", 0.0)(bench)


def _put(what: str, value: object) -> Callable[[Bench], object]:
    return lambda bench: setattr(bench, what, value)


def _stranger(bench: Bench) -> None:
    """Who speaks another version has no session: it is away, too."""
    bench.unknown_peer["right"] = RejectedPeer("10.0.0.8", 9)
    bench.away.add("right")


def _unproven(bench: Bench) -> None:
    bench.unproven["right"] = RejectedPeer("10.0.0.9", 11)
    bench.away.add("right")


def _other_rig(bench: Bench) -> None:
    bench.markers["left"] = MarkerCounts(8, 6)
    bench.away.add("left")  # the link is there, and nothing of it counts


def _same_rig(bench: Bench) -> None:
    bench.markers.clear()
    bench.away.clear()


def _as_ours(bench: Bench) -> None:
    bench.unknown_peer.clear()
    bench.unproven.clear()
    bench.away.clear()


LENS = CheckItem(
    "calibration_absent", "left", "Camera left: its lens is not measured.", "calibrate cameras intrinsics"
)
OLD = CheckItem("calibration_stale", "left", "The lens of camera left was measured after.", "calibrate")
# fmt: off
CASES = [
    Case("camera_absent", "left", lambda b: b.away.add("left"), lambda b: b.away.clear(),
         "not received any more", "slave"),
    Case("auto_mode", "left", _metric("left", exposure_us=7000.0), _metric("left", exposure_us=5000.0),
         "7000, not 5000", "automatic"),
    Case("exposure_drift", "left", _metric("left", light_exposure=0.5), _metric("left", light_exposure=1.0),
         "0.5 times", "calibrate"),
    Case("colour_collision", "left.index-back", _metrics("left", {"overlap.index..back": 3.0}),
         lambda b: b.metrics["left"].clear(), "index and back overlap by 3 hues", "repaint"),
    Case("colour_collision", "left.index-ring", _metrics("left", {"alike.index..ring": 4.0}),
         lambda b: b.metrics["left"].clear(), "look alike, 4 hues apart", "repaint"),
    Case("marker_unseen", "left.index", _unseen, _event("left", "seen.index", 60.0),
         "not once since its colours were changed", "calibrate its colours"),
    Case("background_in_range", "left.back", _event("left", "ambiguous.back", 60.0),
         _event("left", "ambiguous.back", 0.0), "colour of marker back", "cover it"),
    Case("calibration_absent", "left", _put("files", (LENS,)), _put("files", ()), "not measured",
         "calibrate cameras intrinsics"),
    Case("calibration_absent", "left",
         lambda b: b.counts.update(left={"uncalibrated": 1, "uncalibrated.ring": 1, "uncalibrated.back": 1}),
         lambda b: b.counts.update(left={"uncalibrated": 0}),
         "no colour for ring, back: it does not see them", "phalanx-slave colours"),
    Case("calibration_stale", "left", _put("files", (OLD,)), _put("files", ()), "after", "calibrate"),
    Case("calibration_stale", "left", _metric("left", width_px=1280.0), _metric("left", width_px=640.0),
         "1280 x 480", "same cameras/left.json"),
    Case("camera_moved", "left-right", _put("apart", 0.8), _put("apart", 0.0), "miss each other",
         "calibrate cameras stereo"),
    Case("clock_unsynchronised", "right", _set("sigma_ns", "right", 4e6), _set("sigma_ns", "right", 5e4),
         "4.0 ms", "cable"),
    Case("clock_unsynchronised", "right", _set("sigma_ns", "right", None), _set("sigma_ns", "right", 5e4),
         "not known", "cable"),
    Case("packet_loss", "right", _set("loss", "right", 0.1), _set("loss", "right", 0.0), "10 %", "cable"),
    Case("rate_low", "left", _set("rate", "left", 30.0), _set("rate", "left", 60.0), "30 frames",
         "frame_rate_hz"),
    Case("rate_low", "wrist", _set("rate", "wrist", 60.0), _set("rate", "wrist", 90.0), "60 frames",
         "frame_rate_hz"),
    Case("too_hot", "left", _metric("left", temperature_c=86.0), _metric("left", temperature_c=50.0), "86 °C",
         "fan"),
    Case("too_hot", "imu", _metric("imu", throttled=1.0), _metric("imu", throttled=0.0), "supply is too weak",
         "supply"),
    Case("disk_full", "left", _metric("left", disk_free_mb=60.0), _metric("left", disk_free_mb=900.0),
         "60 MB", "recordings"),
    Case("disk_full", "master", _put("disk_mb", 60.0), _put("disk_mb", 900.0), "60 MB", "recordings"),
    Case("strobe_slipped", "wrist", _event("wrist", "strobe.out_of_step", 20.0),
         _event("wrist", "strobe.out_of_step", 0.0), "in the wrong frame", "lead_us"),
    Case("imu_silent", "imu", lambda b: b.away.add("imu"), lambda b: b.away.clear(), "not received any more",
         "phalanx-slave run --name imu"),
    Case("duplicate_sender", "left", _set("duplicate", "left", RejectedPeer("10.0.0.7", 10)),
         _set("duplicate", "left", None), "the one at 10.0.0.7 is ignored", "--name"),
    Case("version_mismatch", "right", _stranger, _as_ours, "right at 10.0.0.8 speaks wire version 9",
         "Install the same version"),
    Case("secret_mismatch", "right", _unproven, _as_ours, "10.0.0.9 claims to be right",
         "device-right.secret"),
    Case("marker_mismatch", "left", _other_rig, _same_rig,
         "left sends 8 markers, the rig of this master has 6", "phalanx fleet deploy"),
]
# fmt: on


def test_every_code_has_a_case() -> None:
    assert {case.code for case in CASES} == set(CODES)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.code}-{case.subject}")
def test_a_fault_shows_alone_within_two_seconds_and_is_gone_within_two(case: Case) -> None:
    bench = Bench()
    assert not any(items for _, items in bench.seconds(12.0))
    case.put(bench)
    shown = bench.seconds(6.0)
    first = next(s for s, items in shown if items)
    assert first <= WITHIN_S
    for s, items in shown:
        if s >= first:
            assert [(item.code, item.subject) for item in items] == [(case.code, case.subject)], s
    item = shown[-1][1][0]
    assert case.expected in item.sentence
    assert case.subject.split(".")[0].split("-")[0] in item.sentence
    assert case.fix in item.fix
    case.take(bench)
    shown = bench.seconds(6.0)
    assert {(item.code, item.subject) for _, items in shown for item in items} <= {(case.code, case.subject)}
    assert not any(items for s, items in shown if s > WITHIN_S)


def test_who_never_came_is_reported_after_a_grace() -> None:
    bench = Bench(away={"right", "imu"})
    shown = bench.seconds(8.0)
    assert not any(items for s, items in shown if s < 5.0)
    assert [(i.code, i.subject) for i in shown[-1][1]] == [("camera_absent", "right"), ("imu_silent", "imu")]
    assert "never received" in shown[-1][1][0].sentence


def test_a_camera_that_gives_no_frames_is_absent_though_its_slave_is_there() -> None:
    bench = Bench()
    bench.seconds(8.0)
    bench.rate["left"] = 0.0
    items = bench.seconds(2.0)[-1][1]
    assert [(item.code, item.subject) for item in items] == [("camera_absent", "left")]
    assert "no frame comes" in items[0].sentence


def test_what_follows_from_a_missing_camera_is_not_reported_nor_when_it_comes_back() -> None:
    bench = Bench()
    bench.seconds(8.0)
    bench.away.add("left")
    bench.seconds(5.0)
    bench.away.clear()
    bench.session["left"] = 2  # another process
    assert not any(items for s, items in bench.seconds(6.0) if s > 0.25)


def test_a_hidden_marker_is_no_fault_and_one_that_is_gone_is() -> None:
    bench = Bench()
    bench.seconds(8.0)
    _event("left", "seen.index", 0.0)(bench)
    assert not any(items for _, items in bench.seconds(25.0))
    items = bench.seconds(8.0)[-1][1]
    assert [(item.code, item.subject) for item in items] == [("marker_unseen", "left.index")]
    assert "for 3" in items[0].sentence


def test_no_marker_is_missed_while_the_hand_is_away() -> None:
    bench = Bench()
    for marker in MARKERS:
        _event("left", f"seen.{marker}", 0.0)(bench)
    assert not any(items for _, items in bench.seconds(60.0))


def test_between_two_bounds_nothing_flickers() -> None:
    bench = Bench()
    bench.seconds(8.0)
    shown: list[bool] = []
    for exposure in (1.4, 1.45, 1.6, 1.45, 1.4, 1.45, 1.3, 1.4, 1.45):
        bench.metrics["left"] = {"light_exposure": exposure}
        shown.append(bool(bench.seconds(1.0)[-1][1]))
    assert shown == [False, False, True, True, True, True, False, False, False]


def test_causes_silence_what_follows_from_them_and_nothing_else() -> None:
    bench = Bench()
    bench.seconds(8.0)
    bench.metrics["left"] = {"overlap.index..back": 3.0}
    bench.per_s["left"] = {"ambiguous.back": 60.0, "ambiguous.ring": 60.0}
    bench.loss["right"] = 0.2
    bench.apart = 0.9
    items = bench.seconds(4.0)[-1][1]
    assert [(item.code, item.subject) for item in items] == [
        ("colour_collision", "left.index-back"),
        ("background_in_range", "left.ring"),
        ("packet_loss", "right"),
    ]


def test_of_three_cameras_the_one_that_moved_is_metrics() -> None:
    rule, verdicts = MovedRule(), list[Verdict]()
    for k in range(20):
        counts = {"poses": 15 * k, "mostly_rejected.top": 14 * k}
        verdicts = list(rule.look(("left", "right", "top"), 6, counts, 250_000_000 * k))
    assert [(one.subject, one.wrong) for one in verdicts] == [
        ("left", False),
        ("right", False),
        ("top", True),
    ]


def test_what_a_slave_reports_of_invented_markers_costs_nothing_and_hides_nothing() -> None:
    bench = Bench()
    assert not any(items for _, items in bench.seconds(12.0))
    bench.metrics["left"] = {f"overlap.a{k}..b{k}": 1.0 for k in range(250)}
    bench.counts["left"] = {f"uncalibrated.m{k}": 1 for k in range(100)}
    bench.per_s["left"] = {f"ambiguous.m{k}": 60.0 for k in range(100)}
    assert not any(items for _, items in bench.seconds(3.0))
