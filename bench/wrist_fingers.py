"""Bends of five fingers by a wrist device alone, from its frames: by level, and in every light; exact truth.

Recordings, hands of a mesh (`bench.wrist_mesh`) whose joints are independent, and the six poses of the Digits study,
simulated from dark to sun. Every triple is an unrelated pose, found by the slave's detector; the device knows its palm
and the bones, not the skin. Errors are of valid fingers, those of TRACKED ones beside them; *false* are TRACKED fingers
whose PIP is off by 20 degrees or more. Baseline of the recordings: the cubic that the paper prints.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import cv2
import numpy as np
from msgspec.structs import replace as changed

from bench.oracle_recorded import angles_of
from bench.row import Row
from bench.wrist_mesh.sets import set_named, write_set
from bench.wrist_shown import RECORDINGS, ROOT, datasets
from common.arrays import Bool, Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.hand.model import CHAINS
from common.messages import WristDetections
from common.recording.frame_recording import open_recording
from common.recording.npz import read_npz
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import AMBIENTS, WristScene
from master.estimator.wrist_pipeline import WristPipeline
from master.rig.wrist import WristSetup
from slave.cameras.replay import read_png
from slave.cameras.synthetic import STROBE
from slave.sources import Frame
from slave.wrist.detector import find
from slave.wrist.strobe import StrobeCycle
from slave.wrist.view import WristView

POSES, SEEDS = 24, (301, 302, 303)
MESHES, CYCLES, MESH_SEED = ("random", "left_random"), 30, 303
FALSE_DEG = 20.0
_CYCLE_NS = 33_333_333


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a device reports of N poses, and their true angles (N, 5, 4) [rad]."""

    setup: WristSetup
    messages: Sequence[WristDetections]
    truth_rad: Float


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Errors (N, 5) [deg] of PIPs, of the thumb its MCP, NaN: not valid; and which fingers are TRACKED (N, 5)."""

    off_deg: Float
    tracked: Bool

    @classmethod
    def of(
        cls, seen: Seen, solver_mode: Literal["fk", "ik", "auto"] = "auto", *, cubic: bool = False
    ) -> Self:
        """Solve, each pose by itself."""
        line = WristPipeline(replace(seen.setup, solver_mode=solver_mode, cubic=cubic), continuous=False)
        poses = [one.pose for message in seen.messages for one in line.push(message)]
        off = np.array([pose.angles_rad for pose in poses]) - seen.truth_rad
        tracked = np.array([pose.tracked[CHAINS[:, 2]] for pose in poses])
        return cls(np.degrees(np.abs(off[..., 2])), tracked)

    @property
    def pip_deg(self) -> float:
        """Mean error of valid PIPs of index to little."""
        return float(np.nanmean(self.off_deg[:, 1:]))

    def row(self, name: str, note: str = "") -> Row:
        """For the table."""
        off, tracked = self.off_deg[:, 1:], self.tracked[:, 1:]
        known = np.isfinite(off)
        sure = off[tracked & known]
        thumb = self.off_deg[np.isfinite(self.off_deg[:, 0]), 0]
        mean, of_thumb = (float(one.mean()) if len(one) else np.nan for one in (sure, thumb))
        said = (
            f"valid {100.0 * known.mean():.0f} %; TRACKED {100.0 * tracked.mean():.0f} %, off by {mean:.1f}, false"
            f" {int((sure >= FALSE_DEG).sum())} of {len(sure)}; thumb {of_thumb:.1f}, TRACKED"
            f" {100.0 * self.tracked[:, 0].mean():.0f} %"
        )
        return Row(name, self.pip_deg, "deg", f"{said}; {note}" if note else said)


def rows() -> Iterator[Row]:
    """Rows of recordings, of meshes, and of every light."""
    cv2.setNumThreads(1)
    data = datasets()
    if (data / "wrist").is_dir():
        for name in RECORDINGS:
            seen = of_recording(data / "wrist" / name, data / "hands")
            yield Found.of(seen).row(f"{name}, recorded: PIP")
            yield Found.of(seen, "ik").row("  laser and tip (ik)")
            yield Found.of(seen, "fk").row("  laser alone, natural (fk)")
            yield Found.of(seen, "fk", cubic=True).row("  the printed cubic", "baseline")
        with tempfile.TemporaryDirectory() as folder:
            for name in MESHES:
                there = Path(folder) / name
                write_set(set_named(name, data, CYCLES, MESH_SEED), data, there, MESH_SEED)
                yield Found.of(of_recording(there, data / "hands")).row(f"{name}, mesh: PIP")
    else:
        yield Row("recordings: skipped", 0.0, "", f"none at {data}: set PHALANX_DATASETS")
    yield from _lights()


def _lights() -> Iterator[Row]:
    found = {light: _joined([Found.of(simulated(light, seed)) for seed in SEEDS]) for light in AMBIENTS}
    for light, one in found.items():
        times = one.pip_deg / found["indoor"].pip_deg
        yield one.row(f"six poses, {light}: PIP", f"{times:.2f} x indoor, goal 1.2")


def _joined(found: Sequence[Found]) -> Found:
    off, tracked = (np.concatenate([getattr(one, key) for one in found]) for key in ("off_deg", "tracked"))
    return Found(off, tracked)


def of_recording(folder: Path, hands: Path) -> Seen:
    """The triples of a recording with truth; `hands` is a folder of hand files."""
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    camera = recording.manifest.cameras[rig.cameras[0]]
    size = (camera.height_px, camera.width_px)
    frames = [
        Frame(row.seq, row.t_ns, row.t_ns, read_png(folder / row.file, size, grey=True))
        for row in recording.frames_of(camera.name)
    ]
    cycles = [StrobeCycle(*frames[k : k + 3]) for k in range(0, len(frames) - 2, 3)]
    view = WristView.of(rig, camera, load(hands / f"{rig.hand}.json", HandProfile))
    angles = angles_of(read_npz(folder / "truth.npz")["angles"])
    return Seen(WristSetup.of(rig, camera, view.model), _messages(cycles, view, camera.name), angles)


def simulated(light: str, seed: int) -> Seen:
    """The six poses, some moments of them."""
    rig = load(ROOT / "calib_json/rigs/wrist.json", RigCalibration)
    camera = load(ROOT / f"calib_json/cameras/{rig.cameras[0]}.json", CameraCalibration)
    hand = load(ROOT / f"calib_json/hands/{rig.hand}.json", HandProfile)
    scene = WristScene.by_name(f"poses@{light}", rig, {camera.name: camera}, hand, seed)
    renderer, view = WristRenderer(scene, camera.name), WristView.of(rig, camera, hand)
    times = (np.arange(POSES) + 0.5) * scene.period_s / POSES
    cycles = [
        StrobeCycle(*(Frame(k, k, k, renderer.render(float(t), kind)) for k, kind in enumerate(STROBE)))
        for t in times
    ]
    angles = np.array([scene.truth(float(t)).angles_rad for t in times])
    return Seen(WristSetup.of(rig, camera, view.model), _messages(cycles, view, camera.name), angles)


def _messages(cycles: Sequence[StrobeCycle], view: WristView, camera: str) -> list[WristDetections]:
    """What the detector finds, with times one after another."""
    found = [find(cycle, view).message(camera, session=1) for cycle in cycles]
    return [
        changed(one, seq=3 * k, t_ns=(k + 1) * _CYCLE_NS, ready_t_ns=(k + 1) * _CYCLE_NS)
        for k, one in enumerate(found)
    ]
