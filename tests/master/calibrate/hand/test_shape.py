"""The shape of a hand puts the caps where the hand model does, and its derivatives are those of finite differences."""

import numpy as np
import pytest

from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from master.calibrate.hand.shape import PER_FINGER, Shape, caps_of

NAMES = ("thumb", "index", "middle", "ring", "little")


@pytest.mark.parametrize("side", ["left", "right"])
def test_caps_and_their_derivatives(side: str) -> None:
    model = HandModel.of(generated_profile("any", side, 0.18))
    cap = np.array([model.mount(name).offset_m for name in NAMES])
    shape = Shape.of(model, ("back",), 0.7, 0.9)
    angles = np.random.default_rng(3).uniform(-0.3, 1.2, (7, 5, 4))
    caps = caps_of(model, cap, shape, angles)
    expected = model.marker_points(model.forward(np.eye(4), angles), NAMES)
    np.testing.assert_allclose(caps.place_m, expected, atol=1e-12)
    e = 1e-6
    for a in range(4):
        step = e * np.eye(4)[a]
        change = (
            caps_of(model, cap, shape, angles + step).place_m
            - caps_of(model, cap, shape, angles - step).place_m
        )
        np.testing.assert_allclose(caps.by_angle[..., a], change / (2 * e), atol=1e-8)
    for finger in range(5):
        for k in range(9):  # ratio and bias of the DIP move no cap of given angles
            step = np.zeros(shape.size)
            step[PER_FINGER * finger + k] = e
            ahead, behind = (
                caps_of(model, cap, shape.stepped(sign * step), angles).place_m for sign in (1, -1)
            )
            found = (ahead - behind)[:, finger] / (2 * e)
            np.testing.assert_allclose(caps.by_shape[:, finger, :, k], found, atol=1e-8)
