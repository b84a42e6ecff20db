"""Export a rendered wrist sequence as raw frames with exact truth.

The form is that of every recording of a wrist device: strobe cycles in the order ambient, laser, LED, and a truth
with one row per strobe cycle, under the keys of rendered recordings.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from common.hand.model import FINGERS, WEBXR_JOINTS
from common.recording.frame_recording import Illumination, Manifest
from common.sim.record import (
    ANGLE_NAMES,
    FIRST_NS,
    Arrays,
    RenderedFrame,
    named_angles,
    write_frames,
    write_truth,
)
from common.sim.wrist.capsules import GROUPS
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene

_LINE = ("laser_uv", "laser_pt", "laser_xyz", "laser_len_vis", "laser_len_lit", "laser_seg")
_TIPS = ("tip_xyz", "tip_uv", "tip_visible")
ORDER = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)


class Shot(NamedTuple):
    """One frame to be taken: stamp [ns], scene time [s]."""

    t_ns: int
    t_s: float


def record_wrist(
    folder: Path,
    scene: WristScene,
    seconds: float = 0.0,
    *,
    start_s: float = 0.0,
    poses_s: Sequence[float] = (),
    step: int = 1,
) -> int:
    """Render a scene as its camera takes it and return the number of strobe cycles.

    Args:
        folder: New or empty.
        seconds: How long [s]; at least one strobe cycle is written.
        start_s: Scene time of the first frame [s].
        poses_s: Scene times [s] instead: every strobe cycle is a pose of its own, in which the hand stands
            still.
        step: Pixels between the rays that shade skin (`WristRenderer`).

    Raises:
        RecordingError: The folder holds something already, or cannot be written.
    """
    take = WristTake(scene, seconds, start_s=start_s, poses_s=poses_s)
    write_frames(folder, take.manifest(), take.frames(step))
    write_truth(folder, take.truth(), take.meta())
    return take.count


class WristTake:
    """Frames that a wrist camera takes of a scene, with the exact truth."""

    def __init__(
        self, scene: WristScene, seconds: float, *, start_s: float = 0.0, poses_s: Sequence[float] = ()
    ) -> None:
        """As `record_wrist`."""
        self._scene, self._name = scene, scene.rig.cameras[0]
        period_s = 1.0 / scene.cameras[self._name].frame_rate_hz
        self.count = len(poses_s) or max(round(seconds / (3.0 * period_s)), 1)
        self._continuous = not poses_s
        self._shots = [
            Shot(FIRST_NS + round(k * period_s * 1e9), poses_s[k // 3] if poses_s else start_s + k * period_s)
            for k in range(3 * self.count)
        ]

    def manifest(self) -> Manifest:
        """Return the manifest."""
        scene = self._scene
        return Manifest(
            version=1,
            kind="wrist",
            cameras={self._name: scene.cameras[self._name]},
            rig=scene.rig,
            continuous=self._continuous,
            note=f"rendered wrist scene, {scene.ambient} light, seed {scene.seed}",
        )

    def frames(self, step: int) -> Iterator[RenderedFrame]:
        """All frames."""
        renderer = WristRenderer(self._scene, self._name, step)
        for k, shot in enumerate(self._shots):
            lit = ORDER[k % 3]
            yield RenderedFrame(self._name, k, shot.t_ns, lit, renderer.render(shot.t_s, lit))

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
            **{key: np.array([getattr(truth, key) for truth in at_laser]) for key in _LINE},
            **{key: np.array([getattr(truth, key) for truth in at_led]) for key in _TIPS},
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
