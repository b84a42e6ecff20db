"""The card's line in the path of every pose: the shipped rig, spied on; and what the estimator gains by it."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from common.arrays import Float
from common.geometry.transforms import axis_rotation
from common.messages import HandPose, MarkerDetections
from master.estimator.epoch import Epoch, Fitted
from master.estimator.estimator import Estimator
from master.fabrik.one_euro import OneEuro
from master.fabrik.solver import Finger
from master.fabrik.triangulate import DepthTriangulator
from master.rig.pipeline import build_pipeline
from master.rig.setup import RigSetup, load_setup
from master.run.app import StageTimes
from tests.hand_helpers import cap_views, detections, natural_angles, palm
from tests.synthetic_run import SyntheticRun, synthetic_run

FRAMES = 30


def shipped(root: Path, rig: str) -> tuple[RigSetup, list[MarkerDetections]]:
    """The shipped rig, and what its two cameras see of a hand that moves; both at once."""
    setup = load_setup(root / "calib_json", rig)
    model = setup.hand
    cameras, angles = tuple(setup.models.values()), natural_angles(np.random.default_rng(1))
    messages: list[MarkerDetections] = []
    for k in range(FRAMES):
        at = np.array([0.04 + 0.03 * np.sin(0.1 * k), 0.08, 0.6])
        joints = model.forward(palm(at_m=at), model.clamp(angles + 0.1 * np.sin(0.1 * k)))
        points = model.marker_points(joints, setup.rig.markers)
        bias = cap_views(model, setup.rig.markers, joints, points, cameras)[0]
        for c, (name, camera) in enumerate(setup.models.items()):
            uv = camera.project(points) + bias[c]
            if k % 5 == 4:
                uv[k % 6] = np.nan  # one that is hidden
            messages.append(detections(name, k, 1_000_000_000 + k * 16_666_667, uv))
    return setup, messages


@pytest.mark.parametrize("rig", ["desk", "desk-fabrik"])
def test_every_pose_of_the_shipped_rig_goes_through_law_filter_and_fabrik(
    root: Path, monkeypatch: pytest.MonkeyPatch, rig: str
) -> None:
    calls, seen = Counter[str](), list[int]()

    def spy(owner: type, name: str, what: str) -> None:
        real: Callable[..., Any] = getattr(owner, name)

        def spied(*positional: Any, **named: Any) -> Any:
            calls[what] += 1
            return real(*positional, **named)

        monkeypatch.setattr(owner, name, spied)

    setup, messages = shipped(root, rig)
    pipeline = build_pipeline(setup, StageTimes())
    spy(DepthTriangulator, "__call__", "depth")
    spy(OneEuro, "push", "one_euro")
    spy(Finger, "solve", "fabrik")
    poses: list[HandPose] = []
    for message in messages:
        before, first = calls.copy(), not poses
        solved = [one.pose for one in pipeline.push(message)]
        fingers = [int(np.isfinite(pose.markers_m[:5, 0]).sum()) for pose in solved]
        made = calls - before
        assert made["depth"] == len(solved) + (first and len(solved) > 0)  # the first hand is looked at twice
        assert made["one_euro"] >= len(solved)
        assert made["fabrik"] == sum(fingers)
        poses, seen = poses + solved, seen + fingers
    assert len(poses) == FRAMES
    assert min(seen) == 4
    assert all(pose.valid.all() for pose in poses)


@pytest.fixture(scope="module")
def run() -> SyntheticRun:
    return synthetic_run(40)


def errors_after(run: SyntheticRun, T: Callable[[Float], Float], *, start: bool) -> list[float]:
    """Mean error of the joints [mm] in the frames after the tracked state was set wrong; without the line's start."""
    pipeline, errors, count = build_pipeline(run.setup, StageTimes()), list[float](), 0
    machine = pipeline._estimator
    assert machine is not None
    if not start:
        push = machine.push
        machine.push = lambda at: push(replace(at, start=None))
    for message in run.messages:
        for solved in pipeline.push(message):
            count += 1
            truth = run.truth(solved.pose.t_ns).position_m
            if count > 25:
                errors.append(float(1e3 * np.linalg.norm(solved.pose.position_m - truth, axis=1)[1:].mean()))
        if count == 25 and not errors:
            last = pipeline._last
            assert last is not None
            assert last.solution is not None
            wrong = T(last.solution.T_rig_palm)
            joints = run.setup.hand.forward(wrong, last.solution.angles_rad)
            pipeline._last = replace(last, solution=replace(last.solution, T_rig_palm=wrong, joints=joints))
            machine.state.palm[:] = wrong
    return errors


@pytest.mark.parametrize("shift_m", [(0.0, 0.0, 0.0), (-0.2, 0.1, 0.25)])
@pytest.mark.parametrize("axis", [1, 2])
def test_a_state_that_is_wrong_is_left_within_two_frames_because_of_the_line(
    run: SyntheticRun, axis: int, shift_m: tuple[float, float, float]
) -> None:
    def wrong(T: Float) -> Float:
        out = T.copy()
        out[:3, :3] = T[:3, :3] @ axis_rotation(axis, np.radians(120.0))
        out[:3, 3] += shift_m
        return out

    typical = errors_after(run, lambda T: T, start=True)
    left = errors_after(run, wrong, start=True)
    misled = errors_after(run, wrong, start=False)
    assert left[1] < max(typical) + 3.0 < 5.0
    assert min(misled[:6]) > 2.0 * left[1]


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> list[Fitted]:
    """What estimators said that publish a hand; those of the line know no pixels."""
    hands, push = list[Fitted](), Estimator.push

    def spied(machine: Estimator, at: Epoch) -> Fitted:
        hand = push(machine, at)
        if at.uv is not None:
            hands.append(hand)
        return hand

    monkeypatch.setattr(Estimator, "push", spied)
    return hands


def test_without_a_planted_jump_nothing_begins_anew(run: SyntheticRun, fitted: list[Fitted]) -> None:
    pipeline = build_pipeline(run.setup, StageTimes())
    assert len([solved for message in run.messages for solved in pipeline.push(message)]) > 30
    assert len(fitted) > 30
    assert not any(hand.reinitialised for hand in fitted)


def test_what_was_shown_of_a_wrong_hand_does_not_linger(run: SyntheticRun, fitted: list[Fitted]) -> None:
    """The markers are elsewhere, and in reverse order, for a while: the hand leaps there and back."""
    shown = list[Float]()
    pipeline, shift_px = build_pipeline(run.setup, StageTimes()), np.array([150.0, 60.0])
    for message in run.messages:
        uv = message.uv[::-1] - shift_px if 10 <= message.seq < 25 else message.uv
        positional = detections(message.camera, message.seq, message.t_ns, uv)
        shown += [one.pose.position_m for one in pipeline.push(positional)]
    solved = [hand.solution.joints.position_m for hand in fitted if hand.solution is not None]
    assert len(solved) == len(shown)
    assert fitted[10].reinitialised
    assert any(hand.reinitialised for hand in fitted[25:28])
    assert np.linalg.norm(shown[12] - shown[8], axis=1).mean() > 0.1
    late = np.linalg.norm(np.array(shown) - np.array(solved), axis=2).mean(axis=1)
    assert late[25:].max() < 8e-3  # without, 20 mm for six frames
