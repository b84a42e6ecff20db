"""Skin of a hand as round cones: met where a ruler says, as thick as the hand file has it; and where a finger ends."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from common.calibration import HandProfile, load
from common.hand.model import CHAINS, Fingertips, HandModel
from common.hand.profiles import generated_profile
from common.hand.skin import PalmarSurface, first_hits


@pytest.fixture(scope="module")
def model(root: Path) -> HandModel:
    """A hand whose file gives radii."""
    return HandModel.of(load(root / "calib_json" / "hands" / "default-right.json", HandProfile))


def test_a_ball_a_cylinder_and_a_cone_are_met_where_a_ruler_says() -> None:
    centres = np.array([[0.0, 0.0, 0.1], [0.0, 0.04, 0.1]])
    rays = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    alike = first_hits(np.array([0.0, 0.02, 0.0]), rays, centres, np.array([0.01, 0.01]))
    np.testing.assert_allclose(alike[:, 0], [0.09, np.inf])  # the side of a cylinder; past it
    below = first_hits(np.array([0.0, -0.05, 0.1]), rays, centres, np.array([0.01, 0.02]))
    np.testing.assert_allclose(below[:, 0], [np.inf, 0.04])  # the ball at its end, from below
    # Radii 10 and 20 mm, 40 mm apart: half way the side is 15 mm / cos(asin(10 / 40)) from the axis.
    capsule = first_hits(np.array([0.0, 0.02, 0.0]), rays, centres, np.array([0.01, 0.02]))
    assert capsule[0, 0] == pytest.approx(0.1 - 0.015 / np.sqrt(1.0 - 1.0 / 16.0), abs=1e-12)


def test_the_surface_is_that_of_the_hand_file_or_of_a_hand_of_its_size(model: HandModel) -> None:
    stated = PalmarSurface.of(model)
    np.testing.assert_allclose(stated.palmar_m[1, [0, 4, 6, 7]], model.radius_m[[7, 8, 9, 10]])
    bare = HandModel.of(msgspec.structs.replace(model.profile, radius_m=None))
    thick = 2e3 * PalmarSurface.of(bare).radius_m[1:, 4]
    assert (np.diff(thick[1:]) < 0.0).all()  # middle, ring, little
    assert ((thick > 12.0) & (thick < 20.0)).all()  # of fingers at the PIP, mm


def test_tips_lie_a_radius_beyond_the_last_joint_or_as_far_as_a_hand_of_this_size_has_them(
    model: HandModel,
) -> None:
    chains = model.chains(np.zeros((5, 4)))
    beyond = Fingertips.of(model).points(chains) - chains.position_m[:, 3]
    np.testing.assert_allclose(np.linalg.norm(beyond, axis=1), model.radius_m[CHAINS[:, 3]])
    bare = msgspec.structs.replace(generated_profile("bare", "right"), radius_m=None)
    tips_m = Fingertips.of(HandModel.of(bare)).beyond_m
    assert ((tips_m > 7e-3) & (tips_m < 14e-3)).all()
