"""A session of `calibrate depth` before the simulated card: detected frames in, laws of the geometry out."""

from pathlib import Path

import numpy as np
import pytest

from common.calibration import CameraCalibration, RigCalibration, load
from common.geometry.camera_model import CameraModel
from common.sim.board import BOARD, BoardRenderer
from common.sim.scenes import DISTANCES_M, MARKER, CardScene
from master.calibrate.depth.fit import FITS, relative_error
from master.calibrate.depth.source import pair_of, parse_target, straightened
from master.calibrate.depth.sweep import Sweep, checked
from master.fabrik.depth import law_residual
from slave.markers.reloadable import LightAdaptiveDetector
from slave.markers.white_balance import Inline

CALIB = Path(__file__).parents[4] / "calib_json"
RIG = load(CALIB / "rigs" / "desk.json", RigCalibration)
CAMERAS = {name: load(CALIB / "cameras" / f"{name}.json", CameraCalibration) for name in RIG.cameras}
MODELS = tuple(CameraModel.of(CAMERAS[name], RIG.camera_pose(name)) for name in RIG.cameras)


@pytest.fixture(scope="module")
def sweep() -> Sweep:
    """One frame of each camera at each distance."""
    scene, index = CardScene(RIG, CAMERAS, 7), RIG.markers.index(MARKER)
    places = range(len(DISTANCES_M))
    uv = np.empty((len(DISTANCES_M), 2, 2))
    area, sigma = np.empty(uv.shape[:2]), np.empty(uv.shape[:2])
    for c, name in enumerate(RIG.cameras):
        renderer, detector = (
            BoardRenderer(scene, name),
            LightAdaptiveDetector(CAMERAS[name], RIG.markers, Inline()),
        )
        for k in places:
            t_s = k * (BOARD.held_s + BOARD.moved_s)
            found = detector.push(renderer.render(t_s), round(t_s * 1e9))
            uv[k, c], area[k, c], sigma[k, c] = found.uv[index], found.area[index], found.sigma_px[index]
    return Sweep.of(np.array(DISTANCES_M), uv, area, [f"place {k}" for k in places], np.hypot(*sigma.T))


def test_the_laws_agree_with_the_geometry(sweep: Sweep) -> None:
    pair = pair_of(RIG, CAMERAS)
    straight, _ = straightened(sweep, pair, parse_target("75x50"))
    good = checked(straight, pair.cameras, pair.size_px)
    assert good.size == len(DISTANCES_M)
    # A power law is not that of two cameras: 0.5 % is what it misses by; an affine one misses by the noise.
    for name, most in (("power_law", 0.01), ("affine_disparity", 0.004)):
        law, _ = FITS[name](good.disparity_px, good.distance_m)
        assert np.abs(relative_error(law, good.disparity_px, good.distance_m)).max() < most, name
        assert law_residual(law, MODELS, RIG.volume)[0] < most, name
