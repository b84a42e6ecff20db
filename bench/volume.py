"""The volume that the rig desk states: a finger tip is taken to its corners, faces and middle, and placed there.

Real renderer, real detector, whole line; the tip sways a little in each place, so that no pixel grid flatters it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.played import solve, times_of, times_of_poses, watch
from bench.row import Row
from common.arrays import Bool, Float
from common.calibration import HandProfile, load
from common.geometry.transforms import rigid
from common.hand.model import HandModel
from common.sim.motion import POSES, HandState, angles_of, base_pose, smooth_step
from common.sim.scene import Scene
from master.rig.files import load_setup
from master.rig.setup import RigSetup

CALIBRATION = Path(__file__).parent.parent / "calib_json"
TIP = 1  # the marker that is taken about: the index finger's
FRAME_HZ = 30.0
PLACE_S, WAY_S = 1.2, 0.5
SWAY_M, SWAY_HZ = 0.004, 1.3


@dataclass(frozen=True, slots=True, eq=False)
class Tour:
    """An open hand whose index tip goes from place to place (P, 3) [m], rig frame, and stays a while in each."""

    model: HandModel
    marker: str
    places: Float

    @property
    def period_s(self) -> float:
        """Time [s] after which the tour begins anew."""
        return PLACE_S * len(self.places)

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]."""
        t = max(t_s, 0.0) % self.period_s
        place = min(int(t / PLACE_S), len(self.places) - 1)
        way = self.places[place] - self.places[place - 1]
        share = smooth_step((t - place * PLACE_S) / WAY_S)
        swing = 2.0 * np.pi * SWAY_HZ * t
        sway = SWAY_M * np.array([np.sin(swing), np.cos(0.7 * swing), np.sin(1.3 * swing)])
        posture = np.array(POSES["open_palm"], np.float64)
        angles = angles_of(self.model, posture, np.zeros((5, 4)))
        pose = base_pose(self.model, np.zeros(3), np.zeros(3), np.zeros(3))
        tip = self.model.marker_points(self.model.forward(pose, angles), (self.marker,))[0]
        to = self.places[place - 1] + share * way + sway - tip
        return HandState(rigid(pose[:3, :3], pose[:3, 3] + to), angles)

    def stays(self, t_s: Float) -> tuple[Float, Bool]:
        """Number of the place (T,) at times (T,) [s], and whether the tip stays there."""
        place = np.minimum(t_s % self.period_s / PLACE_S, len(self.places) - 1e-9)
        return np.floor(place), (place % 1.0) * PLACE_S > WAY_S + 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """What became of the tip in P places.

    Attributes:
        places: (P, 3) [m].
        found: (P,) share of the moments at which it was placed.
        depth: (P,) RMS of the error along z, relative to the distance.
        off_mm: (P,) RMS of the distance from the truth [mm].
        inside: (P,) share of the poses in which the joint of the tip was said to be in the volume.
    """

    places: Float
    found: Float
    depth: Float
    off_mm: Float
    inside: Float


def rows() -> list[Row]:
    """Accuracy in the middle, by distance, and in the worst place."""
    setup, hand = load_setup(CALIBRATION, "desk"), _hand()
    assert setup.rig.volume is not None
    low, high = np.array(setup.rig.volume.low_m), np.array(setup.rig.volume.high_m)
    steps = np.stack(np.meshgrid([0, 1, 2], [0, 1, 2], [0, 1, 2], indexing="ij"), axis=-1).reshape(-1, 3)
    got = measure(setup, hand, low + steps * (high - low) / 2.0)
    out = [
        Row(
            "places in which the tip was found always", 100.0 * float((got.found == 1.0).mean()), "%", "of 27"
        )
    ]
    middle = 13
    out.append(_row("middle", got, np.arange(27) == middle))
    for step in range(3):
        name = f"nine places at {low[2] + step * (high[2] - low[2]) / 2.0:.2f} m"
        out.append(_row(name, got, steps[:, 2] == step))
    out.append(_row("eight corners", got, (steps != 1).all(axis=1)))
    worst = int(np.argmax(got.depth))
    at = ", ".join(f"{v:.2f}" for v in got.places[worst])
    out.append(_row(f"worst place ({at}) m", got, np.arange(27) == worst))
    return out


def measure(setup: RigSetup, hand: HandProfile, places: Float) -> Accuracy:
    """Take the tip to each of the places (P, 3) [m] before the cameras of a rig."""
    model = HandModel.of(hand)
    tour = Tour(model, setup.rig.markers[TIP], places)
    scene = Scene.of_motion(setup.rig, setup.cameras, hand, tour)
    watched = [
        watch(scene, name, times_of(scene, name, tour.period_s, FRAME_HZ)) for name in setup.rig.cameras
    ]
    poses, _ = solve(setup, watched)
    t_s = times_of_poses(poses)
    truth = np.array([scene.truth(float(t)).markers_m[TIP] for t in t_s])
    error = np.array([pose.markers_raw_m[TIP] for pose in poses]) - truth
    inside = np.array([pose.inside_volume[10] for pose in poses])
    place, stays = tour.stays(t_s)
    kept = [(place == p) & stays for p in range(len(places))]
    return Accuracy(
        places,
        found=np.array([np.isfinite(error[k, 0]).mean() for k in kept]),
        depth=np.array([_rms(error[k, 2] / truth[k, 2]) for k in kept]),
        off_mm=np.array([1e3 * _rms(np.linalg.norm(error[k], axis=1)) for k in kept]),
        inside=np.array([inside[k].mean() for k in kept]),
    )


def _row(name: str, got: Accuracy, chosen: Bool) -> Row:
    depth, off = 100.0 * _rms(got.depth[chosen]), _rms(got.off_mm[chosen])
    return Row(f"{name}: depth error, RMS", depth, "%", f"goal 2; whole distance {off:.2f} mm")


def _rms(values: Float) -> float:
    return float(np.sqrt(np.nanmean(np.square(values)))) if np.isfinite(values).any() else float("nan")


def _hand() -> HandProfile:
    return load(CALIBRATION / "hands" / "default-right.json", HandProfile)
