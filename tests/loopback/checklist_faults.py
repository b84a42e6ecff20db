"""Every fault that a rehearsal of the checklist brings about: how it comes, how it goes, and what is to be told."""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bench.checklist_rig import Rig, measured
from bench.local_rig import until
from bench.udp_relay import Impairment
from common.messages import CheckCode

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
    put: Callable[[Rig], None]
    take: Callable[[Rig], None]
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
    code: CheckCode, what: str, put: Callable[[Rig], None], take: Callable[[Rig], None], *subjects: str
) -> Fault:
    return Fault(code, what, put, take, frozenset(subjects))


def _well(camera: str) -> Callable[[Rig], None]:
    return lambda rig: rig.fault(camera)


def _expose(rig: Rig) -> None:
    rig.fault("left", exposes=1.4)


def _darker(rig: Rig) -> None:
    rig.ask("left", "set", '{"exposure_us": 2500}')


def _as_bright(rig: Rig) -> None:
    rig.ask("left", "set", '{"exposure_us": 5000}')


def _collide(rig: Rig) -> None:
    """The slave applies it within a second, and says so: then it is a fault."""
    _range(rig, "back", [36, 95, 81], [62, 255, 255])
    until(lambda: "overlap.index..back" in rig.ask("left", "report").gauges, 20.0)


def _no_colour(rig: Rig) -> None:
    before = rig.ask("left", "settings").gauges["colour.index"]
    _range(rig, "index", [174, 225, 225], [177, 255, 255])
    until(lambda: rig.ask("left", "settings").gauges["colour.index"] != before, 20.0)


def _range(rig: Rig, marker: str, low: list[int], high: list[int]) -> None:
    path = rig.slaves / "cameras/left.json"
    file = rig.read(path)
    file["markers"][marker] |= {"hsv_low": low, "hsv_high": high}
    rig.write(path, file)


def _colours(rig: Rig) -> None:
    """The colours of before, in use again."""
    path = rig.slaves / "cameras/left.json"
    markers = rig.read(rig.master / "cameras/left.json")["markers"]
    before = dict(rig.ask("left", "settings").gauges)
    rig.write(path, {**rig.read(path), "markers": markers})
    names = ("colour.index", "colour.back")
    until(
        lambda: any(rig.ask("left", "settings").gauges[name] != before[name] for name in names),
        20.0,
    )


def _disc(rig: Rig) -> None:
    rig.fault("left", patches=[{"uv": [40, 440], "radius_px": 18, "bgr": _COLOUR_OF_BACK}])


def _no_lens(rig: Rig) -> None:
    _edit(rig, lambda file: file | {"intrinsics": None})


def _new_lens(rig: Rig) -> None:
    _edit(rig, lambda file: file | {"provenance": {"intrinsics": measured("2026-02-02")}})


def _lens(rig: Rig) -> None:
    rig.write(rig.master / "cameras/left.json", rig.read(rig.slaves / "cameras/left.json"))


def _edit(rig: Rig, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    path = rig.master / "cameras/left.json"
    rig.write(path, change(rig.read(path)))


def _move(rig: Rig) -> None:
    rig.fault("right", moved_px=[0.0, 14.0])


def _lose(rig: Rig) -> None:
    rig.relay.way = Impairment(loss=0.2)


def _slow_way(rig: Rig) -> None:
    """Echoes of before know the clock for twenty seconds: only who comes anew over a slow way does not know it."""
    silent = ("imu_silent", "imu")
    rig.processes["imu"].kill()
    rig.processes["imu"].wait()
    until(lambda: silent in rig.lists.now(), 20.0)
    rig.relay.way = Impairment(delay_s=0.012)
    rig.start_slave("imu")
    until(lambda: silent not in rig.lists.now(), 60.0)


def _clear_way(rig: Rig) -> None:
    rig.relay.way = Impairment()


def _halve(rig: Rig) -> None:
    rig.fault("left", keep_one_in=2)


def _stop(name: str) -> Callable[[Rig], None]:
    return lambda rig: rig.processes[name].send_signal(signal.SIGSTOP)


def _go_on(name: str) -> Callable[[Rig], None]:
    return lambda rig: rig.processes[name].send_signal(signal.SIGCONT)


def _kill(rig: Rig) -> None:
    rig.processes["right"].kill()
    rig.processes["right"].wait()


def _again(rig: Rig) -> None:
    """It is away until its slave is there: that takes as long as such a process takes to start."""
    log = rig.slaves.parent / "right.log"
    before = log.read_text().count("ready, waiting")
    rig.start_slave("right")
    until(lambda: log.read_text().count("ready, waiting") > before, 60.0)


def _swap(rig: Rig) -> None:
    rig.fault("wrist", swap_every=10)


def settle(rig: Rig, quiet_s: float, timeout_s: float = 30.0) -> bool:
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
