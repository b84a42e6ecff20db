"""Where a second pair of cameras helps most: tips unseen in six poses, by its angle to the first pair.

    python -m bench.mounts docs/images/mounts.png     some minutes: exact visibility only, nothing is drawn or detected

The second pair is the same bar, half a metre from the middle of the scene, and looks at it. Its *angle* is that
between the axes of the two pairs, 0 beside the first pair, 180 opposite. Its *side* is counted in the plane across the
first pair's axis: 0 to the right, 90 to the user (down in the image), 180 to the left, 270 beyond the finger tips.
"""

import sys
from pathlib import Path

import msgspec
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from bench.occlusion import CALIBRATION, PAIR, PERIOD_S, SEEN, Unseen
from bench.played import shown_by
from common.arrays import Bool, Float
from common.calibration import CameraCalibration, HandProfile, Matrix4, RigCalibration, load
from common.sim.scene import view_centre
from common.sim.scenes import scene_by_name

ANGLES_DEG = (30, 50, 70, 90, 110, 125)
SIDES_DEG = (0, 45, 90, 135, 180, 225, 270, 315)
DISTANCE_M, SAMPLE_HZ, SEED = 0.5, 2.0, 7
HANDS = ("right", "left")


def pair_at(rig: RigCalibration, angle_deg: float, side_deg: float) -> tuple[Float, Float]:
    """Poses (4, 4) of both cameras of a second bar, in the rig frame; its images are upright as a desk is level."""
    angle, side = np.radians(angle_deg), np.radians(side_deg)
    out = np.array([np.sin(angle) * np.cos(side), np.sin(angle) * np.sin(side), -np.cos(angle)])
    x = np.cross([0.0, 0.0, 1.0], -out)
    x = x / np.linalg.norm(x)
    first = np.eye(4)
    first[:3, :3] = np.stack([x, np.cross(-out, x), -out], axis=1)
    bar = np.linalg.inv(rig.camera_pose(PAIR[0])) @ rig.camera_pose(PAIR[1])
    first[:3, 3] = view_centre(rig) + DISTANCE_M * out - first[:3, :3] @ (bar[:3, 3] / 2.0)
    return first, first @ bar


def measure() -> tuple[Unseen, dict[tuple[int, int], Unseen]]:
    """Of the first pair alone, and with a second one at every angle and side; both hands together."""
    rig = load(CALIBRATION / "rigs" / "desk.json", RigCalibration)
    own = {name: load(CALIBRATION / "cameras" / f"{name}.json", CameraCalibration) for name in PAIR}
    first = np.array([_seen(rig, own, hand, PAIR) for hand in HANDS])
    together: dict[tuple[int, int], Unseen] = {}
    for angle in ANGLES_DEG:
        for side in SIDES_DEG:
            poses = dict(zip(("left2", "right2"), pair_at(rig, angle, side), strict=True))
            cameras = own | {
                name: msgspec.structs.replace(own[like], name=name)
                for name, like in zip(poses, PAIR, strict=True)
            }
            wide = msgspec.structs.replace(
                rig,
                cameras=(*PAIR, *poses),
                T_rig_camera=rig.T_rig_camera | {name: _rows(pose) for name, pose in poses.items()},
            )
            second = np.array([_seen(wide, cameras, hand, tuple(poses)) for hand in HANDS])
            together[angle, side] = Unseen.of(np.concatenate((first + second).sum(axis=1)))
            print(f"{angle:4d} {side:4d}  {100 * together[angle, side].tips:5.1f} %", flush=True)
    return Unseen.of(np.concatenate(first.sum(axis=1))), together


def draw(path: Path, alone: Unseen, together: dict[tuple[int, int], Unseen]) -> None:
    """The map as the first pair sees it: angle outwards, side around."""
    figure = Figure(figsize=(8.2, 7.4), dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.02, 0.02, 0.86, 0.9))
    axes.set_axis_off()
    axes.set_aspect("equal")
    axes.set_xlim(-165.0, 165.0)
    axes.set_ylim(160.0, -160.0)  # down is down, as in the image
    for angle in ANGLES_DEG:
        ring = np.radians(np.arange(361))
        axes.plot(angle * np.cos(ring), angle * np.sin(ring), color="0.85", lw=1.0, zorder=1)
        at = angle * np.cos(np.radians(22.5)), angle * np.sin(np.radians(22.5))
        axes.text(*at, f"{angle}°", color="0.4", size=9, ha="center", va="center")
    axes.text(0.0, 0.0, "first\npair", size=10, ha="center", va="center")
    places = np.array(list(together), np.float64)
    x, y = (places[:, 0] * turn(np.radians(places[:, 1])) for turn in (np.cos, np.sin))
    ratio = np.array([one.tips / alone.tips for one in together.values()])
    shown = axes.scatter(x, y, c=ratio, s=600, cmap="viridis_r", vmin=0.0, vmax=1.0, zorder=3)
    for u, v, share in zip(x, y, ratio, strict=True):
        light = "white" if share > 0.4 else "black"
        axes.text(float(u), float(v), f"{share:.2f}", ha="center", va="center", color=light, size=9, zorder=4)
    for side, name in ((0, "right"), (90, "to the user"), (180, "left"), (270, "beyond the finger tips")):
        u, v = 147.0 * np.cos(np.radians(side)), 147.0 * np.sin(np.radians(side))
        axes.text(
            float(u), float(v), name, size=10, ha="center", va="center", rotation=90 if side % 180 == 0 else 0
        )
    axes.set_title(f"Tips unseen with a second pair / with one ({100 * alone.tips:.0f} % of all)", size=12)
    figure.colorbar(shown, cax=figure.add_axes((0.91, 0.15, 0.02, 0.65)))
    figure.savefig(path, metadata={"Software": None})


def _seen(
    rig: RigCalibration, cameras: dict[str, CameraCalibration], side: str, names: tuple[str, ...]
) -> Bool:
    """(C, T, 5) whether each of the cameras `names` sees each tip of one hand."""
    hand = load(CALIBRATION / "hands" / f"default-{side}.json", HandProfile)
    scene = scene_by_name("poses", rig, cameras, hand, SEED)
    times = (np.arange(PERIOD_S * SAMPLE_HZ) + 0.5) / SAMPLE_HZ
    return np.array([shown_by(scene, name, times)[:, :5] >= SEEN for name in names])


def _rows(pose: Float) -> Matrix4:
    return msgspec.convert(pose.tolist(), Matrix4)


if __name__ == "__main__":
    base, found = measure()
    draw(Path(sys.argv[1]), base, found)
    print(
        f"one pair alone: {100 * base.tips:.1f} % of the tips, {100 * base.moments:.1f} % of the moments with one"
    )
    for one_angle in ANGLES_DEG:
        cells = [f"{100 * found[one_angle, one_side].tips:.0f}" for one_side in SIDES_DEG]
        print(f"| {one_angle}° | " + " | ".join(cells) + " |")
