"""Export of one hand seen by marker cameras and its wrist device simultaneously.

The result is one recording of kind `both`.

All frames are on one clock, in the order of their stamps, and so are the samples of the wrist device's IMU. The truth
is that of a marker recording, and beside it that of a wrist recording, its keys prefixed with `wrist_`.
"""

import heapq
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from common.calibration import RigCalibration
from common.imu.recording import write_imu
from common.sim.imu import SimulatedImu
from common.sim.record import FIRST_NS, SceneTake, write_frames, write_truth
from common.sim.scene import Scene
from common.sim.wrist.record import WristTake
from common.sim.wrist.scene import WristScene


def record_both(
    folder: Path,
    marker_scene: Scene,
    wrist_scene: WristScene,
    seconds: float,
    start_s: float = 0.0,
    *,
    imu: bool = True,
    wrist_late_ns: int = 0,
    step: int = 1,
    wrist_rig: RigCalibration | None = None,
) -> tuple[int, int]:
    """Render `seconds` of two scenes of one motion.

    Returns the number of frames per marker camera, and of strobe cycles.

    Args:
        folder: New or empty.
        marker_scene: The hand before marker cameras.
        wrist_scene: The same hand with its wrist device; places in the room may differ.
        seconds: How long [s].
        start_s: Scene time of the first frame [s].
        imu: Whether the IMU of the wrist device is recorded too, a little longer than the frames.
        wrist_late_ns: By how much the stamps of the wrist camera are too late [ns]: a clock error.
        step: Pixels between the rays that shade skin (`WristRenderer`).
        wrist_rig: The wrist device by its manifest; None: the truth.

    Raises:
        CalibrationError: The wrist device has no IMU, or it is not known how that is mounted.
        RecordingError: The folder holds something already, or cannot be written.
        ValueError: The scenes are not of one motion of one hand.
    """
    _check_alike(marker_scene, wrist_scene, (start_s, start_s + seconds))
    sensor = SimulatedImu.of(wrist_scene) if imu else None
    seen = SceneTake(marker_scene, seconds, start_s)
    first_ns = FIRST_NS + round(start_s * 1e9) + wrist_late_ns
    device = WristTake(wrist_scene, seconds, start_s=start_s, step=step, first_ns=first_ns)
    of_markers, of_wrist = seen.manifest(), device.manifest(wrist_rig)
    manifest = replace(
        of_markers,
        kind="both",
        cameras={**of_markers.cameras, **of_wrist.cameras},
        rigs=(wrist_rig or wrist_scene.rig,),
        note=f"{of_markers.note}; {of_wrist.note}",
    )
    frames = heapq.merge(seen.frames(), device.frames(), key=lambda frame: frame.t_ns)
    write_frames(folder, manifest, frames)
    if sensor is not None:
        first, last = zip(seen.span_s, device.span_s, strict=True)
        write_imu(folder, sensor.around(min(first), max(last), FIRST_NS))
    truth = seen.truth() | {f"wrist_{key}": value for key, value in device.truth().items()}
    meta = seen.meta() | {"scene": "both", "wrist": device.meta(), "wrist_late_ns": wrist_late_ns}
    write_truth(folder, truth, meta)
    return seen.count, device.count


def _check_alike(marker_scene: Scene, wrist_scene: WristScene, times_s: tuple[float, ...]) -> None:
    """Whatever the two rigs see, it is the fingers and the wrist of one hand."""
    hands = marker_scene.model.profile.name, wrist_scene.model.profile.name
    if hands[0] != hands[1]:
        raise ValueError(f"hands differ: {hands[0]!r} and {hands[1]!r}")
    for t_s in times_s:
        seen, device = marker_scene.motion.at(t_s), wrist_scene.motion.at(t_s)
        if not (
            np.array_equal(seen.angles_rad, device.angles_rad)
            and np.array_equal(seen.wrist_angles_rad, device.wrist_angles_rad)
        ):
            raise ValueError(f"the scenes move differently at {t_s} s")
