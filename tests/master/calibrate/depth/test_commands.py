"""`calibrate depth` and `calibrate depth --verify` as a user calls them: tables in, laws in the rig file, refusals."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import (
    AffineDisparityCalibration,
    CameraCalibration,
    Provenance,
    RigCalibration,
    load,
    save,
)
from common.errors import CalibrationError, FitError, PhalanxError
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import axis_rotation, rigid
from master.calibrate.depth.source import load_pair
from master.fabrik.depth import AffineDisparity
from tests.cli import calibrate
from tests.hand_helpers import camera_file, rig_file

RIG = AffineDisparity(37.3, 2.64)
STEPS = np.arange(1.0, 0.19, -0.05)


def run(*arguments: object) -> str:
    """What the command prints; what it raises is raised."""
    name, *words = map(str, arguments)
    return calibrate(name, *words)


def tree(tmp_path: Path, rig: RigCalibration | None = None) -> Path:
    """A calib_json tree with the rig "desk", yawed by 0.3 degrees, 500 px."""
    folder = tmp_path / "calib"
    (folder / "rigs").mkdir(parents=True)
    (folder / "cameras").mkdir()
    if rig is None:
        yawed = rigid(axis_rotation(1, np.radians(0.3)), np.array([0.075, 0.0, 0.0]))
        rig = rig_file(T_rig_camera={"left": poses(np.eye(4)), "right": poses(yawed)})
    save(folder / "rigs" / "desk.json", rig)
    for name in rig.cameras:
        save(folder / "cameras" / f"{name}.json", camera_file(name))
    return folder


def poses(T: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in T)


def table(path: Path, disparity: np.ndarray | None = None, header: str = "distance_m,disparity_px") -> Path:
    x = RIG.disparity(STEPS) if disparity is None else disparity
    path.write_text("\n".join([header, *(f"{d:.3f},{v:.3f}" for d, v in zip(STEPS, x, strict=True)), ""]))
    return path


def seen_by(folder: Path, path: Path, side_m: float = 0.0375) -> Path:
    """A table of what the cameras of the tree see of a point at every distance."""
    rig = load(folder / "rigs" / "desk.json", RigCalibration)
    lines = ["distance_m,u_left_px,v_left_px,u_right_px,v_right_px"]
    models = [
        CameraModel.of(load(folder / "cameras" / f"{n}.json", CameraCalibration), rig.camera_pose(n))
        for n in rig.cameras
    ]
    for d in STEPS:
        (ul, vl), (ur, vr) = (model.project(np.array([side_m, 0.01, d])) for model in models)
        lines.append(f"{d:.3f},{ul:.5f},{vl:.5f},{ur:.5f},{vr:.5f}")
    path.write_text("\n".join([*lines, ""]))
    return path


def test_a_table_alone_gives_both_laws_and_writes_nothing(tmp_path: Path) -> None:
    numbers, picture = tmp_path / "n.json", tmp_path / "p.png"
    out = run("depth", table(tmp_path / "s.csv"), "--json", numbers, "--picture", picture)
    assert "nothing written: give --out DIR" in out
    assert "ideal" not in out  # nothing is known of the cameras
    found = json.loads(numbers.read_text())
    assert found["affine_disparity"]["a_m_px"] == pytest.approx(37.3, rel=1e-3)
    assert found["power_law"]["k_m"] == pytest.approx(45.433, rel=0.01)
    assert found["best"] == "affine_disparity"
    assert len(found["points"]) == 17
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_rig_file_gets_laws_date_and_residual_and_keeps_the_rest(tmp_path: Path) -> None:
    calib = tree(tmp_path)
    before = load(calib / "rigs" / "desk.json", RigCalibration)
    out = run("depth", table(tmp_path / "s.csv"), "--calibration", calib, "--rig", "desk", "--out", calib)
    after = load(calib / "rigs" / "desk.json", RigCalibration)
    assert "ideal" in out
    assert "--use affine_disparity" in out  # told, not done
    assert after.depth_model == before.depth_model == "stereo"
    assert after.T_rig_camera == before.T_rig_camera
    assert after.affine_disparity is not None
    assert after.affine_disparity.x0_px == pytest.approx(2.64, abs=0.02)
    provenance = after.provenance["power_law"]
    assert provenance.data == ("s.csv",)
    assert provenance.tool == "calibrate depth"
    assert 0.0 < provenance.residual["mean_percent"] < 1.0
    assert provenance.residual["leave_one_out_mean_percent"] > provenance.residual["mean_percent"]

    again = run(
        "depth", tmp_path / "s.csv", "--calibration", calib, "--rig", "desk", "--out", calib,
        "--use", "affine_disparity",
    )  # fmt: skip
    assert "previous power" in again
    assert "previous affine" in again
    assert load(calib / "rigs" / "desk.json", RigCalibration).depth_model == "affine_disparity"


def test_a_new_tree_is_begun_and_another_rig_of_that_name_is_not_overwritten(tmp_path: Path) -> None:
    calib, new = tree(tmp_path), tmp_path / "new"
    csv = table(tmp_path / "s.csv")
    run("depth", csv, "--calibration", calib, "--rig", "desk", "--out", new)
    assert load(new / "rigs" / "desk.json", RigCalibration).power_law is not None
    assert load(calib / "rigs" / "desk.json", RigCalibration).power_law is None
    save(new / "rigs" / "desk.json", rig_file(("left", "other")))
    with pytest.raises(CalibrationError, match="cameras are left, other"):
        run("depth", csv, "--calibration", calib, "--rig", "desk", "--out", new)


def test_what_is_wrong_stays_out_of_the_tree(tmp_path: Path) -> None:
    calib = tree(tmp_path)
    before = (calib / "rigs" / "desk.json").read_bytes()
    swapped = table(tmp_path / "s.csv", -RIG.disparity(STEPS))
    with pytest.raises(FitError, match="swapped"):
        run("depth", swapped, "--calibration", calib, "--rig", "desk", "--out", calib)
    assert (calib / "rigs" / "desk.json").read_bytes() == before


@pytest.mark.parametrize(("unit_m", "ratio"), [(0.3048, "3.3"), (0.1, "9.9"), (0.5, "2")])
def test_distances_that_are_no_metres_are_refused_where_the_cameras_are_known(
    tmp_path: Path, unit_m: float, ratio: str
) -> None:
    calib, csv = tree(tmp_path), tmp_path / "s.csv"
    lines = [
        f"{d / unit_m:.4f},{x:.3f}" for d, x in zip(STEPS, RIG.disparity(STEPS), strict=True) if d < 0.95
    ]
    csv.write_text("\n".join(["distance_m,disparity_px", *lines]))
    with pytest.raises(FitError, match=rf"s.csv: the distances are {ratio} times .* give metres, not feet"):
        run("depth", csv, "--calibration", calib, "--rig", "desk", "--out", calib)
    assert load(calib / "rigs" / "desk.json", RigCalibration).power_law is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "what to read is missing"),
        (("nothing",), "nothing: does not exist"),
        (("calib/rigs/desk.json",), "neither the folder of a recording nor a .csv"),
        (("s.csv", "--distances", "1:0.2:-0.05"), "--distances has no meaning with s.csv, a table"),
        (("s.csv", "--live"), "a recording or a table has no meaning with --live"),
        (("s.csv", "--save", "x.csv"), "--save has no meaning with a measurement without --live"),
        (("s.csv", "--rig", "desk", "--calibration", "calib", "--fov-deg", "400"), "--fov-deg 400"),
        (("few.csv",), "few.csv: 5 usable distances"),
        (("nothing.txt",), "nothing.txt: does not exist"),
        (("s.csv", "--out", "x"), "--rig NAME"),
        (("s.csv", "--target", "big"), "--target 'big'"),
        (("s.csv", "--rig", "absent"), "absent.json"),
        (("--live", "--rig", "desk", "--calibration", "calib", "--marker", "nose"), "--marker"),
        (("--live", "--bind", "here"), "--bind 'here'"),
    ],
)
def test_a_call_that_cannot_work_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PHALANX_RIG_KEY", bytes(range(32)).hex())
    tree(tmp_path)
    lines = table(tmp_path / "s.csv").read_text().splitlines()
    (tmp_path / "few.csv").write_text("\n".join(lines[:6]))
    with pytest.raises(PhalanxError, match=words):
        run("depth", *arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--distances", "-1,0,2"), "--distances '-1,0,2': distances must be metres, above 0"),
        (("--distances", "100:20:-5"), "not centimetres"),
        (("--angles", "a"), "--angles 'a': expected FIRST:LAST:STEP in degrees"),
        (("--angles", "nan"), "--angles 'nan'"),
        (("--angles", "-90:90:10"), "between -90 and 90"),
    ],
)
def test_verify_names_the_option_that_is_wrong(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    with pytest.raises(CalibrationError, match=words):
        run("depth", "--verify", "--rig", "desk", "--calibration", tree(tmp_path), *arguments)


def test_laws_are_refused_for_three_cameras(tmp_path: Path) -> None:
    calib = tree(tmp_path, rig_file(("left", "right", "top")))
    with pytest.raises(CalibrationError, match="has 3 cameras"):
        run("depth", table(tmp_path / "s.csv"), "--calibration", calib, "--rig", "desk", "--out", calib)


def test_verify_measures_every_model_of_the_rig(tmp_path: Path) -> None:
    calib, numbers, picture = tree(tmp_path), tmp_path / "n.json", tmp_path / "p.png"
    csv = seen_by(calib, tmp_path / "s.csv")
    run("depth", csv, "--calibration", calib, "--rig", "desk", "--out", calib)
    out = run(
        "depth",
        "--verify",
        csv,
        "--calibration",
        calib,
        "--rig",
        "desk",
        "--json",
        numbers,
        "--picture",
        picture,
    )
    assert "fitted to this very sweep" in out
    assert "camera rate: left 60 Hz" in out
    assert "2 % at 1 m/s sideways needs exposures within 1.50 ms" in out
    found = json.loads(numbers.read_text())
    assert found["models"]["stereo"]["max_percent"] < 0.001
    assert found["models"]["affine_disparity"]["max_percent"] < 0.05
    assert 0.1 < found["models"]["power_law"]["mean_percent"] < 1.0
    assert found["rows"][0]["off_axis_deg"] == pytest.approx(np.degrees(np.arctan(0.01 / 0.2)), abs=0.01)
    assert found["budget"]["rows"][-1]["one_pixel_mm"] == pytest.approx(1e3 / 37.5, rel=1e-6)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_predicted_error_off_the_axis_is_the_measured_one(tmp_path: Path) -> None:
    calib, numbers = tree(tmp_path), tmp_path / "n.json"
    run("depth", seen_by(calib, tmp_path / "s.csv"), "--calibration", calib, "--rig", "desk", "--out", calib)
    run(
        "depth",
        "--verify",
        "--calibration",
        calib,
        "--rig",
        "desk",
        "--angles",
        "0,20",
        "--distances",
        "0.5",
        "--json",
        numbers,
    )
    predicted = json.loads(numbers.read_text())["off_axis"]["error_percent"]["affine_disparity"]
    off = tmp_path / "off.csv"
    lines = seen_by(calib, off, side_m=0.0375 + 0.5 * np.tan(np.radians(20.0))).read_text().splitlines()
    off.write_text("\n".join([lines[0], *(line for line in lines if line.startswith("0.500"))]) + "\n")
    run("depth", "--verify", off, "--calibration", calib, "--rig", "desk", "--json", numbers)
    measured = json.loads(numbers.read_text())["rows"][0]
    assert measured["off_axis_deg"] == pytest.approx(20.0, abs=0.1)
    assert predicted[1][0] == pytest.approx(measured["error_percent"]["affine_disparity"], abs=0.01)
    assert abs(predicted[1][0]) > 5 * abs(predicted[0][0])


def test_verify_needs_something_to_verify(tmp_path: Path) -> None:
    csv = table(tmp_path / "s.csv")
    with pytest.raises(CalibrationError, match="nothing to verify"):
        run("depth", "--verify", csv)
    with pytest.raises(CalibrationError, match="v_left_px"):
        run("depth", "--verify", csv, "--calibration", tree(tmp_path), "--rig", "desk")
    with pytest.raises(CalibrationError, match="--sigma-px -1"):
        run("depth", "--verify", csv, "--sigma-px", "-1")


def test_verify_writes_no_law(tmp_path: Path) -> None:
    calib = tree(tmp_path)
    with pytest.raises(CalibrationError, match="--out has no meaning with --verify"):
        run("depth", table(tmp_path / "s.csv"), "--verify", "--calibration", calib, "--out", calib)
    with pytest.raises(CalibrationError, match="--use has no meaning with --verify"):
        run("depth", "--verify", "--calibration", calib, "--use", "stereo")


def test_a_nominal_view_stands_in_for_intrinsics(tmp_path: Path) -> None:
    calib = tree(tmp_path)
    for name in ("left", "right"):
        path = calib / "cameras" / f"{name}.json"
        bare = json.loads(path.read_text())
        bare["intrinsics"] = None
        path.write_text(json.dumps(bare))
    numbers = tmp_path / "n.json"
    out = run("depth", "--verify", "--calibration", calib, "--rig", "desk")
    assert "no budget" in out
    run("depth", "--verify", "--calibration", calib, "--rig", "desk", "--fov-deg", "62.5", "--json", numbers)
    rows = json.loads(numbers.read_text())["budget"]["rows"]
    # One pixel of disparity is 2.53 cm at 1 m and 0.63 cm at 50 cm (docs/theory/sources.md#pixel-of-disparity).
    assert rows[-1]["one_pixel_mm"] == pytest.approx(25.3, abs=0.05)
    assert rows[3]["one_pixel_mm"] == pytest.approx(6.3, abs=0.05)


def test_a_camera_file_made_for_its_colours_does_not_replace_the_recorded_lens(tmp_path: Path) -> None:
    calib = tree(tmp_path)
    measured = Provenance(
        date="2026-01-01T00:00:00Z", tool="calibrate cameras intrinsics", data=(), residual={}
    )
    files = {name: camera_file(name) for name in ("left", "right")}
    recorded = {name: msgspec.structs.replace(file, exposure_us=1.0) for name, file in files.items()}
    for name, expected in (("left", 1.0), ("right", 4000.0)):  # one measured lens is not a pair
        new = msgspec.structs.replace(files[name], provenance={"intrinsics": measured})
        save(calib / "cameras" / f"{name}.json", new)
        assert load_pair(calib, "desk", recorded=recorded).files[0].exposure_us == expected
    (calib / "cameras" / "left.json").unlink()
    with pytest.raises(CalibrationError, match="camera 'right', the recording has not"):
        load_pair(calib, "desk", recorded={"left": recorded["left"]})


def test_a_law_without_depth_at_a_place_is_shown_as_such_and_the_means_are_of_the_others(
    tmp_path: Path,
) -> None:
    law = AffineDisparityCalibration(
        a_m_px=37.3, x0_px=60.0
    )  # no depth below 60 px of disparity: beyond 0.65 m
    calib = tree(tmp_path, rig_file(affine_disparity=law))
    numbers = tmp_path / "n.json"
    out = run(
        "depth",
        "--verify", table(tmp_path / "s.csv"), "--calibration", calib, "--rig", "desk", "--json", numbers
    )  # fmt: skip
    assert "nan" not in out
    found = json.loads(numbers.read_text(), parse_constant=pytest.fail)  # NaN is no JSON
    assert found["rows"][-1]["error_mm"]["affine_disparity"] is None
    assert found["models"]["affine_disparity"]["mean_mm"] > 0.0
