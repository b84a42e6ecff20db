"""A recording with a raw IMU through the offline line: the palm is turned better, and its heading spoils nothing.

The simulated accelerometer sees gravity 2 degrees off for the whole recording; the heading begins anywhere.
"""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copytree

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.calibration import ImuCalibration
from common.errors import RecordingError
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import WRIST
from common.imu.csv_table import read_imu, write_imu
from common.imu.fusion import OrientationFilter
from common.recording.frame_recording import open_recording
from common.sim.record import record_scene
from common.sim.scene import Scene
from master.commands.summary import read_summary
from master.outputs.poses import Poses
from master.replay.offline import solve
from master.rig.setup import RigSetup, load_setup
from tests.replay.replayed import detect, replay

SECONDS, RATE_HZ = 1.0, 30.0
STARTS_S = {41: 3.0, 42: 16.0}  # scene seed -> first moment: two different acts
WORLD = (float(np.cos(np.radians(60.0))), float(np.sin(np.radians(60.0))), 0.0, 0.0)
UP = quaternion_to_matrix(np.array(WORLD))[:, 2]
IMU = ImuCalibration(name="palm-imu", q_palm_imu=(0.5, 0.5, -0.5, 0.5), q_rig_world=WORLD)


@dataclass(frozen=True)
class Recorded:
    """A rendered recording with imu.csv, the detections in it, and the setup it was made with."""

    folder: Path
    detections: Path
    setup: RigSetup

    def solved(self, out: Path, imu: ImuCalibration | None, folder: Path | None = None) -> Float:
        """Rotation vectors (T, 3) [deg], rig axes, by which the palm is wrong, where the rig says `imu`."""
        out.mkdir()
        setup = replace(self.setup, rig=msgspec.structs.replace(self.setup.rig, imu=imu))
        solve(open_recording(folder or self.folder), [setup], self.detections, out)
        return self.errors(out)

    def errors(self, out: Path) -> Float:
        poses = Poses.load(out / "poses.npz")
        with np.load(self.folder / "truth.npz") as truth:
            T_palm = truth["T_palm"]
        found = quaternion_to_matrix(poses.orientation_wxyz[:, WRIST])
        rest = self.setup.hand.rest_rotation[WRIST]
        wrong = found @ np.swapaxes(T_palm[:, :3, :3] @ rest, 1, 2)
        return np.degrees(np.asarray(Rotation.from_matrix(wrong).as_rotvec(), np.float64))


@pytest.fixture(scope="module")
def recorded(root: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Recorded]:
    setup = load_setup(root / "calib_json", "desk")
    cameras = {
        name: msgspec.structs.replace(camera, frame_rate_hz=RATE_HZ) for name, camera in setup.cameras.items()
    }
    setup = RigSetup.of(msgspec.structs.replace(setup.rig, imu=IMU), cameras, setup.hand)
    made: list[Recorded] = []
    for seed, start_s in STARTS_S.items():
        folder = tmp_path_factory.mktemp("imu")
        scene = Scene.standard(setup.rig, cameras, setup.hand.profile, seed)
        record_scene(folder / "recording", scene, SECONDS, start_s, imu=True)
        for camera in setup.rig.cameras:
            detect(folder / "recording", camera, folder)
        made.append(Recorded(folder / "recording", folder, setup))
    return made


def fused(one: Recorded, folder: Path) -> Path:
    """The recording as of a sensor that tells its own orientation; its heading is as little known."""
    copytree(one.folder, folder)
    fusion = OrientationFilter(IMU.rate_hz)
    samples = [fusion.push(sample) for sample in read_imu(one.folder, IMU.name)]
    write_imu(folder, [msgspec.structs.replace(one, heading_sigma_rad=np.nan) for one in samples])
    return folder


def mean_deg(errors: list[Float]) -> float:
    return float(np.mean([np.linalg.norm(e, axis=1).mean() for e in errors]))


def test_the_palm_is_turned_better_with_it_and_an_unknown_heading_spoils_nothing(
    recorded: list[Recorded], tmp_path: Path
) -> None:
    without = [one.solved(tmp_path / f"without{k}", None) for k, one in enumerate(recorded)]
    used = [one.solved(tmp_path / f"used{k}", IMU) for k, one in enumerate(recorded)]
    assert mean_deg(used) < 0.7 * mean_deg(without)
    tilt = [np.linalg.norm(e - np.outer(e @ UP, UP), axis=1).mean() for e in used]
    assert max(tilt) < 4.0  # two degrees per axis, and what the markers add
    heading_without, heading_used = (np.mean([np.abs(e @ UP).mean() for e in x]) for x in (without, used))
    assert heading_used < heading_without + 0.3
    # The same orientations believed in their heading, which is anywhere: the check above would see it.
    trusting = msgspec.structs.replace(IMU, heading_sigma_rad=0.05)
    trusted = [
        one.solved(tmp_path / f"trusted{k}", trusting, fused(one, tmp_path / f"fused{k}"))
        for k, one in enumerate(recorded)
    ]
    assert np.mean([np.abs(e @ UP).mean() for e in trusted]) > heading_without + 3.0


def test_a_heading_is_not_accepted_of_a_sensor_that_measured_none(
    recorded: list[Recorded], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    used = recorded[0].solved(tmp_path / "used", IMU)
    with caplog.at_level(logging.WARNING):
        changed = recorded[0].solved(
            tmp_path / "changed", msgspec.structs.replace(IMU, heading_sigma_rad=0.05)
        )
    assert "imu.csv: orientations of rates and forces: imu.heading_sigma_rad not used" in caplog.text
    np.testing.assert_array_equal(changed, used)
    folder = tmp_path / "of a slave"  # which writes what its filter made of the same
    copytree(recorded[0].folder, folder)
    fusion = OrientationFilter(IMU.rate_hz)
    write_imu(folder, [fusion.push(sample) for sample in read_imu(folder, IMU.name)])
    trusting = msgspec.structs.replace(IMU, heading_sigma_rad=0.05)
    np.testing.assert_array_equal(recorded[0].solved(tmp_path / "slave", trusting, folder), used)


def test_quaternions_of_the_recording_are_used_as_they_are(recorded: list[Recorded], tmp_path: Path) -> None:
    raw = recorded[0].solved(tmp_path / "raw", IMU)
    sensors = recorded[0].solved(tmp_path / "sensors", IMU, fused(recorded[0], tmp_path / "fused"))
    np.testing.assert_array_equal(sensors, raw)


def test_replay_by_command_uses_the_imu_of_the_recording(
    recorded: list[Recorded], root: Path, tmp_path: Path
) -> None:
    one = recorded[0]
    replay(one.folder, tmp_path / "a", "--calibration", root / "calib_json")
    summary = read_summary(tmp_path / "a" / "summary.json")
    counts = msgspec.convert(summary["counts"], dict[str, int])
    assert counts["orientation.used"] == counts["poses"] == round(SECONDS * RATE_HZ)
    direct = one.solved(tmp_path / "b", IMU)
    np.testing.assert_allclose(one.errors(tmp_path / "a"), direct, atol=1e-9)


def test_one_of_which_nothing_is_known_is_not_used_and_that_is_reported(
    recorded: list[Recorded], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    without = recorded[0].solved(tmp_path / "none", None)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        empty = recorded[0].solved(tmp_path / "empty", ImuCalibration())
    assert "imu.csv: not used" in caplog.text
    assert "imu.q_palm_imu" in caplog.text
    np.testing.assert_array_equal(empty, without)


def test_samples_without_orientation_or_out_of_time_are_counted(
    recorded: list[Recorded], tmp_path: Path
) -> None:
    folder = fused(recorded[0], tmp_path / "recording")
    header, *lines = (folder / "imu.csv").read_text().splitlines()
    half = len(lines) - round(0.6 * IMU.rate_hz)  # the last 0.1 s is after the frames
    gone = [",".join([*line.split(",")[:-4], "nan,nan,nan,nan"]) for line in lines[:half]]
    (folder / "imu.csv").write_text("\n".join([header, *gone, *lines[len(gone) :]]) + "\n")
    recorded[0].solved(tmp_path / "half", IMU, folder)
    counts = msgspec.convert(read_summary(tmp_path / "half" / "summary.json")["counts"], dict[str, int])
    assert counts["orientation.missing"] == len(gone)
    assert counts["orientation.absent"] > 5
    assert counts["orientation.used"] > 5
    assert counts["orientation.used"] + counts["orientation.absent"] == counts["poses"]


def test_a_broken_table_is_an_error_with_its_line(recorded: list[Recorded], tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    copytree(recorded[0].folder, folder)
    with (folder / "imu.csv").open("a") as table:
        table.write("1,2,3\n")
    with pytest.raises(RecordingError, match=r"imu\.csv: line \d+: 3 columns"):
        recorded[0].solved(tmp_path / "broken", IMU, folder)
