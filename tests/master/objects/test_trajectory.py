"""Where an object is led to while nobody sees it, and when that ends."""

import numpy as np

from common.geometry.transforms import rigid
from master.objects.fit import ORDERS, Fitted, Motion
from master.objects.line import HELD_S, Trajectory

FRAME_NS = 16_666_667


def fitted(speed_m_s: float, *, measured_only: bool = True) -> Fitted:
    rates = np.zeros((ORDERS, 2, 3))
    rates[1, 0, 0] = speed_m_s
    motion = Motion(rigid(np.eye(3), np.array([0.0, 0.0, 0.5])), rates)
    one = np.ones(4)
    return Fitted(motion, 1e-6 * np.eye(12), 0.0, one, one, one, measured_only)


def test_its_speed_dies_away() -> None:
    trajectory = Trajectory()
    trajectory.push(0, fitted(1.0))
    near, far = (trajectory.predicted(round(t * 1e9)) for t in (0.001, 0.45))
    assert near is not None
    assert far is not None
    np.testing.assert_allclose(near.T[0, 3], 0.001, rtol=0.01)
    np.testing.assert_allclose(far.T[0, 3], 0.12, rtol=0.03)  # speed times the time in which it dies


def test_its_uncertainty_grows_and_after_a_while_there_is_none() -> None:
    trajectory = Trajectory()
    trajectory.push(0, fitted(0.2))
    first, later = (trajectory.held_cov(round(t * 1e9)) for t in (0.02, 0.4))
    assert first is not None
    assert later is not None
    assert (np.diagonal(later) > np.diagonal(first)).all()
    late_ns = round((HELD_S + 0.01) * 1e9)
    assert trajectory.held_cov(late_ns) is None
    assert trajectory.predicted(late_ns) is None
    assert not trajectory


def test_a_never_complete_pose_is_forgotten() -> None:
    trajectory = Trajectory()
    assert trajectory.push(0, fitted(0.0))
    last = round(HELD_S * 1e9 / FRAME_NS)
    accepted = [trajectory.push(k * FRAME_NS, fitted(0.0, measured_only=False)) for k in range(1, last + 3)]
    assert all(accepted[: last - 1])
    assert not accepted[-1]


def test_the_past_is_of_before_all_that_is_seen_and_its_speed_counts() -> None:
    trajectory = Trajectory()
    for k in range(40):
        trajectory.push(k * FRAME_NS, fitted(1.0))
    past = trajectory.past(40 * FRAME_NS, 36 * FRAME_NS)
    np.testing.assert_allclose(past.motion.T[0, 3], 4 * FRAME_NS * 1e-9, rtol=1e-6)
    assert (np.linalg.eigvalsh(past.precision) > 0.0).all()
    np.testing.assert_allclose(past.off(past.motion), np.zeros(12), atol=1e-12)
