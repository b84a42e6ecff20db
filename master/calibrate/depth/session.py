"""A session guides a person through a depth sweep with running slaves.

The target is put at one distance after another, and measured there while it stands still: so nothing is
paired, each camera's centroids are averaged on their own. The session opens the link as a master does.
"""

import os
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from common.arrays import Float
from common.bus.keys import link_key
from common.clock import SystemClock
from common.command_line import echo
from common.errors import CalibrationError, FitError
from common.messages import Detections, MarkerDetections
from master.calibrate.depth.source import Measured, load_pair, straightened
from master.calibrate.depth.sweep import FARTHEST_M, Sweep, parse_distances, place_of, write_table
from master.calibrate.session import Session
from master.commands.options import address
from master.run.app import AuxiliaryMessage
from master.run.ingest import Ingest

_QUARTERS = 4
_PUBLISHED = "1.00:0.20:-0.05"


class Meter:
    """Push machine that averages one marker in two cameras.

    State: the frames of the last `seconds`, and the reason why it waits (`trouble`).
    """

    def __init__(self, cameras: tuple[str, str], marker: int, frames: int, seconds: float) -> None:
        """Wait for `frames` frames of each camera at rest over `seconds`."""
        self.cameras, self._marker = cameras, marker
        self._frames, self._span_ns = max(frames, 2 * _QUARTERS), round(seconds * 1e9)
        self._kept: tuple[deque[tuple[int, Float]], ...] = (deque(), deque())
        self.trouble = f"no frames from {' and '.join(cameras)}"

    def push(self, message: MarkerDetections) -> Sweep | None:
        """Take one camera's detections; return the place once it is complete."""
        if message.camera not in self.cameras:
            return None
        mine = self._kept[self.cameras.index(message.camera)]
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

    @property
    def rates_hz(self) -> list[float]:
        """Rates of the two cameras, by their stamps."""
        return [(len(kept) - 1) / ((kept[-1][0] - kept[0][0]) * 1e-9) for kept in self._kept]

    def _judge(self) -> Sweep | None:
        for camera, kept in zip(self.cameras, self._kept, strict=True):
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
        sigma_px = float(np.hypot(*(values[:, 0].std(ddof=1) for values in seen)))
        uv, area = [values[:, :2] for values in seen], [values[:, 2] for values in seen]
        return place_of(uv, area, sigma_px, "reading", float("nan"))


def _drift(uv: Float) -> float:
    """Largest distance between the means of the quarters of a reading (T, 2) [px]."""
    means = np.array([quarter.mean(axis=0) for quarter in np.array_split(uv, _QUARTERS)])
    return float(np.ptp(means, axis=0).max())


Live = Session[Detections | AuxiliaryMessage]


def read(session: Live, meter: Meter) -> Sweep:
    """Read the target that stands before the cameras now; its distance is NaN.

    Raises:
        FitError: It did not stand still, or was not seen, for ten seconds; the message states which.
    """
    while session.receive(0.0) is not None:  # what was seen while it was being put there
        pass
    since_ns = session.clock.now_ns()
    for message in session.during(10.0):
        if not isinstance(message, MarkerDetections) or message.t_ns < since_ns:
            continue
        reading = meter.push(message)
        session.person.progress(meter.progress)
        if reading is not None:
            return reading
    raise FitError(meter.trouble)


def guide(
    session: Live, new_meter: Callable[[], Meter], distances: Sequence[float], keep: Callable[[Sweep], None]
) -> Sweep:
    """Lead a person through a sweep; return all places in the order of measurement.

    Args:
        session: Its messages have times on its clock, the master's.
        new_meter: Makes the meter of one place.
        keep: Given the sweep so far after each reading, to save it.
    """
    done: list[Sweep] = []
    waiting, person = deque(distances), session.person
    while waiting:
        answer = person.ask(
            f"target at {waiting[0]:.3f} m, then Enter (its true distance; s to skip; q to end): "
        )
        answer = None if answer is None else answer.strip().lower()
        if answer is None or answer == "q":
            break
        if answer == "s":
            waiting.popleft()
            continue
        distance = waiting[0] if answer == "" else _number(answer)
        if distance is None:
            person.notify(f"{answer!r}: neither a distance in metres, nor s, nor q")
            continue
        meter = new_meter()
        try:
            reading = read(session, meter)
        except FitError as error:
            person.notify(f"{distance:.3f} m: not measured: {error}; try again")
            continue
        waiting.popleft()
        place = f"reading {len(done) + 1}"
        done.append(replace(reading, distance_m=np.array([distance]), place=(place,)))
        rates = zip(meter.cameras, meter.rates_hz, strict=True)
        person.notify(
            f"{len(done)} of {len(done) + len(waiting)}, {distance:.3f} m: disparity {reading.disparity_px[0]:.3f} px,"
            f" standard deviation {reading.sigma_px[0]:.3f} px, {reading.frames[0]} frames (cameras: "
            + ", ".join(f"{camera} {rate:.1f} Hz" for camera, rate in rates)
            + ")"
        )
        keep(Sweep.joined(done))
    return Sweep.joined(done)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 < value < FARTHEST_M else None


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
        meter = partial(Meter, pair.cameras, names.index(marker), options.frames, options.seconds)
        sweep = guide(Session(ingest.get, clock=clock), meter, wanted, keep)
    finally:
        ingest.close()
    sweep, note = straightened(sweep, pair, outline)
    rates = ", ".join(f"{file.name} {file.frame_rate_hz:g} Hz" for file in pair.files)
    about = f"{sweep.size} places of the marker {marker!r}, measured live (cameras set to {rates}){note}"
    return Measured(sweep, pair, table.name if table is not None else "live", about)
