"""What several tests of slaves share: colours of the rendered recordings, and what draws a scene."""

from pathlib import Path
from typing import Any

import pytest

from common.sim.scenes import renderer_of
from slave.commands.offline import calibrate_colours

_DRAWN: dict[tuple[int, str, bool], tuple[object, Any]] = {}


@pytest.fixture(scope="session")
def colours(datasets: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calib_json tree whose cameras have the colours picked in `calib_colors`."""
    tree = tmp_path_factory.mktemp("calibration")
    (tree / "cameras").mkdir()
    for camera in ("left", "right"):
        calibrate_colours(datasets / "stereo/calib_colors", camera, tree / "cameras" / f"{camera}.json")
    return tree


@pytest.fixture
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let synthetic cameras of one scene share what draws it: to make it takes as long as fifty frames."""

    def shared(scene: Any, camera: str, *, live: bool = False) -> Any:
        key = id(scene), camera, live
        if key not in _DRAWN:
            _DRAWN[key] = scene, renderer_of(scene, camera, live=live)
        return _DRAWN[key][1]

    monkeypatch.setattr("slave.cameras.synthetic.renderer_of", shared)
