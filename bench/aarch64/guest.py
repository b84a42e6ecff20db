"""The program that is counted: runs one case frame by frame, and marks where the count is read.

    python -m bench.aarch64.guest FOLDER CASE     prints a line of JSON: labels of the marks, hash of what was found

It also runs natively, for that hash: it must be equal on both architectures.
"""

import hashlib
import json
import os
import random
import sys
import threading
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from bench.aarch64.frames import FRAME_NS, SIX, TWELVE, WRIST, MarkedFrames, read, read_strobed, without
from bench.markers import published
from common.clock import Clock
from common.messages import Message, WristDetections, encode
from master.run.link import MasterLink
from slave.link import SlaveLink
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.engine import engine_named
from slave.report import DetectionCounters
from slave.sender import MarkerPipeline, run
from slave.sources import Frame
from slave.wrist import engine as wrist_engine
from slave.wrist.detector import WristDetector
from slave.wrist.led_image import WristView

FIRST, LAST = 20, 60  # the slope is taken between these counts of frames
MACHINE_CODE = ("numba", "numba-windows", "wrist-numba")  # cases
STROBED = ("wrist", "wrist-numba")
WINDOWS = ("windows", "search", "numba-windows")
PUSHED = ("six", "twelve", "numba", *WINDOWS)
KEY = bytes(range(32))
MASTER, SLAVE = ("10.0.0.1", 47801), ("10.0.0.2", 5)


class Marks:
    """Places where the plugin writes its count. Holds their labels, in order."""

    def __init__(self) -> None:
        """Begin with none."""
        self.labels: list[str] = []

    def __call__(self, label: str) -> None:
        """Mark this place: the system call that the plugin looks for, harmless everywhere."""
        self.labels.append(label)
        os.sched_get_priority_max(os.SCHED_FIFO)


class Digest:
    """SHA-256 of arrays, any NaN counting as the same NaN."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._sha = hashlib.sha256()

    def add(self, *arrays: np.ndarray) -> None:
        """Take arrays of floats."""
        for array in arrays:
            self._sha.update(np.where(np.isnan(array), np.nan, array).astype(float).tobytes())

    def hex(self) -> str:
        """The hash of all that was taken."""
        return self._sha.hexdigest()


def arrays_of(message: Message) -> list[np.ndarray]:
    """The arrays of a message as floats, field by field."""
    values = (getattr(message, name) for name in message.__struct_fields__)
    return [value.astype(float) for value in values if isinstance(value, np.ndarray)]


class StillClock(Clock):
    """A clock that shows what it is set to, so that an emulated minute ends no session."""

    t_ns = 1_000_000_000_000

    def now_ns(self) -> int:
        """Return what it is set to."""
        return self.t_ns


class _Wire:
    """Where the slave's loop sends to: a started link, all of `Uplink.send` save the socket. Holds what was sent."""

    def __init__(self, camera: str) -> None:
        clock = StillClock()
        source = random.Random(7).randbytes
        master = MasterLink((camera,), KEY, clock, ("10.0.0.255", 47800), "tcp/10.0.0.1:47802", 0, source)
        self._link = SlaveLink(camera, KEY, clock, source)
        self._lock = threading.Lock()
        self.datagrams: list[bytes] = []
        for _ in range(200):
            for datagram, _to in master.due():
                self._link.receive_beacon(datagram, MASTER, clock.now_ns())
                self._link.receive(datagram, MASTER, clock.now_ns())
            for datagram, _to in self._link.due():
                master.receive(datagram, SLAVE, clock.now_ns())
            if self._link.started:
                return
            clock.t_ns += 5_000_000
        raise RuntimeError("the master's start did not come within a simulated second")

    @property
    def session(self) -> int:
        return self._link.process

    def send(self, message: Message) -> None:
        with self._lock:
            sealed = self._link.seal(message)
            if sealed is None:
                raise RuntimeError("the session has ended")
            self.datagrams.append(sealed[0])


class _Source:
    """Frames for the slave's loop. Holds the number of the next one."""

    def __init__(self, frames: MarkedFrames, mark: Callable[[int], None]) -> None:
        self._frames = frames
        self._mark = mark
        self._seq = 0

    def read(self) -> Frame | None:
        k, self._seq = self._seq, self._seq + 1
        self._mark(k)
        return None if k == LAST else Frame(k, k * FRAME_NS, k * FRAME_NS, self._frames.image(k))

    def close(self) -> None:
        pass


def run_case(case: str, folder: Path, marks: Marks) -> str:
    """Run `case` over all frames with marks at FIRST and LAST; return the hash of what it found."""
    if case in STROBED:
        return _run_strobed(case, folder, marks)
    frames = read(folder / (TWELVE if case == "twelve" else SIX))
    if case == "search":
        frames = without(frames, frames.names[0])
    digest = Digest()
    mark, each = partial(_mark, marks, case), partial(_each, marks, case)
    engine = engine_named("numba" if case in MACHINE_CODE else "numpy")
    detector = MarkerDetector(frames.camera, frames.names, engine=engine)
    detector.windows_only = case in WINDOWS
    found: list[Detections] = []
    if case in PUSHED:
        each(lambda k: found.append(detector.push(frames.image(k), k * FRAME_NS)))
    elif case == "lost":
        each(lambda k: found.append(detector.fresh().push(frames.image(k), 0)))
    elif case == "seed":
        ranges = [(frames.camera.markers or {})[name] for name in frames.names]
        each(lambda k: digest.add(published.detect(frames.image(k), ranges)))
    elif case == "step":
        wire = _Wire(frames.camera.name)
        line = (wire.session, wire.send, detector.push, DetectionCounters(frames.names))
        run(_Source(frames, mark), MarkerPipeline(frames.camera.name, *line), threading.Event())
        digest.add(np.frombuffer(b"".join(wire.datagrams), np.uint8))
    else:
        raise ValueError(f"no case {case!r}")
    for one in found:
        digest.add(*(np.asarray(getattr(one, field.name), float) for field in fields(one)))
    return digest.hex()


def _mark(marks: Marks, case: str, k: int) -> None:
    """Mark the place before step `k`, where it is one that is counted from or to."""
    if k in (FIRST, LAST):
        marks(f"{case} {k}")


def _each(marks: Marks, case: str, step: Callable[[int], None]) -> None:
    """Take all steps of a case, with its marks."""
    for k in range(LAST):
        _mark(marks, case, k)
        step(k)
    _mark(marks, case, LAST)


def _run_strobed(case: str, folder: Path, marks: Marks) -> str:
    """Run a wrist device's triples: strobe, seams, laser, tips, message, encode; a step is a triple."""
    frames, digest = read_strobed(folder / WRIST), Digest()
    view = WristView.of(frames.rig, frames.camera, frames.hand)
    engine = wrist_engine.engine_named("numba" if case in MACHINE_CODE else "numpy")
    detector = WristDetector(view, frames.camera.frame_rate_hz, engine)
    messages: list[WristDetections] = []

    def step(k: int) -> None:
        for seq, image in enumerate(frames.cycle(k), 3 * k):
            t_ns = frames.t_ns(seq)
            if (found := detector.push(Frame(seq, t_ns, t_ns, image))) is not None:
                messages.append(found.message(frames.camera.name, 7))
                encode(messages[-1])

    _each(marks, case, step)
    if len(messages) < LAST - FIRST:
        raise RuntimeError(f"{len(messages)} of {LAST} triples gave messages")
    for one in messages:
        # Least squares of outlines differ in the last bit from processor to processor.
        digest.add(*(np.round(array, 3) for array in arrays_of(one)))
    return digest.hex()


def main(arguments: list[str]) -> int:
    """Run one case; print one line."""
    cv2.setNumThreads(1)
    folder, case = arguments
    marks = Marks()
    digest = run_case(case, Path(folder), marks)
    sys.stdout.write(json.dumps({"labels": marks.labels, "hash": digest}) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
