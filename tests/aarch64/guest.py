"""The program that is counted: runs one case frame by frame, and marks where the count is read.

    python -m tests.aarch64.guest FOLDER CASE     prints a line of JSON: labels of the marks, hash of what was found

It also runs natively, for that hash: it must be equal on both architectures.
"""

import hashlib
import json
import os
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np

from bench.markers import published
from common.messages import Message, WristDetections, encode
from slave.markers.detector import Detections, MarkerDetector
from slave.markers.engine import engine_named
from slave.sources import Frame
from slave.wrist import engine as wrist_engine
from slave.wrist.detector import WristDetector
from slave.wrist.led_image import WristView
from tests.aarch64.frames import FRAME_NS, SIX, WRIST, read, read_strobed

FIRST, LAST = 20, 60  # the slope is taken between these counts of frames
MACHINE_CODE = ("numba", "numba-windows", "wrist-numba")  # cases
STROBED = ("wrist", "wrist-numba")
WINDOWS = ("windows", "numba-windows")


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


def run_case(case: str, folder: Path, marks: Marks) -> str:
    """Run `case` over all frames with marks at FIRST and LAST; return the hash of what it found."""
    if case in STROBED:
        return _run_strobed(case, folder, marks)
    if case not in (SIX, "numba", "seed", *WINDOWS):
        raise ValueError(f"no case {case!r}")
    frames, digest, found = read(folder / SIX), Digest(), list[Detections]()
    if case == "seed":
        ranges = [(frames.camera.markers or {})[name] for name in frames.names]
        _each(marks, case, lambda k: digest.add(published.detect(frames.image(k), ranges)))
    else:
        engine = engine_named("numba" if case in MACHINE_CODE else "numpy")
        detector = MarkerDetector(frames.camera, frames.names, engine=engine)
        detector.windows_only = case in WINDOWS
        _each(marks, case, lambda k: found.append(detector.push(frames.image(k), k * FRAME_NS)))
    for one in found:
        digest.add(*(np.asarray(getattr(one, field.name), float) for field in fields(one)))
    return digest.hex()


def _each(marks: Marks, case: str, step: Callable[[int], None]) -> None:
    """Take all steps of a case, with its marks."""
    for k in range(LAST):
        if k == FIRST:
            marks(f"{case} {FIRST}")
        step(k)
    marks(f"{case} {LAST}")


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
