"""Who wears a device: knuckles and palm of simulated people are found again, and motions that tell nothing refused."""

import json
from collections.abc import Callable
from dataclasses import replace as replaced
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from bench.report import CALIBRATION
from bench.wrist.calibration import Person, knuckle_sigma_m, knuckles
from common.arrays import Float
from common.calibration import HandProfile, RigCalibration, load, parse, save
from common.errors import CalibrationError, FitError
from common.geometry.transforms import rotation_vector_to_matrix, transform
from common.hand.model import CHAINS, HandModel
from common.hand.skin import PalmarSurface
from common.messages import WristDetections
from common.recording.recorded_files import write_npz
from master.calibrate.tree_files import matrix_of, provenance
from master.calibrate.wrist import subject
from master.calibrate.wrist.subject import Subject, _check, calibrate_subject
from master.calibrate.wrist.subject_fit import FLAT, fists_of, guided
from master.calibrate.wrist.subject_model import MCP, UNKNOWN, SubjectModel, Unknown, fitted_profile
from master.rig.setup import WristSetup
from tests.cli import calibrate
from tests.picture_helpers import mirrored

ANGLES = np.radians(
    [[[2.0, 0.0, 0.0]] * 4, [[0.0, 50.0, 4.0]] * 4, [[-3.0, 85.0, 0.0]] * 4, [[1.0, 30.0, 60.0]] * 4]
)


def setup_of(person: Person) -> WristSetup:
    return WristSetup.of(person.rig, person.camera, HandModel.of(person.hand))


@pytest.fixture(scope="module")
def people() -> dict[int, Person]:
    """A right and a left hand, whose files are wrong in palm and knuckles."""
    return {seed: Person.of(seed) for seed in (40, 41)}


@pytest.fixture(scope="module")
def motions(people: dict[int, Person]) -> dict[int, list[WristDetections]]:
    """The guided motion of each, as seen."""
    return {seed: person.detected("subject")[0] for seed, person in people.items()}


@pytest.fixture(scope="module")
def subjects(people: dict[int, Person], motions: dict[int, list[WristDetections]]) -> dict[int, Subject]:
    """What is made of it."""
    return {
        seed: calibrate_subject(motions[seed], person.rig, person.camera, person.hand)
        for seed, person in people.items()
    }


@pytest.mark.parametrize("seed", [40, 41])
def test_knuckles_5_mm_off_and_a_palm_askew_are_found_within_stated_sigma(
    people: dict[int, Person], subjects: dict[int, Subject], seed: int
) -> None:
    person, found = people[seed], subjects[seed]
    rotation_before, before = person.errors(person.rig, person.hand)
    rotation, after = person.errors(found.rig, found.hand)
    assert np.sqrt(np.mean(after**2)) < 0.75 * np.sqrt(np.mean(before**2))
    assert np.abs(after[:, 0]).max() < 2.5  # across is what the laser tells best [mm]
    by_sigma = 1e-3 * after / knuckle_sigma_m(found)
    assert np.sqrt(np.mean(by_sigma**2)) < 1.5
    assert np.abs(by_sigma).max() < 3.0
    # About y and z the palm is told by where fingers go aside, about x by the flat hand alone.
    assert np.linalg.norm(rotation[1:]) < max(2.5, np.linalg.norm(rotation_before[1:]))
    assert abs(rotation[0]) < 3.0 * np.degrees(np.sqrt(found.fit.covariance[0, 0]))
    assert found.rig.provenance["T_camera_palm"].tool == "calibrate wrist subject"
    assert {"knuckles", "palmar_scale"} <= found.hand.provenance.keys()
    # What is written is what was fitted.
    written = transform(np.array(found.rig.T_camera_palm), knuckles(found.hand))
    np.testing.assert_allclose(written, found.model.knuckles(found.unknown), atol=1e-7)


def test_what_the_laser_does_not_constrain_keeps_its_prior_and_is_reported(
    people: dict[int, Person], motions: dict[int, list[WristDetections]], subjects: dict[int, Subject]
) -> None:
    person, cycles, found = people[40], motions[40], subjects[40]
    shrunk = Unknown.of(np.sqrt(np.diag(found.fit.covariance)) / found.fit.prior_sigma)
    assert shrunk.knuckle_m[:, 0].max() < 0.7  # across
    assert shrunk.thick.min() > 0.8  # a thicker finger looks like a knuckle farther away
    # With a palm that a board has placed, knuckles are known better.
    rig = replace(person.true_rig, provenance={"T_camera_palm": provenance("calibrate wrist palm", (), {})})
    placed = calibrate_subject(cycles, rig, person.camera, person.hand)
    surer = Unknown.of(np.sqrt(np.diag(placed.fit.covariance)) / placed.fit.prior_sigma)
    assert (surer.knuckle_m[:, :2] < shrunk.knuckle_m[:, :2]).all()  # across and up
    assert np.sqrt(np.mean(person.errors(placed.rig, placed.hand)[1] ** 2)) < 3.0


def test_derivatives_are_those_of_the_function(people: dict[int, Person]) -> None:
    model, rng = SubjectModel(setup_of(people[41])), np.random.default_rng(0)
    x = 1e-3 * rng.standard_normal(UNKNOWN)
    by_x, by_angles = model.derivatives(x, ANGLES)
    way, rotation = 3e-4 * rng.standard_normal(UNKNOWN), 3e-3 * rng.standard_normal(ANGLES.shape)
    ahead, behind = model(x + way, ANGLES + rotation), model(x - way, ANGLES - rotation)
    change = 2.0 * (by_x @ way + (by_angles @ rotation[..., None])[..., 0])
    scale = np.array([1e-4, 1e-4, 0.2, 0.2])  # m and px
    np.testing.assert_array_less(np.abs((ahead - behind - change) / scale), 1.0)


def test_the_files_written_show_what_was_fitted(people: dict[int, Person]) -> None:
    person, rng = people[40], np.random.default_rng(1)
    for hand in (person.hand, replace(person.hand, radius_m=None)):
        setup = WristSetup.of(person.rig, person.camera, HandModel.of(hand))
        model = SubjectModel(setup)
        x = rng.standard_normal(UNKNOWN) * np.r_[np.full(18, 1e-3), np.full(8, 0.02)]
        unknown = Unknown.of(x)
        new = HandModel.of(fitted_profile(setup.model, unknown))
        rig = replace(person.rig, T_camera_palm=matrix_of(model.palm(unknown)))
        again = SubjectModel(WristSetup.of(rig, person.camera, new))
        fitted, shown = model(x, ANGLES), again(np.zeros(UNKNOWN), ANGLES)
        np.testing.assert_allclose(shown[..., :2], fitted[..., :2], atol=3e-4)
        np.testing.assert_allclose(shown[..., 2:], fitted[..., 2:], atol=2.0)
        assert (new.rest_position_m[CHAINS[0]] == setup.model.rest_position_m[CHAINS[0]]).all()


@pytest.mark.parametrize(
    ("cost", "fists"),
    [
        (((10.0, 165.0), (204.0, 38.0)), [False, True]),
        (((10.0, 165.0), (81.0, 95.0)), [False, True]),  # false tips: it suits neither
        (((90.0, 80.0), (150.0, 20.0)), [False, True]),
        (((150.0, 20.0), (140.0, 30.0)), [True, True]),  # what was clearly done is not made another
        (((10.0, 165.0), (12.0, 150.0)), [False, False]),
        (((20.0, 25.0), (30.0, 25.0)), [False, True]),
    ],
)
def test_an_unclear_bend_is_of_the_kind_that_is_missing(
    cost: tuple[tuple[float, float], ...], fists: list[bool]
) -> None:
    assert fists_of(np.array(cost)).tolist() == fists


def along(*bends: float, flat: float = 0.17) -> Float:
    """Laser points (T, 4) of a hand that is flat, bends until they are so near [m], and is flat again."""
    parts = [np.full(6, flat)]
    for near in bends:
        way = flat + (near - flat) * (0.5 - 0.5 * np.cos(np.linspace(0.0, 2.0 * np.pi, 30)))
        parts += [way, np.full(6, flat)]
    return np.repeat(np.concatenate(parts)[:, None], 4, axis=1)


def test_a_motion_falls_into_its_bends() -> None:
    found = guided(along(0.09, 0.11))
    assert set(found.bend.tolist()) == {FLAT, 0, 1}
    assert (found.row[found.bend == 0].max() < found.row[found.bend == 1].min()).all()
    gaps = along(0.09, 0.11)
    gaps[::3, 1] = np.nan
    gaps[7] = np.nan
    assert set(guided(gaps).bend.tolist()) == {FLAT, 0, 1}


@pytest.mark.parametrize(
    ("seen", "match"),
    [
        (along(0.09), "the hand bent 1 times .* open the hand flat"),
        (along(0.165, 0.165), "0 fingers bend before the laser"),
        (np.full((40, 4), np.nan), "0 fingers bend before the laser"),
        (np.empty((0, 4)), "0 fingers bend before the laser"),
        (along(0.09, 0.11) * [1.0, np.nan, np.nan, 1.0], "2 fingers bend before the laser, at least 3"),
    ],
)
def test_a_motion_without_its_parts_is_refused(seen: Float, match: str) -> None:
    with pytest.raises(FitError, match=match):
        guided(seen)


def no_tips(uv: Float, name: str) -> Float:
    return uv + (np.nan if name == "tip" else 0.0)


def no_laser(uv: Float, name: str) -> Float:
    return uv + (np.nan if name == "laser" else 0.0)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (mirrored, "no likely subject.*hand and side"),
        (no_tips, "0 fingertips are seen, at least 8"),
        (no_laser, "0 fingers bend before the laser"),
    ],
)
def test_a_fault_of_the_device_is_refused_by_name(
    people: dict[int, Person],
    motions: dict[int, list[WristDetections]],
    change: Callable[[Float, str], Float],
    cause: str,
) -> None:
    person, wrong = people[40], list[WristDetections]()
    for one in motions[40]:
        laser, tip = change(one.laser_uv, "laser"), change(one.tip_uv, "tip")
        laser_sigma, tip_sigma = (
            np.where(np.isnan(uv[:, 0]), np.nan, sigma)
            for uv, sigma in ((laser, one.laser_sigma_px), (tip, one.tip_sigma_px))
        )
        wrong.append(
            replace(one, laser_uv=laser, tip_uv=tip, laser_sigma_px=laser_sigma, tip_sigma_px=tip_sigma)
        )
    with pytest.raises(FitError, match=cause):
        calibrate_subject(wrong, person.rig, person.camera, person.hand)


def test_a_hand_file_of_the_other_side_is_refused(
    people: dict[int, Person], motions: dict[int, list[WristDetections]]
) -> None:
    person, hand = people[40], load(CALIBRATION / "hands" / "default-left.json", HandProfile)
    with pytest.raises(FitError, match=r"no likely subject.*hand file that of this hand and side"):
        calibrate_subject(motions[40], person.rig, person.camera, hand)


def test_a_laser_plane_that_is_six_degrees_off_is_refused(
    people: dict[int, Person], motions: dict[int, list[WristDetections]]
) -> None:
    person, rig = people[40], people[40].rig
    assert rig.laser_plane is not None
    rotated = rotation_vector_to_matrix(np.array([0.1, 0.0, 0.0])) @ np.array(rig.laser_plane.normal)
    x, y, z = rotated.tolist()
    wrong = replace(rig, laser_plane=replace(rig.laser_plane, normal=(x, y, z)))
    with pytest.raises(
        FitError, match=r"no likely subject.*laser plane measured|never|bent at their knuckles"
    ):
        calibrate_subject(motions[40], wrong, person.camera, person.hand)


def test_a_motion_that_determines_nothing_is_refused(subjects: dict[int, Subject]) -> None:
    """One without straight fingers that bend, one without a fist, and one that bends them by 40 degrees only."""
    found = subjects[40]
    fit, half = found.fit, found.fit.angles_rad.copy()
    half[..., MCP] = np.minimum(half[..., MCP], np.radians(40.0))
    _check(fit, found.seen)
    for wrong, match in (
        (replaced(fit, fist=np.ones_like(fit.fist)), "never bends straight fingers at their knuckles"),
        (replaced(fit, fist=np.zeros_like(fit.fist)), "never closes to a fist"),
        (replaced(fit, angles_rad=half), "bent at their knuckles to index 40, .* bend them towards 90 deg"),
    ):
        with pytest.raises(FitError, match=match):
            _check(wrong, found.seen)


def test_a_hand_file_says_how_thick_its_fingers_are(people: dict[int, Person]) -> None:
    hand = people[40].hand
    for plain in (hand, replace(hand, radius_m=None)):
        typical, thick = (
            PalmarSurface.of(HandModel.of(one)) for one in (plain, replace(plain, palmar_scale={"ring": 1.2}))
        )
        ratio = thick.palmar_m / typical.palmar_m
        np.testing.assert_allclose(ratio[3], 1.2)
        np.testing.assert_allclose(np.delete(ratio, 3, axis=0), 1.0)
        np.testing.assert_allclose(thick.radius_m / typical.radius_m, ratio)


@pytest.mark.parametrize(("key", "value"), [("ringfinger", "1.1"), ("ring", "0.1"), ("ring", '"thick"')])
def test_a_thickness_that_is_none_is_refused_with_its_key(key: str, value: str) -> None:
    raw = (CALIBRATION / "hands" / "default-right.json").read_text()
    wrong = raw.replace('"version": 1,', f'"version": 1, "palmar_scale": {{"{key}": {value}}},', 1)
    with pytest.raises(CalibrationError, match=r"me\.json.*palmar_scale"):
        parse(wrong.encode(), HandProfile, "me.json")


def test_the_command_writes_rig_and_hand_and_draws(
    people: dict[int, Person],
    motions: dict[int, list[WristDetections]],
    subjects: dict[int, Subject],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    person, rows = people[40], motions[40]

    def fitted(cycles: list[WristDetections], rig: RigCalibration, *_: object) -> Subject:
        """The fit to the same motion, which lasts some seconds."""
        np.testing.assert_array_equal([one.laser_uv for one in cycles], [one.laser_uv for one in rows])
        np.testing.assert_array_equal([one.tip_uv for one in cycles], [one.tip_uv for one in rows])
        assert rig.T_camera_palm == person.rig.T_camera_palm
        return subjects[40]

    monkeypatch.setattr(subject, "calibrate_subject", fitted)
    for folder, name, value in (
        ("rigs", person.rig.name, person.rig),
        ("cameras", person.camera.name, person.camera),
        ("hands", person.rig.hand, replace(person.hand, name=person.rig.hand)),
    ):
        (tmp_path / "tree" / folder).mkdir(parents=True, exist_ok=True)
        save(tmp_path / "tree" / folder / f"{name}.json", value)
    (tmp_path / "found").mkdir()
    columns = {
        key: np.array([getattr(row, key) for row in rows])
        for key in ("t_ns", "seq", "laser_uv", "laser_sigma_px", "tip_uv", "tip_sigma_px")
    }
    write_npz(tmp_path / "found" / f"detections_{person.camera.name}.npz", columns)
    out, picture = tmp_path / "out", tmp_path / "subject.png"
    options = [
        "--detections",
        tmp_path / "found",
        "--rig",
        person.rig.name,
        "--calibration",
        tmp_path / "tree",
    ]
    options += ["--name", "me", "--out", out, "--picture", picture, "--json", tmp_path / "report.json"]
    calibrate("subject", tmp_path / "guided", *options)
    rig = load(out / "rigs" / f"{person.rig.name}.json", RigCalibration)
    hand = load(out / "hands" / "me.json", HandProfile)
    assert rig.hand == hand.name == "me"
    assert hand.palmar_scale.keys() == {"index", "middle", "ring", "little"}
    assert cv2.imread(str(picture)) is not None
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["fingers"]["ring"]["knuckle_sigma_mm"][0] < 3.0
    WristSetup.of(rig, person.camera, HandModel.of(hand))
