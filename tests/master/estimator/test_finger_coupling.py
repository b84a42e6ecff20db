"""How MCP and PIP of a hand are coupled is learnt from the fingers whose tips are seen."""

from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.hand.model import CHAINS
from common.messages import HandPose
from master.estimator.settings import DEFAULT
from master.estimator.wrist_pipeline import WristPipeline
from tests.master.estimator.wrist_case import CYCLE_NS, PIP, WristCase, bent, pipeline, pushed

CURL_DEG = np.linspace(25.0, 80.0, 120)
SHOWN_PIP_DEG = 8.0


@pytest.fixture(scope="module")
def wrist_case(root: Path) -> WristCase:
    return WristCase.of(root)


def learnt(wrist_case: WristCase, share: float, spread_deg: float = 0.0) -> WristPipeline:
    """A device that has seen a hand close with its tips in sight: MCP = share x PIP, off by so much."""
    line, rng = pipeline(wrist_case, continuous=True), np.random.default_rng(5)
    for k, pip in enumerate(CURL_DEG):
        mcp = np.clip(share * pip + spread_deg * rng.normal(), 0.0, 90.0)
        pushed(line, wrist_case.message(bent(float(mcp), float(pip)), (k + 1) * CYCLE_NS))
    return line


def coupled(line: WristPipeline) -> tuple[float, float]:
    """MCP as a share of the PIP, and within how much of the PIP."""
    prior = line._estimator._at.prior
    return float(prior.per_pip[1, 1] + prior.coupled_share[0]), float(prior.coupled_spread[0])


def laser_alone(wrist_case: WristCase, line: WristPipeline) -> tuple[HandPose, Float]:
    """The pose of a hand that opens until no tip is seen, and standard deviations (4,) [deg] of its PIPs."""
    angles, pose = bent(0.54 * SHOWN_PIP_DEG, SHOWN_PIP_DEG), None
    for k in range(12):
        pose = pushed(line, wrist_case.message(angles, (len(CURL_DEG) + 30 + k) * CYCLE_NS, tips=False))
    assert pose is not None
    return pose, np.degrees(np.sqrt(line._estimator._at.scan.pip2[1:]))


@pytest.mark.parametrize("share", [0.45, 0.54, 0.7])
def test_a_hand_teaches_its_own_share(wrist_case: WristCase, share: float) -> None:
    found, spread = coupled(learnt(wrist_case, share))
    assert found == pytest.approx(share, abs=0.08)
    assert spread < 0.7 * DEFAULT.coupled_spread


def test_a_hand_that_follows_no_share_is_not_taken_to(wrist_case: WristCase) -> None:
    assert coupled(learnt(wrist_case, 0.54, 30.0))[1] > DEFAULT.coupled_spread


def test_a_hand_that_keeps_to_its_share_is_tracked_by_the_laser_alone(wrist_case: WristCase) -> None:
    """As long as nothing is learnt it is vague, and vaguer where the hand defies the prior."""
    fresh, stationary = laser_alone(wrist_case, pipeline(wrist_case, continuous=True))
    pose, close = laser_alone(wrist_case, learnt(wrist_case, 0.54))
    other, wide = laser_alone(wrist_case, learnt(wrist_case, 0.54, 30.0))
    np.testing.assert_allclose(np.degrees(pose.angles_rad[1:, PIP]), SHOWN_PIP_DEG, atol=6.0)
    assert (close < 0.9 * stationary).all()
    assert (stationary < 0.9 * wide).all()
    tips = CHAINS[1:, PIP]
    assert pose.tracked[tips].sum() > fresh.tracked[tips].sum()
    assert not other.tracked[tips].any()


def test_what_was_learnt_fades(wrist_case: WristCase) -> None:
    line = learnt(wrist_case, 0.7)
    late_ns = round(1e9 * 20.0 * DEFAULT.coupled_s)
    pushed(line, wrist_case.message(bent(20.0, 40.0), late_ns))
    share, spread = coupled(line)
    assert share == pytest.approx(0.54, abs=0.01)
    assert spread == pytest.approx(DEFAULT.coupled_spread, abs=0.01)
