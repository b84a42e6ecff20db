"""Other geometry, depth model, filter or hand while the master tracks: a new pipeline takes the old one's place.

The new pipeline is built on another thread and shown the last messages, so that its tracks, filter and hand stand when
it takes over, between two messages. An instant is never solved twice: poses go on with rising times.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path

from common.arrays import Float
from common.errors import CalibrationError, PhalanxError
from common.messages import Detections
from common.watching import WatchedFiles
from master.ik.tracker import HandTracker
from master.rig import Pipeline, RigSetup, load_setup, pipeline_of
from master.stereo.pipeline import SolvedPose, Stage

_WARM_FRAMES = 6  # of each camera: tracks need two, and the 1 € filter (6 Hz at rest) has settled after 0.1 s
_CLOSE_FRAMES = 2  # of each camera: what may be left for the loop to catch up with
_ROUNDS = 20
_NEEDS_RESTART = ("width_px", "height_px", "frame_rate_hz")


@dataclass(frozen=True, slots=True)
class RigFiles:
    """Where a setup was read: the arguments of `load_setup`."""

    calibration: Path
    rig: str
    hand: Path | None = None

    def load(self) -> RigSetup:
        """Read the files as they are now.

        Raises:
            CalibrationError: As `load_setup`.
        """
        return load_setup(self.calibration, self.rig, self.hand)

    def paths(self, setup: RigSetup) -> tuple[Path, ...]:
        """All files that `setup` was read from."""
        cameras = [self.calibration / "cameras" / f"{name}.json" for name in setup.rig.cameras]
        hand = self.hand or self.calibration / "hands" / f"{setup.rig.hand}.json"
        return (self.calibration / "rigs" / f"{self.rig}.json", *cameras, hand)


class _WhenOpen:
    """A `Stage` that measures nothing until it is opened."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.open = False

    def __call__(self, name: str) -> AbstractContextManager[None]:
        return self._stage(name) if self.open else nullcontext()


class LivePipeline:
    """The pipeline in use. Holds it, its setup, the last messages, and the one that is to take over with the next."""

    def __init__(self, setup: RigSetup, stage: Stage) -> None:
        """Begin with the pipeline of `setup`; `stage` measures the stages of whichever is in use.

        Raises:
            CalibrationError: The depth model does not fit the rig.
        """
        self._stage = stage
        self._setup: RigSetup = setup
        self._tracker = _new_tracker(setup)
        self._now = pipeline_of(setup, stage, tracker=self._tracker)
        cameras = len(setup.rig.cameras)
        self._close = _CLOSE_FRAMES * cameras
        self._recent: deque[tuple[int, Detections]] = deque(maxlen=_WARM_FRAMES * cameras)
        self._number = 0
        self._last_ns = -(2**63)
        # And the number of the last message it has seen. One thread fills it, another empties it.
        self._next: deque[tuple[Pipeline, int]] = deque(maxlen=1)

    @property
    def counts(self) -> Counter[str]:
        """Events since the start, whichever pipeline counted them."""
        return self._now.counts

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, oldest first."""
        self._number += 1
        self._recent.append((self._number, message))
        solved = self._take_over(*self._next.popleft()) if self._next else self._now.push(message)
        if solved:
            self._last_ns = solved[-1].pose.t_ns
        return solved

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take what the IMU says of its orientation (4,); a pipeline that takes over begins without."""
        self._now.push_orientation(t_ns, orientation_wxyz, heading_sigma_rad)

    def change(self, setup: RigSetup) -> None:
        """Let a pipeline of `setup` take over. From any thread but the loop's; takes as long as it takes to build one.

        Raises:
            CalibrationError: The depth model does not fit the rig; nothing has changed.
        """
        stage = _WhenOpen(self._stage)
        if self._tracker is not None and _hand(setup) == _hand(self._setup):
            setup = replace(setup, hand=self._setup.hand)
            tracker = self._tracker.fresh()
        else:
            tracker = _new_tracker(setup)
        new = pipeline_of(setup, stage, tracker=tracker)
        shown = 0
        for _ in range(_ROUNDS):  # while these are solved, more come
            waiting = [(number, message) for number, message in list(self._recent) if number > shown]
            for number, message in waiting:
                new.push(message)
                shown = number
            if len(waiting) <= self._close:
                break
        stage.open = True
        self._setup, self._tracker = setup, tracker
        self._next.append((new, shown))

    def _take_over(self, new: Pipeline, shown: int) -> list[SolvedPose]:
        """Show the new pipeline what it has not seen yet, and take its poses that are later than the last one."""
        old, self._now = self._now.counts, new
        new.counts.clear()
        new.counts.update(old)
        missed = [message for number, message in self._recent if number > shown]
        solved = [one for message in missed for one in new.push(message)]
        later = [one for one in solved if one.pose.t_ns > self._last_ns]
        new.counts["poses"] -= len(solved) - len(later)
        return later


class RigTuning:
    """Follows the files of a rig. Holds the setup in use, and how often a change was applied and refused.

    Its methods are called on several threads and take turns.
    """

    def __init__(
        self, files: RigFiles, setup: RigSetup, pipeline: LivePipeline, say: Callable[[str], None]
    ) -> None:
        """Follow `files`, which say `setup`, and change `pipeline`; `say` is told one line for each change."""
        self._files, self._setup, self._pipeline, self._say = files, setup, pipeline, say
        self._watched = WatchedFiles()
        self._turn = threading.Lock()
        self._applied = self._refused = 0

    @property
    def setup(self) -> RigSetup:
        """The setup in use."""
        return self._setup

    def counts(self) -> dict[str, int]:
        """`reload.applied`, `reload.refused`."""
        return {"reload.applied": self._applied, "reload.refused": self._refused}

    def look(self) -> None:
        """Use the files if they were changed; where that fails, say so once and go on as before."""
        if not self._watched.changed(self._files.paths(self._setup)):
            return
        try:
            self.reload()
        except PhalanxError as error:
            self._say(f"changed files are not used: {error}")

    def reload(self) -> None:
        """Use the files as they are now.

        Raises:
            CalibrationError: One is broken, they contradict each other, or they need a restart. Nothing has changed.
        """
        with self._turn:
            try:
                setup = self._files.load()
                if _content(setup) == _content(self._setup):
                    return
                _refuse_restart(self._setup, setup)
                self._pipeline.change(setup)
            except PhalanxError:
                self._refused += 1
                raise
            self._setup = setup
            self._applied += 1
        self._say("changed files are in use")


def _new_tracker(setup: RigSetup) -> HandTracker | None:
    """The tracker of the hand's markers; a wrist device has none."""
    return HandTracker(setup.hand, setup.hand_markers) if setup.wrist is None else None


def _hand(setup: RigSetup) -> tuple[object, ...]:
    return setup.hand.profile, setup.hand_markers


def _content(setup: RigSetup) -> tuple[object, ...]:
    return setup.rig, setup.cameras, setup.hand.profile


def _refuse_restart(old: RigSetup, new: RigSetup) -> None:
    """Refuse what slaves, files and viewers were started with.

    Raises:
        CalibrationError: With the key, and what to restart.
    """
    where = f"rig {new.rig.name!r}"
    if old.rig.kind != new.rig.kind:
        raise CalibrationError(
            f"{where}: kind: {old.rig.kind} cannot become {new.rig.kind} while it runs: restart all processes of the"
            " rig"
        )
    for key in ("cameras", "markers"):
        was, now = getattr(old.rig, key), getattr(new.rig, key)
        if was != now:
            raise CalibrationError(
                f"{where}: {key}: {', '.join(was)} cannot become {', '.join(now)} while it runs: restart all "
                "processes of the rig"
            )
    if old.hand.profile.name != new.hand.profile.name:
        raise CalibrationError(
            f"{where}: hand: {old.hand.profile.name} cannot become {new.hand.profile.name} while it runs: restart "
            "the master"
        )
    if old.imus != new.imus:
        raise CalibrationError(
            f"{where}: imu.name: {', '.join(old.imus) or 'none'} cannot become {', '.join(new.imus) or 'none'} while "
            "it runs: restart the master"
        )
    for name, camera in new.cameras.items():
        for key in _NEEDS_RESTART:
            was, now = getattr(old.cameras[name], key), getattr(camera, key)
            if was != now:
                raise CalibrationError(
                    f"camera {name!r}: {key}: {was} cannot become {now} while it runs: restart all processes of the rig"
                )
