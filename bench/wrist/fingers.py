"""Joint angles of five fingers by a wrist device alone, from its frames: by level, and in every light; exact truth.

Recordings, and the six poses of the Digits study, simulated from dark to sun. Every cycle is an unrelated pose, found
by the slave's detector; the device knows its palm and the bones, not the skin. Errors are of valid fingers, those of
TRACKED ones beside them; *false*: TRACKED, PIP off by 20 degrees or more. Baseline: the cubic that the paper prints.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import cv2
import numpy as np
from msgspec.structs import replace as changed

from bench.oracle.sets import angles_of
from bench.report import Row, datasets, rig_files, skipped
from bench.wrist.frames import RECORDINGS, drawn, recorded
from common.arrays import Bool, Float
from common.hand.model import CHAINS
from common.messages import WristDetections
from common.sim.wrist.scene import AMBIENTS, WristScene
from master.estimator.wrist_pipeline import WristPipeline
from master.rig.setup import WristSetup
from slave.wrist.detector import find
from slave.wrist.led_image import WristView
from slave.wrist.strobe import StrobeCycle

_SEEDS = (301, 302, 303)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Messages of a device of N poses, and their true angles (N, 5, 4) [rad]."""

    setup: WristSetup
    messages: Sequence[WristDetections]
    truth_rad: Float


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Errors (N, 5) [deg] of PIPs, of the thumb its MCP, NaN: not valid; and which fingers are TRACKED (N, 5)."""

    off_deg: Float
    tracked: Bool

    @classmethod
    def of(cls, seen: Seen, level: Literal["fk", "ik", "auto"] = "auto", *, cubic: bool = False) -> Self:
        """Solve, each pose by itself."""
        line = WristPipeline(replace(seen.setup, solver_mode=level, cubic=cubic), continuous=False)
        poses = [one.pose for message in seen.messages for one in line.push(message)]
        off = np.array([pose.angles_rad for pose in poses]) - seen.truth_rad
        tracked = np.array([pose.tracked[CHAINS[:, 2]] for pose in poses])
        return cls(np.degrees(np.abs(off[..., 2])), tracked)

    @property
    def pip_deg(self) -> float:
        """Mean error of valid PIPs of index to little."""
        return float(np.nanmean(self.off_deg[:, 1:]))

    def row(self, name: str, note: str = "") -> Row:
        """Return the row of the table."""
        off, tracked = self.off_deg[:, 1:], self.tracked[:, 1:]
        known = np.isfinite(off)
        sure = off[tracked & known]
        thumb = self.off_deg[np.isfinite(self.off_deg[:, 0]), 0]
        mean, of_thumb = (float(one.mean()) if len(one) else np.nan for one in (sure, thumb))
        false_deg = 20.0
        text = (
            f"valid {100.0 * known.mean():.0f} %; TRACKED {100.0 * tracked.mean():.0f} %, off by {mean:.1f}, false"
            f" {int((sure >= false_deg).sum())} of {len(sure)}; thumb {of_thumb:.1f}, TRACKED"
            f" {100.0 * self.tracked[:, 0].mean():.0f} %"
        )
        return Row(name, self.pip_deg, "deg", f"{text}; {note}" if note else text)


def rows() -> Iterator[Row]:
    """Measure recordings and every light."""
    cv2.setNumThreads(1)
    data = datasets()
    if (data / "wrist").is_dir():
        for name in RECORDINGS:
            seen = of_recording(data / "wrist" / name, data / "hands")
            yield Found.of(seen).row(f"{name}, recorded: PIP")
            yield Found.of(seen, "ik").row("  laser and tip (ik)")
            yield Found.of(seen, "fk").row("  laser alone, natural (fk)")
            yield Found.of(seen, "fk", cubic=True).row("  the printed cubic", "baseline")
    else:
        yield skipped("recordings", data / "wrist")
    found = {light: _joined([Found.of(simulated(light, seed)) for seed in _SEEDS]) for light in AMBIENTS}
    for light, one in found.items():
        yield one.row(
            f"six poses, {light}: PIP", f"{one.pip_deg / found['indoor'].pip_deg:.2f} x indoor, goal 1.2"
        )


def _joined(found: Sequence[Found]) -> Found:
    off, tracked = (np.concatenate([getattr(one, key) for one in found]) for key in ("off_deg", "tracked"))
    return Found(off, tracked)


def of_recording(folder: Path, hands: Path) -> Seen:
    """Detect in a recording with truth; `hands` is a folder of hand files."""
    read = recorded(folder, hands)
    messages = _messages(read.cycles, read.view, read.camera.name)
    return Seen(
        WristSetup.of(read.rig, read.camera, read.view.model), messages, angles_of(read.truth["angles"])
    )


def simulated(light: str, seed: int) -> Seen:
    """Render and detect some moments of the six poses."""
    rig, cameras, hand = rig_files("wrist")
    camera = cameras[rig.cameras[0]]
    scene = WristScene.by_name(f"poses@{light}", rig, cameras, hand, seed)
    view = WristView.of(rig, camera, hand)
    poses = 24
    times = (np.arange(poses) + 0.5) * scene.period_s / poses
    angles = np.array([scene.truth(float(t)).angles_rad for t in times])
    messages = _messages(drawn(scene, camera.name, times), view, camera.name)
    return Seen(WristSetup.of(rig, camera, view.model), messages, angles)


def _messages(cycles: Sequence[StrobeCycle], view: WristView, camera: str) -> list[WristDetections]:
    """The detector's messages, with times one after another."""
    found = [find(cycle, view).message(camera, session=1) for cycle in cycles]
    times = [(k + 1) * 33_333_333 for k in range(len(found))]
    return [
        changed(m, seq=3 * k, t_ns=t, ready_t_ns=t) for k, (m, t) in enumerate(zip(found, times, strict=True))
    ]
