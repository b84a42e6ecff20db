"""Scores of objects: golden errors, truth between two of its instants, and what is not there."""

from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float, Int
from common.errors import RecordingError
from common.geometry.transforms import axis_rotation, matrix_to_quaternion, rigid
from master.evaluation.score import (
    ObjectTruth,
    errors,
    load_object_truth,
    score_object,
    score_objects,
    tracked_share,
)
from master.outputs.result_files import ObjectPoses

MS = 1_000_000


def truth(count: int = 11, period_ns: int = 20 * MS) -> ObjectTruth:
    """It goes 1 m/s along x and turns 1 rad/s about z."""
    t_s = np.arange(count) * period_ns * 1e-9
    T = np.array([rigid(axis_rotation(2, float(t)), np.array([t, 0.0, 0.5])) for t in t_s])
    return ObjectTruth(np.arange(count) * period_ns, T)


def poses(t_ns: Int, T: Float, tracked: bool = True, sigma: float = 1e-3) -> ObjectPoses:
    count = len(t_ns)
    return ObjectPoses(
        "cube",
        t_ns,
        T[:, :3, 3],
        matrix_to_quaternion(T[:, :3, :3]),
        np.tile(sigma**2 * np.eye(6), (count, 1, 1)),
        np.zeros(count),
        np.ones(count, np.uint8),
        np.full(count, tracked),
        np.full(count, 3),
        np.full(count, 3),
        np.zeros(count, np.bool_),
        np.zeros(count, np.int64),
    )


def moved(T: Float, shift_m: Float, rotation: Float) -> Float:
    out = T.copy()
    out[:, :3, 3] += shift_m
    out[:, :3, :3] = rotation @ out[:, :3, :3]
    return out


def test_errors_are_millimetres_and_degrees() -> None:
    true = truth()
    off = moved(true.T_rig_object, np.array([3e-3, 0.0, 4e-3]), axis_rotation(1, np.radians(2.0)))
    mm, deg = errors(poses(true.t_ns, off), true)
    np.testing.assert_allclose(mm, 5.0)
    np.testing.assert_allclose(deg, 2.0)
    scores = score_object(poses(true.t_ns, off), true)
    assert (scores["mm"], scores["deg"], scores["mm_p95"], scores["tracked"]) == (5.0, 2.0, 5.0, 1.0)
    assert scores["nees"] == pytest.approx(25.0 + np.radians(2.0) ** 2 * 1e6, rel=1e-3)


def test_truth_is_interpolated_and_ends_where_it_ends() -> None:
    true = truth()
    t_ns = np.array([-1, 0, 5 * MS, 133 * MS, 200 * MS, 201 * MS])
    T = true.at(t_ns)
    np.testing.assert_allclose(T[1:5, 0, 3], t_ns[1:5] * 1e-9)
    np.testing.assert_allclose(T[2, :3, :3], axis_rotation(2, 0.005), atol=1e-9)
    assert np.isnan(T[[0, 5]]).all()
    apart = truth(3, 500 * MS)
    assert np.isnan(apart.at(np.array([250 * MS]))).all(), "too far apart to be led between"
    assert np.isnan(ObjectTruth(np.zeros(0, np.int64), np.zeros((0, 4, 4))).at(t_ns)).all()
    one = truth(1)
    np.testing.assert_allclose(one.at(np.array([0, 1]))[0], one.T_rig_object[0])


def test_what_is_held_is_not_scored_and_is_missing() -> None:
    true = truth()
    held = poses(true.t_ns, moved(true.T_rig_object, np.array([1.0, 0.0, 0.0]), np.eye(3)), tracked=False)
    assert score_object(held, true) == {"poses": 11.0, "tracked": 0.0}
    none = ObjectPoses.stacked([], object="cube")
    assert score_object(none, true) == {"poses": 0.0, "tracked": 0.0}
    half = poses(true.t_ns[:5], true.T_rig_object[:5])
    assert tracked_share(half, true) == pytest.approx(5 / 11)
    rare = poses(true.t_ns[::5], true.T_rig_object[::5])
    assert tracked_share(rare, true) == 1.0, "a slow master that always tracks it loses nothing"
    both = poses(true.t_ns, true.T_rig_object)
    both.tracked[5:] = False
    assert tracked_share(both, true) == pytest.approx(5 / 11)


def test_the_worst_object_is_that_of_the_summary() -> None:
    scores = {"a": {"mm": 1.0, "deg": 2.0, "tracked": 0.5}, "b": {"mm": 3.0, "deg": 1.0, "tracked": 1.0}}
    scored = score_objects(scores)
    assert (scored["object_mm"], scored["object_deg"], scored["object_tracked"]) == (3.0, 2.0, 0.5)
    assert scored["objects"] == scores
    assert score_objects({}) == {}
    assert "object_mm" not in score_objects({"a": {"tracked": 0.0}})


def test_truth_of_a_recording_is_read_by_name(tmp_path: Path) -> None:
    assert load_object_truth(tmp_path, "cube") is None
    T = truth().T_rig_object
    np.savez(tmp_path / "truth.npz", t_ref=np.arange(11) * 0.02, object_cube=T, object_wand=T[:4])
    found = load_object_truth(tmp_path, "cube")
    assert found is not None
    assert found.t_ns[:2].tolist() == [1_000_000_000, 1_020_000_000]
    assert load_object_truth(tmp_path, "pen") is None
    with pytest.raises(RecordingError, match=r"object_wand has shape \(4, 4, 4\), expected \(11, 4, 4\)"):
        load_object_truth(tmp_path, "wand")
