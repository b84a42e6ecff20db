"""Draws how the light of one strobed triple becomes fingers, on the simulated wrist device.

python -m bench.wrist_picture docs/images/wrist.png
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from common.arrays import Float, Image
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.hand.model import CHAINS
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from master.estimator.wrist_pipeline import WristPipeline
from master.rig.wrist import WristSetup
from master.run.stages import StageTimes
from slave.cameras.synthetic import STROBE
from slave.sources import Frame
from slave.wrist.background import lit
from slave.wrist.detector import find
from slave.wrist.fingers import separate
from slave.wrist.strobe import StrobeCycle
from slave.wrist.view import WristView

TREE = Path(__file__).resolve().parents[1] / "calib_json"
T_S = 2.0  # of a curl: half bent, the fingertips in view
SCALE = 0.6
# Okabe and Ito's colours, blue first: thumb ... little.
COLOURS = ((0, 159, 230), (233, 180, 86), (115, 158, 0), (167, 121, 204), (0, 94, 213))
GREY = (160, 160, 160)


def picture(t_s: float = T_S, scene: str = "curl") -> Image:
    """(H, W, 3) BGR: the three frames above; below the light of laser and of LEDs alone with what was found,
    and the solved hand."""
    rig = load(TREE / "rigs/wrist.json", RigCalibration)
    camera = load(TREE / "cameras/wrist.json", CameraCalibration)
    hand = load(TREE / f"hands/{rig.hand}.json", HandProfile)
    view = WristView.of(rig, camera, hand)
    renderer = WristRenderer(WristScene.by_name(scene, rig, {camera.name: camera}, hand), camera.name, step=1)
    frames = [
        Frame(k, 0, 0, renderer.render(t_s + k / camera.frame_rate_hz, kind)) for k, kind in enumerate(STROBE)
    ]
    cycle = StrobeCycle(*frames)
    found = find(cycle, view)
    ambient = cycle.ambient.image
    laser, led = lit(cycle.laser.image, ambient), lit(cycle.led.image, ambient)
    lines = _shown(laser, "laser - ambient: a point on each finger")
    _points(lines, found.laser.uv, cross=True)
    fingers = _shown(led, "LEDs - ambient: seams, and fingertips")
    for seam in separate(led, view).polylines():
        whole = seam[np.isfinite(seam).all(axis=1)]
        cv2.polylines(
            fingers, [_pixels(whole)], isClosed=False, color=GREY, thickness=1, lineType=cv2.LINE_AA
        )
    _points(fingers, found.tips.uv, cross=False)
    top = [
        _shown(f.image, name)
        for f, name in zip(frames, ("1: ambient light", "2: laser", "3: LEDs"), strict=True)
    ]
    hand_shown = _shown(led, "the hand that the master makes of it")
    pipeline = WristPipeline(WristSetup.of(rig, camera, view.model), continuous=False, stage=StageTimes())
    solved = [*pipeline.push(found.message(camera.name, 1)), *pipeline.flush()]
    _bones(hand_shown, view.optics.project(solved[0].pose.position_m))
    below = [lines, fingers, hand_shown]
    return np.asarray(np.vstack([np.hstack(top), np.hstack(below)]), np.uint8)


def _shown(image: Image, title: str) -> Image:
    """A grey picture in colour, scaled, brighter, with a title."""
    bright = np.clip(image.astype(np.float32) * 1.4, 0.0, 255.0).astype(np.uint8)
    size = (round(image.shape[1] * SCALE), round(image.shape[0] * SCALE))
    out = cv2.cvtColor(cv2.resize(bright, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    cv2.putText(out, title, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(out, np.uint8)


def _points(image: Image, uv: Float, *, cross: bool) -> None:
    for point, colour in zip(uv, COLOURS, strict=True):
        if np.isfinite(point).all():
            x, y = _pixels(point[None])[0, 0].tolist()
            if cross:
                cv2.drawMarker(image, (x, y), colour, cv2.MARKER_CROSS, 14, 2, cv2.LINE_AA)
            else:
                cv2.circle(image, (x, y), 8, colour, 2, cv2.LINE_AA)


def _bones(image: Image, joints: Float) -> None:
    """Fingers of joints (26, 2) [px]."""
    for chain, colour in zip(CHAINS, COLOURS, strict=True):
        points = _pixels(joints[chain])
        cv2.polylines(image, [points], isClosed=False, color=colour, thickness=2, lineType=cv2.LINE_AA)
        for x, y in points[:, 0].tolist():
            cv2.circle(image, (x, y), 4, colour, -1, cv2.LINE_AA)


def _pixels(uv: Float) -> np.ndarray:
    return np.round(uv * SCALE).astype(np.int32)[:, None]


if __name__ == "__main__":
    cv2.imwrite(sys.argv[1], picture())
