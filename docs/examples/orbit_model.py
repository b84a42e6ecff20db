"""Pinch, and turn or zoom a 3D model on the screen.

Run a master (or `phalanx demo --scene gestures --bus tcp/127.0.0.1:47802`), and beside it
    python docs/examples/orbit_model.py                      a chair, in a window; or --web: as a page
    python docs/examples/orbit_model.py --model engine.glb --radius 0.3

A clutch of two steps: a pinch that stays for a moment takes the model; what then moves first decides, the hand (orbit)
or the gap of the pinch (zoom), until the pinch ends. Letting go moves both: what the last moment did is undone.
"""

import argparse
import math
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from common.arrays import Float
from common.bus.bus import Bus
from common.bus.zenoh_bus import ZenohBus
from common.errors import PhalanxError
from common.geometry.transforms import axis_rotation
from common.messages import Gesture
from common.messages.streams import MASTER
from master.outputs.rerun import ViewerProcess

TAKE_NS, UNDO_NS, SILENT_NS = 200_000_000, 200_000_000, 1_000_000_000
GAIN = np.array([12.0, 12.0, math.log(2.0) / 0.007])  # 13 cm turn it a quarter, 7 mm of gap double it
MOST = np.array([np.inf, math.radians(85.0), math.log(20.0)])
SMOOTH_S, FRAME_S, ASK_S, MOVED_M, OPENED_M = 0.07, 1.0 / 60.0, 1.0, 0.012, 0.003  # the last two decide
PAINT = [(230, 159, 0), *[(86, 180, 233)] * 5]
HELP = {"": "pinch to take the model", "taken": "taken: move the hand to orbit, open the pinch to zoom"}


class Orbit:
    """Yaw, pitch [rad] and log of the zoom (3,) by pinches; holds what is shown, its goal, and the clutch."""

    def __init__(self, *, mirror: bool = False) -> None:
        self.shown, self.mode, self._goal = np.zeros(3), "", np.zeros(3)
        self._first_ns, self._t_ns, self._pinch = 0, 0, ("", 0)
        self._gain = GAIN * ([-1, 1, 1] if mirror else [1, 1, 1])
        self._from: tuple[Float, Float] | None = None  # middle and gap (4,) [m], goal: where it began
        self._past: deque[tuple[int, Float]] = deque(maxlen=512)

    def push(self, gesture: Gesture) -> None:
        """Take a message: one pinch has the model, from the first that is heard of it to its end."""
        pinch, at = (gesture.hand, gesture.began_t_ns), np.append(gesture.origin_m, gesture.distance_m)
        other = self._pinch[0] and pinch != self._pinch and gesture.t_ns - self._t_ns < SILENT_NS
        if gesture.kind != "pinch" or other:
            return
        if pinch != self._pinch:
            self._pinch, self.mode, self._from, self._first_ns = pinch, "taken", None, gesture.t_ns
            self._past = deque([(0, self._goal)], maxlen=512)
        self._t_ns = gesture.t_ns
        if gesture.phase == "end":
            self._goal = [goal for t_ns, goal in self._past if t_ns <= gesture.t_ns - UNDO_NS][-1]
            self._pinch, self.mode = ("", 0), ""
        elif np.isfinite(at).all():
            self._follow(at)

    def _follow(self, at: Float) -> None:
        if self._from is None or self._t_ns - self._first_ns < TAKE_NS:
            self._from = (at, self._goal)
        moved, goal = at - self._from[0], self._from[1]
        far = float(np.linalg.norm(moved[:3])) / MOVED_M, abs(moved[3]) / OPENED_M
        if self.mode == "taken" and max(far) > 1.0:  # it begins here: what decided is no leap
            self.mode, self._from = ("orbit" if far[0] > far[1] else "zoom"), (at, self._goal)
        elif self.mode != "taken":
            part = self._gain * ([1, 1, 0] if self.mode == "orbit" else [0, 0, 1])
            self._goal = np.clip(goal + part * moved[[0, 1, 3]], -MOST, MOST)
        self._past.append((self._t_ns, self._goal))

    def glide(self, seconds: float) -> None:
        """Go on towards the goal for so long."""
        self.shown = self.shown - (self._goal - self.shown) * math.expm1(-seconds / SMOOTH_S)


def chair() -> rr.Boxes3D:
    """A chair, 2 m high about its middle, which tells at a glance how it is turned."""
    boxes = [(0.0, 0.0, 0.0, 0.5, 0.05, 0.5), (0.0, 0.75, -0.45, 0.5, 0.3, 0.05)]
    boxes += [(x, h - 1.0, 1.35 - 1.8 * h, 0.05, h, 0.05) for x in (-0.45, 0.45) for h in (0.5, 1.0)]
    at, half = np.hsplit(np.array(boxes), 2)
    return rr.Boxes3D(centers=at, half_sizes=half, colors=PAINT, fill_mode="solid")


def show_model(show: rr.RecordingStream, model: rr.Boxes3D | rr.Asset3D, radius: float) -> None:
    """What never changes: the model, the eye before it, a line of text below."""
    eye = rrb.EyeControls3D(position=(0.0, 0.9, 3.2), look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 1.0, 0.0))
    views = [rrb.Spatial3DView(eye_controls=eye), rrb.TextDocumentView(origin="said", name="Pinch")]
    show.send_blueprint(rrb.Blueprint(rrb.Vertical(*views, row_shares=[9, 1]), collapse_panels=True))
    show.log("/", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
    show.log("model/shape", model, rr.Transform3D(scale=1.0 / radius), static=True)


def run(bus: Bus, orbit: Orbit, show: rr.RecordingStream, go_on: Callable[[], bool]) -> None:
    """Follow the gestures while `go_on`; the screen says what is waited for."""
    feed, shown, drawn = bus.subscribe("gesture", depth=256), "", np.full(3, np.nan)
    there, last_s, asked_s = False, time.monotonic(), -ASK_S
    while go_on():
        message = feed.get(FRAME_S)
        while isinstance(message, Gesture):
            orbit.push(message)
            message, there, asked_s = feed.get(0.0), True, time.monotonic()
        if (now_s := time.monotonic()) - asked_s > ASK_S:
            there, asked_s = MASTER in bus.alive(), now_s
        orbit.glide(now_s - last_s)
        if not np.abs(orbit.shown - drawn).max() < 1e-4:
            drawn = orbit.shown
            rotation = axis_rotation(0, drawn[1]) @ axis_rotation(1, drawn[0])
            show.log("model", rr.Transform3D(mat3x3=rotation * math.exp(drawn[2])))
        text, last_s = HELP.get(orbit.mode, orbit.mode) if there else "waiting for a master ...", now_s
        if text != shown:
            show.log("said", rr.TextDocument(shown := text))
            sys.stderr.write(f"{text}\n")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bus", default="tcp/127.0.0.1:47802", help="tls/ with keys (default: %(default)s)")
    parser.add_argument("--model", type=Path, metavar="FILE.glb", help="what to show (default: a chair)")
    parser.add_argument("--mirror", action="store_true", help="the reference camera faces you")
    parser.add_argument("--radius", type=float, default=1.0, help="of the model (default: %(default)s)")
    parser.add_argument("--web", type=int, nargs="?", const=9091, metavar="PORT", help="a page, not a window")
    options = parser.parse_args()
    try:
        data = options.model.read_bytes() if options.model else None
        model = chair() if data is None else rr.Asset3D(contents=data, media_type="model/gltf-binary")
        with closing(ViewerProcess(options.web)) as viewer:
            show = rr.RecordingStream("orbit_model")
            show.connect_grpc(viewer.url)
            show_model(show, model, options.radius)
            sys.stderr.write(f"{viewer.address}\n")
            try:
                run(ZenohBus(None, options.bus), Orbit(mirror=options.mirror), show, viewer.alive)
            except KeyboardInterrupt:
                show.disconnect()
    except (PhalanxError, OSError) as error:
        sys.exit(f"orbit_model: {error}")


if __name__ == "__main__":
    main()
