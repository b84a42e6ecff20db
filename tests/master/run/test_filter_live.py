"""A slider of the console acts on the 3D hand of a running master: lag and jitter, over UDP and the bus."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.hand.model import HandJoints
from common.messages import HandPose
from master.console.controls import FilterTuner
from tests.hand_helpers import RIGHT, palm
from tests.master.run.test_tuning import Master, master
from tests.network_helpers import PATIENCE_S
from tests.synthetic_run import hand_at

HEAVY = {"min_cutoff_hz": 0.3, "beta": 0.0, "d_cutoff_hz": 4.0, "jitter_m": 3e-4}
LIGHT = {"min_cutoff_hz": 30.0, "beta": 4000.0, "d_cutoff_hz": 4.0, "jitter_m": 3e-3}
SWAY_RAD_S, SWAY_M = 2.0 * np.pi, 0.03
SETTLED_NS = 1_500_000_000  # from then on a filter of 0.3 Hz has forgotten where it began
POSES = 90
RELAXED = np.radians([[8.0, 8.0, 12.0, 12.0]] + 4 * [[0.0, 12.0, 22.0, 14.7]])


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Master]:
    with master(tmp_path_factory.mktemp("filter")) as one:
        one.sigma_px = 0.15
        yield one


def swaying(t_ns: int) -> HandJoints:
    """A hand that sways sideways at up to 0.2 m/s."""
    x = SWAY_M * np.sin(SWAY_RAD_S * 1e-9 * t_ns)
    return RIGHT.forward(palm(at_m=np.array([x, 0.08, 0.5])), RELAXED)


def published(
    running: Master, settings: dict[str, float], hand: Callable[[int], HandJoints]
) -> tuple[Float, Float]:
    """Times (T,) [s] and joints (T, 26, 3) [m] that come once the settings act on this hand."""
    running.hand = hand
    FilterTuner("bench", Path(), lambda command: running.live.bus.ask(command, 30.0)).set(settings)
    since_ns = time.monotonic_ns() + SETTLED_NS
    deadline = time.monotonic() + PATIENCE_S
    t: list[float] = []
    joints: list[Float] = []
    while len(t) < POSES:
        assert time.monotonic() < deadline, f"{len(t)} poses of {POSES} came"
        pose = running.poses.get(0.5)
        if isinstance(pose, HandPose) and pose.t_ns > since_ns and pose.valid.all():
            t.append(1e-9 * pose.t_ns)
            joints.append(pose.position_m)
    return np.array(t), np.array(joints)


def jitter_mm(running: Master, settings: dict[str, float]) -> float:
    """How far the joints of a hand at rest go from one pose to the next, RMS, all axes together."""
    _, joints = published(running, settings, lambda _t_ns: hand_at(0.0))
    return 1e3 * float(np.sqrt(np.square(np.diff(joints, axis=0)).sum(axis=2).mean()))


def lag_ms_and_share(running: Master, settings: dict[str, float]) -> tuple[float, float]:
    """How much later the palm sways than the true hand, and how far, as a share of its way."""
    t, joints = published(running, settings, swaying)
    phase = SWAY_RAD_S * t
    waves = np.stack([np.sin(phase), np.cos(phase), np.ones(len(t))], axis=1)
    (sine, cosine, _), *_ = np.linalg.lstsq(waves, joints[:, 0, 0])
    return 1e3 * float(np.arctan2(-cosine, sine)) / SWAY_RAD_S, float(np.hypot(sine, cosine)) / SWAY_M


def test_a_hand_at_rest_trembles_as_the_sliders_say(running: Master) -> None:
    heavy, light = jitter_mm(running, HEAVY), jitter_mm(running, LIGHT)
    assert light > 0.3, "there is something to filter"
    assert heavy < 0.15 * light, (heavy, light)


def test_a_hand_in_motion_lags_as_the_sliders_say(running: Master) -> None:
    # A low pass of 0.3 Hz is atan(1 / 0.3) = 73 degrees late at 1 Hz, 203 ms, and leaves 0.29 of the way.
    lag, share = lag_ms_and_share(running, HEAVY)
    assert 150.0 < lag < 230.0
    assert share < 0.4
    lag, share = lag_ms_and_share(running, LIGHT)
    assert lag < 30.0
    assert share > 0.95
