"""`phalanx-master calibrate capture`: pictures of a board from the running slaves, for `intrinsics` and `stereo`."""

import os
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from common.calibration import CameraCalibration, RigCalibration, load
from common.clock import SystemClock
from common.errors import CalibrationError
from common.keys import link_key
from master.calibrate.cameras.capture import StillTaker, capture, new_folder
from master.calibrate.cameras.live_views import LiveViews
from master.calibrate.cameras.options import Dictionary, MarkerMm, Size, SquareMm, board_of, options_of
from master.ingest import Ingest
from master.master_bus import host_bus
from master.options import (
    CALIB_JSON,
    HERE_BEACON,
    HERE_BIND,
    HERE_BUS,
    Beacon,
    Bind,
    BusEnd,
    Calibration,
    KeyFile,
    Rig,
    address,
)
from master.stopping import stop_on_signals

FEWEST = 5  # from which a lens can be fitted at all
_START_S = 5.0
_POLL_S = 0.2
_HINT_ROUNDS = 50  # ten seconds


def capture_views(
    out: Annotated[Path, typer.Option(help="New or empty folder for the pictures.")],
    board: Size = "9x6",
    square_mm: SquareMm = 25.0,
    marker_mm: MarkerMm = None,
    dictionary: Dictionary = "4X4_50",
    views: Annotated[int, typer.Option(min=FEWEST, max=200, help="Views to keep.")] = 25,
    rig: Rig = "desk",
    calibration: Calibration = CALIB_JSON,
    beacon: Beacon = HERE_BEACON,
    bind: Bind = HERE_BIND,
    bus: BusEnd = HERE_BUS,
    key_file: KeyFile = None,
) -> None:
    """Keep a picture whenever the board is held still somewhere new; all running slaves of the rig at once.

    This is the rig's master while it runs: end `phalanx-master run` first. Slaves whose cameras have no colours yet
    run with `--colours none`. Ctrl-C ends it early; what was kept stays.

    Examples:

      phalanx-master calibrate capture --rig desk --board 9x6 --square-mm 25 --out views

      phalanx-master calibrate stereo views --board 9x6 --square-mm 25 --rig desk --out calib_json      then
    """
    ends = address(beacon, "--beacon"), address(bind, "--bind")
    cameras = cameras_of(calibration, rig)
    sizes = _sizes(calibration, cameras)
    live = LiveViews(board_of(board, square_mm, marker_mm, dictionary), cameras)
    key = link_key(os.environ, key_file)
    clock = SystemClock()
    new_folder(out)
    stop = stop_on_signals()
    with ExitStack() as stack:
        link = host_bus(bus, live.cameras)
        stack.callback(link.close)
        ingest = Ingest(live.cameras, key, clock, *ends, bus, _START_S)
        stack.callback(ingest.close)
        _wait(ingest, live.cameras, stop)
        taker = StillTaker(link, ingest, sizes)
        stack.callback(taker.close)
        kept = capture(taker.take, live, out, views, stop, typer.echo, live.missing)
    if kept < FEWEST:
        raise CalibrationError(f"{out}: {kept} views kept; a calibration needs {FEWEST}, better {views}")
    typer.echo(f"{kept} views in {out}; next: phalanx-master calibrate {_next(live, out, rig)}")


def _next(live: LiveViews, out: Path, rig: str) -> str:
    """The command that makes a calibration of what was kept."""
    several = len(live.cameras) > 1
    what, of_rig = ("stereo", f" --rig {rig}") if several else ("intrinsics", "")
    return f"{what} {out} {options_of(live.board)}{of_rig} --out DIR"


def cameras_of(calibration: Path, rig: str) -> tuple[str, ...]:
    """The cameras of a rig, which need not have lenses or places yet."""
    return load(calibration / "rigs" / f"{rig}.json", RigCalibration).cameras


def _sizes(calibration: Path, cameras: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    """Width and height [px] that the camera files say."""
    files = (load(calibration / "cameras" / f"{name}.json", CameraCalibration) for name in cameras)
    return {file.name: (file.width_px, file.height_px) for file in files}


def _wait(ingest: Ingest, cameras: tuple[str, ...], stop: threading.Event) -> None:
    """Until the start was given; says whom it waits for.

    Raises:
        CalibrationError: Called with to stop before.
    """
    previous: frozenset[str] | None = None
    rounds = 0
    while not ingest.started:
        here = ingest.connected
        if here != previous:
            absent = ", ".join(name for name in cameras if name not in here)
            typer.echo(f"waiting for {absent or 'the start'}")
            previous = here
        rounds += 1
        if rounds % _HINT_ROUNDS == 0 and not here:
            typer.echo(
                "no slave answers: is it running, with the same rig key, and does --beacon reach it? Its log says more"
            )
        if stop.wait(_POLL_S):
            raise CalibrationError("stopped before any slave was there")
