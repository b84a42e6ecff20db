"""The oracle's recorded sets: rendered recordings, detected, and real hands before simulated cameras.

Of a Leap recording joints and palm are the truth; wrist and metacarpals were not recorded. The rig is the shipped one,
before the back of the hand in the mean. What the caps show of themselves, and what hides them, is drawn of the hand
whose angles come nearest to the recorded joints; then each cap is moved to where the recorded tip is.
"""

import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares  # pyright: ignore[reportUnknownVariableType]
from scipy.spatial.transform import Rotation, Slerp

from bench.both.shown import markers_shown
from bench.hands.draws import FACING_ROTATION
from bench.hands.motion import Recorded, recordings
from bench.oracle.freeze import Piece, calibration_files
from bench.oracle.truth import STEP_NS, Truth
from bench.played import START_NS
from bench.report import CALIBRATION, command
from bench.rigs.rooms import DESK
from common.arrays import Float, Int
from common.geometry.transforms import rigid
from common.hand.model import CHAINS, HandModel
from common.messages.sensed import MarkerDetections
from common.recording.frame_recording import open_recording
from common.recording.recorded_files import read_npz
from common.sim.motion import HandState
from common.sim.scene import Scene, view_centre
from master.replay.recorded import recorded_detections
from master.rig.setup import load_setup

RENDERED = {
    "stills": ("calib_colors", "lights_0_warm", "poses_left"),
    "static": ("static",),
    "translate_8ms": ("translate_8ms",),
    "flex90": ("flex90",),
    "sweeps": ("sweep_paper", "sweep_rough"),
}
_FINGER_ANGLES = (
    (1, 0, 3, 4),
    *((6 + 4 * k, 5 + 4 * k, 7 + 4 * k, 8 + 4 * k) for k in range(4)),
)
"""Columns of a recording's angles in the order of a pose's: abduction, flexion, PIP, DIP."""
_SEED = 21
_UP = np.array([0.0, 0.06, 0.0])  # of the palm's origin from the middle of the view


def rendered(data: Path, names: Sequence[str]) -> Iterator[Piece]:
    """Recordings of the marker rig, through the slave's own detection.

    Args:
        data: The data folder.
        names: Of the recordings.
    """
    with tempfile.TemporaryDirectory() as name:
        tree = Path(name)
        (tree / "cameras").mkdir()
        for camera in ("left", "right"):
            target = tree / "cameras" / f"{camera}.json"
            command("slave", "colours", data / "stereo/calib_colors", "--camera", camera, "-o", target)
        for one in names:
            yield _detected(data / "stereo" / one, tree, data / "hands")


def _detected(folder: Path, tree: Path, hands: Path) -> Piece:
    recording = open_recording(folder)
    rig = recording.manifest.marker_rig()
    files = {f"rigs/{rig.name}.json": msgspec.json.encode(rig)}
    files[f"hands/{rig.hand}.json"] = (hands / f"{rig.hand}.json").read_bytes()
    messages: list[MarkerDetections] = []
    with tempfile.TemporaryDirectory() as name:
        for camera in rig.cameras:
            target = Path(name) / f"detections_{camera}.npz"
            command(
                "slave",
                "run",
                "--name",
                camera,
                "--camera",
                f"replay:{folder}",
                "--calibration",
                tree,
                "-o",
                target,
            )
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
    found = [
        np.asarray(CubicSpline(since_s, rows)(1e-9 * (fine - t_ns[0]))) for rows in (joints_m, angles_rad)
    ]
    return Truth(fine, found[0], found[1])


def hand_of(webxr: Float) -> Float:
    """Joints (T, 26, 3) of WebXR joints (T, 25, 3): the palm is between root and knuckle of the middle finger."""
    palm = webxr[:, [10, 11]].mean(axis=1, keepdims=True)
    return np.concatenate([palm, webxr], axis=1)


def angles_of(angles_rad: Float) -> Float:
    """Angles (T, 5, 4) as of a pose, of those of a recording (T, 21)."""
    return angles_rad[:, np.array(_FINGER_ANGLES)]


@dataclass(frozen=True, slots=True, eq=False)
class Replayed:
    """A recorded hand as a motion before the shipped rig, between its samples by straight lines in the palm's frame.

    Attributes:
        t_s: (T,) times of the samples.
        turn: Of the palm, rig frame, over time.
        origin_m: (T, 3) of the palm, rig frame.
        fingers_m: (T, 20, 3) recorded joints, palm frame.
        angles_rad: (T, 20) of the hand model, nearest to these.
    """

    t_s: Float
    rotation: Slerp
    origin_m: Float
    fingers_m: Float
    angles_rad: Float

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
    """Angles (T, 20) [rad] whose joints are nearest to recorded ones (T, 5, 4, 3) [m], palm frame.

    Of every other sample; those between are what lies between.
    """
    rows, out = np.union1d(np.arange(0, len(fingers_m), 2), len(fingers_m) - 1), list[Float]()
    start = np.zeros(20)
    for fingers in fingers_m[rows]:

        def off(x: Float, fingers: Float = fingers) -> Float:
            return (1e3 * (model.chains(x.reshape(5, 4)).position_m - fingers)).ravel()

        start = np.asarray(least_squares(off, start, xtol=1e-4, ftol=1e-4).x, np.float64)
        out.append(start)
    found = np.array(out)
    columns = [np.interp(np.arange(len(fingers_m)), rows, found[:, k]) for k in range(20)]
    return np.asarray(np.stack(columns, axis=1), np.float64)


def leap(data: Path) -> Iterator[Piece]:
    """Recorded hands in motion; `data` is the data folder."""
    desk = load_setup(CALIBRATION, DESK)
    for seed, recorded in enumerate(recordings(data / "leapjs"), _SEED):
        name = "".join(c if c.isalnum() else "-" for c in recorded.name).lower()
        model = recorded.model()
        profile = replace(model.profile, name=name)
        motion = Replayed.of(recorded, model, view_centre(desk.rig))
        scene = Scene.of_motion(replace(desk.rig, hand=name), desk.cameras, profile, motion, seed)
        files = {
            key: data for key, data in calibration_files(CALIBRATION, DESK).items() if "hands" not in key
        }
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
    bones = np.diff(joints_m[:, CHAINS[1:]], axis=2)
    bones /= np.linalg.norm(bones, axis=3, keepdims=True)
    cosine = (bones[:, :, 0] * bones[:, :, 1]).sum(axis=2)
    angles_rad[:, 1:, 2] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return Truth(START_NS + since_ns, joints_m, angles_rad)
