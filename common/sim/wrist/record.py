"""Write a simulated wrist sequence as a recording of raw frames with its exact truth; and spoil its order.

The form is that of every recording of a wrist device: strobed triples in the order ambient, laser, LED, and a truth
with one row per triple, under the keys of rendered recordings.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from common.calibration import RigCalibration
from common.errors import RecordingError
from common.frame_recording import Illumination, Manifest
from common.frame_writing import RecordingWriter, encode_png
from common.hand_model import FINGERS, WEBXR_JOINTS
from common.sim.record import ANGLE_NAMES, FIRST_NS, TRUTH, TRUTH_META, named_angles
from common.sim.wrist.flesh import GROUPS
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene

ORDER = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Shot:
    """One frame to be taken: frame number, stamp [ns], scene time [s], what lights it."""

    seq: int
    t_ns: int
    t_s: float
    lit: Illumination


def with_faults(
    frames: Sequence[T], rng: np.random.Generator, drop: float = 0.0, double: float = 0.0, swap: float = 0.0
) -> list[T]:
    """Frames as a bad camera or link delivers them: each with these probabilities lost, twice, or after the next one.

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
    """Render a scene as its camera takes it; return the number of triples.

    Args:
        folder: New or empty.
        scene: What to render.
        seconds: How long [s]; at least one triple is written.
        start_s: Scene time of the first frame [s].
        poses_s: Scene times [s] instead: every triple is a pose of its own, in which the hand stands still.
        faults: Makes of all frames those that are delivered, such as `with_faults`; stamps and numbers go on rising.
        step: Pixels between the rays that shade skin (`WristRenderer`).
        rig: What the manifest says of the device; None: the truth.

    Raises:
        RecordingError: The folder holds something already, or cannot be written.
    """
    name = scene.rig.cameras[0]
    period = 1.0 / scene.cameras[name].frame_rate_hz
    count = len(poses_s) or max(round(seconds / (3.0 * period)), 1)
    times = [poses_s[k // 3] if poses_s else start_s + k * period for k in range(3 * count)]
    shots = [Shot(k, FIRST_NS + round(k * period * 1e9), t, ORDER[k % 3]) for k, t in enumerate(times)]
    manifest = Manifest(
        version=1,
        kind="wrist",
        cameras={name: scene.cameras[name]},
        rig=rig or scene.rig,
        continuous=not poses_s,
        note=f"rendered wrist scene, {scene.ambient} light, seed {scene.seed}",
    )
    renderer = WristRenderer(scene, name, step)
    writer = RecordingWriter(folder, manifest)
    try:
        for shot, (seq, t_ns) in _stamped(shots if faults is None else faults(shots), period):
            writer.add(name, seq, t_ns, shot.lit, encode_png(renderer.render(shot.t_s, shot.lit)))
    finally:
        writer.close()
    try:
        _write_truth(folder, scene, shots)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot write: {error.strerror}") from error
    return count


def _stamped(shots: list[Shot], period_s: float) -> list[tuple[Shot, tuple[int, int]]]:
    """Shots with number and stamp [ns] of their delivery: what is lost leaves a gap, what comes twice takes a frame."""
    out: list[tuple[Shot, tuple[int, int]]] = []
    more = 0
    last: int | None = None
    for shot, own in zip(shots, sorted(shot.seq for shot in shots), strict=True):
        more += own == last
        last = own
        out.append((shot, (own + more, FIRST_NS + round((own + more) * period_s * 1e9))))
    return out


def _write_truth(folder: Path, scene: WristScene, shots: list[Shot]) -> None:
    """One row per triple: the hand and the line at its laser frame, the finger tips at its LED frame."""
    lasers, leds = shots[1::3], shots[2::3]
    at_laser = [scene.truth(shot.t_s) for shot in lasers]
    at_led = [
        before if led.t_s == laser.t_s else scene.truth(led.t_s)
        for before, laser, led in zip(at_laser, lasers, leds, strict=True)
    ]

    np.savez(
        folder / TRUTH,
        t_ns=np.array([shot.t_ns for shot in lasers]),
        ambient=np.array([scene.ambient] * len(lasers)),
        angles=np.array([named_angles(scene.model, truth.angles_rad) for truth in at_laser]),
        joints=np.array([truth.joints.position_m[1:] for truth in at_laser]),
        laser_uv=np.array([truth.laser_uv for truth in at_laser]),
        laser_pt=np.array([truth.laser_pt for truth in at_laser]),
        laser_xyz=np.array([truth.laser_xyz for truth in at_laser]),
        laser_len_vis=np.array([truth.laser_len_vis for truth in at_laser]),
        laser_len_lit=np.array([truth.laser_len_lit for truth in at_laser]),
        laser_seg=np.array([truth.laser_seg for truth in at_laser]),
        tip_xyz=np.array([truth.tip_xyz for truth in at_led]),
        tip_uv=np.array([truth.tip_uv for truth in at_led]),
        tip_visible=np.array([truth.tip_visible for truth in at_led]),
    )
    meta = {
        "scene": "wrist",
        "side": scene.model.profile.side,
        "frames": len(lasers),
        "groups": GROUPS,
        "fingers": FINGERS,
        "joints": WEBXR_JOINTS,
        "angles": ANGLE_NAMES,
        "ambient": scene.ambient,
        "seed": scene.seed,
        "note": "angles, joints and laser at the laser frame, finger tips at the LED frame of each triple",
    }
    (folder / TRUTH_META).write_bytes(msgspec.json.format(msgspec.json.encode(meta), indent=1))
