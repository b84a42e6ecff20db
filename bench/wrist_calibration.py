"""What the calibration of a wrist device is worth: laser plane, flat field and palm against the truth they are of.

Boards are rendered before the wrist camera by `common.sim.wrist_board`, each seed another laser and other places of the
board. Wearers are those of `bench.wrist_subjects`, each seed another person.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from bench.row import Row
from bench.wrist_subjects import Person
from common.arrays import Float
from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.flat_field import field_at
from common.calibration.wrist import LaserPlane
from common.errors import FitError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import (
    matrix_to_rotation_vector,
    rotation_vector_to_matrix,
    transform,
)
from common.hand.model import HandModel
from common.recording.frame_recording import Illumination
from common.sim.wrist_board import LED_LOBE, LENS_POWER, WristBoardRenderer, WristBoardScene, board_poses
from master.calibrate.cameras.boards import Checkerboard, board_corners
from master.calibrate.wrist.board_pose import place_corners
from master.calibrate.wrist.flat_command import white_of
from master.calibrate.wrist.flat_field import fit_flat_field
from master.calibrate.wrist.laser_command import LinesSeen, lines_of
from master.calibrate.wrist.lit_views import LitView
from master.calibrate.wrist.palm_board import BoardOffset, palm_from_board
from master.calibrate.wrist.plane import PlaneFit, ViewLine, fit_plane
from master.calibrate.wrist.subject import Subject, calibrate_subject
from master.estimator.wrist_pipeline import WristPipeline
from master.rig.wrist import WristSetup

CALIB = Path("calib_json")
SEEDS = range(100, 120)
LASERS = SEEDS[:12]  # rendered views take a third of a second each
VIEWS = (3, 4, 6, 10)
FLAT_SEEDS, FLAT_VIEWS = range(200, 202), 40
CURLED = 6  # people whose curl is solved, with three tables each
BOARD = Checkerboard(9, 6, 0.015)
PALM_BOARD, OFFSET = Checkerboard(7, 4, 0.010), BoardOffset(0.085, 0.0, 0.022, 1.0)
LENS_SIGMA_PX = (0.35, 0.5)  # focal length, centre: what a calibration from a dozen board views leaves
KNUCKLES = np.array([0.0, 0.0, 0.08])


def rows() -> Iterator[Row]:
    """Errors against the truth: normal [deg], offset [mm], flat field [%], palm [deg, mm]."""
    camera = load(CALIB / "cameras" / "wrist.json", CameraCalibration)
    rig = load(CALIB / "rigs" / "wrist.json", RigCalibration)
    yield from _planes(camera, rig)
    yield from _fields(camera, rig)
    yield from _palms(camera, rig)
    yield from _subjects()


def _planes(camera: CameraCalibration, rig: RigCalibration) -> Iterator[Row]:
    exact: dict[int, list[tuple[PlaneFit, LaserPlane]]] = {count: [] for count in VIEWS}
    wrong_lens: list[tuple[PlaneFit, LaserPlane]] = []
    refused = dict.fromkeys(VIEWS, 0)
    for seed in LASERS:
        plane = _plane_of(seed)
        scene, views = _shown(camera, rig, plane, max(VIEWS), seed)
        seen = lines_of(views, BOARD, scene.optics())
        for count in VIEWS:
            try:
                exact[count].append((fit_plane(_first(seen, count)), plane))
            except FitError:
                refused[count] += 1
        lens = lines_of(views, BOARD, _wrong_lens(camera, seed))
        wrong_lens.append((fit_plane(lens.lines), plane))
    for count in VIEWS:
        note = f"{len(exact[count])} of {len(LASERS)} seeds; {refused[count]} refused: board missed"
        yield from _errors(f"laser plane, {count} views", exact[count], note)
    yield from _errors(
        f"laser plane, {max(VIEWS)} views, lens as measured", wrong_lens, "lens off by its sigma"
    )


def _errors(name: str, found: list[tuple[PlaneFit, LaserPlane]], note: str) -> Iterator[Row]:
    rotation = [_angle_deg(np.array(fit.plane.normal), np.array(true.normal)) for fit, true in found]
    shift = [1e3 * abs(fit.plane.offset_m - true.offset_m) for fit, true in found]
    sigma = [np.degrees(fit.normal_sigma_rad) for fit, _ in found]
    claim = f"largest {max(rotation):.4f}, stated sigma {np.median(sigma):.4f}; goal 0.1; {note}"
    yield Row(f"{name}: normal, median", float(np.median(rotation)), "deg", claim)
    sigma_mm = np.median([1e3 * fit.offset_sigma_m for fit, _ in found])
    claim = f"largest {max(shift):.4f}, stated sigma {sigma_mm:.4f}; goal 0.1"
    yield Row(f"{name}: offset, median", float(np.median(shift)), "mm", claim)


def _fields(camera: CameraCalibration, rig: RigCalibration) -> Iterator[Row]:
    residual: list[float] = []
    worst: list[float] = []
    for seed in FLAT_SEEDS:
        scene, views = _shown(camera, rig, None, FLAT_VIEWS, seed)
        seen = white_of(views, BOARD, scene.optics(), np.array(rig.led))
        try:
            fit = fit_flat_field(seen.samples, scene.optics())
        except FitError as error:
            yield Row(f"flat field, seed {seed}", float("nan"), "%", f"refused: {error}")
            continue
        residual.append(100.0 * fit.cross_validated_rms)
        xy = seen.samples.xy
        ratio = field_at(fit.field, xy) * (1.0 + (xy**2).sum(axis=1)) ** (0.5 * (LED_LOBE + LENS_POWER))
        worst.append(100.0 * float(np.percentile(np.abs(ratio / np.median(ratio) - 1.0), 95)))
    if residual:
        note = f"{len(residual)} seeds of {FLAT_VIEWS} views; largest {max(residual):.2f}"
        yield Row("flat field: residual of views left out", float(np.median(residual)), "%", note)
        yield Row(
            "flat field against the truth, p95 where paper was",
            float(np.median(worst)),
            "%",
            f"largest {max(worst):.2f}",
        )


def _palms(camera: CameraCalibration, rig: RigCalibration) -> Iterator[Row]:
    optics, true = CameraModel.of(camera, np.eye(4)), np.array(rig.T_camera_palm)
    uv = optics.project(transform(true @ OFFSET.T_palm_board(PALM_BOARD), board_corners(PALM_BOARD)))
    by_board: list[tuple[float, float]] = []
    for seed in SEEDS:
        noise = 0.1 * np.random.default_rng(seed).standard_normal(uv.shape)
        fit = palm_from_board([place_corners(uv + noise, PALM_BOARD, optics)], PALM_BOARD, OFFSET)
        by_board.append(_palm_error(fit.T_camera_palm, true))
    yield from _palm_rows(
        "palm by a board, corners 0.1 px", by_board, "one view; the ruler's error comes on top"
    )


def _subjects() -> Iterator[Row]:
    """Mounting and knuckles before and after a guided motion, and the PIP of a natural curl with the files of each."""
    rotation: list[tuple[Float, Float]] = []
    knuckle: list[tuple[Float, Float]] = []
    unlikely: list[Float] = []
    refused = 0
    people: list[tuple[Person, Subject]] = []
    for person in map(Person.of, SEEDS):
        try:
            found = calibrate_subject(person.detected("subject")[0], person.rig, person.camera, person.hand)
        except FitError:
            refused += 1
            continue
        before, after = person.errors(person.rig, person.hand), person.errors(found.rig, found.hand)
        rotation.append((before[0], after[0]))
        knuckle.append((before[1], after[1]))
        unlikely.append(1e-3 * after[1] / found.knuckle_sigma_m)
        people.append((person, found))
    note = f"{len(people)} people, {refused} refused; palm 3 deg, 2 mm, knuckles 5 mm off per axis"
    for k, axis in enumerate(("x, the pitch of the hand", "y", "z")):
        was, now = (_rms(np.array([one[side][k] for one in rotation])) for side in (0, 1))
        yield Row(f"subject: palm's turn about {axis}, rms", now, "deg", f"before {was:.2f}; {note}")
    for k, axis in enumerate(("across", "away from the lens, down", "away from the lens, ahead")):
        was, now = (_rms(np.array([one[side][:, k] for one in knuckle])) for side in (0, 1))
        yield Row(f"subject: knuckles {axis}, rms", now, "mm", f"before {was:.2f}")
    yield Row(
        "subject: knuckles by stated sigma, rms",
        _rms(np.array(unlikely)),
        "sigma",
        "1 is honest, less is careful",
    )
    errors = [_pip_errors(person, found) for person, found in people[:CURLED]]
    for k, name in enumerate(("files as they were", "calibrated", "true files")):
        value = _rms(np.concatenate([one[k] for one in errors]))
        yield Row(
            f"subject: PIP of a natural curl, {name}, rms", value, "deg", f"{len(errors)} people, to 90 deg"
        )


def _pip_errors(person: Person, found: Subject) -> list[Float]:
    """Errors [deg] with the old, the new and the true files."""
    cycles, true = person.detected("curl", np.linspace(0.3, 3.6, 24))
    out: list[Float] = []
    for rig, hand in (
        (person.rig, person.hand),
        (found.rig, found.hand),
        (person.true_rig, person.true_hand),
    ):
        line = WristPipeline(WristSetup.of(rig, person.camera, HandModel.of(hand)), continuous=False)
        angles = np.array([line.push(cycle)[0].pose.angles_rad for cycle in cycles])
        error = np.degrees(angles[:, 1:, 2] - true[:, 1:, 2])
        out.append(error[np.isfinite(error)])
    return out


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _palm_rows(name: str, found: list[tuple[float, float]], note: str) -> Iterator[Row]:
    rotation, shift = np.array(found).T
    yield Row(
        f"{name}: turn, median", float(np.median(rotation)), "deg", f"largest {rotation.max():.2f}; {note}"
    )
    yield Row(f"{name}: knuckles, median", float(np.median(shift)), "mm", f"largest {shift.max():.2f}")


def _plane_of(seed: int) -> LaserPlane:
    """A laser tilted by up to 6 degrees, 26 to 34 mm from the camera."""
    rng = np.random.default_rng([seed, 1])
    x, y, z = rotation_vector_to_matrix(np.radians(rng.uniform(-6.0, 6.0, 3)))[:, 1].tolist()
    return LaserPlane(normal=(x, y, z), offset_m=0.03 + float(rng.uniform(-0.004, 0.004)))


def _shown(
    camera: CameraCalibration, rig: RigCalibration, plane: LaserPlane | None, count: int, seed: int
) -> tuple[WristBoardScene, tuple[LitView, ...]]:
    """A board before the device and its rendered views; without a plane anywhere, and without laser frames."""
    own = rig if plane is None else replace(rig, laser_plane=plane, laser=None)
    optics = CameraModel.of(camera, np.eye(4))
    poses = board_poses(optics, BOARD.columns, BOARD.rows, BOARD.square_m, plane, count, seed)
    scene = WristBoardScene(own, camera, BOARD.columns, BOARD.rows, BOARD.square_m, poses, seed=seed)
    renderer = WristBoardRenderer(scene)
    kinds = [lit for lit in Illumination if lit is not Illumination.NONE]
    if plane is None:
        kinds.remove(Illumination.LASER)
    views: list[LitView] = []
    for pose in range(count):
        images = {lit: renderer.render(pose, lit) for lit in kinds}
        views.append(LitView(str(pose), {lit: lambda image=image: image for lit, image in images.items()}))
    return scene, tuple(views)


def _first(seen: LinesSeen, count: int) -> tuple[ViewLine, ...]:
    return tuple(line for line in seen.lines if int(line.name) < count)


def _wrong_lens(camera: CameraCalibration, seed: int) -> CameraModel:
    """The camera with a lens that is off as a measured one is."""
    lens = camera.intrinsics
    assert lens is not None
    rng = np.random.default_rng([seed, 2])
    focal = float(rng.normal(0.0, LENS_SIGMA_PX[0]))
    u, v = rng.normal(0.0, LENS_SIGMA_PX[1], 2).tolist()
    off = replace(
        lens, fx_px=lens.fx_px + focal, fy_px=lens.fy_px + focal, cx_px=lens.cx_px + u, cy_px=lens.cy_px + v
    )
    return CameraModel.of(replace(camera, intrinsics=off), np.eye(4))


def _palm_error(T: Float, true: Float) -> tuple[float, float]:
    """Turn [deg], and how far the knuckles are off [mm]."""
    rotation = float(np.degrees(np.linalg.norm(matrix_to_rotation_vector(T[:3, :3] @ true[:3, :3].T))))
    return rotation, float(1e3 * np.linalg.norm(transform(T, KNUCKLES) - transform(true, KNUCKLES)))


def _angle_deg(a: Float, b: Float) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
