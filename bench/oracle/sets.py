"""The sets of the oracle: scenes, held hands and a room, simulated; recordings; hands before a wrist device.

Of a Leap recording joints and palm are the truth; wrist and metacarpals were not recorded. The rig is the shipped one,
before the back of the hand in the mean. What the caps show of themselves, and what hides them, is drawn of the hand
whose angles come nearest to the recorded joints; then each cap is moved to where the recorded tip is.

Of a wrist device alone (recordings) the palm stands where calibration found it, in its camera's frame. Before both
kinds of rig messages are made of the truth (`shown_of`), or found by both slaves in rendered frames (`watched`). Hidden
is a finger whose tip is not in sight of the wrist camera; before both, one whose marker fewer than two cameras see.
"""

import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from bench.both.scene import Both, Observed, Shown, markers_shown, shown_of, watched
from bench.hands.draws import FACING_ROTATION
from bench.hands.motion import Recorded, held_poses, nearest, pip_deg, recordings
from bench.oracle.truth import STEP_NS, Piece, Truth, calibration_files
from bench.played import START_NS, times_of
from bench.report import CALIBRATION, command, detect
from bench.rigs.rooms import DESK, ROOM, middle_m, room
from common.arrays import Float, Int
from common.errors import RecordingError
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, FINGERS, HandModel
from common.messages import MarkerDetections, WristDetections
from common.recording.frame_recording import open_recording
from common.recording.recorded_files import read_npz
from common.sim.motion import HandState, ScriptedMotion, smooth_step
from common.sim.scene import Scene, view_centre
from common.sim.scenes import scene_by_name
from master.evaluation.wrist_score import load_wrist_truth
from master.replay.recorded import recorded_cycles, recorded_detections
from master.rig.setup import load_setup

SCENES = ("standard", "grasp", "both-travel")
SEEDS = (11, 12, 13)
# Of the palm from the middle of the view, so that the fingers are in it.
_BEHIND_M = np.array([0.03, 0.08, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """A hand that opens for half a second, takes a pose in another half and then does not move."""

    place: Float  # pose of the palm (4, 4) [m]
    open_rad: Float  # (5, 4)
    pose_rad: Float  # (5, 4)
    period_s: float = 60.0

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]."""
        share = smooth_step(min(max((t_s - 0.5) / 0.5, 0.0), 1.0))
        return HandState(self.place, (1.0 - share) * self.open_rad + share * self.pose_rad)


def scenes(name: str, seconds: float = 10.0, seeds: tuple[int, ...] = SEEDS) -> Iterator[Piece]:
    """The scene called `name` before the shipped rig, once for each seed."""
    desk = load_setup(CALIBRATION, DESK)
    files = calibration_files(CALIBRATION, DESK)
    for seed in seeds:
        scene = scene_by_name(name, desk.rig, desk.cameras, desk.hand.profile, seed)
        yield shown_piece(f"seed{seed}", files, scene, seconds, seed)


def shown_piece(name: str, files: dict[str, bytes], scene: Scene, seconds: float, seed: int) -> Piece:
    """What the cameras of a scene's rig report, with errors as large as measured."""
    messages: list[MarkerDetections] = []
    for camera in scene.rig.cameras:
        rate = scene.cameras[camera].frame_rate_hz
        times = times_of(scene, camera, seconds, rate)
        messages += markers_shown(scene, camera, times, 1.0 / rate, seed)[0]
    messages.sort(key=lambda one: one.t_ns)
    return Piece(name, (scene.rig.name,), files, messages, truth_of(scene, seconds))


def truth_of(scene: Scene, seconds: float) -> Truth:
    """The hand of a scene, finely in time, a little longer than it is watched."""
    since_ns: Int = np.arange(0, round((seconds + 0.1) * 1e9), STEP_NS)
    states = tuple(scene.motion.at(1e-9 * t) for t in since_ns.tolist())
    angles_rad = np.stack([state.angles_rad for state in states])
    joints = scene.model.forward(np.stack([state.T_rig_palm for state in states]), angles_rad)
    return Truth(START_NS + since_ns, joints.position_m, angles_rad)


def held(seed: int = SEEDS[0]) -> Iterator[Piece]:
    """A hand that takes a pose and keeps it, for each of some poses."""
    desk = load_setup(CALIBRATION, DESK)
    files = calibration_files(CALIBRATION, DESK)
    place = rigid(FACING_ROTATION, view_centre(desk.rig) + _BEHIND_M)
    poses = held_poses(desk.hand)
    for k, (name, angles) in enumerate(poses.items()):
        motion = Held(place, poses["open"], angles)
        scene = Scene.of_motion(desk.rig, desk.cameras, desk.hand.profile, motion, seed + k)
        yield shown_piece(name, files, scene, 3.0, seed + k)


def in_room(seconds: float = 2.0, seed: int = SEEDS[0]) -> Iterator[Piece]:
    """A hand among 16 cameras."""
    with tempfile.TemporaryDirectory() as folder:
        tree = room(Path(folder), 16, 90.0)
        setup, files = load_setup(tree, ROOM), calibration_files(tree, ROOM)
    motion = ScriptedMotion(setup.hand, middle_m(), seed)
    scene = Scene.of_motion(setup.rig, setup.cameras, setup.hand.profile, motion, seed)
    yield shown_piece(f"seed{seed}", files, scene, seconds, seed)


STEREO = {
    "stills": ("calib_colors", "lights_0_warm", "poses_left"),
    "static": ("static",),
    "translate_8ms": ("translate_8ms",),
    "flex90": ("flex90",),
    "sweeps": ("sweep_paper", "sweep_rough"),
}
_FINGER_ANGLES = ((1, 0, 3, 4), *((6 + 4 * k, 5 + 4 * k, 7 + 4 * k, 8 + 4 * k) for k in range(4)))
"""Columns of a recording's angles in the order of a pose's: abduction, flexion, PIP, DIP."""
_UP = np.array([0.0, 0.06, 0.0])  # of the palm's origin from the middle of the view


def stereo(data: Path, names: Sequence[str]) -> Iterator[Piece]:
    """Recordings `names` of the marker rig in the data folder, through the slave's own detection."""
    with tempfile.TemporaryDirectory() as name:
        tree = Path(name)
        (tree / "cameras").mkdir()
        for camera in ("left", "right"):
            target = tree / "cameras" / f"{camera}.json"
            command("slave", "colours", data / "stereo/calib_colors", "--camera", camera, "-o", target)
        for one in names:
            yield _markers_detected(data / "stereo" / one, tree, data / "hands")


def _markers_detected(folder: Path, tree: Path, hands: Path) -> Piece:
    recording = open_recording(folder)
    rig = recording.manifest.marker_rig()
    files = {f"rigs/{rig.name}.json": msgspec.json.encode(rig)}
    files[f"hands/{rig.hand}.json"] = (hands / f"{rig.hand}.json").read_bytes()
    messages: list[MarkerDetections] = []
    with tempfile.TemporaryDirectory() as name:
        for camera in rig.cameras:
            target = Path(name) / f"detections_{camera}.npz"
            detect(folder, camera, target, "--calibration", tree)
            messages += recorded_detections(Path(name), camera, len(rig.markers))
            files[f"cameras/{camera}.json"] = msgspec.json.encode(recording.manifest.cameras[camera])
    messages.sort(key=lambda one: one.t_ns)
    truth = _rendered_truth(folder, recording.manifest.continuous)
    return Piece(folder.name, (rig.name,), files, messages, truth)


def _rendered_truth(folder: Path, continuous: bool) -> Truth:
    """Where frames follow one another, more finely than they do, by cubic splines through them; a sweep has no hand."""
    data = read_npz(folder / "truth.npz")
    if "joints" not in data:
        t_ns: Int = 1_000_000_000 * (1 + np.arange(len(data["depth"])))
        return Truth(t_ns, np.full((len(t_ns), 26, 3), np.nan), np.full((len(t_ns), 5, 4), np.nan), False)
    t_ns = np.round(1e9 * (1.0 + np.asarray(data["t_ref"], np.float64))).astype(np.int64)
    joints_m, angles_rad = hand_of(data["joints"]), angles_of(data["angles"])
    if len(t_ns) < 4 or not continuous:
        return Truth(t_ns, joints_m, angles_rad, continuous)
    steps: Int = int(t_ns[0]) + STEP_NS * np.arange(int(np.ptp(t_ns)) // STEP_NS)
    fine = np.unique(np.concatenate([steps, t_ns]))
    since_s = 1e-9 * (t_ns - t_ns[0])
    at_s = 1e-9 * (fine - t_ns[0])
    joints, angles = (np.asarray(CubicSpline(since_s, rows)(at_s)) for rows in (joints_m, angles_rad))
    return Truth(fine, joints, angles)


def hand_of(webxr: Float) -> Float:
    """Joints (T, 26, 3) of WebXR joints (T, 25, 3): the palm is between root and knuckle of the middle finger."""
    palm = webxr[:, [10, 11]].mean(axis=1, keepdims=True)
    return np.concatenate([palm, webxr], axis=1)


def angles_of(angles_rad: Float) -> Float:
    """Angles (T, 5, 4) as of a pose, of those of a recording (T, 21)."""
    return angles_rad[:, np.array(_FINGER_ANGLES)]


@dataclass(frozen=True, slots=True, eq=False)
class Replayed:
    """A recorded hand as a motion before the shipped rig, between its samples by straight lines in the palm's frame."""

    t_s: Float  # (T,) times of the samples
    rotation: Slerp  # of the palm, rig frame, over time
    origin_m: Float  # (T, 3) of the palm, rig frame
    fingers_m: Float  # (T, 20, 3) recorded joints, palm frame
    angles_rad: Float  # (T, 20) of the hand model, nearest to these

    @property
    def period_s(self) -> float:
        """How long it is [s]."""
        return float(self.t_s[-1])

    def at(self, t_s: float) -> HandState:
        """The hand at time `t_s` [s]."""
        t_s = min(max(t_s, 0.0), self.period_s)
        angles = _between(self.t_s, self.angles_rad, t_s).reshape(5, 4)
        return HandState(self.palm(t_s), angles)

    def palm(self, t_s: float) -> Float:
        """The pose (4, 4) of the palm, rig frame."""
        return rigid(np.asarray(self.rotation(t_s).as_matrix()), _between(self.t_s, self.origin_m, t_s))

    def joints(self, t_s: float) -> Float:
        """The recorded joints (20, 3) [m], rig frame."""
        t_s = min(max(t_s, 0.0), self.period_s)
        palm = self.palm(t_s)
        return _between(self.t_s, self.fingers_m, t_s) @ palm[:3, :3].T + palm[:3, 3]

    @classmethod
    def of(cls, recorded: Recorded, model: HandModel, centre_m: Float) -> "Replayed":
        """Turned and moved so that in the mean its back is before the cameras, fingers up."""
        palms = recorded.T_rig_palm
        mean = np.asarray(Rotation.from_matrix(palms[:, :3, :3]).mean().as_matrix())
        rotation = FACING_ROTATION @ mean.T
        middle = palms[:, :3, 3].mean(axis=0)
        origin_m = (palms[:, :3, 3] - middle) @ rotation.T + centre_m + _UP
        t_s = np.asarray(1e-9 * recorded.t_ns, np.float64)
        slerp = Slerp(t_s, Rotation.from_matrix(rotation @ palms[:, :3, :3]))
        angles = _nearest_angles(model, recorded.fingers_m)
        return cls(t_s, slerp, origin_m, recorded.fingers_m.reshape(-1, 20, 3), angles)


def _between(t_s: Float, rows: Float, at_s: float) -> Float:
    after = int(np.clip(np.searchsorted(t_s, at_s), 1, len(t_s) - 1))
    share = (at_s - t_s[after - 1]) / (t_s[after] - t_s[after - 1])
    return np.asarray((1.0 - share) * rows[after - 1] + share * rows[after])


def _nearest_angles(model: HandModel, fingers_m: Float) -> Float:
    """Angles (T, 20) [rad] nearest to recorded joints (T, 5, 4, 3) [m], palm frame; every other sample is fitted."""
    rows = np.union1d(np.arange(0, len(fingers_m), 2), len(fingers_m) - 1)
    found = nearest(model, fingers_m[rows], 1e-4)
    columns = [np.interp(np.arange(len(fingers_m)), rows, found[:, k]) for k in range(20)]
    return np.asarray(np.stack(columns, axis=1), np.float64)


def leap(data: Path) -> Iterator[Piece]:
    """Recorded hands in motion; `data` is the data folder."""
    desk = load_setup(CALIBRATION, DESK)
    for seed, recorded in enumerate(recordings(data / "leapjs"), 21):
        name = "".join(c if c.isalnum() else "-" for c in recorded.name).lower()
        model = recorded.model()
        profile = replace(model.profile, name=name)
        motion = Replayed.of(recorded, model, view_centre(desk.rig))
        scene = Scene.of_motion(replace(desk.rig, hand=name), desk.cameras, profile, motion, seed)
        files = {k: v for k, v in calibration_files(CALIBRATION, DESK).items() if "hands" not in k}
        rig = json.loads(files[f"rigs/{DESK}.json"]) | {"hand": name}
        files[f"rigs/{DESK}.json"] = json.dumps(rig).encode()
        files[f"hands/{name}.json"] = msgspec.json.encode(profile)
        messages = [one for camera in scene.rig.cameras for one in _seen(scene, motion, camera, seed)]
        messages.sort(key=lambda one: one.t_ns)
        yield Piece(name, (DESK,), files, messages, _leap_truth(motion))


def _seen(scene: Scene, motion: Replayed, camera: str, seed: int) -> Iterator[MarkerDetections]:
    rate_hz = scene.cameras[camera].frame_rate_hz
    begin_s = 1e-9 * scene.timing(camera).start_offset_ns
    times_s = np.arange(begin_s, motion.period_s - 0.03, 1.0 / rate_hz)
    optics = scene.optics[camera]
    row_s = 1e-6 * scene.cameras[camera].row_time_us
    tips = [scene.rig.markers.index(name) for name in ("thumb", "index", "middle", "ring", "little")]
    for message, t_s in zip(
        markers_shown(scene, camera, times_s, 1.0 / rate_hz, seed)[0], times_s.tolist(), strict=True
    ):
        uv = message.uv.copy()
        for finger, marker in enumerate(tips):
            if np.isfinite(uv[marker, 0]):
                at_s = t_s + row_s * float(uv[marker, 1])
                state = motion.at(at_s)
                drawn = scene.model.forward(state.T_rig_palm, state.angles_rad).position_m[CHAINS[finger, 3]]
                both = optics.project(np.stack([motion.joints(at_s)[4 * finger + 3], drawn]))
                uv[marker] += both[0] - both[1]
        yield replace(message, uv=uv)


def _leap_truth(motion: Replayed) -> Truth:
    since_ns: Int = np.arange(0, round(motion.period_s * 1e9), STEP_NS)
    joints_m = np.full((len(since_ns), 26, 3), np.nan)
    joints_m[:, CHAINS.ravel()] = [motion.joints(1e-9 * t) for t in since_ns.tolist()]
    angles_rad = np.full((len(since_ns), 5, 4), np.nan)
    angles_rad[:, 1:, 2] = np.radians(pip_deg(joints_m[:, CHAINS.ravel()]))
    return Truth(START_NS + since_ns, joints_m, angles_rad)


WORN = ("curl", "mcp", "spread", "left_small")
FUSED = {
    "fused-poses": ("both-poses", "desk", "wrist"),
    "fused-curl": ("both-curl", "desk", "wrist"),
    "fused-travel": ("both-travel", "desk", "wrist"),
    "fused-grasp": ("grasp", "desk", "wrist"),
    "fused-grip": ("grasp", "desk-back3", "wrist-back3"),
    "fused-grip-slow": ("grasp", "desk-back3", "wrist-back3"),
}
RENDERED = {
    "rendered-grasp": ("grasp", "desk", "wrist"),
    "rendered-grip": ("grasp", "desk-back3", "wrist-back3"),
}
_SLOW = "fused-grip-slow"
_SEEDS = (31, 32)


def worn(data: Path) -> Iterator[Piece]:
    """Rendered recordings of wrist devices; `data` is the data folder."""
    for name in WORN:
        yield _cycles_detected(data / "wrist" / name, data / "hands")


def _cycles_detected(folder: Path, hands: Path) -> Piece:
    recording = open_recording(folder)
    rig = recording.manifest.wrist_rig()
    camera, hand = rig.cameras[0], hands / f"{rig.hand}.json"
    files = {
        f"rigs/{rig.name}.json": msgspec.json.encode(rig),
        f"cameras/{camera}.json": msgspec.json.encode(recording.manifest.cameras[camera]),
        f"hands/{rig.hand}.json": hand.read_bytes(),
    }
    with tempfile.TemporaryDirectory() as name:
        target = Path(name) / f"detections_{camera}.npz"
        detect(folder, camera, target, "--hand", hand)
        messages = list(recorded_cycles(Path(name), camera))
    found = load_wrist_truth(recording, camera)
    if found is None:
        raise RecordingError(f"{folder}: it has no truth")
    angles = angles_of(read_npz(folder / "truth.npz")["angles"])
    truth = Truth(found.t_ns, hand_of(found.joints_m), angles, recording.manifest.continuous)
    return Piece(folder.name, (rig.name,), files, messages, changed(truth, hidden=~found.tip_visible))


def fused(name: str, seconds: float = 8.0, seeds: Sequence[int] = _SEEDS) -> Iterator[Piece]:
    """A hand before marker cameras, with a wrist device and its IMU, by seed; `name`: of `FUSED` or `RENDERED`."""
    scene, *rigs = (FUSED | RENDERED)[name]
    sensed = watched if name in RENDERED else shown_of
    files = calibration_files(CALIBRATION, rigs[0]) | calibration_files(CALIBRATION, rigs[1])
    for seed in seeds:
        shown = sensed(Both.of(scene, seed, rigs=(rigs[0], rigs[1])), seconds)
        messages = _thinned(shown.messages) if name == _SLOW else shown.messages
        yield Piece(f"seed{seed}", tuple(rigs), files, messages, _truth_of(shown))


def _thinned(messages: list[Observed]) -> list[Observed]:
    """The same with every third triple (three frames) alone: as many as a busy machine makes."""
    return [one for one in messages if not isinstance(one, WristDetections) or one.seq // 3 % 3 == 0]


def _truth_of(shown: Shown) -> Truth:
    scene = shown.both.scene
    truth = truth_of(scene, shown.seconds)
    cameras = shown.visibility.cameras_of(1e-9 * (truth.t_ns - truth.t_ns[0]), 0.02)
    markers = [scene.rig.markers.index(name) for name in FINGERS]
    return changed(truth, hidden=np.asarray(cameras[:, markers] < 2, np.bool_))
