"""The recordings by name, and writing one."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from bench.wrist_mesh.poses import curling, natural, random_pose, spread, straight
from bench.wrist_mesh.render import ORDER, Arrays, Device, Moment, View
from bench.wrist_mesh.room import LEVELS, Room, behind
from bench.wrist_mesh.truth import FINGERS, GROUPS
from common.arrays import Float
from common.calibration import HandProfile, load
from common.hand.model import WEBXR_JOINTS, HandModel
from common.recording.frame_recording import Manifest, load_manifest
from common.sim.record import ANGLE_NAMES, FIRST_NS, RenderedFrame, write_frames, write_truth

PERIOD_S = 1.0 / 90.0
STRAIGHT = np.zeros(2)


@dataclass(frozen=True, slots=True, eq=False)
class Set:
    """What to render.

    Attributes:
        name: Also of its folder.
        like: The rendered recording whose device and hand it has.
        note: What it shows.
        moments: Of each triple the three moments of its frames.
        continuous: Whether the triples follow each other.
        light: A key of `LEVELS`.
    """

    name: str
    like: str
    note: str
    moments: list[tuple[Moment, Moment, Moment]]
    continuous: bool = False
    light: str = "indoor"


NAMES = ("random", "left_random", "curl", "mcp", "spread", "six", "motion", "moving_palm")


def set_named(name: str, datasets: Path, frames: int | None, seed: int) -> Set:
    """The set `name`, or `name@light`.

    Raises:
        ValueError: There is none of that name or light.
    """
    kind, _, light = name.partition("@")
    light = light or "indoor"
    if kind not in NAMES or light not in LEVELS:
        raise ValueError(
            f"set {name!r}: must be one of {', '.join(NAMES)}, then @ and one of {', '.join(LEVELS)}"
        )
    return replace(_made(kind, datasets, frames, np.random.default_rng(seed)), name=name, light=light)


def _made(kind: str, datasets: Path, frames: int | None, rng: np.random.Generator) -> Set:
    if kind in ("random", "left_random"):
        like = "curl" if kind == "random" else "left_small"
        hand = load_manifest(datasets / "wrist" / like).wrist_rig().hand
        model = HandModel.of(load(datasets / "hands" / f"{hand}.json", HandProfile))
        poses = [random_pose(model, rng) for _ in range(frames or 40)]
        return Set(kind, like, "independent joints", _still(poses))
    if kind == "curl":
        pip = np.radians(np.linspace(2.5, 117.5, frames or 24))
        return Set(kind, "curl", "natural flexion", _still(natural(np.repeat(pip[:, None], 4, axis=1))))
    if kind == "mcp":
        bent = np.radians(np.linspace(5.0, 85.0, frames or 9))
        return Set(kind, "curl", "straight fingers, only the MCP bends", _still([straight(b) for b in bent]))
    if kind == "spread":
        cases = [(share, aside) for aside in (0.0, 5.0, -5.0) for share in (0.5, 1.5, 2.4)][:frames]
        poses = [spread(share, np.radians(40.0), np.radians(aside)) for share, aside in cases]
        return Set(kind, "curl", "lateral motion of half-bent fingers", _still(poses))
    if kind == "six":
        poses = np.load(datasets / "wrist" / "left_small" / "truth.npz")["angles"]
        return Set(kind, "curl", "the six poses A-F", _still(poses[:frames]))
    count = 3 * (frames or 60)
    t_s = np.arange(count, dtype=np.float64) * PERIOD_S
    if kind == "motion":
        angles = curling(t_s, rng.uniform(0.0, 2.0 * np.pi, 4))
        bends = np.zeros((count, 2))
        return Set(kind, "curl", "fingers that curl and uncurl, out of phase", _moving(angles, bends), True)
    angles = curling(0.4 * t_s, rng.uniform(0.0, 2.0 * np.pi, 4))
    bends = np.radians(15.0) * np.stack([np.sin(5.0 * t_s), 0.5 * np.sin(3.1 * t_s + 1.0)], axis=1)
    return Set(kind, "curl", "fingers that curl, and a wrist that bends", _moving(angles, bends), True)


def write_set(one: Set, datasets: Path, folder: Path, seed: int) -> None:
    """Render a set into `folder`, new or empty.

    Raises:
        RecordingError: It holds something already, or cannot be written.
    """
    manifest = load_manifest(datasets / "wrist" / one.like)
    rig = msgspec.structs.replace(manifest.wrist_rig(), name=f"mesh_{one.name.replace('@', '_')}")
    manifest = msgspec.structs.replace(
        manifest, rig=rig, continuous=one.continuous, note=f"{one.note}, {one.light} light"
    )
    device = Device.of(manifest, datasets)
    room = Room.of(one.light, behind(datasets))
    truths: list[Arrays] = []
    write_frames(
        folder, manifest, _frames(one, device, room, folder, truths, np.random.default_rng(seed + 1))
    )
    three = np.array([[moment.angles_rad for moment in cycle] for cycle in one.moments])
    truth: Arrays = {"angles": three[:, 1], "angles_3frames": three}
    truth["flexion"] = np.array([cycle[1].wrist_angles_rad for cycle in one.moments])
    truth["ambient"] = np.array([one.light] * len(three))
    truth |= {key: np.array([row[key] for row in truths]) for key in truths[0]}
    write_truth(folder, truth, _meta(one, device, manifest, seed))


def _frames(
    one: Set, device: Device, room: Room, folder: Path, truths: list[Arrays], rng: np.random.Generator
) -> Iterator[RenderedFrame]:
    """All frames; beside them the label pictures are written and the truths are gathered, of the laser's moment."""
    for k, cycle in enumerate(one.moments):
        last: View | None = None
        for i, (moment, lit) in enumerate(zip(cycle, ORDER, strict=True)):
            if last is None or one.continuous:
                last = device.view(moment)
            if i == 1:
                label = device.label(last)
                cv2.imwrite(str(folder / f"label_{k:06d}.png"), label)
                truths.append(device.truth(last, label))
            t_ns = FIRST_NS + round((3 * k + i) * PERIOD_S * 1e9)
            yield RenderedFrame(device.camera.name, 3 * k + i, t_ns, lit, device.frame(last, room, lit, rng))


def _meta(one: Set, device: Device, manifest: Manifest, seed: int) -> dict[str, object]:
    return {
        "name": one.name,
        "scene": "wrist",
        "note": manifest.note + "; rasterised after the rendered recordings; truth is of the laser's frame",
        "side": "right" if device.hand_mesh.hinges.side_sign > 0.0 else "left",
        "frames": len(one.moments),
        "groups": GROUPS,
        "fingers": FINGERS,
        "joints": WEBXR_JOINTS,
        "angles": ANGLE_NAMES,
        "ambient_level": LEVELS[one.light],
        "seed": seed,
        "frame_dt": PERIOD_S if one.continuous else 0.0,
        "black_level": 2,
        "bits": 8,
    }


def _still(poses: Float | list[Float]) -> list[tuple[Moment, Moment, Moment]]:
    moments = [Moment(np.asarray(pose), STRAIGHT) for pose in poses]
    return [(moment, moment, moment) for moment in moments]


def _moving(angles: Float, bends: Float) -> list[tuple[Moment, Moment, Moment]]:
    moments = [Moment(*pair) for pair in zip(angles, bends, strict=True)]
    return [(moments[k], moments[k + 1], moments[k + 2]) for k in range(0, len(moments), 3)]
