"""A mounting from a motion without noise is that of the truth, by the command as by its parts; and what is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace as replaced

from common.arrays import Float
from common.calibration import RigCalibration, load, save
from common.errors import CalibrationError, FitError
from common.geometry.transforms import quaternion_to_matrix
from common.imu.csv_table import write_imu
from common.messages import HandPose
from common.recording.frame_recording import COLUMNS, FRAMES, MANIFEST, Manifest
from master.calibrate.extrinsics import extrinsics, problem
from master.calibrate.extrinsics.extrinsics import calibrate_extrinsics, refuse
from master.calibrate.extrinsics.unknown import UNKNOWN, Fit
from master.rig.setup import RigSetup
from tests.cli import calibrate
from tests.master.calibrate.extrinsics.moved import CAMERA_LATE_NS, IMU_LATE_NS, Moved, moved
from tests.master.calibrate.extrinsics.worn import errors
from tests.master.replay.test_solve_both import write_detections
from tests.picture_helpers import mirrored

CERTAIN = {
    "rotation_sigma_deg": 1.0,
    "shift_sigma_mm": 1.0,
    "imu_rotation_sigma_deg": 1.0,
    "camera_imu_sigma_deg": 1.0,
    "camera_clock_sigma_ms": 1.0,
    "imu_clock_sigma_ms": 1.0,
}


def calibrated(seen: Moved, **other: object) -> extrinsics.Extrinsics:
    """The mounting, with some of what was seen replaced."""
    markers = seen.both.markers
    given: dict[str, object] = {
        "poses": seen.poses,
        "markers": markers.markers,
        "model": markers.hand,
        "cycles": seen.cycles,
        "samples": seen.samples,
        "rig": seen.rig,
        "camera": seen.both.wrist.cameras[seen.rig.cameras[0]],
    }
    return calibrate_extrinsics(**(given | other))  # pyright: ignore[reportArgumentType]


def recorded(seen: Moved, folder: Path) -> Path:
    """The same as a recording without frames, with its detections."""
    markers, wrist = seen.both.markers, seen.both.wrist
    cameras = {**markers.cameras, **wrist.cameras}
    save(
        folder / MANIFEST,
        Manifest(version=1, kind="both", cameras=cameras, rig=markers.rig, rigs=(seen.rig,)),
    )
    (folder / FRAMES).write_text(",".join(COLUMNS) + "\n")
    write_imu(folder, seen.samples)
    write_detections(folder, seen.cycles)
    return folder


def test_the_command_writes_the_true_extrinsics_into_a_tree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, found = moved(), list[extrinsics.Extrinsics]()

    def as_seen(_setup: RigSetup, _folder: Path) -> list[HandPose]:
        return seen.poses

    def noted(*given: object) -> extrinsics.Extrinsics:
        found.append(calibrate_extrinsics(*given))  # pyright: ignore[reportArgumentType]
        return found[0]

    # The line of the markers has tests of its own; without noise fewer steps are enough.
    monkeypatch.setattr(extrinsics, "marker_poses", as_seen)
    monkeypatch.setattr(extrinsics, "calibrate_extrinsics", noted)
    monkeypatch.setattr(problem, "_COARSE_ROUNDS", (3,))
    monkeypatch.setattr(problem, "_ROUNDS", (4, 3))
    folder, tree, picture = recorded(seen, tmp_path), tmp_path / "tree", tmp_path / "extrinsics.png"
    files = ("--out", tree, "--picture", picture, "--json", tmp_path / "found.json")
    calibrate("extrinsics", folder, "--detections", folder, *files)

    rotation_deg, shift_mm, imu_deg, camera_ms, imu_ms = errors(found[0], seen.both).tolist()
    assert rotation_deg < 2.0  # of which most is that nobody knows when a wrist is straight
    assert shift_mm < 1.5
    assert imu_deg < 0.7
    assert camera_ms < 2.0  # skin is not made of cones, and six seconds are few
    assert imu_ms < 1.0

    rig = load(tree / "rigs" / "wrist.json", RigCalibration)
    assert rig.imu is not None
    assert rig.imu.q_palm_imu is not None
    assert rig.imu.q_rig_world is not None
    np.testing.assert_allclose(np.array(rig.T_camera_palm), np.array(found[0].rig.T_camera_palm))
    assert rig.stamp_offset_us["wrist"] == pytest.approx(1e-3 * CAMERA_LATE_NS, abs=2000.0)
    assert rig.imu.stamp_offset_us == pytest.approx(1e-3 * IMU_LATE_NS, abs=1000.0)
    true = seen.both.wrist.rig.imu
    assert true is not None
    up = quaternion_to_matrix(np.array([rig.imu.q_rig_world, true.q_rig_world]))[:, :, 2]
    assert np.degrees(np.arccos(up[0] @ up[1])) < 2.5  # its filter leans where an arm is accelerated
    assert {"T_camera_palm", "stamp_offset_us", "imu"} <= rig.provenance.keys()
    assert "straight" in str(rig.provenance["T_camera_palm"])
    assert picture.stat().st_size > 20_000


def test_what_was_not_seen_together_is_refused() -> None:
    seen = moved()
    for nothing, what in (("poses", "markers"), ("cycles", "wrist camera"), ("samples", "IMU")):
        with pytest.raises(FitError, match=f"the {what} saw nothing: for ten seconds bend"):
            calibrated(seen, **{nothing: []})
    with pytest.raises(FitError, match=r"saw the hand together in \d+ cycles, at least 60"):
        calibrated(seen, poses=seen.poses[:150])
    with pytest.raises(FitError, match=r"the IMU was silent for 0\.2"):
        calibrated(seen, samples=seen.samples[:300] + seen.samples[324:])
    others = tuple("back" if name == "index" else name for name in seen.both.markers.markers)
    with pytest.raises(FitError, match="no marker sits on the tip of the index finger"):
        calibrated(seen, markers=others)


def slipped(uv: Float, late: bool) -> Float:
    return uv + np.array([0.0, 20.0 * late])


@pytest.mark.parametrize("change", [mirrored, slipped])
def test_pictures_that_no_mounting_explains_are_refused(change: Callable[[Float, bool], Float]) -> None:
    seen = moved()
    wrong = [
        replaced(one, laser_uv=change(one.laser_uv, k > 60), tip_uv=change(one.tip_uv, k > 60))
        for k, one in enumerate(seen.cycles)
    ]
    with pytest.raises(FitError, match=r"no mounting explains what was seen: .* of this hand and side"):
        calibrated(seen, cycles=wrong)


def test_a_device_without_an_imu_is_refused() -> None:
    seen = moved()
    with pytest.raises(CalibrationError, match="imu: missing"):
        calibrated(seen, rig=replaced(seen.rig, imu=None))


def fitted(off: float) -> Fit:
    """A fit that leaves all sights so many standard deviations off."""
    unknown = None
    each = np.full((70, 4, 4), off)
    return Fit(
        unknown,  # type: ignore[arg-type]
        np.eye(UNKNOWN),
        np.zeros((70, 2)),
        np.zeros(70),
        each,
        np.ones_like(each),
        each,
        1e-3,
        5,
    )


def test_what_no_extrinsics_explain_is_refused() -> None:
    refuse(fitted(1.0), CERTAIN)
    with pytest.raises(FitError, match=r"no mounting explains what was seen: it is 3\.0 times"):
        refuse(fitted(3.0), CERTAIN)


@pytest.mark.parametrize(
    ("quantity", "value", "message"),
    [
        ("imu_rotation_sigma_deg", 5.0, "turn the forearm about another axis"),
        ("shift_sigma_mm", 5.0, "bend every finger"),
        ("imu_clock_sigma_ms", 9.0, "move fingers and forearm faster"),
    ],
)
def test_what_the_motion_does_not_determine_is_refused_with_what_to_do(
    quantity: str, value: float, message: str
) -> None:
    with pytest.raises(FitError, match=message):
        refuse(fitted(1.0), CERTAIN | {quantity: value})
