"""Simulate sensors: the scene of a camera, the IMU on a hand, a tracker.

A simulated IMU or tracker measures item k when its own oscillator, which is the slave's (perhaps skewed) clock, is at
`epoch + k periods`, and emits it then. A process too slow for its rate leaves items out, seen as gaps in `seq`, and
never works off a backlog. A scene that has no such sensor raises the `PhalanxError` of its kind.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from msgspec.structs import replace

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.clock import Clock, SkewedClock
from common.errors import CalibrationError, CameraError, TrackerError
from common.geometry.transforms import matrix_to_quaternion
from common.imu.csv_table import write_imu
from common.messages import ImuSample, TrackerPose
from common.recording.frame_recording import open_recording
from common.sim.board import BoardScene
from common.sim.scene import Scene
from common.sim.scenes import view_by_name
from common.sim.sensors import SimulatedImu, SimulatedTracker
from common.sim.wrist.scene import WristScene

ItemT = TypeVar("ItemT", ImuSample, TrackerPose)
TRACKER_HZ = 100.0  # poses per second of the simulated tracker


class FrameClock(Clock):
    """The time of a scene that goes on only where somebody sleeps in it."""

    def __init__(self, start_ns: int) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Return the time [ns]."""
        return self._now_ns

    def sleep(self, seconds: float) -> None:
        """Let so many seconds be over."""
        self._now_ns += round(seconds * 1e9)


class SyntheticSensor(Generic[ItemT]):
    """A `Source` that measures the scene of the synthetic cameras."""

    def __init__(
        self,
        measure: Callable[[int, float, int], ItemT],
        rate_hz: float,
        epoch_ns: int,
        clock: SkewedClock,
        stop: threading.Event,
    ) -> None:
        """Measure items by number, time of the scene [s] and stamp [ns] from the epoch."""
        self._measure, self._rate_hz = measure, rate_hz
        self._epoch_ns, self._clock, self._stop = epoch_ns, clock, stop
        self._first_ns = clock.from_true(epoch_ns)
        self._next = 0
        self._started = self._closed = False

    def read(self) -> ItemT | None:
        """Measure the next item and wait until it is due; None once closed or stopped."""
        seq = self._due_next()
        t_ns = self._measured_ns(seq)
        item = self._measure(seq, (self._clock.to_true(t_ns) - self._epoch_ns) * 1e-9, t_ns)
        while not (self._closed or self._stop.is_set()):
            if (left_ns := t_ns - self._clock.now_ns()) <= 0:
                self._next, self._started = seq + 1, True
                return item
            self._stop.wait(left_ns * 1e-9)
        return None

    def close(self) -> None:
        """End the stream."""
        self._closed = True

    def _due_next(self) -> int:
        """The item after the last, or the first to come where that is half a period late."""
        late_ns = self._clock.now_ns() - self._measured_ns(self._next)
        period_ns = 1e9 / self._rate_hz
        if late_ns <= (0.5 * period_ns if self._started else 0.0):
            return self._next
        return self._next + int(late_ns // period_ns) + 1

    def _measured_ns(self, seq: int) -> int:
        """When item `seq` is measured, own clock [ns]."""
        return self._first_ns + round(seq * 1e9 / self._rate_hz)


def world_of(
    assumed: Path, rig: RigCalibration, truth: Path | None, name: str | None
) -> tuple[Path, RigCalibration]:
    """Folder and rig of the simulated world: the slave's own, unless given.

    Places and lenses of the slave's own rig may be unknown; the tree `truth` and its rig `name`, else of the same
    name, know them.

    Raises:
        CalibrationError: That rig is of another kind, lacks cameras, or one of its files is missing or broken.
    """
    if truth is None:
        if name is not None:
            raise CalibrationError(f"--truth-rig {name}: needs --truth DIR, the tree that it is in")
        return assumed, rig
    path = truth / "rigs" / f"{rig.name if name is None else name}.json"
    true = load(path, RigCalibration)
    if true.kind != rig.kind:
        raise CalibrationError(
            f"{path}: kind: the true rig is one of {true.kind}, rig {rig.name!r} of {rig.kind}"
        )
    if strange := [camera for camera in rig.cameras if camera not in true.cameras]:
        raise CalibrationError(
            f"{path}: cameras: the true rig has no {', '.join(strange)}, only {', '.join(true.cameras)}: name the "
            f"cameras of rig {rig.name!r} so, or take another one (--truth-rig)"
        )
    return truth, true


def scene_of(calibration: Path, rig: RigCalibration, name: str, seed: int) -> Scene | BoardScene | WristScene:
    """The scene `name` before a rig's cameras, from files of a calib_json tree."""
    names = rig.hand, *rig.other_hands
    hand, *others = (load(calibration / "hands" / f"{n}.json", HandProfile) for n in names)
    cameras = {n: load(calibration / "cameras" / f"{n}.json", CameraCalibration) for n in rig.cameras}
    objects = {n: load(calibration / "objects" / f"{n}.json", ObjectProfile) for n in rig.objects}
    return view_by_name(name, rig, cameras, hand, seed, objects, others)


def imu_of(camera: str, calibration: Path, rig: RigCalibration, name: str, seed: int) -> SimulatedImu:
    """The IMU on the hand that a camera, by its driver, sees in a scene."""
    scene = scene_of(calibration, rig, name, seed) if camera == "synthetic" else None
    if not isinstance(scene, Scene | WristScene):
        raise CameraError(
            f"--imu: only a hand before a synthetic camera has one, not {camera} with scene {name}"
        )
    return SimulatedImu.of(scene)


def tracker_of(
    calibration: Path, rig: RigCalibration, name: str, seed: int, profile: ObjectProfile
) -> SimulatedTracker:
    """The tracker on an object that synthetic cameras see in the scene `name`."""
    scene = scene_of(calibration, rig, name, seed)
    if not isinstance(scene, Scene):
        raise TrackerError(f"--scene {name}: there is no object in it that a tracker could sit on")
    return SimulatedTracker.of(scene, profile, seed)


def poses_of(name: str, tracker: SimulatedTracker) -> Callable[[int, float, int], TrackerPose]:
    """What a `SyntheticSensor` measures of tracker `name`; NaN where it is lost."""

    def measure(seq: int, t_s: float, t_ns: int) -> TrackerPose:
        pose = tracker.pose(t_s)
        if pose is None:
            return TrackerPose(name, 0, seq, t_ns, np.full(3, np.nan), np.full(4, np.nan))
        return TrackerPose(name, 0, seq, t_ns, pose[:3, 3], matrix_to_quaternion(pose[:3, :3]))

    return measure


def add_imu(folder: Path, imu: SimulatedImu, epoch_ns: int, clock: SkewedClock) -> None:
    """Add what the IMU measured meanwhile; scene time 0 is at `epoch_ns`."""
    taken_s = [(clock.to_true(row.t_ns) - epoch_ns) * 1e-9 for row in open_recording(folder).rows]
    samples = imu.around(min(taken_s), max(taken_s), epoch_ns)
    write_imu(folder, (replace(one, t_ns=clock.from_true(one.t_ns)) for one in samples))
