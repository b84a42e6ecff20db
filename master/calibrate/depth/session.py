"""A session guides a person through a depth sweep with running slaves.

The target is put at one distance after another, and measured there while it stands still: so nothing is
paired, each camera's centroids are averaged on their own. The session opens the link as a master does.
"""

import os
import sys
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Float, Int
from common.bus.keys import link_key
from common.clock import Clock, SystemClock
from common.command_line import echo
from common.errors import CalibrationError, FitError
from common.messages import Detections, MarkerDetections
from master.calibrate.depth.source import Measured, load_pair, straightened
from master.calibrate.depth.sweep import FARTHEST_M, Sweep, parse_distances, write_table
from master.commands.options import address
from master.outputs.bus import Receive
from master.run.app import AuxiliaryMessage
from master.run.ingest import Ingest

_QUARTERS = 4
_PUBLISHED = "1.00:0.20:-0.05"


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The target at rest."""

    uv: Float  # (2, 2) mean centroids [px] in the two cameras
    area_px2: Float  # (2,) mean areas
    sigma_px: float  # standard deviation of one frame pair's disparity [px]
    frames: Int  # (2,) frames averaged
    rate_hz: Float  # (2,) rate of the cameras, by their stamps


class Meter:
    """Push machine that averages one marker in two cameras.

    State: the frames of the last `seconds`, and the reason why it waits (`trouble`).
    """

    def __init__(self, cameras: tuple[str, str], marker: int, frames: int, seconds: float) -> None:
        """Wait for `frames` frames of each camera at rest over `seconds`."""
        self._cameras, self._marker = cameras, marker
        self._frames, self._span_ns = max(frames, 2 * _QUARTERS), round(seconds * 1e9)
        self._kept: tuple[deque[tuple[int, Float]], ...] = (deque(), deque())
        self.trouble = f"no frames from {' and '.join(cameras)}"

    def push(self, message: MarkerDetections) -> Reading | None:
        """Take one camera's detections; return the reading once it is complete."""
        if message.camera not in self._cameras:
            return None
        mine = self._kept[self._cameras.index(message.camera)]
        m = self._marker
        if np.isnan(message.uv[m, 0]):
            mine.clear()
        else:
            mine.append((message.t_ns, np.array([*message.uv[m], message.area[m]])))
            while len(mine) > self._frames and mine[-1][0] - mine[1][0] >= self._span_ns:
                mine.popleft()
        return self._judge()

    @property
    def progress(self) -> float:
        """Share of what is needed, 0...1, of the camera that is behind."""
        return min(
            min(len(kept) / self._frames, (kept[-1][0] - kept[0][0]) / self._span_ns if kept else 0.0, 1.0)
            for kept in self._kept
        )

    def _judge(self) -> Reading | None:
        for camera, kept in zip(self._cameras, self._kept, strict=True):
            if len(kept) < self._frames or kept[-1][0] - kept[0][0] < self._span_ns:
                self.trouble = (
                    f"camera {camera!r} does not see the target all the time: it is outside the image, hidden, or the"
                    " camera is silent"
                )
                return None
        seen = [np.array([values for _, values in kept]) for kept in self._kept]
        drift = max(_drift(values[:, :2]) for values in seen)
        shake = max(float(values[:, :2].std(axis=0).max()) for values in seen)
        # drift over the reading, five times the noise of a quarter's mean; 0.5 % of the depth at 1 m
        still_px = 0.2
        shake_px = 0.5  # standard deviation of single frames, five times the noise of a good centroid
        if drift > still_px or shake > shake_px:
            self.trouble = (
                f"the target moves: its image drifts by {drift:.2f} px and shakes by {shake:.2f} px; {still_px} and"
                f" {shake_px} are allowed"
            )
            return None
        times = [np.array([t for t, _ in kept], np.int64) for kept in self._kept]
        return Reading(
            uv=np.stack([values[:, :2].mean(axis=0) for values in seen]),
            area_px2=np.array([values[:, 2].mean() for values in seen]),
            sigma_px=float(np.hypot(*(values[:, 0].std(ddof=1) for values in seen))),
            frames=np.array([len(values) for values in seen]),
            rate_hz=np.array([(t.size - 1) / ((t[-1] - t[0]) * 1e-9) for t in times]),
        )


def _drift(uv: Float) -> float:
    """Largest distance between the means of the quarters of a reading (T, 2) [px]."""
    means = np.array([quarter.mean(axis=0) for quarter in np.array_split(uv, _QUARTERS)])
    return float(np.ptp(means, axis=0).max())


def measure(
    receive: Receive[Detections | AuxiliaryMessage],
    meter: Meter,
    clock: Clock,
    progress: Callable[[float], None],
) -> Reading:
    """Read the target that stands before the cameras now.

    Raises:
        FitError: It did not stand still, or was not seen, for ten seconds; the message states which.
    """
    while receive(0.0) is not None:  # what was seen while it was being put there
        pass
    since_ns = clock.now_ns()
    while clock.now_ns() - since_ns < 10.0 * 1e9:
        message = receive(0.1)
        if not isinstance(message, MarkerDetections) or message.t_ns < since_ns:
            continue
        reading = meter.push(message)
        progress(meter.progress)
        if reading is not None:
            return reading
    raise FitError(meter.trouble)


def run_session(
    receive: Receive[Detections | AuxiliaryMessage],
    cameras: tuple[str, str],
    marker: int,
    distances: Sequence[float],
    *,
    frames: int,
    seconds: float,
    clock: Clock,
    ask: Callable[[str], str | None],
    notify: Callable[[str], None],
    progress: Callable[[float], None],
    keep: Callable[[Sweep], None],
) -> Sweep:
    """Lead a person through a sweep; return all places in the order of measurement.

    Args:
        receive: Gives detections, times on `clock`, the master's.
        cameras: First (left) and second camera.
        marker: Index of the target's marker.
        frames, seconds: Frames of each camera to average, and time over which, at least.
        ask: Shows a prompt and returns the answer; None: nobody answers any more.
        progress: Called with the share of a reading that is done.
        keep: Given the sweep so far after each reading, to save it.
    """
    done: list[tuple[float, Reading]] = []
    waiting = deque(distances)
    while waiting:
        answer = ask(f"target at {waiting[0]:.3f} m, then Enter (its true distance; s to skip; q to end): ")
        answer = None if answer is None else answer.strip().lower()
        if answer is None or answer == "q":
            break
        distance = waiting[0] if answer == "" else _number(answer)
        if answer == "s" or distance is None:
            if answer == "s":
                waiting.popleft()
            else:
                notify(f"{answer!r}: neither a distance in metres, nor s, nor q")
            continue
        try:
            reading = measure(receive, Meter(cameras, marker, frames, seconds), clock, progress)
        except FitError as error:
            notify(f"{distance:.3f} m: not measured: {error}; try again")
            continue
        waiting.popleft()
        done.append((distance, reading))
        notify(_reading_line(distance, reading, cameras))
        keep(_sweep(done))
    return _sweep(done)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 < value < FARTHEST_M else None


def _reading_line(distance: float, reading: Reading, cameras: tuple[str, str]) -> str:
    disparity = float(reading.uv[0, 0] - reading.uv[1, 0])
    rates = ", ".join(f"{c} {r:.1f} Hz" for c, r in zip(cameras, reading.rate_hz.tolist(), strict=True))
    return (
        f"{distance:.3f} m: disparity {disparity:.3f} px, standard deviation {reading.sigma_px:.3f} px,"
        f" {int(reading.frames.min())} frames (cameras: {rates})"
    )


def _sweep(done: Sequence[tuple[float, Reading]]) -> Sweep:
    uv = np.stack([r.uv for _, r in done], axis=1) if done else np.empty((2, 0, 2))
    return Sweep(
        distance_m=np.array([d for d, _ in done], np.float64),
        disparity_px=uv[0, :, 0] - uv[1, :, 0],
        uv=uv,
        area_px2=np.stack([r.area_px2 for _, r in done], axis=1) if done else np.empty((2, 0)),
        sigma_px=np.array([r.sigma_px for _, r in done], np.float64),
        frames=np.array([int(r.frames.min()) for _, r in done], np.int64),
        place=tuple(f"reading {i}" for i in range(1, len(done) + 1)),
    )


def sweep_live(options: Namespace, outline: Float) -> Measured:
    """Lead the user through a sweep with the slaves that run."""
    beacon, bind = address(options.beacon, "--beacon"), address(options.bind, "--bind")
    key = link_key(os.environ, options.key_file)
    pair = load_pair(options.calibration, options.rig or "desk", options.fov_deg)
    assert pair.rig is not None
    marker: str | None = options.marker
    table: Path | None = options.save_table
    names = pair.rig.markers
    if marker is None or marker not in names:
        raise CalibrationError(f"--marker: which paint has the target? one of {', '.join(names)}")
    wanted: list[float] = parse_distances(options.distances or _PUBLISHED).tolist()
    clock = SystemClock()

    def keep(sweep: Sweep) -> None:
        if table is not None:
            write_table(table, sweep)

    ingest = Ingest(pair.rig.cameras, key, clock, beacon, bind, "")
    try:
        host, port = ingest.address
        echo(f"listening on {host}:{port}; {len(wanted)} distances, marker {marker!r}")
        sweep = run_session(
            ingest.get,
            pair.cameras,
            names.index(marker),
            wanted,
            frames=options.frames,
            seconds=options.seconds,
            clock=clock,
            ask=_ask,
            notify=_print,
            progress=_progress,
            keep=keep,
        )
    finally:
        ingest.close()
    sweep, note = straightened(sweep, pair, outline)
    rates = ", ".join(f"{file.name} {file.frame_rate_hz:g} Hz" for file in pair.files)
    about = f"{sweep.size} places of the marker {marker!r}, measured live (cameras set to {rates}){note}"
    return Measured(sweep, pair, (table.name if table is not None else "live",), about)


def _ask(prompt: str) -> str | None:
    echo(prompt, end="")
    line = sys.stdin.readline()
    return line.rstrip("\n") if line else None


def _print(line: str) -> None:
    if sys.stderr.isatty():
        echo("\r\033[K", end="", error=True)  # the progress goes
    echo(line)


def _progress(share: float) -> None:
    if sys.stderr.isatty():
        echo(f"\rreading {100 * share:3.0f} % ", end="", error=True)
