"""Errors of the calibration of a wrist device against exact truth: its laser plane, palm and knuckles of the subject.

Boards are rendered, each seed another laser and other places of the board. The files of people are wrong in the pose of
the palm (3 degrees and 2 mm per axis) and in the knuckles (5 mm per axis); their detections are the simulated truth
with noise, and one tip in twenty is none.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from bench.report import Row, rig_files, rms
from bench.study.trials import participant
from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration
from common.calibration.rig import LaserPlane
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_rotation_vector, rotation_vector_to_matrix, transform
from common.hand.model import CHAINS, JOINTS, HandModel
from common.messages import WristDetections
from common.recording.frame_recording import Illumination
from common.sim.wrist.board import WristBoardRenderer, WristBoardScene, board_poses
from common.sim.wrist.scene import WristScene
from master.calibrate.cameras.boards import Checkerboard
from master.calibrate.wrist.device import LitView
from master.calibrate.wrist.laser_plane import PlaneFit, fit_plane, lines_of
from master.calibrate.wrist.subject import Subject, calibrate_subject
from master.calibrate.wrist.subject_model import UNKNOWN, Unknown
from master.estimator.wrist_pipeline import WristPipeline
from master.rig.setup import WristSetup

LASER_PX, TIP_PX = 0.4, 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """One who wears the device; same seed, same person."""

    seed: int
    camera: CameraCalibration  # of the device
    rig: RigCalibration  # as the files have it
    hand: HandProfile
    true_rig: RigCalibration  # as it is
    true_hand: HandProfile

    @classmethod
    def of(cls, seed: int, knuckles_m: float = 5e-3) -> "Person":
        """Draw one; even seeds have right hands. `knuckles_m`: how far each knuckle is off, per axis, either way."""
        left = bool(seed % 2)
        rig, cameras, typical = rig_files("wrist-left" if left else "wrist")
        camera = cameras[rig.cameras[0]]
        who = participant(seed, 1, rig, typical)
        moved = np.random.default_rng([seed, 5]).uniform(-knuckles_m, knuckles_m, (4, 3))
        return cls(seed, camera, rig, who.measured, who.rig, with_knuckles(who.hand, moved))

    def shown(self, scene: str) -> WristScene:
        """What this person does."""
        return WristScene.by_name(
            scene, self.true_rig, {self.camera.name: self.camera}, self.true_hand, self.seed
        )

    def detected(self, scene: str, times_s: Float | None = None) -> tuple[list[WristDetections], Float]:
        """What the slave sees of a scene at these times (T,), and the true angles (T, 5, 4) [rad]."""
        shown, rng = self.shown(scene), np.random.default_rng([self.seed, 6])
        every_s = 0.2
        times_s = np.arange(0.0, shown.period_s, every_s) if times_s is None else times_s
        out: list[WristDetections] = []
        angles: list[Float] = []
        for k, t_s in enumerate(times_s.tolist()):
            truth = shown.truth(t_s)
            laser = truth.laser_uv[1:6] + rng.normal(0.0, LASER_PX, (5, 2))
            tip = np.where(truth.tip_visible[:, None], truth.tip_uv, np.nan) + rng.normal(0.0, TIP_PX, (5, 2))
            false_tips, false_px = 0.05, 60.0
            wrong = rng.uniform(size=5) < false_tips
            tip[wrong] += rng.uniform(-false_px, false_px, (int(wrong.sum()), 2))
            out.append(detections(self.camera.name, k, laser, tip))
            angles.append(truth.angles_rad)
        return out, np.array(angles)

    def errors(self, rig: RigCalibration, hand: HandProfile) -> tuple[Float, Float]:
        """Turn of the palm (3,) [deg], camera axes, and where knuckles are beside the true ones (4, 3) [mm]."""
        pose, true = (np.array(one.T_camera_palm) for one in (rig, self.true_rig))
        rotation = np.degrees(matrix_to_rotation_vector(pose[:3, :3] @ true[:3, :3].T))
        return rotation, 1e3 * (transform(pose, knuckles(hand)) - transform(true, knuckles(self.true_hand)))


def detections(camera: str, k: int, laser: Float, tip: Float) -> WristDetections:
    """Triple `k` with laser points and tips (5, 2) [px]."""
    unseen, none = np.isnan(laser[:, 0]), np.isnan(tip[:, 0])
    sigma, tip_sigma = np.where(unseen, np.nan, LASER_PX), np.where(none, np.nan, TIP_PX)
    t_ns, nothing = k * 100_000_000, np.full(5, np.nan)
    return WristDetections(camera, 0, 3 * k, t_ns, t_ns, laser, sigma, nothing, tip, tip_sigma, nothing)


def knuckles(hand: HandProfile) -> Float:
    """(4, 3) of index ... little [m], palm frame."""
    return HandModel.of(hand).rest_position_m[CHAINS[1:, 0]]


def with_knuckles(hand: HandProfile, moved_m: Float) -> HandProfile:
    """The hand with the knuckles of index ... little, and their fingers, moved by (4, 3) [m], palm frame."""
    joints = dict(hand.rest_joints)
    for chain, moved in zip(CHAINS[1:], moved_m, strict=True):
        for name in (JOINTS[int(joint)] for joint in chain):
            x, y, z = (np.array(joints[name].position_m) + moved).tolist()
            joints[name] = replace(joints[name], position_m=(x, y, z))
    return replace(hand, rest_joints=joints)


_SEEDS = range(100, 120)
_LASERS = _SEEDS[:12]  # rendered views take a third of a second each
_VIEWS = (3, 4, 6, 10)
_BOARD = Checkerboard(9, 6, 0.015)
_LENS_SIGMA_PX = (0.35, 0.5)  # focal length, centre: of a calibration from a dozen board views
_LIT = (Illumination.AMBIENT, Illumination.LASER, Illumination.LED)


def knuckle_sigma_m(found: Subject) -> Float:
    """Standard deviations (4, 3) [m] of knuckles, by palm and hand file together."""
    by_x, nudge = np.empty((4, 3, UNKNOWN)), 1e-5
    for k, step in enumerate(nudge * np.eye(UNKNOWN)):
        ahead, behind = (found.model.knuckles(Unknown.of(found.fit.x + by)) for by in (step, -step))
        by_x[..., k] = (ahead - behind) / (2.0 * nudge)
    return np.sqrt(np.einsum("fki,ij,fkj->fk", by_x, found.fit.covariance, by_x))


def rows() -> Iterator[Row]:
    """Measure laser planes: normal [deg], offset [mm]; and subjects: palm [deg], knuckles [mm], PIP [deg]."""
    rig, cameras, _ = rig_files("wrist")
    yield from _planes(cameras["wrist"], rig)
    yield from _subjects()


def _planes(camera: CameraCalibration, rig: RigCalibration) -> Iterator[Row]:
    exact: dict[int, list[tuple[PlaneFit, LaserPlane]]] = {count: [] for count in _VIEWS}
    wrong_lens: list[tuple[PlaneFit, LaserPlane]] = []
    refused = dict.fromkeys(_VIEWS, 0)
    for seed in _LASERS:
        plane = _plane_of(seed)
        scene, views = _shown(camera, rig, plane, max(_VIEWS), seed)
        lines, _ = lines_of(views, _BOARD, scene.optics())
        for count in _VIEWS:
            try:
                fit = fit_plane(tuple(line for line in lines if int(line.name) < count))
            except FitError:
                refused[count] += 1
            else:
                exact[count].append((fit, plane))
        wrong_lens.append((fit_plane(lines_of(views, _BOARD, _wrong_lens(camera, seed))[0]), plane))
    for count in _VIEWS:
        note = f"{len(exact[count])} of {len(_LASERS)} seeds; {refused[count]} refused: board missed"
        yield from _errors(f"laser plane, {count} views", exact[count], note)
    name = f"laser plane, {max(_VIEWS)} views, lens as measured"
    yield from _errors(name, wrong_lens, "lens off by its sigma")


def _errors(name: str, found: list[tuple[PlaneFit, LaserPlane]], note: str) -> Iterator[Row]:
    normals = [(np.array(fit.plane.normal), np.array(true.normal)) for fit, true in found]
    rotation = [np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)) for a, b in normals]
    shift = [1e3 * abs(fit.plane.offset_m - true.offset_m) for fit, true in found]
    sigma_deg = np.median([np.degrees(fit.normal_sigma_rad) for fit, _ in found])
    sigma_mm = np.median([1e3 * fit.offset_sigma_m for fit, _ in found])
    stated = f"largest {max(rotation):.4f}, stated sigma {sigma_deg:.4f}; goal 0.1; {note}"
    yield Row(f"{name}: normal, median", float(np.median(rotation)), "deg", stated)
    stated = f"largest {max(shift):.4f}, stated sigma {sigma_mm:.4f}; goal 0.1"
    yield Row(f"{name}: offset, median", float(np.median(shift)), "mm", stated)


def _subjects() -> Iterator[Row]:
    """Mounting and knuckles before and after a guided motion, and the PIP of a natural curl with the files of each."""
    rotation, knuckle = list[tuple[Float, Float]](), list[tuple[Float, Float]]()
    unlikely, people = list[Float](), list[tuple[Person, Subject]]()
    for person in map(Person.of, _SEEDS):
        try:
            found = calibrate_subject(person.detected("subject")[0], person.rig, person.camera, person.hand)
        except FitError:
            continue
        before, after = person.errors(person.rig, person.hand), person.errors(found.rig, found.hand)
        rotation.append((before[0], after[0]))
        knuckle.append((before[1], after[1]))
        unlikely.append(1e-3 * after[1] / knuckle_sigma_m(found))
        people.append((person, found))
    note = f"{len(people)} of {len(_SEEDS)} people; palm 3 deg, 2 mm, knuckles 5 mm off per axis"
    for k, axis in enumerate(("x, the pitch of the hand", "y", "z")):
        was, now = (rms([one[side][k] for one in rotation]) for side in (0, 1))
        yield Row(f"subject: palm's turn about {axis}, rms", now, "deg", f"before {was:.2f}; {note}")
    for k, axis in enumerate(("across", "away from the lens, down", "away from the lens, ahead")):
        was, now = (rms(np.array([one[side][:, k] for one in knuckle])) for side in (0, 1))
        yield Row(f"subject: knuckles {axis}, rms", now, "mm", f"before {was:.2f}")
    yield Row("subject: knuckles by stated sigma, rms", rms(np.array(unlikely)), "sigma", "goal 1")
    curled = 6  # people whose curl is solved, with three tables each
    errors = [_pip_errors(person, found) for person, found in people[:curled]]
    for k, name in enumerate(("files as they were", "calibrated", "true files")):
        value, note = rms(np.concatenate([one[k] for one in errors])), f"{len(errors)} people, to 90 deg"
        yield Row(f"subject: PIP of a natural curl, {name}, rms", value, "deg", note)


def _pip_errors(person: Person, found: Subject) -> list[Float]:
    """Errors [deg] with the old, the new and the true files."""
    cycles, true = person.detected("curl", np.linspace(0.3, 3.6, 24))
    files = (person.rig, person.hand), (found.rig, found.hand), (person.true_rig, person.true_hand)
    out: list[Float] = []
    for rig, hand in files:
        line = WristPipeline(WristSetup.of(rig, person.camera, HandModel.of(hand)), continuous=False)
        angles = np.array([line.push(cycle)[0].pose.angles_rad for cycle in cycles])
        out.append(np.degrees(angles[:, 1:, 2] - true[:, 1:, 2]))
    return out


def _plane_of(seed: int) -> LaserPlane:
    """A laser tilted by up to 6 degrees, 26 to 34 mm from the camera."""
    rng = np.random.default_rng([seed, 1])
    x, y, z = rotation_vector_to_matrix(np.radians(rng.uniform(-6.0, 6.0, 3)))[:, 1].tolist()
    return LaserPlane(normal=(x, y, z), offset_m=0.03 + float(rng.uniform(-0.004, 0.004)))


def _shown(
    camera: CameraCalibration, rig: RigCalibration, plane: LaserPlane, count: int, seed: int
) -> tuple[WristBoardScene, tuple[LitView, ...]]:
    """A board before the device and its rendered views."""
    own = replace(rig, laser_plane=plane, laser=None)
    size = (_BOARD.columns, _BOARD.rows, _BOARD.square_m)
    poses = board_poses(CameraModel.of(camera, np.eye(4)), *size, plane, count, seed)
    scene = WristBoardScene(own, camera, *size, poses, seed=seed)
    renderer = WristBoardRenderer(scene)
    views: list[LitView] = []
    for pose in range(count):
        images = {lit: renderer.render(pose, lit) for lit in _LIT}
        views.append(LitView(str(pose), {lit: lambda image=image: image for lit, image in images.items()}))
    return scene, tuple(views)


def _wrong_lens(camera: CameraCalibration, seed: int) -> CameraModel:
    """The camera with a lens that is off as a measured one is."""
    lens = camera.intrinsics
    assert lens is not None
    rng = np.random.default_rng([seed, 2])
    focal = float(rng.normal(0.0, _LENS_SIGMA_PX[0]))
    u, v = rng.normal(0.0, _LENS_SIGMA_PX[1], 2).tolist()
    fx, fy, cx, cy = lens.fx_px + focal, lens.fy_px + focal, lens.cx_px + u, lens.cy_px + v
    off = replace(lens, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy)
    return CameraModel.of(replace(camera, intrinsics=off), np.eye(4))
