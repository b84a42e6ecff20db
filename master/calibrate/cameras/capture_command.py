"""Command `phalanx calibrate cameras capture`: board images from running slaves.

They are for `intrinsics` and `stereo`.
"""

import os
import threading
from argparse import Namespace
from contextlib import ExitStack
from pathlib import Path

from common.bus.keys import link_key
from common.calibration import CameraCalibration, RigCalibration, load
from common.clock import SystemClock
from common.errors import CalibrationError
from common.terminal import echo
from master.calibrate.cameras.capture import StillTaker, capture, new_folder
from master.calibrate.cameras.live_views import LiveViews
from master.calibrate.cameras.options import board_of, options_of
from master.commands.options import (
    address,
)
from master.run.ingest import Ingest
from master.run.master_bus import host_bus
from master.run.stopping import stop_on_signals


def capture_views(options: Namespace) -> None:
    """Keep an image whenever the board is held still somewhere new.

    All running slaves of the rig at once.
    """
    ends = address(options.beacon, "--beacon"), address(options.bind, "--bind")
    cameras = cameras_of(options.calibration, options.rig)
    sizes = _sizes(options.calibration, cameras)
    live = LiveViews(
        board_of(options.board, options.square_mm, options.marker_mm, options.dictionary), cameras
    )
    key = link_key(os.environ, options.key_file)
    clock = SystemClock()
    new_folder(options.out)
    stop = stop_on_signals()
    with ExitStack() as stack:
        link = host_bus(options.bus, live.cameras)
        stack.callback(link.close)
        start_s = 5.0
        ingest = Ingest(live.cameras, key, clock, *ends, options.bus, start_s)
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
    """The command that makes a calibration of what was kept."""
    several = len(live.cameras) > 1
    what, of_rig = ("stereo", f" --rig {rig}") if several else ("intrinsics", "")
    return f"cameras {what} {out} {options_of(live.board)}{of_rig} --out DIR"


def cameras_of(calibration: Path, rig: str) -> tuple[str, ...]:
    """The cameras of a rig, which need not have lenses or places yet."""
    return load(calibration / "rigs" / f"{rig}.json", RigCalibration).cameras


def _sizes(calibration: Path, cameras: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    """Return the image sizes that the camera files state.

    Width and height [px].
    """
    files = (load(calibration / "cameras" / f"{name}.json", CameraCalibration) for name in cameras)
    return {file.name: (file.width_px, file.height_px) for file in files}


def _wait(ingest: Ingest, cameras: tuple[str, ...], stop: threading.Event) -> None:
    """Wait until the start is given, and print whom it waits for.

    Raises:
        CalibrationError: Called with to stop before.
    """
    previous: frozenset[str] | None = None
    rounds = 0
    while not ingest.started:
        here = ingest.connected
        if here != previous:
            absent = ", ".join(name for name in cameras if name not in here)
            echo(f"waiting for {absent or 'the start'}")
            previous = here
        rounds += 1
        hint_rounds = 50  # ten seconds
        if rounds % hint_rounds == 0 and not here:
            echo(
                "no slave answers: is it running, with the same rig key, and does --beacon reach it? See its log"
            )
        poll_s = 0.2
        if stop.wait(poll_s):
            raise CalibrationError("stopped before any slave was there")
