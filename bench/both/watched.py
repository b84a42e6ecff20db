"""What both slaves find in the rendered frames of a scene: drawn and detected in memory, nothing of it saved."""

from collections.abc import Iterator

import numpy as np

from bench.both.scene import Both, Observed, Shown, Sight, in_order, orientations
from bench.played import START_NS, message_of, times_of
from common.arrays import Bool, Float
from common.sim.render import Renderer
from common.sim.wrist.render import WristRenderer
from slave.cameras.synthetic import STROBE
from slave.markers.reloadable import detector_for
from slave.markers.white_balance import Inline
from slave.sources import Frame
from slave.wrist.detector import WristDetector
from slave.wrist.led_image import WristView


def watched(both: Both, seconds: float) -> Shown:
    """What the slaves report of a scene within its first `seconds`; some seconds for each."""
    messages = orientations(both, seconds)
    times, marker_colour = dict[str, Float](), dict[str, Float]()
    for camera in both.markers.rig.cameras:
        rate = both.markers.cameras[camera].frame_rate_hz
        times[camera] = times_of(both.scene, camera, seconds, rate)
        found, marker_colour[camera] = _markers(both, camera, times[camera])
        messages += found
    cycles, line_t, line, tip = cycles_of(both, seconds)
    return Shown(both, seconds, in_order(messages + cycles), Sight(times, marker_colour, line_t, line, tip))


def _markers(both: Both, camera: str, times_s: Float) -> tuple[list[Observed], Float]:
    """One marker camera's frames, and the paint (T, M) [px^2] in sight."""
    scene = both.scene
    renderer = Renderer(scene, camera)
    detector = detector_for(scene.cameras[camera], scene.rig.markers, Inline(), free=scene.rig.free_markers)
    out: list[Observed] = []
    marker_colour: list[Float] = []
    for seq, t in enumerate(times_s.tolist()):
        image, view = renderer.observe(t)
        marker_colour.append(np.where(np.isfinite(view.uv[:, 0]), view.area, 0.0))
        t_ns = START_NS + round(t * 1e9)
        out.append(message_of(camera, seq, t_ns, detector.push(image, t_ns)))
    return out, np.array(marker_colour)


def cycles_of(both: Both, seconds: float) -> tuple[list[Observed], Float, Float, Bool]:
    """The wrist device's triples; when its laser frames were, what of line [m] and tips (K, 5) was in sight."""
    name = both.wrist.rig.cameras[0]
    own = both.wrist.cameras[name]
    detector = WristDetector(WristView.of(both.wrist.rig, own, both.wrist.hand.profile), own.frame_rate_hz)
    out: list[Observed] = []
    times: list[float] = []
    for frame in _frames(both, name, seconds):
        if (found := detector.push(frame)) is not None:
            out.append(found.message(name, session=1))
            times.append(1e-9 * (found.cycle.laser.t_ns - START_NS))
    truths = [(both.wrist_scene.truth(t), both.wrist_scene.truth(t + 1.0 / own.frame_rate_hz)) for t in times]
    line = np.array([laser.laser_len_vis[1:6] for laser, _ in truths])
    return out, np.array(times), line, np.array([led.tip_visible for _, led in truths])


def _frames(both: Both, name: str, seconds: float) -> Iterator[Frame]:
    """Frames of the wrist camera, strobed in turn."""
    own, renderer = both.wrist.cameras[name], WristRenderer(both.wrist_scene, name)
    for seq, t in enumerate((np.arange(round(seconds * own.frame_rate_hz)) / own.frame_rate_hz).tolist()):
        t_ns = START_NS + round(t * 1e9)
        image = renderer.render(t, STROBE[seq % len(STROBE)])
        yield Frame(seq, t_ns, t_ns, image, exposure_us=own.exposure_us)
