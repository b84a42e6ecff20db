"""A slave without colours sends frames without markers, whatever it looks at."""

import numpy as np

from common.messages import MarkerDetections
from slave.markers.reloadable import NullDetector
from tests.slave.painted import hand, render


def test_every_answer_is_a_message_in_which_nothing_is_seen() -> None:
    detector = NullDetector(6)
    for t_ns in (0, 16_000_000):
        found = detector.push(render(hand(300.0), noise=2.0, seed=1), t_ns)
        message = MarkerDetections(
            "left",
            1,
            2,
            t_ns,
            t_ns,
            found.uv,
            found.area,
            found.quality,
            found.sigma_px,
            found.alt_uv,
        )
        assert np.isnan(message.uv).all()
        assert found.colour.shape == (6, 3)
