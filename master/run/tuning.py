"""Tuning changes the setup while the master tracks, or asks for a restart.

What slaves, files and viewers were started with cannot change. Other geometry, depth model, filter, hand,
object or gestures: a new pipeline replaces the old one. It is built on another thread and shown the last
messages, so that its tracks, filter and hand stand when it takes over, between two messages. An epoch is
never solved twice: poses go on with rising times. Each hand has a pipeline of its own; objects and gestures
change together (`dispatcher`).
"""

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from math import ceil, nan
from typing import TypeAlias

import msgspec

from common.arrays import Float
from common.calibration import FilterCalibration, parse
from common.calibration.files import MonitoredFiles, Part
from common.errors import CalibrationError, PhalanxError
from common.messages import Detections, Name
from master.estimator.pipeline import SolvedPose
from master.fabrik.solver import Stage
from master.rig.pipeline import Pipeline, pipeline_of
from master.rig.setup import RigFiles, RigSetup
from master.run.dispatcher import Dispatcher

_ALL = "give all processes of the rig the same files, then restart them"
_MASTER = "restart the master"


def refuse_other_hands(old: Sequence[RigSetup], new: Sequence[RigSetup]) -> None:
    """Refuse other hands than those that are solved, by a CalibrationError with both."""
    was, now = (tuple(setup.hand.profile.name for setup in setups) for setups in (old, new))
    if was != now:
        raise _refusal(f"rig {new[0].rig.name!r}: hand", was, now, _MASTER)


def refuse_restart(old: RigSetup, new: RigSetup) -> None:
    """Refuse what slaves, files and viewers were started with.

    Raises:
        CalibrationError: With the key, and what to restart.
    """
    where = f"rig {new.rig.name!r}"
    fixed: list[tuple[str, Sequence[str], Sequence[str], str]] = [
        (f"{where}: kind", (old.rig.kind,), (new.rig.kind,), _ALL),
        (f"{where}: cameras", old.camera_names, new.camera_names, _ALL),
        (f"{where}: markers", old.markers, new.markers, _ALL),
        (f"{where}: objects", [one.name for one in old.objects], [one.name for one in new.objects], _ALL),
        (f"{where}: tracker of its objects", old.trackers, new.trackers, _MASTER),
        (f"{where}: imu.name", old.imus, new.imus, _MASTER),
    ]
    for name in (name for name in new.cameras if name in old.cameras):
        was, now = old.cameras[name], new.cameras[name]
        for key in ("width_px", "height_px"):
            fixed.append(
                (f"camera {name!r}: {key}", [str(getattr(was, key))], [str(getattr(now, key))], _ALL)
            )
    for key, was, now, remedy in fixed:
        if was != now:
            raise _refusal(key, was, now, remedy)
    if old.rows != new.rows:
        raise CalibrationError(f"{where}: markers: cannot stand in another order while it runs: {_ALL}")


def _refusal(key: str, was: Sequence[str], now: Sequence[str], remedy: str) -> CalibrationError:
    return CalibrationError(
        f"{key}: {', '.join(was) or 'none'} cannot become {', '.join(now) or 'none'} while it runs: {remedy}"
    )


_ROUNDS = 20


class FilterTrial(Part, frozen=True):
    """Body of the command "filter": a rig, and its filter as the rig file has it."""

    rig: Name
    filter: FilterCalibration


class _WhenOpen:
    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.open = False

    def __call__(self, name: str) -> AbstractContextManager[None]:
        return self._stage(name) if self.open else nullcontext()


# What a message does to a pipeline.
_Shown: TypeAlias = Callable[[Pipeline], list[SolvedPose]]


class LivePipeline:
    """The pipeline of one hand in use, its last messages, and the one to take over."""

    def __init__(
        self, setup: RigSetup, stage: Stage, dropped_epochs: Callable[[], bool] | None = None
    ) -> None:
        """Begin with the pipeline of `setup`.

        `stage` measures the stages of whichever pipeline is in use; `dropped_epochs` is asked for each of its
        epochs whether it is dropped.

        Raises:
            CalibrationError: The depth model does not fit the rig.
        """
        self._stage, self._dropped_epochs = stage, dropped_epochs
        self._setup: RigSetup = setup
        self._now = pipeline_of(setup, stage, dropped_epochs=dropped_epochs)
        per_frame = _messages_per_frame(setup)
        close_frames = 2  # of each camera: what may be left for the loop to catch up with
        self._close = close_frames * per_frame
        warm_frames = 6  # of each camera: tracks need two, and the shipped 1 € filter has settled after 0.1 s
        self._recent: deque[tuple[int, _Shown]] = deque(maxlen=warm_frames * per_frame)
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
        self._keep(lambda pipeline: pipeline.push(message))
        solved = self._take_over(*self._next.popleft()) if self._next else self._now.push(message)
        if solved:
            self._last_ns = solved[-1].pose.t_ns
        return solved

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take an orientation (4,) measured by the hand's IMU."""

        def show(pipeline: Pipeline) -> list[SolvedPose]:
            pipeline.push_orientation(t_ns, orientation_wxyz, heading_sigma_rad)
            return []

        self._keep(show)
        show(self._now)

    def _keep(self, show: _Shown) -> None:
        self._number += 1
        self._recent.append((self._number, show))

    def flush(self) -> list[SolvedPose]:
        """Nothing comes any more: the poses that still wait for something."""
        return self._now.flush()

    def renew(self) -> None:
        """Let a new pipeline of the same setup take over, which has seen nothing so far."""
        take = self.prepare(self._setup)
        self._recent.clear()
        take()

    def prepare(self, setup: RigSetup) -> Callable[[], None]:
        """Build a pipeline of `setup`; return what warms it up and switches to it.

        From any thread but the loop's.

        Raises:
            CalibrationError: The depth model does not fit the rig; nothing has changed.
        """
        stage = _WhenOpen(self._stage)
        # What it is shown to warm up has been solved by the other already: nothing of it is dropped.
        dropped_epochs = self._dropped_epochs
        new = pipeline_of(
            setup,
            stage,
            dropped_epochs=None if dropped_epochs is None else lambda: stage.open and dropped_epochs(),
        )

        def take() -> None:
            shown = self._warm(new)
            stage.open = True
            self._setup = setup
            self._next.append((new, shown))

        return take

    def _warm(self, new: Pipeline) -> int:
        """Show it the last messages; return the number of the last one."""
        shown = 0
        for _ in range(_ROUNDS):  # while these are solved, more come
            waiting = [(number, show) for number, show in list(self._recent) if number > shown]
            for number, show in waiting:
                show(new)
                shown = number
            if len(waiting) <= self._close:
                break
        return shown

    def _take_over(self, new: Pipeline, shown: int) -> list[SolvedPose]:
        """Switch to the new pipeline, and return its poses later than the last."""
        old, self._now = self._now.counts, new
        new.counts.clear()
        new.counts.update(old)
        missed = [show for number, show in self._recent if number > shown]
        solved = [one for show in missed for one in show(new)]
        later = [one for one in solved if one.pose.t_ns > self._last_ns]
        new.counts["poses"] -= len(solved) - len(later)
        return later


class RigTuning:
    """Follower of the files of all rigs; methods may be called on several threads."""

    def __init__(
        self,
        files: RigFiles,
        setups: Sequence[RigSetup],
        pipelines: Sequence[LivePipeline],
        notify: Callable[[str], None],
        dispatcher: Dispatcher | None = None,
    ) -> None:
        """Follow `files`, which hold the `setups`, and change the pipelines with them.

        `notify` gets one line for each change. `dispatcher` has objects and gestures; None: nobody asks for
        any.
        """
        self._files, self._notify, self._dispatcher = files, notify, dispatcher
        self._setups, self._pipelines = tuple(setups), tuple(pipelines)
        self._monitored = MonitoredFiles()
        self._lock = threading.Lock()
        self._applied = self._refused = 0

    @property
    def setups(self) -> tuple[RigSetup, ...]:
        """The setups in use."""
        return self._setups

    def counts(self) -> dict[str, int]:
        """`reload.applied`, `reload.refused`."""
        return {"reload.applied": self._applied, "reload.refused": self._refused}

    def look(self) -> None:
        """Apply the files if they changed; a failure is reported and changes nothing."""
        with self._lock:
            changed = self._monitored.changed(self._files.paths(self._setups))
        if not changed:
            return
        try:
            self.reload()
        except PhalanxError as error:
            self._notify(f"changed files are not used: {error}")

    def reload(self) -> None:
        """Use the files as they are now, those of all hands or none.

        Raises:
            CalibrationError: One is broken, they contradict each other, or they need a restart. Nothing has
                changed.
        """
        with self._lock:
            changed = self._use(self._files.load)
        if changed:
            self._notify("changed files are in use")

    def try_filter(self, body: str) -> None:
        """Use another 1 € filter for a rig until its files change (a `FilterTrial`).

        What has changed in the files until now is used first: the next look does not take the trial back for
        that.

        Raises:
            CalibrationError: The body is none, or of a rig that does not run. Nothing has changed.
        """
        trial = parse(body.encode(), FilterTrial, "filter")
        self.look()
        with self._lock:
            self._use(lambda: _with_filter(self._setups, trial))

    def renew(self, sender: str) -> None:
        """Replace all solvers that `sender` feeds: the state of the old may be broken."""
        with self._lock:
            for setup, pipeline in zip(self._setups, self._pipelines, strict=True):
                if sender in setup.senders:
                    pipeline.renew()
            if self._dispatcher is not None:
                self._dispatcher.prepare(self._setups)()

    def _use(self, get: Callable[[], Sequence[RigSetup]]) -> bool:
        """Use these setups, all or none; False if they were in use."""
        try:
            setups = tuple(get())
            refuse_other_hands(self._setups, setups)
            both = list(zip(self._setups, setups, self._pipelines, strict=True))
            for old, new, _ in both:
                refuse_restart(old, new)
            changed = [(old, new, line) for old, new, line in both if _content(old) != _content(new)]
            switches = [line.prepare(new) for _, new, line in changed]
            if self._dispatcher is not None and any(
                _auxiliary_inputs(old) != _auxiliary_inputs(new) for old, new, _ in both
            ):
                switches.append(self._dispatcher.prepare(setups))
        except PhalanxError:
            self._refused += 1
            raise
        if not switches:
            return False
        for switch in switches:
            switch()
        self._setups = setups
        self._applied += 1
        return True


def _with_filter(setups: Sequence[RigSetup], trial: FilterTrial) -> list[RigSetup]:
    names = [setup.rig.name for setup in setups]
    if trial.rig not in names:
        raise CalibrationError(f"filter: rig: {trial.rig!r} does not run here; there are {', '.join(names)}")
    return [
        replace(setup, rig=msgspec.structs.replace(setup.rig, filter=trial.filter))
        if setup.rig.name == trial.rig
        else setup
        for setup in setups
    ]


def _messages_per_frame(setup: RigSetup) -> int:
    """Messages of all cameras and the IMU per frame of the slowest camera, about."""
    slowest_hz = min(camera.frame_rate_hz for camera in setup.cameras.values())
    imus = [rig.imu for rig in (setup.rig, setup.wrist_rig) if rig is not None and rig.imu is not None]
    samples = max((imu.rate_hz for imu in imus), default=0.0) / slowest_hz
    return len(setup.camera_names) + ceil(samples)


def _content(setup: RigSetup) -> tuple[object, ...]:
    return setup.rig, setup.wrist_rig, setup.cameras, setup.hand.profile, setup.rows, setup.settings


def _auxiliary_inputs(setup: RigSetup) -> tuple[object, ...]:
    return setup.rig, setup.cameras, setup.hand.profile, setup.rows, setup.objects, setup.gestures
