"""Reliability diagrams: honest regions lie on the diagonal, and what is absent is said."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.reliability import LEVELS, draw, found_in, main


@pytest.mark.parametrize("degrees", [2, 3])
def test_honest_regions_lie_on_the_diagonal(degrees: int) -> None:
    chi_2 = np.random.default_rng(1).chisquare(degrees, 100_000)
    np.testing.assert_allclose(found_in(chi_2, degrees), LEVELS, atol=0.01)
    too_sure = found_in(4.0 * chi_2, degrees)  # sigma is half of what it should be
    assert (too_sure[10:90] < LEVELS[10:90] - 0.05).all()


def test_three_diagrams_are_drawn(tmp_path: Path) -> None:
    chi_2 = np.random.default_rng(1).chisquare(3, 100)
    draw(tmp_path / "new" / "r.png", [(0.1, 0.05, 0.5), (0.9, 0.95, 0.5)], {"joints": chi_2}, {"imu": chi_2})
    image = cv2.imread(str(tmp_path / "new" / "r.png"))
    assert image is not None
    assert all(panel.min() < 128 for panel in np.array_split(image, 3, axis=1))


def test_absent_data_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PHALANX_DATASETS", str(tmp_path))
    with pytest.raises(SystemExit):
        main(["--picture", str(tmp_path / "r.png")])
    assert "set PHALANX_DATASETS" in capsys.readouterr().err
