"""Recorded hands as the truth: what is cut, what is kept, and that errors are seen where there are some."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.hands.draws import PointHand
from bench.hands.motion import Recorded, held_poses, jitter, play, recordings, wide_limits
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from tests.hand_helpers import MARKERS, palm, small_cov


def named(folder: Path, name: str) -> Recorded:
    return next(recorded for recorded in recordings(folder / "leapjs") if recorded.name == name)


def test_a_hand_that_changes_its_size_is_cut(datasets: Path) -> None:
    parts = [
        recorded for recorded in recordings(datasets / "leapjs") if recorded.name.startswith("confidence")
    ]
    assert len(parts) == 2
    for part in parts:
        bones = np.linalg.norm(np.diff(part.fingers_m, axis=2), axis=3)
        assert bones.std(axis=0).max() < 1e-5
        roots = part.fingers_m[:, :, 0]
        assert roots.std(axis=0).max() < 1e-5  # the palm frame is fixed to the palm


def test_a_profile_that_is_another_hand_is_seen(datasets: Path) -> None:
    whole = named(datasets, "pinch")
    short = replace(
        whole, t_ns=whole.t_ns[:90], T_rig_palm=whole.T_rig_palm[:90], fingers_m=whole.fingers_m[:90]
    )
    own = play(short, whole.model(), seed=1)
    larger = replace(whole, fingers_m=whole.fingers_m * 1.3).model()
    assert own.shown_m.mean() < 5e-3
    assert play(short, larger, seed=1).shown_m.mean() > 2.0 * own.shown_m.mean()


def test_jitter_is_what_differs_over_time() -> None:
    model = HandModel.of(generated_profile("held", "right"))
    angles = held_poses(model)["relaxed"]
    assert model.within_limits(angles).all()
    solver = PointHand(model, MARKERS, continuous=False)
    caps = model.marker_points(model.forward(palm(), angles), MARKERS)
    near = [solver.push(k, caps + np.array([x, 0.0, 0.0]), small_cov()) for k, x in enumerate((-1e-3, 1e-3))]
    hands = [hand.solution for hand in near if hand.solution is not None]
    place, bent, rotated = jitter(hands * 4)
    np.testing.assert_allclose(place, 1.0, atol=0.05)  # 1 mm to either side
    assert bent < 0.2
    assert rotated < 0.2
    assert jitter(hands[:1] * 4) == (0.0, 0.0, 0.0)


def test_the_limits_are_wide_enough_to_be_no_help() -> None:
    limits = wide_limits()
    assert limits.index.flexion_rad[0] < -0.5
    assert limits.little.pip_rad[1] > 2.0
