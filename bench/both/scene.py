"""One hand before the marker rig and with the wrist device on its forearm: scenes, messages, poses, exact truth.

`shown` makes messages of exact truth with errors as large as measured, for many seeds: nothing is drawn. Errors wander,
as real ones do. They are those of 30 s of the six poses, rendered and detected, and of docs/wrist.md:

| report | made of | errors |
|---|---|---|
| marker | centroid of its visible paint | found from 15 px^2 on; 0.06 px of a whole cap to 0.6 px of a speck |
| laser, four fingers | centroid of the line in sight | 0.55 px; 3 % of the time that of a neighbour |
| laser, thumb | the same | 3.3 px; 30 % of the time 12 px |
| fingertip | its end, where in sight | 2.5 px; a quarter missed; 5 % some 20 px elsewhere; of thumbs one in six |

`watched` renders and detects instead. `Solved`: a wrist device alone knows no place: its hand is put where the wrist
joint truly is, turned as the palm truly is; its joints are then those of the fingers alone, with an exact palm.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Self

import numpy as np

from bench.played import START_NS, observed, times_of
from bench.report import CALIBRATION, chi_squares
from common.arrays import Bool, Float, Int
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import CHAINS, WRIST
from common.imu.fusion import OrientationFilter
from common.messages import HandPose, ImuSample, MarkerDetections, WristDetections
from common.sim.painter import MarkerView
from common.sim.render import Renderer
from common.sim.scene import Scene, SceneTruth
from common.sim.scenes import scene_by_name
from common.sim.sensors import SimulatedImu
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene, WristTruth
from master.outputs.poses import Poses
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigSetup, load_setup
from master.run.app import StageTimes
from slave.cameras.synthetic import STROBE
from slave.sources import Frame
from slave.wrist.detector import WristDetector
from slave.wrist.led_image import WristView

SCENES = ("both-poses", "both-curl", "both-travel", "grasp")
MARKER_RIG, WRIST_RIG = "desk", "wrist"

Observed = MarkerDetections | WristDetections | ImuSample


@dataclass(frozen=True, slots=True, eq=False)
class Both:
    """One scene as both sensors have it."""

    name: str  # of the scene
    seed: int  # of motion and noise
    scene: Scene  # what the marker rig sees; its truth is that of the hand, in the rig frame
    wrist_scene: WristScene  # what the wrist device sees of the same hand
    markers: RigSetup  # the marker rig alone
    wrist: RigSetup  # the wrist device alone

    @classmethod
    def of(cls, name: str, seed: int, rigs: tuple[str, str] = (MARKER_RIG, WRIST_RIG)) -> "Both":
        """Make the scene called `name` before both kinds of rig of one hand; PhalanxError: there is none."""
        markers, wrist = (load_setup(CALIBRATION, rig) for rig in rigs)
        scene = scene_by_name(name, markers.rig, markers.cameras, markers.hand.profile, seed)
        worn = WristScene(wrist.rig, wrist.cameras, wrist.hand, scene.motion, seed=seed)
        return cls(name, seed, scene, worn, markers, wrist)

    @property
    def fused(self) -> RigSetup:
        """Both rigs as one."""
        return RigSetup.joined([self.markers, self.wrist])

    def truth(self, t_ns: int) -> SceneTruth:
        """The hand, in the rig frame, at a moment of the messages' clock."""
        return self.scene.truth(1e-9 * (t_ns - START_NS))


@dataclass(frozen=True, slots=True, eq=False)
class Visibility:
    """What of the markers is truly in sight, frame by frame."""

    visible_t_s: Mapping[str, Float]  # camera -> (T,) scene times [s] of its frames
    visible_px2: Mapping[str, Float]  # camera -> (T, M) visible area of every marker [px^2]

    def cameras_of(self, t_s: Float, within_s: float) -> Int:
        """(N, M) how many cameras have each marker (9 px^2) in sight within so long of the moments (N,) [s]."""
        count = np.zeros((len(t_s), next(iter(self.visible_px2.values())).shape[1]), np.int64)
        for name, times in self.visible_t_s.items():
            seen = self.visible_px2[name] >= 9.0
            total = np.concatenate([np.zeros((1, seen.shape[1]), np.int64), np.cumsum(seen, axis=0)])
            first, last = (np.searchsorted(times, t_s + way * within_s) for way in (-1.0, 1.0))
            count += total[last] > total[first]
        return count


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What the sensors report of a scene, and what of it is truly in sight."""

    both: Both  # the scene
    seconds: float  # how long it was watched
    messages: list[Observed]  # of all sensors, in the order of their stamps
    visibility: Visibility


def in_order(messages: list[Observed]) -> list[Observed]:
    """In the order of capture, as a recording is solved."""
    return sorted(messages, key=lambda message: message.t_ns)


def orientations(both: Both, seconds: float) -> list[Observed]:
    """What the IMU's slave sends of that time: raw samples of the forearm with its filter's orientation."""
    imu = both.wrist.rig.imu
    if imu is None:
        return []
    fusion = OrientationFilter(imu.rate_hz)
    return [fusion.push(one) for one in SimulatedImu.of(both.wrist_scene).around(0.0, seconds, START_NS)]


_THUMB_CLAIMED_PX = (12.0, 29.0)
_OTHER_FINGER, _THUMB_WRONG, _TIP_FOUND, _THUMB_TIP_FOUND, _TIP_FALSE = (
    NormalDist().inv_cdf(share) for share in (0.03, 0.3, 0.75, 0.15, 0.05)
)


class _Wander:
    """Errors of unit variance that are about the same for a while (an AR(1) process), N at once."""

    def __init__(self, rng: np.random.Generator, shape: tuple[int, ...], step_s: float) -> None:
        hold_s = 0.2  # errors and misses are about the same for so long
        self._rng, self._keep = rng, float(np.exp(-step_s / hold_s))
        self._now = rng.normal(size=shape)

    def __call__(self) -> Float:
        """The next step."""
        fresh = self._rng.normal(size=self._now.shape)
        self._now = self._keep * self._now + np.sqrt(1.0 - self._keep**2) * fresh
        return self._now


def shown(name: str, seconds: float, seed: int, every: int = 1) -> Shown:
    """What the sensors report of the scene called `name`; `every`: only each n-th frame of marker cameras."""
    return shown_of(Both.of(name, seed), seconds, every)


def shown_of(both: Both, seconds: float, every: int = 1) -> Shown:
    """The same of a scene before other rigs."""
    messages = orientations(both, seconds)
    times, paint = dict[str, Float](), dict[str, Float]()
    for camera in both.markers.rig.cameras:
        rate = both.markers.cameras[camera].frame_rate_hz / every
        times[camera] = times_of(both.scene, camera, seconds, rate)
        found, paint[camera] = markers_shown(both.scene, camera, times[camera], 1.0 / rate, both.seed)
        messages += found
    frame_s = 1.0 / both.wrist.cameras[both.wrist.rig.cameras[0]].frame_rate_hz
    cycles = _cycles(both, np.arange(1.0, seconds / frame_s - 1.0, 3.0) * frame_s, frame_s)
    return Shown(both, seconds, in_order(messages + cycles), Visibility(times, paint))


def markers_shown(
    scene: Scene, camera: str, times_s: Float, step_s: float, seed: int
) -> tuple[list[MarkerDetections], Float]:
    """One marker camera's frames at scene times (T,) [s], and the paint (T, M) [px^2] in sight."""
    place = scene.rig.cameras.index(camera)
    count = len(scene.rig.markers)
    rng = np.random.default_rng([seed, 21, place])
    least, lasting = _Wander(rng, (count,), step_s), _Wander(rng, (count, 2), step_s)
    renderer = Renderer(scene, camera)
    out: list[MarkerDetections] = []
    marker_colour: list[Float] = []
    for seq, t in enumerate(times_s.tolist()):
        view = renderer.markers(t)
        marker_colour.append(_paint(view))
        off = 0.8 * lasting() + 0.6 * rng.normal(size=(count, 2))
        spot_px2, spot_spread_px2 = 15.5, 4.0  # of paint that is found half of the time
        found = view.area > spot_px2 + spot_spread_px2 * least()
        out.append(_marker_message(camera, seq, START_NS + round(t * 1e9), view, found, off))
    return out, np.array(marker_colour)


def _paint(view: MarkerView) -> Float:
    """The paint (M,) in sight [px^2]."""
    return np.where(np.isfinite(view.uv[:, 0]), view.area, 0.0)


def _marker_message(
    camera: str, seq: int, t_ns: int, view: MarkerView, found: Bool, off: Float
) -> MarkerDetections:
    """One frame, of which these markers (M,) are found, with errors of unit variance (M, 2)."""
    found = found & np.isfinite(view.uv[:, 0])
    whole_px2, whole_px, speck_px = 100.0, 0.1, 1.1  # claimed of caps from so much paint on, and at most
    small = (whole_px2 / np.maximum(view.area, 1.0)) ** 1.4
    sigma = np.clip(whole_px * small, whole_px, speck_px)
    of_claimed = 0.6  # how large errors are by what is claimed
    uv = np.where(found[:, None], view.uv + (of_claimed * sigma)[:, None] * off, np.nan)
    area, quality = np.where(found, view.area, np.nan), np.clip(view.area / whole_px2, 0.1, 1.0)
    quality, sigma = (np.where(found, value, np.nan) for value in (quality, sigma))
    return MarkerDetections(camera, 1, seq, t_ns, t_ns, uv, area, quality, sigma, np.full_like(uv, np.nan))


def _cycles(both: Both, times_s: Float, frame_s: float) -> list[Observed]:
    """The triples with laser frames at these times."""
    report = _WristErrors(both, 3.0 * frame_s)
    out: list[Observed] = []
    for k, t in enumerate(times_s.tolist()):
        laser, led = both.wrist_scene.truth(t), both.wrist_scene.truth(t + frame_s)
        t_ns = START_NS + round(t * 1e9)
        out.append(report(3 * k + 1, t_ns, t_ns + round(frame_s * 1e9), laser, led))
    return out


class _WristErrors:
    """Makes messages of truth. Holds the errors of the moment."""

    def __init__(self, both: Both, step_s: float) -> None:
        rng = np.random.default_rng([both.seed, 22])
        self._camera, self._fx = both.wrist.rig.cameras[0], float(both.wrist_scene.optics.matrix[0, 0])
        self._rng = rng
        self._other, self._missed, self._false = (_Wander(rng, (5,), step_s) for _ in range(3))
        self._laser, self._tip, self._aside = (_Wander(rng, (5, 2), step_s) for _ in range(3))

    def __call__(
        self, seq: int, t_ns: int, ready_ns: int, laser: WristTruth, led: WristTruth
    ) -> WristDetections:
        """The message of one triple, from the truth at its laser and at its LED frame."""
        at, sigma, length = self._line(laser)
        tip, tip_sigma = self._tips(led)
        depth_unit, depth_noise = 0.8, 0.04
        depth = depth_unit * led.tip_xyz[:, 2] * (1.0 + depth_noise * self._rng.normal(size=5))
        depth = np.where(np.isnan(tip[:, 0]), np.nan, depth)
        return WristDetections(self._camera, 1, seq, t_ns, ready_ns, at, sigma, length, tip, tip_sigma, depth)

    def _line(self, truth: WristTruth) -> tuple[Float, Float, Float]:
        other, off = self._other(), 0.8 * self._laser() + 0.6 * self._rng.normal(size=(5, 2))
        line, length_m = truth.laser_uv[1:6], truth.laser_len_vis[1:6]
        line_m = 3e-3
        seen = (length_m >= line_m) & np.isfinite(line[:, 0])
        laser_px, laser_claimed_px, line_share = 0.55, 0.5, 0.63  # of the line's length is reported
        at = line + laser_px * off
        sigma = np.full(5, laser_claimed_px)
        for f in np.flatnonzero(other < _OTHER_FINGER):
            near = [n for n in (f - 1, f + 1) if f > 0 and 0 < n < 5 and seen[n]]
            if near:
                at[f] = line[near[0]] + laser_px * off[f]
        wrong = bool(other[0] < _THUMB_WRONG)
        thumb_px, thumb_wrong_px = 3.3, 12.0
        at[0] = line[0] + (thumb_wrong_px if wrong else thumb_px) * off[0]
        sigma[0] = _THUMB_CLAIMED_PX[int(wrong)]
        length = line_share * self._fx * length_m / truth.laser_xyz[1:6, 2]
        nothing = np.where(seen, 1.0, np.nan)
        return at * nothing[:, None], sigma * nothing, length * nothing

    def _tips(self, truth: WristTruth) -> tuple[Float, Float]:
        missed, false = self._missed(), self._false() < _TIP_FALSE
        off, aside = 0.8 * self._tip() + 0.6 * self._rng.normal(size=(5, 2)), self._aside()
        typical = np.array([_THUMB_TIP_FOUND, *4 * [_TIP_FOUND]])
        found = truth.tip_visible & (missed < typical) & np.isfinite(truth.tip_uv[:, 0])
        tip_px, tip_claimed_px, tip_false_px, tip_false_claimed_px = 2.5, 4.4, 20.0, 9.0
        away = tip_false_px * aside / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 0.5)
        at = truth.tip_uv + np.where(false[:, None], away, 0.0) + tip_px * off
        claimed = np.where(false, tip_false_claimed_px, tip_claimed_px)
        return np.where(found[:, None], at, np.nan), np.where(found, claimed, np.nan)


def watched(both: Both, seconds: float) -> Shown:
    """What the slaves report of a scene within its first `seconds`; some seconds for each."""
    messages = orientations(both, seconds)
    times, paint = dict[str, Float](), dict[str, Float]()
    for camera in both.markers.rig.cameras:
        rate = both.markers.cameras[camera].frame_rate_hz
        times[camera] = times_of(both.scene, camera, seconds, rate)
        found = list(observed(both.scene, camera, times[camera]))
        paint[camera] = np.array([_paint(view) for _, view, _ in found])
        messages += [message for message, _, _ in found]
    return Shown(both, seconds, in_order(messages + cycles_of(both, seconds)), Visibility(times, paint))


def cycles_of(both: Both, seconds: float) -> list[Observed]:
    """The wrist device's triples, rendered and detected."""
    name = both.wrist.rig.cameras[0]
    own = both.wrist.cameras[name]
    detector = WristDetector(WristView.of(both.wrist.rig, own, both.wrist.hand.profile), own.frame_rate_hz)
    found = [detector.push(frame) for frame in _frames(both, name, seconds)]
    return [one.message(name, session=1) for one in found if one is not None]


def _frames(both: Both, name: str, seconds: float) -> Iterator[Frame]:
    """Frames of the wrist camera, strobed in turn."""
    own, renderer = both.wrist.cameras[name], WristRenderer(both.wrist_scene, name)
    for seq, t in enumerate((np.arange(round(seconds * own.frame_rate_hz)) / own.frame_rate_hz).tolist()):
        t_ns = START_NS + round(t * 1e9)
        image = renderer.render(t, STROBE[seq % len(STROBE)])
        yield Frame(seq, t_ns, t_ns, image, exposure_us=own.exposure_us)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """What a pipeline made of a scene, in the rig frame, and the truth at the same N moments."""

    poses: Poses  # as published, but a hand that only a wrist device knows put where it truly is
    t_s: Float  # (N,) scene times [s]
    truth_m: Float  # (N, 26, 3) joints [m]
    placed_m: Float  # (N, 26, 3) joints of the poses, were the palm where it truly is [m]
    truth_rad: Float  # (N, 5, 4) angles
    markers: bool  # whether the pipeline has marker cameras
    wrist: bool  # whether it has the wrist device, and so its IMU

    @classmethod
    def of(cls, both: Both, poses: list[HandPose], setup: RigSetup) -> Self:
        """Judge these poses of a rig; those of the first second are left out."""
        settled_s = 1.0  # of every scene's beginning: filters and IMU find their feet
        kept = [pose for pose in poses if pose.t_ns >= START_NS + round(settled_s * 1e9)]
        found = Poses.of(kept)
        t_s = np.asarray((found.t_ns - START_NS) * 1e-9, np.float64)
        states = [both.scene.motion.at(t) for t in t_s.tolist()]
        angles = np.array([state.angles_rad for state in states])
        truth = both.scene.model.forward(np.array([state.T_rig_palm for state in states]), angles)
        placed = _placed(found, truth.position_m[:, WRIST], truth.rotation[:, WRIST])
        by = bool(setup.markers), setup.wrist is not None
        shown = found if setup.markers else placed
        return cls(shown, t_s, truth.position_m, placed.position_m, angles, *by)

    @property
    def off_mm(self) -> Float:
        """(N, 25) errors of all joints but the palm's [mm]; NaN where not valid."""
        off = 1e3 * np.linalg.norm(self.poses.position_m - self.truth_m, axis=2)
        return np.where(self.poses.valid, off, np.nan)[:, 1:]

    @property
    def fingers_mm(self) -> Float:
        """(N, 15) errors of the joints beyond the knuckles, were the palm where it truly is [mm]; NaN: not valid."""
        off = 1e3 * np.linalg.norm(self.placed_m - self.truth_m, axis=2)
        return np.where(self.poses.valid, off, np.nan)[:, CHAINS[:, 1:].ravel()]

    @property
    def pip_deg(self) -> Float:
        """(N, 5) errors of the PIP, of the thumb its MCP [deg]; NaN where the finger is not valid."""
        off = np.degrees(np.abs(self.poses.angles_rad - self.truth_rad)[..., 2])
        return np.where(self.poses.valid[:, CHAINS[:, 1]], off, np.nan)

    @property
    def joint_chi2(self) -> Float:
        """(N, 25) chi square of every joint by its own covariance; NaN where not valid or without one."""
        off = (self.poses.position_m - self.truth_m)[:, 1:]
        cov = self.poses.cov_m2[:, 1:]
        known = self.poses.valid[:, 1:] & np.isfinite(cov).all(axis=(2, 3)) & np.isfinite(off).all(axis=2)
        safe = np.where(known[..., None, None], cov, np.eye(3))
        return np.where(known, chi_squares(off, safe), np.nan)


def _placed(found: Poses, wrist_m: Float, wrist_rotation: Float) -> Poses:
    """A hand with the wrist joint there (N, 3) and turned so (N, 3, 3)."""
    own = quaternion_to_matrix(found.orientation_wxyz[:, WRIST])
    rotation = wrist_rotation @ np.swapaxes(own, 1, 2)
    beyond = found.position_m - found.position_m[:, WRIST, None]
    place = wrist_m[:, None] + np.einsum("nab,njb->nja", rotation, beyond)
    cov = rotation[:, None] @ found.cov_m2 @ np.swapaxes(rotation, 1, 2)[:, None]
    return replace(found, position_m=place, cov_m2=cov)


def solve(setup: RigSetup, messages: Iterable[Observed]) -> list[HandPose]:
    """The poses that a rig's pipeline makes of those messages that are of its sensors."""
    pipeline = pipeline_of(setup, StageTimes())
    poses: list[HandPose] = []
    for message in messages:
        if isinstance(message, ImuSample):
            if message.source in setup.imus:
                pipeline.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
        elif message.camera in setup.cameras:
            poses += [one.pose for one in pipeline.push(message)]
    return poses + [one.pose for one in pipeline.flush()]
