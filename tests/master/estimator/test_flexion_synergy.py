"""Fingers that close naturally: by the ratios of the papers, or those that a hand file states."""

import msgspec
import numpy as np

from common.calibration import Couplings
from common.hand.model import HandModel
from common.hand.profiles import generated_profile
from master.estimator.priors import FlexionSynergy


def test_a_finger_bends_by_the_ratios_of_the_paper_unless_its_hand_states_others() -> None:
    profile = generated_profile("made", "right")
    curl, aside = np.full(5, np.radians(50.0)), np.full(5, np.radians(3.0))
    angles = np.degrees(FlexionSynergy.of(HandModel.of(profile)).angles(curl, aside))
    np.testing.assert_allclose(angles[1:], [[3.0, 27.0, 50.0, 42.0]] * 4)
    stated = msgspec.structs.replace(profile, couplings=Couplings(dip_per_pip=0.7, mcp_per_pip=None))
    angles = np.degrees(FlexionSynergy.of(HandModel.of(stated)).angles(curl, aside))
    np.testing.assert_allclose(angles[1:], [[3.0, 27.0, 50.0, 35.0]] * 4)


def test_a_thumb_goes_through_the_same_share_of_each_range() -> None:
    model = HandModel.of(generated_profile("made", "right"))
    synergy = FlexionSynergy.of(model)
    low, high = model.limits_rad[0, 1:].T
    for share, end in ((0.0, synergy.range_rad[:, 0]), (1.0, synergy.range_rad[:, 1])):
        np.testing.assert_allclose(
            synergy.angles(end, np.zeros(5))[0, 1:], low + share * (high - low), atol=1e-12
        )
