"""Every fault that is rehearsed with the checklist: how it comes, how it goes, and what is to be listed."""

import signal
import statistics
import time
import warnings
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from typing import Any

from bench.rigs.local import until
from common.messages import CheckCode
from tests.faults.relay import Impairment
from tests.lag import Lag
from tests.slaves_rig import Key, SlavesRig, measured, read, write

WAIT_S, AFTER_S = 30.0, 2.5  # for a line of the list; for what follows from a fault
NOMINAL = 2  # reports
BEHIND_S = 0.05  # so late a sleep is where a machine has other things to do
# A machine that is behind draws fewer pictures than it should: then that is listed as well, and it is true.
BEHIND = {"rate_low"}
_COLOUR_OF_BACK = (64, 178, 130)  # sRGB, blue first: the reference colour of the marker


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        code: What the list is to say, and nothing else.
        what: In words.
        put, take: Bring it about, and away; each returns when it has happened.
        subjects: Whom it may name.
    """

    code: CheckCode
    what: str
    put: Callable[[SlavesRig], None]
    take: Callable[[SlavesRig], None]
    subjects: frozenset[str]


def of_markers() -> list[Fault]:
    """Those of a rig of marker cameras left and right, with an IMU."""
    everybody = ("left", "right", "imu")
    return [
        _fault("auto_mode", "an automatic exposes 1.4 times as long", _expose, _well("left"), "left"),
        _fault("exposure_drift", "half of the exposure", _darker, _as_bright, "left"),
        _fault("colour_collision", "range of back reaches into index", _collide, _colours, "left.index-back"),
        _fault("marker_unseen", "a range in which nothing is", _no_colour, _colours, "left.index"),
        _fault("background_in_range", "a disc in the colour of back", _disc, _well("left"), "left.back"),
        _fault("calibration_absent", "the camera file has no lens any more", _no_lens, _lens, "left"),
        _fault("calibration_stale", "a lens measured after the places", _new_lens, _lens, "left"),
        _fault("camera_moved", "the picture moves by 14 px", _move, _well("right"), "left-right"),
        _fault("packet_loss", "every fifth datagram is lost", _lose, _clear_way, *everybody),
        _fault("clock_unsynchronised", "a slave that starts behind 12 ms each way", _slow_way, _clear_way, "imu"),
        _fault("rate_low", "every second frame", _halve, _well("left"), "left"),
        _fault("too_hot", "86 °C", lambda rig: rig.warm(86.0), lambda rig: rig.warm(52.0), *everybody),
        _fault("disk_full", "60 MB left", lambda rig: rig.disk(60.0), lambda rig: rig.disk(9000.0), *everybody),
        _fault("imu_silent", "its process stands still", _stop("imu"), _go_on("imu"), "imu"),
        _fault("camera_absent", "its process is killed", _kill, _again, "right"),
    ]  # fmt: skip


def of_wrist() -> list[Fault]:
    """Those of a wrist device."""
    return [
        _fault(
            "strobe_slipped", "one frame in ten changes place with the next", _swap, _well("wrist"), "wrist"
        )
    ]


def _fault(
    code: CheckCode,
    what: str,
    put: Callable[[SlavesRig], None],
    take: Callable[[SlavesRig], None],
    *subjects: str,
) -> Fault:
    return Fault(code, what, put, take, frozenset(subjects))


def _well(camera: str) -> Callable[[SlavesRig], None]:
    return lambda rig: rig.fault(camera)


def _expose(rig: SlavesRig) -> None:
    rig.fault("left", exposes=1.4)


def _darker(rig: SlavesRig) -> None:
    rig.ask("left", "set", '{"exposure_us": 2500}')


def _as_bright(rig: SlavesRig) -> None:
    rig.ask("left", "set", '{"exposure_us": 5000}')


def _collide(rig: SlavesRig) -> None:
    """The slave applies it within a second, and says so: then it is a fault."""
    _range(rig, "back", [36, 95, 81], [62, 255, 255])
    until(lambda: "overlap.index..back" in rig.ask("left", "report").metrics, 20.0)


def _no_colour(rig: SlavesRig) -> None:
    before = rig.ask("left", "settings").metrics["colour.index"]
    _range(rig, "index", [174, 225, 225], [177, 255, 255])
    until(lambda: rig.ask("left", "settings").metrics["colour.index"] != before, 20.0)


def _range(rig: SlavesRig, marker: str, low: list[int], high: list[int]) -> None:
    path = rig.slaves / "cameras/left.json"
    file = read(path)
    file["markers"][marker] |= {"hsv_low": low, "hsv_high": high}
    write(path, file)


def _colours(rig: SlavesRig) -> None:
    """The colours of before, in use again."""
    path = rig.slaves / "cameras/left.json"
    markers = read(rig.master / "cameras/left.json")["markers"]
    before = dict(rig.ask("left", "settings").metrics)
    write(path, {**read(path), "markers": markers})
    names = ("colour.index", "colour.back")
    until(
        lambda: any(rig.ask("left", "settings").metrics[name] != before[name] for name in names),
        20.0,
    )


def _disc(rig: SlavesRig) -> None:
    rig.fault("left", patches=[{"uv": [40, 440], "radius_px": 18, "bgr": _COLOUR_OF_BACK}])


def _no_lens(rig: SlavesRig) -> None:
    _edit(rig, lambda file: file | {"intrinsics": None})


def _new_lens(rig: SlavesRig) -> None:
    _edit(rig, lambda file: file | {"provenance": {"intrinsics": measured("2026-02-02")}})


def _lens(rig: SlavesRig) -> None:
    write(rig.master / "cameras/left.json", read(rig.slaves / "cameras/left.json"))


def _edit(rig: SlavesRig, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    path = rig.master / "cameras/left.json"
    write(path, change(read(path)))


def _move(rig: SlavesRig) -> None:
    rig.fault("right", moved_px=[0.0, 14.0])


def _lose(rig: SlavesRig) -> None:
    rig.relay.way = Impairment(loss=0.2)


def _slow_way(rig: SlavesRig) -> None:
    """Echoes of before know the clock for twenty seconds: only who comes anew over a slow way does not know it."""
    silent = ("imu_silent", "imu")
    rig.kill("imu")
    until(lambda: silent in rig.lists.now(), 20.0)
    rig.relay.way = Impairment(delay_s=0.012)
    rig.start_slave("imu")
    until(lambda: silent not in rig.lists.now(), 60.0)


def _clear_way(rig: SlavesRig) -> None:
    rig.relay.way = Impairment()


def _halve(rig: SlavesRig) -> None:
    rig.fault("left", keep_one_in=2)


def _stop(name: str) -> Callable[[SlavesRig], None]:
    return lambda rig: rig.processes[name].send_signal(signal.SIGSTOP)


def _go_on(name: str) -> Callable[[SlavesRig], None]:
    return lambda rig: rig.processes[name].send_signal(signal.SIGCONT)


def _kill(rig: SlavesRig) -> None:
    rig.kill("right")


def _again(rig: SlavesRig) -> None:
    """It is away until its slave is there: that takes as long as such a process takes to start."""
    log = rig.folder / "right.log"
    before = log.read_text().count("ready, waiting")
    rig.start_slave("right")
    until(lambda: log.read_text().count("ready, waiting") > before, 60.0)


def _swap(rig: SlavesRig) -> None:
    rig.fault("wrist", swap_every=10)


def settle(rig: SlavesRig, quiet_s: float, timeout_s: float = 30.0) -> bool:
    """Wait until the list has been empty for so long."""
    deadline = time.monotonic() + timeout_s
    since = time.monotonic()
    while time.monotonic() < deadline:
        if rig.lists.now():
            since = time.monotonic()
        elif time.monotonic() - since > quiet_s:
            return True
        time.sleep(0.05)
    return False


@dataclass(frozen=True, slots=True)
class Shown:
    """What became of faults on the list.

    Attributes:
        faults: What was put wrong, at once.
        shown_s, cleared_s: From the last fault to the list that has them all, from their end to the list that has none
            [s]; None: never.
        shown_reports, cleared_reports: How many of the master's reports, one a second, came in that time.
        others: What else was listed from the fault to the end of what could follow.
        subjects: Of each code whom it named.
    """

    faults: Sequence[Fault]
    shown_s: float | None
    cleared_s: float | None
    shown_reports: int
    cleared_reports: int
    others: frozenset[Key]
    subjects: dict[str, frozenset[str]]


def rehearse(rig: SlavesRig, faults: Sequence[Fault], after_s: float = AFTER_S) -> Shown:
    """Bring them about and away; wait `after_s` for what may follow."""
    settle(rig, after_s)
    began, codes = time.monotonic(), {fault.code for fault in faults}
    for fault in faults:
        fault.put(rig)
    put, reports = time.monotonic(), rig.lists.reports
    shown_s = _wait(rig, began, codes, codes)
    shown_reports = rig.lists.reports - reports
    time.sleep(after_s)
    now = rig.lists.now()
    subjects = {one: frozenset(subject for code, subject in now if code == one) for one in codes}
    for fault in faults:
        fault.take(rig)
    taken, reports = time.monotonic(), rig.lists.reports
    cleared_s = _wait(rig, taken, codes, set())
    cleared_reports = rig.lists.reports - reports
    time.sleep(after_s)
    others = {key for _, keys in rig.lists.since(began) for key in keys if key[0] not in codes}
    late_s = None if shown_s is None else max(shown_s - (put - began), 0.0)
    return Shown(faults, late_s, cleared_s, shown_reports, cleared_reports, frozenset(others), subjects)


def _wait(rig: SlavesRig, since: float, codes: Set[str], wanted: Set[str]) -> float | None:
    """How long [s] until a list came that has of these codes the wanted ones and no other."""

    def holds() -> bool:
        lists = rig.lists.since(since)
        return bool(lists) and {code for code, _ in lists[-1][1]} & codes == wanted

    return time.monotonic() - since if until(holds, WAIT_S) else None


def clean(rig: SlavesRig, seconds: float) -> frozenset[Key]:
    """Return what is listed while nothing is wrong."""
    settle(rig, AFTER_S)
    since = time.monotonic()
    time.sleep(seconds)
    return frozenset(key for _, keys in rig.lists.since(since) for key in keys)


def reports(lag: Lag) -> int:
    """How many reports more than nominal are the machine's own doing."""
    worst = statistics.quantiles([0.0, 0.0, *lag.late_s], n=10)[-1]
    return 1 + round(20.0 * worst)  # twenty things happen one after the other between a fault and its line


def wrong(shown: Shown, reports: int) -> list[str]:
    """In what a rehearsal is not as expected, if so many reports more than nominal are the machine's own doing."""
    told = {
        "never shown": shown.shown_s is None,
        "never gone": shown.cleared_s is None,
        f"also told: {set(shown.others)}": not {other for other, _ in shown.others} <= BEHIND,
        f"shown after {shown.shown_reports} reports": shown.shown_reports > NOMINAL + reports,
        f"gone after {shown.cleared_reports} reports": shown.cleared_reports > NOMINAL + reports,
    }
    for fault in shown.faults:
        named = shown.subjects[fault.code]
        told[f"{fault.code} of {set(named)}"] = not named or not named <= fault.subjects
    return [what for what, holds in told.items() if holds]


def rehearsed(rig: SlavesRig, fault: Fault, lag: Lag, after_s: float = AFTER_S) -> frozenset[str]:
    """Bring a fault about; whom it names."""
    return rehearsed_together(rig, [fault], lag, after_s).subjects[fault.code]


def rehearsed_together(rig: SlavesRig, faults: Sequence[Fault], lag: Lag, after_s: float = AFTER_S) -> Shown:
    """Bring faults about at once; once more where it was not as expected and the machine was behind."""
    for last in (False, False, True):
        lag.late_s.clear()
        shown = rehearse(rig, faults, after_s)
        found = wrong(shown, reports(lag))
        if not found:
            return shown
        assert not last, found
        assert lag.worst_s > BEHIND_S, found
        codes = ", ".join(fault.code for fault in faults)
        warnings.warn(f"{codes} again, {found}: this machine was {lag.worst_s:.2f} s behind", stacklevel=2)
    raise AssertionError("unreachable")
