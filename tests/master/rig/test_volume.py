"""A joint says whether it lies in the stated volume; a pose outside stays a pose, and is counted."""

import numpy as np
import pytest

from common.calibration import Volume
from common.hand.model import TIPS
from common.messages import HandPose
from master.rig.merge import corners, edges, inside
from master.rig.pipeline import build_pipeline
from master.run.app import StageTimes
from tests.synthetic_run import synthetic_run

CUBE = Volume(low_m=(-0.2, -0.1, 0.4), high_m=(0.2, 0.3, 0.8))


def test_faces_belong_to_the_volume_and_nothing_beyond() -> None:
    points = corners(CUBE)
    assert inside(CUBE, points).all()
    middle = points.mean(axis=0)
    assert not inside(CUBE, middle + 1.0001 * (points - middle)).any()
    for axis in range(3):
        beyond = middle.copy()
        beyond[axis] += 0.2001
        assert not inside(CUBE, beyond)


def test_without_a_volume_everything_is_inside_and_nan_is_nowhere() -> None:
    lost = np.full((2, 3), np.nan)
    assert inside(None, lost).all()
    assert not inside(CUBE, lost).any()


def test_a_box_has_twelve_edges_each_along_one_axis() -> None:
    lines = edges(CUBE)
    assert lines.shape == (12, 2, 3)
    assert len({tuple(line.ravel()) for line in lines.round(9)}) == 12
    length = np.abs(lines[:, 1] - lines[:, 0])
    np.testing.assert_array_equal((length > 0).sum(axis=1), 1)
    np.testing.assert_allclose(length.sum(axis=0), 4 * 0.4)


def _poses(volume: Volume | None) -> tuple[list[HandPose], int]:
    run = synthetic_run(12, volume=volume)
    pipeline = build_pipeline(run.setup, StageTimes())
    poses = [solved.pose for message in run.messages for solved in pipeline.push(message)]
    return poses, pipeline.counts["outside_volume"]


@pytest.mark.parametrize("volume", [None, Volume(low_m=(-1.0, -1.0, 0.1), high_m=(1.0, 1.0, 2.0))])
def test_a_hand_within_is_inside_with_every_joint(volume: Volume | None) -> None:
    poses, outside = _poses(volume)
    assert all(pose.inside_volume.all() for pose in poses)
    assert outside == 0


def test_a_hand_that_reaches_out_is_reported_joint_by_joint_and_stays_valid() -> None:
    everything, _ = _poses(None)
    border = float(np.mean([pose.position_m[:, 1].mean() for pose in everything]))
    poses, outside = _poses(
        Volume(low_m=(-1.0, border, 0.1), high_m=(1.0, 1.0, 2.0))
    )  # y is down: tips are out
    assert len(poses) == len(everything) == outside
    for pose, free in zip(poses, everything, strict=True):
        np.testing.assert_array_equal(pose.inside_volume, pose.position_m[:, 1] >= border)
        np.testing.assert_array_equal(pose.valid, free.valid)
        np.testing.assert_array_equal(pose.position_m, free.position_m)
        assert not pose.inside_volume[TIPS[1:4]].any()
        assert pose.valid.all()
