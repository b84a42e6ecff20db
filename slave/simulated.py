"""What a simulated sensor beside this slave senses: the scene before its camera, and the IMU on the hand in it; and the
time of a scene that waits for whoever draws it."""

from pathlib import Path

from msgspec.structs import replace

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.clock import SkewedClock
from common.errors import CalibrationError, CameraError, TrackerError
from common.frame_recording import open_recording
from common.imu_recording import write_imu
from common.object_profile import ObjectProfile
from common.sim.board import BoardScene
from common.sim.imu import SimulatedImu
from common.sim.scene import Scene
from common.sim.scenes import view_by_name
from common.sim.tracker import SimulatedTracker
from common.sim.wrist.scene import WristScene


class FrameClock:
    """The time of a scene that waits: it goes on only where somebody sleeps in it. Holds the time."""

    def __init__(self, start_ns: int) -> None:
        """Begin at a time [ns]."""
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Return the time [ns]."""
        return self._now_ns

    def sleep(self, seconds: float) -> None:
        """Let so many seconds be over."""
        self._now_ns += round(seconds * 1e9)


def world_of(
    assumed: Path, rig: RigCalibration, truth: Path | None, name: str | None
) -> tuple[Path, RigCalibration]:
    """Folder and rig that say how the simulated world is: those that the slave believes, unless it is told otherwise.

    Args:
        believed: The calib_json tree of the slave.
        rig: Its rig, of which places and lenses may be unknown.
        truth: Another tree, which knows them; None: the slave believes the truth.
        name: The rig there; None: the one of the same name.

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
    """The scene `name` before the cameras of a rig, from the files of a calib_json tree.

    Raises:
        PhalanxError: As `view_by_name`; a file is missing or broken.
    """
    hand = load(calibration / "hands" / f"{rig.hand}.json", HandProfile)
    cameras = {n: load(calibration / "cameras" / f"{n}.json", CameraCalibration) for n in rig.cameras}
    objects = {n: load(calibration / "objects" / f"{n}.json", ObjectProfile) for n in rig.objects}
    return view_by_name(name, rig, cameras, hand, seed, objects)


def imu_of(camera: str, calibration: Path, rig: RigCalibration, name: str, seed: int) -> SimulatedImu:
    """The IMU on the hand that a camera, given by its driver, sees in the scene `name`.

    Raises:
        CameraError: The camera is not synthetic, or there is no hand before it.
        PhalanxError: As `scene_of`, and `SimulatedImu.of`.
    """
    scene = scene_of(calibration, rig, name, seed) if camera == "synthetic" else None
    if not isinstance(scene, Scene | WristScene):
        raise CameraError(
            f"--imu: only a hand before a synthetic camera has one, not {camera} with scene {name}"
        )
    return SimulatedImu.of(scene)


def tracker_of(
    calibration: Path, rig: RigCalibration, name: str, seed: int, profile: ObjectProfile
) -> SimulatedTracker:
    """The tracker on an object that synthetic cameras see in the scene `name`.

    Raises:
        TrackerError: There is no object in that scene.
        PhalanxError: As `scene_of`, and `SimulatedTracker.of`.
    """
    scene = scene_of(calibration, rig, name, seed)
    if not isinstance(scene, Scene):
        raise TrackerError(f"--scene {name}: there is no object in it that a tracker could sit on")
    return SimulatedTracker.of(scene, profile, seed)


def add_imu(folder: Path, imu: SimulatedImu, epoch_ns: int, clock: SkewedClock) -> None:
    """Write into a recording what the IMU said meanwhile, on the clock of the frames; scene time 0 is at `epoch_ns`.

    Raises:
        RecordingError: The recording is broken, or the file cannot be written.
    """
    taken_s = [(clock.to_true(row.t_ns) - epoch_ns) * 1e-9 for row in open_recording(folder).rows]
    samples = imu.around(min(taken_s), max(taken_s), epoch_ns)
    write_imu(folder, (replace(one, t_ns=clock.from_true(one.t_ns)) for one in samples))
