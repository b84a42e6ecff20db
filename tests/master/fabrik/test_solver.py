"""The line by itself: what it makes of exact centroids, of cameras and markers that go, and of targets out of reach."""

import numpy as np
import pytest

from common.arrays import Float
from common.calibration import AffineDisparityCalibration
from common.hand.model import CHAINS, TIPS
from common.messages import MarkerDetections, Source
from master.estimator.epoch import HandEstimate
from master.fabrik.settings import FABRIK
from master.fabrik.solver import FabrikSolver
from master.rig.pipeline import build_pipeline, line_of
from master.run.app import StageTimes
from tests.hand_helpers import RIGHT, detections
from tests.synthetic_run import PERIOD_NS, SyntheticRun, synthetic_run

PINHOLE = AffineDisparityCalibration(a_m_px=37.5, x0_px=0.0)
MODELS: list[dict[str, object]] = [
    {"depth_model": "affine_disparity", "affine_disparity": PINHOLE},
    {"depth_model": "stereo"},
]
FAR_M = np.array([0.1, 0.0, 0.15])


@pytest.fixture(scope="module", params=MODELS, ids=["law", "stereo"])
def run(request: pytest.FixtureRequest) -> SyntheticRun:
    return synthetic_run(70, **request.param)


def line(run: SyntheticRun, *, continuous: bool = True) -> FabrikSolver:
    return line_of(run.setup, StageTimes(), continuous=continuous)


def solve(solver: FabrikSolver, messages: list[MarkerDetections]) -> list[HandEstimate]:
    return [hand for message in messages for hand in solver.push(message)] + solver.flush()


def joint_mm(hand: HandEstimate, run: SyntheticRun) -> Float:
    assert hand.solution is not None
    return 1e3 * np.linalg.norm(hand.solution.joints.position_m - run.truth(hand.t_ns).position_m, axis=1)


def test_a_moving_hand_is_solved_by_its_centroids_alone(run: SyntheticRun) -> None:
    hands = solve(line(run), run.messages)
    assert len(hands) >= 69
    assert np.mean([joint_mm(hand, run)[1:].mean() for hand in hands]) < 4.5
    for hand in hands:
        assert hand.solution is not None
        assert RIGHT.within_limits(hand.solution.angles_rad).all()
        assert hand.valid.all()
        assert hand.tracked.all()
        assert hand.seen.all()
        assert hand.solved
        assert (hand.residual_m < 3e-3).all()
        assert (hand.iterations <= 20).all()
        assert (hand.source[TIPS] == Source.MEASURED).all()
    assert np.mean([hand.reached.mean() for hand in hands]) > 0.7


def test_the_covariance_holds_the_joints(run: SyntheticRun) -> None:
    inside = list[float]()
    for hand in solve(line(run), run.messages):
        assert hand.solution is not None
        off = hand.solution.joints.position_m - run.truth(hand.t_ns).position_m
        cov = hand.solution.cov_m2
        assert (np.linalg.eigvalsh(cov) > -1e-15).all()
        inside.append(float(np.mean(np.vecdot(off, np.linalg.solve(cov, off[..., None])[..., 0]) < 7.81)))
    assert np.mean(inside) > 0.9


def without(message: MarkerDetections, *markers: int) -> MarkerDetections:
    uv = message.uv.copy()
    uv[list(markers)] = np.nan
    return detections(message.camera, message.seq, message.t_ns, uv)


def test_a_hidden_finger_is_held_and_said_to_be(run: SyntheticRun) -> None:
    messages = [without(m, 1) if 20 <= m.seq < 40 else m for m in run.messages]
    hands = solve(line(run), messages)
    hidden = [hand for hand in hands if not hand.seen[1]]
    assert len(hidden) >= 18
    for hand in hidden:
        assert not hand.tracked[CHAINS[1]].any()
        assert (hand.source[CHAINS[1]] == Source.HELD).all()
        assert np.isnan(hand.residual_m[1])
        assert hand.tracked[CHAINS[2]].all()
        assert joint_mm(hand, run)[CHAINS[1]].max() < 60.0
    assert hands[-1].tracked.all()


def test_one_camera_lost_the_line_says_so_holds_and_comes_back(run: SyntheticRun) -> None:
    lost = [m for m in run.messages if m.camera == "left" or not 20 <= m.seq < 60]
    hands = solve(line(run), lost)
    since = 1_000_000_000 + 20 * PERIOD_NS
    gone = [hand for hand in hands if not hand.solved]
    assert len(gone) >= 35
    for hand in gone:
        assert not hand.tracked.any()
        assert (hand.source == Source.HELD).all()
        if hand.t_ns - since < 0.4e9:
            assert hand.valid.all()
            assert hand.solution is not None
        if hand.t_ns - since > 1e9 * (FABRIK.forget_s + 0.05):
            assert not hand.valid.any()
            assert hand.solution is None
    cov = [np.trace(hand.solution.cov_m2[0]) for hand in gone if hand.solution is not None]
    assert (np.diff(cov) > 0.0).all()
    assert hands[-1].tracked.all()
    assert joint_mm(hands[-1], run)[1:].mean() < 6.0


def test_a_target_out_of_reach_is_flagged_and_not_tracked(run: SyntheticRun) -> None:
    """The index's marker 18 cm beside the hand, in both cameras alike."""
    far = list[MarkerDetections]()
    for m in run.messages:
        uv, point = m.uv.copy(), RIGHT.marker_points(run.truth(m.t_ns), ("index",)) + FAR_M
        uv[1] = run.setup.models[m.camera].project(point)[0]
        far.append(detections(m.camera, m.seq, m.t_ns, uv) if m.seq >= 20 else m)
    hands = solve(line(run), far)[22:-2]
    assert all(hand.seen[1] for hand in hands)
    assert not any(hand.tracked[CHAINS[1]].any() for hand in hands)
    for hand in hands:
        assert hand.solution is not None
        assert np.isfinite(hand.solution.joints.position_m).all()
        assert RIGHT.within_limits(hand.solution.angles_rad).all()


def test_nothing_seen_is_no_hand_and_nothing_raises(run: SyntheticRun) -> None:
    hands = solve(line(run), [without(m, 0, 1, 2, 3, 4, 5) for m in run.messages[:12]])
    assert hands
    assert all(hand.solution is None and not hand.valid.any() and not hand.solved for hand in hands)
    few = solve(line(run), [without(m, 0, 1, 2, 3, 5) for m in run.messages[:12]])
    assert all(hand.solution is None for hand in few)


def test_unrelated_frames_remember_nothing(run: SyntheticRun) -> None:
    epochs = [epoch for m in run.messages[:20] for epoch in line(run, continuous=False).sync.push(m)]
    alone = [line(run, continuous=False).solve(epoch) for epoch in epochs]
    solver = line(run, continuous=False)
    for one, hand in zip(alone, (solver.solve(epoch) for epoch in epochs), strict=True):
        assert one.solution is not None
        assert hand.solution is not None
        np.testing.assert_array_equal(one.solution.joints.position_m, hand.solution.joints.position_m)
        np.testing.assert_array_equal(hand.smooth_m, hand.markers.points_m)


@pytest.mark.parametrize("model", MODELS)
def test_the_pipeline_of_solver_fabrik_publishes_this_hand(model: dict[str, object]) -> None:
    run = synthetic_run(30, solver="fabrik", **model)
    pipeline = build_pipeline(run.setup, StageTimes())
    poses = [solved.pose for m in run.messages for solved in pipeline.push(m)]
    hands = solve(line(run), run.messages)[: len(poses)]
    assert len(hands) == len(poses) > 25
    for pose, hand in zip(poses, hands, strict=True):
        assert hand.solution is not None
        np.testing.assert_array_equal(pose.position_m, hand.solution.joints.position_m)
        np.testing.assert_array_equal(pose.markers_m, hand.smooth_m)
        np.testing.assert_array_equal(pose.tracked, hand.tracked)
