"""The line given whatever the wire lets pass: nothing raises, nothing poisons it, nothing is compiled on the way."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import master.estimator
import master.fabrik
from common.calibration import PowerLawCalibration
from common.hand.model import HandModel
from common.messages import HandPose, MarkerDetections, Source, decode, encode
from common.messages.parts import MAX_PICTURE
from master.fabrik.caps import CapTables
from master.fabrik.depth import PowerLaw
from master.fabrik.triangulate import DepthTriangulator, disparity_tables
from master.rig.pipeline import build_pipeline, line_of
from master.run.app import StageTimes
from tests.hand_helpers import LEFT, MARKERS, RIGHT
from tests.master.fabrik.compiled import compiled
from tests.synthetic_run import SyntheticRun, synthetic_run

LAWS: list[dict[str, object]] = [
    {"depth_model": "power_law", "power_law": PowerLawCalibration(k_m=37.5, z=-1.0)},
    {"depth_model": "stereo"},
]
BEFORE, STORM = 10, 40  # frames of a hand, then frames of anything


@pytest.fixture(scope="module", params=LAWS, ids=["law", "stereo"])
def run(request: pytest.FixtureRequest) -> SyntheticRun:
    return synthetic_run(BEFORE + STORM + 20, **request.param)


def anything(message: MarkerDetections, rng: np.random.Generator) -> MarkerDetections:
    """What a sender may say and the master takes in: pixels of the picture, areas and sigmas from bound to bound."""
    m, far = len(message.area), np.array([639.5, 479.5])
    uv = rng.uniform(-0.5, far, (m, 2))
    warm_start = rng.random(m) < 0.5
    uv[warm_start] = message.uv[warm_start] + rng.normal(0.0, 10.0 ** rng.uniform(-1, 4), (m, 2))[warm_start]
    uv = np.clip(uv, -0.5, far)
    kind = rng.random()
    if kind < 0.2:
        uv[:] = uv[0]  # all in one place
    elif kind < 0.4:
        uv[:] = [300.0, 200.0]  # of both cameras: infinitely far, or nearly so
        uv[:, 0] += rng.choice([0.0, 1e-12, 1e-6, 0.1]) * rng.normal()
    seen = rng.random(m) < rng.choice([0.2, 0.6, 1.0])
    uv[~seen] = np.nan
    area = rng.choice([0.0, 1e-9, 400.0, float(MAX_PICTURE) ** 2, np.nan], m)
    sigma = np.where(seen, rng.choice([1e-6, 0.1, 30.0, float(MAX_PICTURE)], m), np.nan)
    return msgspec.structs.replace(
        message, uv=uv, area=area, quality=np.ones(m), sigma_px=sigma, alt_uv=np.full((m, 2), np.nan)
    )


@pytest.mark.parametrize("solver", ["estimator", "fabrik"])
@pytest.mark.parametrize("seed", range(2))
def test_whatever_senders_say_nothing_raises_and_the_hand_comes_back(
    run: SyntheticRun, solver: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    setup = replace(run.setup, rig=msgspec.structs.replace(run.setup.rig, solver=solver))
    pipeline, poses = build_pipeline(setup, StageTimes()), list[HandPose]()
    for message in run.messages:
        wild = BEFORE <= message.seq < BEFORE + STORM
        sent = decode(encode(anything(message, rng) if wild else message))
        assert isinstance(sent, MarkerDetections)
        poses += [solved.pose for solved in pipeline.push(sent)]
    assert len(poses) > BEFORE + STORM + 15
    for pose in poses:
        decode(encode(pose))  # within the bounds of the wire
        known = np.isfinite(pose.position_m.sum(axis=1))
        assert known[pose.valid].all()
        assert np.isfinite(pose.cov_m2[pose.valid]).all()
        triangulated = np.isfinite(pose.markers_raw_m).all(axis=1)
        np.testing.assert_array_equal(triangulated, np.isfinite(pose.markers_cov_m2).all(axis=(1, 2)))
        np.testing.assert_array_equal(triangulated, np.isfinite(pose.markers_m).all(axis=1))
    for pose in poses[-5:]:
        assert pose.valid.all()
        assert (pose.source != Source.HELD).all()
        off = np.linalg.norm(pose.position_m - run.truth(pose.t_ns).position_m, axis=1)
        assert off[1:].mean() < 0.025


@pytest.mark.parametrize("law", [PowerLaw(37.5, -1.0), PowerLaw(45.4, -1.035)])
def test_a_point_is_placed_with_its_covariance_or_not_at_all(law: PowerLaw, run: SyntheticRun) -> None:
    """Also where it is nearer to the cameras than a cap is large, and where nothing is known of the hand's tilt."""
    cameras, caps = tuple(run.setup.models.values()), CapTables.of(RIGHT, MARKERS)
    place = DepthTriangulator(disparity_tables(cameras, law, 0.01, 1e6, 1e9), caps)
    solver, rng, triangulated = line_of(run.setup, StageTimes()), np.random.default_rng(9), 0
    hands = [hand.solution for message in run.messages[:20] for hand in solver.push(message)]
    hand = hands[-1]
    assert hand is not None
    unsure = replace(hand, tilt_cov_rad2=np.full((5, 3, 3), np.nan))
    for k in range(1000):
        uv = rng.uniform(-MAX_PICTURE, 2 * MAX_PICTURE, (2, 6, 2))
        uv[1] = uv[0] - [10.0 ** rng.uniform(-13.0, 4.5), 0.0]
        found = place(uv, np.full((2, 6), 0.1), np.full((2, 6), 400.0), unsure if k % 3 == 0 else hand, 0.02)
        whole = np.isfinite(found.points_m.sum(axis=1))
        np.testing.assert_array_equal(whole, np.isfinite(found.cov_m2).all(axis=(1, 2)))
        np.testing.assert_array_equal(whole, np.isfinite(found.noise_m2).all(axis=(1, 2)))
        triangulated += int(whole.sum())
        assert not whole[:5].any() or k % 3 > 0
    assert triangulated > 150


def test_caps_are_looked_at_as_of_the_hand_that_is_given_and_its_age(run: SyntheticRun) -> None:
    """A tracker's hand is newer than the line's last one where one camera was lost."""
    solver = line_of(run.setup, StageTimes())
    epochs = [epoch for message in run.messages[:30] for epoch in solver.sync.push(message)]
    hands = [solver.solve(epoch).solution for epoch in epochs[:-1]]
    late = replace(epochs[-1], t_ns=epochs[-2].t_ns + 300_000_000)
    fresh, old = (
        line_of(run.setup, StageTimes()).solve(late, hands[-1], age_s).markers for age_s in (1 / 60, 0.3)
    )
    held = solver.solve(late, hands[-1], 1 / 60).markers
    np.testing.assert_array_equal(held.cov_m2, fresh.cov_m2)
    assert (np.trace(old.cov_m2[:5], axis1=1, axis2=2) > np.trace(fresh.cov_m2[:5], axis1=1, axis2=2)).all()


@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize("model", [RIGHT, LEFT], ids=["right", "left"])
def test_no_kernel_is_compiled_while_a_hand_is_tracked(
    run: SyntheticRun, model: HandModel, continuous: bool
) -> None:
    """Nor of one whose DIPs are free: `tests.master.estimator.test_fused_pipeline`."""
    rng = np.random.default_rng(4)
    setup = replace(run.setup, hand=model)
    pipeline = build_pipeline(setup, StageTimes(), continuous=continuous)
    before = compiled(master.fabrik, master.estimator)
    assert before["master.estimator.update.fit_epoch"] >= 1
    for k, message in enumerate(run.messages):
        sent = anything(message, rng) if k % 5 == 0 else message
        alternative = np.where(rng.random((6, 1)) < 0.1, np.minimum(sent.uv + 30.0, [639.5, 479.5]), np.nan)
        pipeline.push(msgspec.structs.replace(sent, alt_uv=alternative))
    pipeline.flush()
    assert compiled(master.fabrik, master.estimator) == before
