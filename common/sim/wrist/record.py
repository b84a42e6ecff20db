"""Export writes a wrist sequence, alone or together with marker cameras.

The form is that of every recording of a wrist device: strobe cycles in the order ambient, laser, LED, and a truth
with one row per strobe cycle, under the keys of rendered recordings. The order of the frames can be spoiled.

Together with marker cameras it is one recording of kind `both`: all frames are on one clock, in the order of their
stamps, and so are the samples of the wrist device's IMU. The truth is that of a marker recording, and beside it that
of a wrist recording, its keys prefixed with `wrist_`.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from msgspec.structs import replace

from common.calibration import RigCalibration
from common.hand.model import FINGERS, WEBXR_JOINTS
from common.imu.csv_table import write_imu
from common.recording.frame_recording import Illumination, Manifest
from common.sim.record import (
    ANGLE_NAMES,
    FIRST_NS,
    Arrays,
    RenderedFrame,
    SceneTake,
    named_angles,
    write_frames,
    write_truth,
)
from common.sim.scene import Scene
from common.sim.sensors import SimulatedImu
from common.sim.wrist.capsules import GROUPS
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene

ORDER = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame to be taken: number, stamp [ns], scene time [s], illumination."""

    seq: int
    t_ns: int
    t_s: float
    lit: Illumination


def with_faults(
    frames: Sequence[T], rng: np.random.Generator, drop: float = 0.0, double: float = 0.0, swap: float = 0.0
) -> list[T]:
    """Lose, double or delay frames, with these probabilities, as a faulty link does.

    A frame suffers at most one of the three; the frame that another one was swapped with suffers none.
    """
    fate = rng.uniform(size=len(frames))
    out: list[T] = []
    held: list[T] = []
    for frame, chance in zip(frames, fate.tolist(), strict=True):
        if held:
            out += [frame, held.pop()]
        elif chance >= drop + double + swap:
            out.append(frame)
        elif chance >= drop + double:
            held.append(frame)
        elif chance >= drop:
            out += [frame, frame]
    return out + held


def record_wrist(
    folder: Path,
    scene: WristScene,
    seconds: float = 0.0,
    *,
    start_s: float = 0.0,
    poses_s: Sequence[float] = (),
    faults: Callable[[list[Shot]], list[Shot]] | None = None,
    step: int = 1,
    rig: RigCalibration | None = None,
) -> int:
    """Render a scene as its camera takes it and return the number of strobe cycles.

    Args:
        folder: New or empty.
        seconds: How long [s]; at least one strobe cycle is written.
        start_s: Scene time of the first frame [s].
        poses_s: Scene times [s] instead: every strobe cycle is a pose of its own, in which the hand stands
            still.
        faults: Makes of all frames those that are delivered, such as `with_faults`; stamps and numbers go on
            rising.
        step: Pixels between the rays that shade skin (`WristRenderer`).
        rig: The device by its manifest; None: the truth.

    Raises:
        RecordingError: The folder holds something already, or cannot be written.
    """
    take = WristTake(scene, seconds, start_s=start_s, poses_s=poses_s, faults=faults, step=step)
    write_frames(folder, take.manifest(rig), take.frames())
    write_truth(folder, take.truth(), take.meta())
    return take.count


class WristTake:
    """Frames that a wrist camera takes of a scene, with the exact truth."""

    def __init__(
        self,
        scene: WristScene,
        seconds: float = 0.0,
        *,
        start_s: float = 0.0,
        poses_s: Sequence[float] = (),
        faults: Callable[[list[Shot]], list[Shot]] | None = None,
        step: int = 1,
        first_ns: int = FIRST_NS,
    ) -> None:
        """As `record_wrist`; `first_ns` is the stamp of the first frame."""
        self._scene, self._step, self._first_ns = scene, step, first_ns
        self._name = scene.rig.cameras[0]
        self._period_s = 1.0 / scene.cameras[self._name].frame_rate_hz
        self.count = len(poses_s) or max(round(seconds / (3.0 * self._period_s)), 1)
        self._continuous, self._faults = not poses_s, faults
        times = [poses_s[k // 3] if poses_s else start_s + k * self._period_s for k in range(3 * self.count)]
        self._shots = [Shot(k, self._stamp(k), t, ORDER[k % 3]) for k, t in enumerate(times)]

    @property
    def span_s(self) -> tuple[float, float]:
        """Scene times [s] of the first and the last frame."""
        return self._shots[0].t_s, self._shots[-1].t_s

    def manifest(self, rig: RigCalibration | None = None) -> Manifest:
        """Return the manifest, with the device as `rig` states; None: the truth."""
        scene = self._scene
        return Manifest(
            version=1,
            kind="wrist",
            cameras={self._name: scene.cameras[self._name]},
            rig=rig or scene.rig,
            continuous=self._continuous,
            note=f"rendered wrist scene, {scene.ambient} light, seed {scene.seed}",
        )

    def frames(self) -> Iterator[RenderedFrame]:
        """All frames that are delivered."""
        renderer = WristRenderer(self._scene, self._name, self._step)
        shots = self._shots if self._faults is None else self._faults(self._shots)
        for shot, seq in _numbered(shots):
            yield RenderedFrame(
                self._name, seq, self._stamp(seq), shot.lit, renderer.render(shot.t_s, shot.lit)
            )

    def truth(self) -> Arrays:
        """Return the ground truth, one row per strobe cycle.

        The hand and the line at its laser frame, the finger tips at its LED frame.
        """
        scene = self._scene
        lasers, leds = self._shots[1::3], self._shots[2::3]
        at_laser = [scene.truth(shot.t_s) for shot in lasers]
        at_led = [
            before if led.t_s == laser.t_s else scene.truth(led.t_s)
            for before, laser, led in zip(at_laser, lasers, leds, strict=True)
        ]
        return {
            "t_ns": np.array([shot.t_ns for shot in lasers]),
            "ambient": np.array([scene.ambient] * len(lasers)),
            "angles": np.array([named_angles(scene.model, truth.angles_rad) for truth in at_laser]),
            "joints": np.array([truth.joints.position_m[1:] for truth in at_laser]),
            "flexion": np.array([truth.wrist_angles_rad for truth in at_laser]),
            "laser_uv": np.array([truth.laser_uv for truth in at_laser]),
            "laser_pt": np.array([truth.laser_pt for truth in at_laser]),
            "laser_xyz": np.array([truth.laser_xyz for truth in at_laser]),
            "laser_len_vis": np.array([truth.laser_len_vis for truth in at_laser]),
            "laser_len_lit": np.array([truth.laser_len_lit for truth in at_laser]),
            "laser_seg": np.array([truth.laser_seg for truth in at_laser]),
            "tip_xyz": np.array([truth.tip_xyz for truth in at_led]),
            "tip_uv": np.array([truth.tip_uv for truth in at_led]),
            "tip_visible": np.array([truth.tip_visible for truth in at_led]),
        }

    def meta(self) -> dict[str, object]:
        """What the columns of the truth are."""
        scene = self._scene
        return {
            "scene": "wrist",
            "side": scene.model.profile.side,
            "frames": self.count,
            "groups": GROUPS,
            "fingers": FINGERS,
            "joints": WEBXR_JOINTS,
            "angles": ANGLE_NAMES,
            "ambient": scene.ambient,
            "seed": scene.seed,
            "note": "angles, joints and laser at the laser frame, finger tips at the LED frame of each strobe cycle",
        }

    def _stamp(self, seq: int) -> int:
        return self._first_ns + round(seq * self._period_s * 1e9)


def _numbered(shots: list[Shot]) -> list[tuple[Shot, int]]:
    """Number shots as delivered: a loss leaves a gap, what comes twice takes a frame."""
    out: list[tuple[Shot, int]] = []
    more = 0
    last: int | None = None
    for shot, own in zip(shots, sorted(shot.seq for shot in shots), strict=True):
        more += own == last
        last = own
        out.append((shot, own + more))
    return out


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
