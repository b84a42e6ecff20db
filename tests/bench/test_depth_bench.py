"""The static figure of `bench depth`: the noise of a resting marker's depth, through real detection."""

from pathlib import Path

import numpy as np

from bench.cameras.depth import AWAY_M, SETTLING, static
from master.rig.setup import load_setup


def test_a_resting_marker_stands_within_a_millimetre_at_60_cm(root: Path) -> None:
    run = static(load_setup(root / "calib_json", "desk"), place=1, frames=SETTLING + 40)
    assert abs(float(run.raw_m.mean()) - AWAY_M) < 0.01
    raw, filtered = run.raw_m.std(axis=0, ddof=1), run.filtered_m.std(axis=0, ddof=1)
    assert np.sqrt(np.mean(raw**2)) < 1e-3
    assert np.sqrt(np.mean(filtered**2)) < np.sqrt(np.mean(raw**2))
    assert raw.min() > 5e-5  # the noise is fresh in every frame: a frozen picture would pass the rest
