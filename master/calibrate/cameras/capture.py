"""The command `calibrate cameras capture` keeps board images of slaves.

Whole frames come over the bus, at a person's pace. While it runs it *is* the rig's master: it gives the start
and keeps the clocks, so that slaves need not know that nobody tracks. Nothing is calibrated here; its folder
is what `calibrate cameras intrinsics` and `stereo` read.
"""

import os
import threading
from argparse import Namespace
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from common.arrays import Image
from common.bus.bus import Bus, Subscription
from common.bus.keys import link_key
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.files import date_now
from common.clock import SystemClock, now_ns
from common.command_line import echo
from common.errors import BusError, CalibrationError, PictureError
from common.messages import Command, Still
from common.messages.picture_size import Size
from common.recording.pictures import decode
from master.calibrate.cameras.boards import board_in, options_of
from master.calibrate.cameras.coverage import LiveViews, Verdict
from master.commands.options import address
from master.run.ingest import Ingest
from master.run.process import host_bus, stop_on_signals

_ASK_S = 0.5
NOTES = "capture.json"


@dataclass(frozen=True, slots=True)
class Round:
    """Pictures that were requested together."""

    stills: Mapping[str, Still]
    images: Mapping[str, Image]  # (H, W, 3) BGR
    spread_ms: float  # time between the first and the last of them [ms]; NaN while a clock is not known
    # camera -> why its picture was not decoded
    refused: Mapping[str, str] = field(default_factory=dict[str, str])


def capture(
    take: Callable[[], Round],
    live: LiveViews,
    folder: Path,
    wanted: int,
    stop: threading.Event,
    notify: Callable[[str], None],
    advise: Callable[[], str] = lambda: "",
) -> int:
    """Keep views until there are enough or `stop` is set; return how many.

    They are CAMERA/NUMBER.jpg of `folder`, which `new_folder` made, as they came. `notify` is called with
    what the person should read, `advise` after each view that was kept.

    Raises:
        CalibrationError: The folder cannot be written.
    """
    previous, notified_ns = "", now_ns()
    spread: list[float] = []
    while len(live.views) < wanted and not stop.is_set():
        began_ns = now_ns()
        round_ = take()
        verdict = live.push(round_.images) if round_.images else Verdict(False, "no camera answers")
        text = verdict.text + _without(live.cameras, round_)
        log_ns = 2_000_000_000  # the same text is not logged more often
        if verdict.kept:
            view = live.views[-1]
            spread.append(round_.spread_ms)
            _keep(folder, view.name, {name: round_.stills[name] for name in view.observations})
            hint = advise()
            notify(f"view {len(live.views)} of {wanted}: {text}{'; ' * bool(hint)}{hint}")
        elif text != previous or began_ns - notified_ns > log_ns:
            notify(text)
            previous, notified_ns = text, began_ns
        stop.wait(max(0.0, 0.3 - (now_ns() - began_ns) * 1e-9))
    if live.views:
        _note(folder, live, spread)
    return len(live.views)


class StillTaker:
    """Asks every camera for its next frame.

    Holds the bus subscription and the ingest that keeps the clocks.
    """

    def __init__(self, bus: Bus, ingest: Ingest, sizes: Mapping[str, Size]) -> None:
        """Subscribe to stills of the cameras in `sizes`: camera -> width and height [px]."""
        self._bus, self._ingest, self._sizes = bus, ingest, dict(sizes)
        self._cameras = tuple(sizes)
        self._next_round: Subscription = bus.subscribe("still", depth=4 * len(sizes))

    def take(self) -> Round:
        """Ask all cameras, then wait until all that answered have sent, at most a second."""
        while self._next_round.get(0.0) is not None:
            pass  # what came too late for its own round
        askers = [threading.Thread(target=self._ask, args=(name,), daemon=True) for name in self._cameras]
        for thread in askers:
            thread.start()
        stills: dict[str, Still] = {}
        end_ns = now_ns() + 1_000_000_000
        while len(stills) < len(self._cameras) and (left_ns := end_ns - now_ns()) > 0:
            message = self._next_round.get(left_ns * 1e-9)
            if isinstance(message, Still) and message.camera in self._cameras:
                stills[message.camera] = message
        for thread in askers:
            thread.join()
        while self._ingest.get(0.0) is not None:
            pass  # detections come along; nobody needs them
        return self._round(stills)

    def close(self) -> None:
        """End the subscription. Safe to call twice."""
        self._next_round.close()

    def _ask(self, camera: str) -> None:
        try:
            self._bus.ask(Command(camera, "still"), _ASK_S)
        except BusError:
            return  # it is not there, or busy: the next round asks again, and the person reads who is seen

    def _round(self, stills: Mapping[str, Still]) -> Round:
        images, refused = dict[str, Image](), dict[str, str]()
        for name in self._cameras:
            if name in stills:
                try:
                    images[name] = decode(stills[name].jpeg, self._sizes[name])
                except PictureError as error:
                    refused[name] = str(error)
        return Round(stills, images, self._spread_ms(stills), refused)

    def _spread_ms(self, stills: Mapping[str, Still]) -> float:
        times: list[int] = []
        for name, still in stills.items():
            if (estimate := self._ingest.clock_of(name)) is None:
                return float("nan")
            times.append(estimate.to_local(still.t_ns))
        return (max(times) - min(times)) * 1e-6 if times else float("nan")


def _without(cameras: tuple[str, ...], round_: Round) -> str:
    """Which cameras gave no picture, and why."""
    silent = [name for name in cameras if name not in round_.images and name not in round_.refused]
    absent = f" (no picture from {' and '.join(silent)}: is the slave running?)" if silent else ""
    refused = (
        f" (the picture of {name} {why}; see cameras/{name}.json here and on the slave)"
        for name, why in round_.refused.items()
    )
    return absent + "".join(refused)


def new_folder(folder: Path) -> None:
    """Make the folder for the pictures, or take an empty one.

    Raises:
        CalibrationError: It holds something already, or cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        taken = next(folder.iterdir(), None)
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot make this folder: {error.strerror}") from error
    if taken is not None:
        raise CalibrationError(f"{folder}: holds {taken.name} already; give a new or empty folder")


def _keep(folder: Path, view: str, stills: Mapping[str, Still]) -> None:
    try:
        for name, still in stills.items():
            (folder / name).mkdir(exist_ok=True)
            (folder / name / f"{view}.jpg").write_bytes(still.jpeg)
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot write: {error.strerror}") from error


def _note(folder: Path, live: LiveViews, spread_ms: list[float]) -> None:
    known = [value for value in spread_ms if np.isfinite(value)]
    notes = {
        "date": date_now(),
        "board": str(live.board),
        "cameras": list(live.cameras),
        "views": len(live.views),
        "largest_spread_ms": round(max(known), 3) if known else None,
    }
    try:
        (folder / NOTES).write_bytes(msgspec.json.format(msgspec.json.encode(notes)) + b"\n")
    except OSError as error:
        raise CalibrationError(f"{folder / NOTES}: cannot write: {error.strerror}") from error


def capture_views(options: Namespace) -> None:
    """Keep images of all running slaves when the board is still somewhere new."""
    ends = address(options.beacon, "--beacon"), address(options.bind, "--bind")
    cameras = cameras_of(options.calibration, options.rig)
    sizes = _sizes(options.calibration, cameras)
    live = LiveViews(board_in(options), cameras)
    key = link_key(os.environ, options.key_file)
    clock = SystemClock()
    new_folder(options.out)
    stop = stop_on_signals()
    with ExitStack() as stack:
        link = host_bus(options.bus, live.cameras)
        stack.callback(link.close)
        ingest = Ingest(live.cameras, key, clock, *ends, options.bus, 5.0)
        stack.callback(ingest.close)
        _wait(ingest, live.cameras, stop)
        taker = StillTaker(link, ingest, sizes)
        stack.callback(taker.close)
        kept = capture(taker.take, live, options.out, options.views, stop, echo, live.missing)
    fewest = 5  # from which a lens can be fitted at all
    if kept < fewest:
        raise CalibrationError(
            f"{options.out}: {kept} views kept; a calibration needs {fewest}, better {options.views}"
        )
    echo(f"{kept} views in {options.out}; next: phalanx calibrate {_next(live, options.out, options.rig)}")


def _next(live: LiveViews, out: Path, rig: str) -> str:
    several = len(live.cameras) > 1
    what, of_rig = ("stereo", f" --rig {rig}") if several else ("intrinsics", "")
    return f"cameras {what} {out} {options_of(live.board)}{of_rig} --out DIR"


def cameras_of(calibration: Path, rig: str) -> tuple[str, ...]:
    """The cameras of a rig, which need not have lenses or poses yet."""
    return load(calibration / "rigs" / f"{rig}.json", RigCalibration).cameras


def _sizes(calibration: Path, cameras: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    """Camera -> width and height [px], as the camera files state."""
    files = (load(calibration / "cameras" / f"{name}.json", CameraCalibration) for name in cameras)
    return {file.name: (file.width_px, file.height_px) for file in files}


def _wait(ingest: Ingest, cameras: tuple[str, ...], stop: threading.Event) -> None:
    """Wait until the start is given, and print whom it waits for."""
    previous: frozenset[str] | None = None
    rounds = 0
    while not ingest.started:
        here = ingest.connected
        if here != previous:
            absent = ", ".join(name for name in cameras if name not in here)
            echo(f"waiting for {absent or 'the start'}")
            previous = here
        rounds += 1
        if rounds % 50 == 0 and not here:  # ten seconds
            echo(
                "no slave answers: is it running, with the same rig key, and does --beacon reach it? See its log"
            )
        if stop.wait(0.2):
            raise CalibrationError("stopped before any slave was there")
