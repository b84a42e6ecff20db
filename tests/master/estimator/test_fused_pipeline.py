"""The fused line through its own door: streams that go and come back, and what it says of itself meanwhile."""

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

import master.estimator
import master.fabrik
from bench.both.scene import Both, Observed, Solved, shown, solve
from bench.played import START_NS
from common.arrays import Bool
from common.hand.model import CHAINS
from common.messages import HandPose, ImuSample, MarkerDetections, SolverMode, Source, WristDetections
from master.estimator.pipeline import MarkerPipeline
from master.estimator.settings import DEFAULT
from master.rig.pipeline import pipeline_of
from master.run.app import StageTimes
from tests.master.fabrik.compiled import compiled

SECONDS, GONE_S, BACK_S = 3.2, 1.8, 2.5
Seen = tuple[Both, list[Observed]]


@pytest.fixture(scope="module")
def seen() -> Seen:
    """What all sensors say of a hand that curls."""
    both = shown("both-curl", SECONDS, 3)
    assert any(isinstance(message, ImuSample) for message in both.messages)
    return both.both, both.messages


def gone(message: Observed) -> bool:
    """Whether a message falls into the time in which a stream is cut off."""
    return GONE_S < 1e-9 * (message.t_ns - START_NS) < BACK_S


def without(seen: Seen, rejected: Callable[[Observed], bool]) -> Solved:
    both, messages = seen
    return Solved.of(both, solve(both.fused, [one for one in messages if not rejected(one)]), both.fused)


@pytest.fixture(scope="module")
def whole(seen: Seen) -> Solved:
    return without(seen, lambda _: False)


@pytest.fixture(scope="module")
def cut(seen: Seen) -> Solved:
    """With the marker cameras away for a while."""
    return without(seen, lambda message: isinstance(message, MarkerDetections) and gone(message))


def away(cut: Solved) -> Bool:
    """Poses while no marker camera spoke."""
    return (cut.t_s > GONE_S + 0.05) & (cut.t_s < BACK_S - 0.05)


def test_poses_come_at_the_cycles_while_the_cameras_are_silent(whole: Solved, cut: Solved) -> None:
    assert (np.diff(cut.poses.t_ns) > 0).all()
    alone = cut.t_s[away(cut)]
    assert np.diff(alone) == pytest.approx(1.0 / 30.0, abs=2e-3)
    assert np.diff(whole.t_s).max() < 0.02


def test_fingers_are_seen_and_the_palm_is_held_meanwhile(cut: Solved) -> None:
    at = away(cut)
    assert (cut.poses.source[at][:, CHAINS[1:].ravel()] == Source.WRIST).mean() > 0.7
    tracked = cut.poses.tracked[at]
    # Nobody sees where the hand is, and it may have gone.
    assert not tracked[cut.t_s[at] > GONE_S + 0.25].any()
    if tracked.any():
        assert cut.off_mm[at][tracked[:, 1:]].max() < 1e3 * DEFAULT.tracked_m
    assert cut.poses.valid[at].all()
    assert np.nanmean(cut.pip_deg[at][:, 1:]) < 12.0


def test_nothing_leaps_when_the_cameras_go_or_come_back(cut: Solved) -> None:
    step = np.diff(cut.poses.position_m, axis=0) - np.diff(cut.truth_m, axis=0)
    follows_s = 0.1  # poses farther apart are a new beginning
    valid = cut.poses.valid[1:] & cut.poses.valid[:-1] & (np.diff(cut.t_s) <= follows_s)[:, None]
    steps = np.where(valid, 1e3 * np.linalg.norm(step, axis=2), np.nan)[:, 1:]
    about = (np.abs(cut.t_s[1:] - GONE_S) < 0.2) | (np.abs(cut.t_s[1:] - BACK_S) < 0.4)
    assert np.nanmax(steps[about]) < 8.0
    assert cut.poses.tracked[cut.t_s > SECONDS - 0.15].mean() > 0.6


def test_the_covariance_of_an_unobserved_palm_grows(cut: Solved) -> None:
    at = away(cut)
    spread = np.sqrt(np.trace(cut.poses.cov_m2[at][:, 1], axis1=1, axis2=2))
    assert (np.diff(spread) > 0.0).all()
    assert (np.linalg.eigvalsh(cut.poses.cov_m2[at][:, 1]) > 0.0).all()


def test_wrist_angles_and_rotation_of_the_palm_are_published_with_their_uncertainty(
    seen: Seen, whole: Solved
) -> None:
    truth = np.array([seen[0].scene.motion.at(t).wrist_angles_rad for t in whole.t_s.tolist()])
    off = np.abs(whole.poses.wrist_angles_rad - truth)
    assert np.isfinite(whole.poses.wrist_angles_sigma_rad).all()
    assert (off < 4.0 * whole.poses.wrist_angles_sigma_rad).mean() > 0.9
    assert np.isfinite(whole.poses.palm_world_wxyz).all()


def test_without_the_wrist_device_the_cameras_go_on_by_themselves(seen: Seen, whole: Solved) -> None:
    single = without(seen, lambda message: isinstance(message, WristDetections) and gone(message))
    at = (single.t_s > GONE_S + 0.1) & (single.t_s < BACK_S)
    np.testing.assert_array_equal(single.t_s, whole.t_s)
    assert not (single.poses.solver_mode[at] > 0).any()
    assert single.poses.valid[at].all()
    assert np.nanmedian(single.off_mm[at]) < 8.0
    assert (single.poses.solver_mode[single.t_s > BACK_S + 0.1] > 0).any()


def test_without_the_imu_the_palm_is_that_of_the_markers(seen: Seen, whole: Solved) -> None:
    single = without(seen, lambda message: isinstance(message, ImuSample) and gone(message))
    at = (single.t_s > GONE_S + 0.1) & (single.t_s < BACK_S - 0.1)
    assert np.isnan(single.poses.palm_world_wxyz[at]).all()
    assert np.isfinite(single.poses.palm_world_wxyz[single.t_s > BACK_S + 0.1]).all()
    assert np.nanmedian(single.off_mm[at]) < 1.5 * np.nanmedian(whole.off_mm[at]) + 1.0


def test_fingers_are_better_with_the_wrist_device_than_without(seen: Seen, whole: Solved) -> None:
    """Of a hand that closes before cameras that lose its tips."""
    markers = Solved.of(seen[0], solve(seen[0].markers, seen[1]), seen[0].markers)
    assert np.nanmean(whole.pip_deg[:, 1:]) < np.nanmean(markers.pip_deg[:, 1:])


def door(seen: Seen) -> MarkerPipeline:
    found = pipeline_of(seen[0].fused, StageTimes())
    assert isinstance(found, MarkerPipeline)
    return found


def pushed(pipeline: MarkerPipeline, messages: list[Observed]) -> list[HandPose]:
    out: list[HandPose] = []
    for message in messages:
        if isinstance(message, ImuSample):
            pipeline.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
        else:
            out += [one.pose for one in pipeline.push(message)]
    return out


def test_late_and_doubled_cycles_are_counted_and_change_nothing(seen: Seen) -> None:
    some = [message for message in seen[1] if 1e-9 * (message.t_ns - START_NS) < 1.0]
    doubled: list[Observed] = []
    before: WristDetections | None = None
    for message in some:
        doubled.append(message)
        if isinstance(message, WristDetections):
            doubled.append(message)
            if before is not None:
                doubled.append(before)
            before = message
    plain, troubled = door(seen), door(seen)
    expected, got = pushed(plain, some), pushed(troubled, doubled)
    assert len(got) == len(expected) > 40
    for a, b in zip(expected, got, strict=True):
        np.testing.assert_array_equal(a.position_m, b.position_m)
    assert troubled.counts["late"] == len(doubled) - len(some)
    assert plain.counts["late"] == 0


def test_no_kernel_is_compiled_while_both_track_a_hand(seen: Seen) -> None:
    """Its DIPs are free, as before every wrist device; now and then nothing or something wild is seen."""
    rng, line = np.random.default_rng(4), door(seen)
    before = compiled(master.fabrik, master.estimator)
    assert before["master.estimator.update.fit_epoch"] >= 1
    some = [message for message in seen[1] if 1e-9 * (message.t_ns - START_NS) < 0.6]
    wild: list[Observed] = []
    for k, message in enumerate(some):
        if k % 5 == 0 and isinstance(message, MarkerDetections):
            uv = np.where(np.isnan(message.uv), np.nan, rng.uniform(0.0, 479.0, message.uv.shape))
            message = msgspec.structs.replace(message, uv=uv, alt_uv=np.minimum(uv + 30.0, 479.0))
        wild.append(message)
    assert len(pushed(line, wild)) > 20
    line.flush()
    assert compiled(master.fabrik, master.estimator) == before


def test_levels_are_published_with_the_poses(whole: Solved) -> None:
    levels = whole.poses.solver_mode[whole.t_s > 1.2]
    assert (levels[:, 1:] > 0).mean() > 0.8
    assert (levels[:, 1:] == SolverMode.IK).any()
    assert np.isfinite(whole.poses.laser_m[whole.t_s > 1.2]).mean() > 0.7
