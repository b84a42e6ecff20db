"""The wall clock of a machine jumps, on real processes: nothing between light and pose may notice.

The slave of one camera and the master run with wall_clock.c loaded before the C library, so that a file says what their
wall clock shows while they run; their monotonic clock is left alone, as it is by `date -s`, by NTP or by a
battery that died. Needs a C compiler, `cc`.
"""

import os
import struct
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from common.errors import PhalanxError
from common.messages.streams import MASTER
from tests.slaves_rig import SlavesRig

CAMERA, OTHER = "left", "right"
STEPS_S = (10.0, -10.0)
WATCH_S = 8.0
LEAST_SHARE = 0.6
SOURCE = Path(__file__).with_name("wall_clock.c")
_LIBRARY = "wall_clock.so"
_AHEAD = struct.Struct("=q")  # [ns]
_COUNTS = ("left.clock_steps", "left.restarts", "unsynchronised")


@dataclass(frozen=True, slots=True)
class Run:
    """What one jump did.

    Attributes:
        share: Frames of the camera, and poses, whichever is fewer, in the seconds after it, against as many seconds
            before it; each for every frame of the other camera, whose slave knows nothing and has the same machine.
        rise: How much the counts rose that tell a clock that jumped, or a session that began anew.
    """

    share: float
    rise: Mapping[str, int]


def built(folder: Path) -> Path:
    """The library that moves a process' wall clock.

    Raises:
        PhalanxError: No C compiler, or it refuses.
    """
    library = folder / _LIBRARY
    try:
        subprocess.run(
            ["cc", "-O1", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl"],
            check=True,
            capture_output=True,
        )
    except FileNotFoundError as error:
        raise PhalanxError("no cc: apt install gcc libc6-dev") from error
    except subprocess.CalledProcessError as error:
        raise PhalanxError(f"{SOURCE}: {error.stderr.decode()}") from error
    return library


class WallClock:
    """The wall clock of all processes that have its `environment`. Holds the file that says what it shows."""

    def __init__(self, folder: Path) -> None:
        """It is right.

        Raises:
            PhalanxError: It cannot be built, or does not move what it should: nothing would be measured.
        """
        self._file = folder / "clock"
        self._file.write_bytes(_AHEAD.pack(0))
        self.environment = {"LD_PRELOAD": str(built(folder)), "WALL_CLOCK_FILE": str(self._file)}
        self._check()

    def set(self, ahead_s: float) -> None:
        """Have it so far ahead of the true one from now on."""
        with self._file.open("r+b") as file:  # in place: whoever has it mapped sees it
            file.write(_AHEAD.pack(round(ahead_s * 1e9)))

    def _check(self) -> None:
        for ahead_s in (*STEPS_S, 0.0):
            self.set(ahead_s)
            measured = subprocess.run(
                [sys.executable, "-c", "import time; print(time.time(), time.monotonic())"],
                env=os.environ | self.environment,
                capture_output=True,
                text=True,
                check=True,
            )
            wall, monotonic = (float(word) for word in measured.stdout.split())
            if abs(wall - time.time() - ahead_s) > 4.0 or abs(monotonic - time.monotonic()) > 4.0:
                raise PhalanxError(f"{SOURCE}: does not move the wall clock alone here")


def jump(rig: SlavesRig, clock: WallClock, ahead_s: float) -> Run:
    """Have the wall clock jump and come back, and see what the master counts meanwhile."""
    measured = [_counts(rig)]
    for ahead in (0.0, ahead_s):
        clock.set(ahead)
        time.sleep(WATCH_S)
        measured.append(_counts(rig))
    clock.set(0.0)
    before, after = (_for_each(OTHER, *pair) for pair in pairwise(measured))
    share = min(after[name] / before[name] for name in before)
    return Run(share, {name: measured[2].get(name, 0) - measured[1].get(name, 0) for name in _COUNTS})


def measure(folder: Path, runs: int) -> dict[float, list[Run]]:
    """Jumps of both directions, so many of each, on one rig.

    Raises:
        PhalanxError: The rig does not come up, or has its true clock.
    """
    clock = WallClock(folder)
    rig = SlavesRig(folder / "desk", "desk", dict.fromkeys((CAMERA, MASTER), clock.environment))
    try:
        for name in (CAMERA, MASTER):
            if _LIBRARY not in Path(f"/proc/{rig.processes[name].pid}/maps").read_text():
                raise PhalanxError(f"{name} has its true clock")
        return {ahead_s: [jump(rig, clock, ahead_s) for _ in range(runs)] for ahead_s in STEPS_S}
    finally:
        rig.close()


def _for_each(other: str, before: Mapping[str, int], after: Mapping[str, int]) -> dict[str, float]:
    """Poses, and frames of the camera, for every frame of the other one between two reports."""
    frames = max(after[f"{other}.received"] - before[f"{other}.received"], 1)
    return {name: max(after[name] - before[name], 1) / frames for name in ("poses", f"{CAMERA}.received")}


def _counts(rig: SlavesRig) -> dict[str, int]:
    return dict(rig.ask(MASTER, "report").counts)
