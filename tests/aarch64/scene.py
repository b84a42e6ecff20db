"""Renders, on the host and uncounted, what is counted on: marked hands, and a curl before a wrist device."""

from pathlib import Path

from bench.report import rig_files
from common.sim.render import Renderer
from common.sim.scene import Scene
from common.sim.wrist.render import WristRenderer
from common.sim.wrist.scene import WristScene
from slave.cameras.synthetic import STROBE
from tests.aarch64.frames import SIX, WRIST, MarkedFrames, StrobedFrames, write, write_strobed

OPEN_S = 20.0  # an open hand: all six markers in view
COUNT = 11  # forth and back a period of twenty frames
CURL = "curl"


def rendered() -> MarkedFrames:
    """Six markers of the standard scene, before the rig `desk`."""
    rig, cameras, hand = rig_files("desk")
    name = rig.cameras[0]
    renderer = Renderer(Scene.standard(rig, cameras, hand), name)
    images = [renderer.render(OPEN_S + 1.0 / 60.0 * k) for k in range(COUNT)]
    return MarkedFrames(cameras[name], rig.markers, images)


def strobed() -> StrobedFrames:
    """Triples of a curl before the wrist device of the rig `wrist`."""
    rig, cameras, hand = rig_files("wrist")
    name = rig.cameras[0]
    camera = cameras[name]
    renderer = WristRenderer(WristScene.by_name(CURL, rig, cameras, hand, 7), name)
    curl_s = 0.5  # begins where fingers bend
    images = [renderer.render(curl_s + k / camera.frame_rate_hz, STROBE[k % 3]) for k in range(3 * COUNT)]
    return StrobedFrames(rig, camera, hand, images)


def write_all(folder: Path) -> None:
    """Write every set to a folder of its name in `folder`."""
    write(folder / SIX, rendered())
    write_strobed(folder / WRIST, strobed())
