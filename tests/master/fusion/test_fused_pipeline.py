"""The fused line through its own door: streams that go and come back, and what it says of itself meanwhile."""

import numpy as np
import pytest

from bench.fusion_scene import Both
from bench.fusion_shown import shown
from bench.fusion_solved import Solved, solve
from bench.played import START_NS
from common.arrays import Bool
from common.hand_model import CHAINS
from common.messages import ImuSample, MarkerDetections, Source
from master.estimator.settings import DEFAULT

SECONDS, GONE_S, BACK_S = 3.2, 1.8, 2.5


@pytest.fixture(scope="module")
def watched() -> tuple[Both, Solved, Solved]:
    """A hand that curls, solved with all streams, and with the marker cameras away for a while."""
    seen = shown("both-curl", SECONDS, 3)
    left = [
        message
        for message in seen.messages
        if not (isinstance(message, MarkerDetections) and GONE_S < 1e-9 * (message.t_ns - START_NS) < BACK_S)
    ]
    fused = seen.both.fused
    whole, cut = solve(fused, seen.messages), solve(fused, left)
    assert any(isinstance(message, ImuSample) for message in seen.messages)
    return seen.both, Solved.of(seen.both, whole, fused), Solved.of(seen.both, cut, fused)


def away(cut: Solved) -> Bool:
    """Poses while no marker camera spoke."""
    return (cut.t_s > GONE_S + 0.05) & (cut.t_s < BACK_S - 0.05)


def test_poses_come_at_the_triples_while_the_cameras_are_silent(watched: tuple[Both, Solved, Solved]) -> None:
    _, whole, cut = watched
    assert (np.diff(cut.poses.t_ns) > 0).all()
    alone = cut.t_s[away(cut)]
    assert np.diff(alone) == pytest.approx(1.0 / 30.0, abs=2e-3)
    assert np.diff(whole.t_s).max() < 0.02


def test_fingers_are_seen_and_the_palm_is_held_meanwhile(watched: tuple[Both, Solved, Solved]) -> None:
    _, _, cut = watched
    at = away(cut)
    assert (cut.poses.source[at][:, CHAINS[1:].ravel()] == Source.WRIST).mean() > 0.7
    tracked = cut.poses.tracked[at]
    assert not tracked[
        cut.t_s[at] > GONE_S + 0.25
    ].any()  # nobody sees where the hand is, and it may have gone
    assert cut.off_mm[at][tracked[:, 1:]].max() < 1e3 * DEFAULT.tracked_m
    assert cut.poses.valid[at].all()
    assert np.nanmean(cut.pip_deg[at][:, 1:]) < 12.0


def test_nothing_leaps_when_the_cameras_go_or_come_back(watched: tuple[Both, Solved, Solved]) -> None:
    _, _, cut = watched
    steps = cut.steps_mm
    about = (np.abs(cut.t_s[1:] - GONE_S) < 0.2) | (np.abs(cut.t_s[1:] - BACK_S) < 0.4)
    assert np.nanmax(steps[about]) < 8.0
    assert cut.poses.tracked[cut.t_s > SECONDS - 0.15].mean() > 0.6


def test_bend_and_turn_of_the_palm_are_told_with_their_doubt(watched: tuple[Both, Solved, Solved]) -> None:
    both, whole, _ = watched
    truth = np.array([both.scene.motion.at(t).bend_rad for t in whole.t_s.tolist()])
    off = np.abs(whole.poses.wrist_bend_rad - truth)
    assert np.isfinite(whole.poses.wrist_bend_sigma_rad).all()
    assert (off < 4.0 * whole.poses.wrist_bend_sigma_rad).mean() > 0.9
    assert np.isfinite(whole.poses.palm_world_wxyz).all()
