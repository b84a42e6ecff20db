"""Rates that real cameras have, 58.9 and 56 Hz, through the whole line: a pose for every frame, as right as at 60 Hz.

Frames are rendered and detected; the row times are those of the sensors.
"""

from functools import cache
from itertools import pairwise
from pathlib import Path
from shutil import copytree
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from msgspec.structs import replace

from bench.played import START_NS, Watched, solve, times_of, times_of_poses, watch
from common.arrays import Float
from common.calibration import CameraCalibration, load, save
from common.messages import HandPose
from common.sim.scene import STANDARD_SEED
from common.sim.scenes import scene_by_name
from master.rig.setup import load_setup

ROOT = Path(__file__).resolve().parents[3]
SECONDS = 2.0
Rates = tuple[float, float]
OV5647_US, IMX708_US = 31.75, 26.72  # row to row


@cache
def played(
    file_hz: Rates, row_us: float, true_hz: Rates | None = None
) -> tuple[list[HandPose], list[Watched], Float]:
    """Poses, what each camera sent, and the mean joint error of each pose [mm]; `true_hz`: at which frames come."""
    with TemporaryDirectory() as folder:
        tree = Path(copytree(ROOT / "calib_json", Path(folder) / "calib"))
        for name, rate_hz in zip(("left", "right"), file_hz, strict=True):
            path = tree / f"cameras/{name}.json"
            save(path, replace(load(path, CameraCalibration), frame_rate_hz=rate_hz, row_time_us=row_us))
        setup = load_setup(tree, "desk")
    scene = scene_by_name("standard", setup.rig, dict(setup.cameras), setup.hand.profile, STANDARD_SEED)
    watched = [
        watch(scene, name, times_of(scene, name, SECONDS, rate_hz))
        for name, rate_hz in zip(("left", "right"), true_hz or file_hz, strict=True)
    ]
    poses, counts = solve(setup, watched)
    assert not {name for name in counts if "late" in name or "dropped" in name or "stale" in name}
    truth = [scene.truth(t).joints.position_m for t in times_of_poses(poses).tolist()]
    off_mm = 1e3 * np.linalg.norm(np.array([pose.position_m for pose in poses]) - np.array(truth), axis=2)
    return poses, watched, off_mm[:, 1:].mean(axis=1)


CASES = [
    ((58.9, 58.9), OV5647_US, None),
    ((56.0, 56.0), IMX708_US, None),
    ((58.9, 60.0), OV5647_US, None),
    (
        (58.9, 58.9),
        OV5647_US,
        (62.5, 62.5),
    ),  # a kernel that takes the pixel clock of the OV5647 for slower than it is
]


@pytest.mark.parametrize(("file_hz", "row_us", "true_hz"), CASES)
def test_every_frame_of_the_leading_camera_is_a_pose_at_its_own_time(
    file_hz: Rates, row_us: float, true_hz: Rates | None
) -> None:
    poses, watched, _ = played(file_hz, row_us, true_hz)
    rates_hz = true_hz or file_hz
    centre_ns = round(0.5 * 479 * row_us * 1e3)
    sent = [message.t_ns + centre_ns for message in watched[0].messages]
    at = [pose.t_ns for pose in poses]
    assert set(at) <= set(sent), "an epoch is a frame of the leading camera"
    assert [b - a for a, b in pairwise(at)] == [
        b - a for a, b in pairwise(sent[sent.index(at[0]) :][: len(at)])
    ]
    waiting = 3  # frames, for the other camera's next
    assert len(sent) - waiting <= len(at) <= len(sent)
    assert abs((len(at) - 1) / ((at[-1] - at[0]) * 1e-9) - rates_hz[0]) < 0.01
    assert at[0] < START_NS + 0.1e9


@pytest.mark.parametrize(("file_hz", "row_us", "true_hz"), CASES)
def test_joints_are_as_right_as_at_60_hz(file_hz: Rates, row_us: float, true_hz: Rates | None) -> None:
    settled = 10  # frames of the filter
    off_mm, usual_mm = (
        float(played(*case)[2][settled:].mean())
        for case in ((file_hz, row_us, true_hz), ((60.0, 60.0), row_us, None))
    )
    assert off_mm < 1.1 * usual_mm
