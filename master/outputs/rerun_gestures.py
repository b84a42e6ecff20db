"""Gestures in the viewer's scene.

Which gesture the hand makes, where it makes it, and lanes of gestures over time.

world/gestures/HAND/pose             the name of the pose beside the palm
world/gestures/HAND/pinch            thumb to finger, brighter as it closes, with the distance of their skins
world/gestures/HAND/dial             circle about the dial's axis; /turned: arc of the angle, with its degrees
world/gestures/HAND/ray              where a finger points
world/gestures/HAND/tap              the key that was tapped, for half a second
states/HAND/KIND                     the same over time
events/HAND                          every begin, end and tap as a line of text
"""

from collections.abc import Mapping, Sequence
from math import isfinite

import numpy as np
import rerun as rr

from common.arrays import Float
from common.hand.model import FINGERS
from common.messages import Gesture
from master.outputs.palette import GESTURE_RGB, Rgb
from master.outputs.rerun_blueprint import EVENTS, WORLD
from master.outputs.rerun_states import States

_LINE_M = 0.0012
_ARC_STEP_RAD = np.deg2rad(4.0)
_LABEL_M = np.array([0.0, -0.02, 0.0])  # of a name: above what it names


class GesturesLayer:
    """Logger of gestures to a recording that belongs to the caller.

    Holds which key each hand tapped last, and when.
    """

    def __init__(self, recording: rr.RecordingStream, states: States) -> None:
        self._rec, self._states = recording, states
        self._tapped: dict[str, int] = {}

    def log(self, gestures: Sequence[Gesture], joints_m: Mapping[tuple[str, int], Float]) -> None:
        """Log gestures of any hands, in the order of time.

        Args:
            gestures: The messages.
            joints_m: Hand and `t_ns` -> (6, 3) the five tips and the palm [m], rig frame, where they are known.
        """
        for one in gestures:
            root = rr.new_entity_path([WORLD, "gestures", one.hand])
            at = joints_m.get((one.hand, one.t_ns), np.full((6, 3), np.nan))
            self._states.at(one.t_ns)
            tap_ns = 500_000_000
            if one.t_ns - self._tapped.get(one.hand, one.t_ns) > tap_ns:
                del self._tapped[one.hand]
                self._rec.log(f"{root}/tap", rr.Clear(recursive=True))
            if one.kind == "tap":
                self._tapped[one.hand] = one.t_ns
                self._name(f"{root}/tap", f"key {one.name}", at[0], GESTURE_RGB["tap"])
                self._states.log(f"{one.hand}/tap", one.began_t_ns, one.name)
                self._states.log(f"{one.hand}/tap", one.t_ns, None)
            else:
                self._held(root, one, at)
            if one.phase != "update":
                self._states.at(one.t_ns)
                self._rec.log(
                    rr.new_entity_path([EVENTS, one.hand]),
                    rr.TextLog(f"{one.phase} {one.kind}: {label_of(one)}", level="INFO"),
                )

    def _held(self, root: str, one: Gesture, at: Float) -> None:
        path, colour = f"{root}/{'ray' if one.kind == 'point' else one.kind}", GESTURE_RGB[one.kind]
        if one.phase == "end":
            self._states.log(f"{one.hand}/{one.kind}", one.t_ns, None)
            self._states.at(one.t_ns)
            self._rec.log(path, rr.Clear(recursive=True))
            return
        if one.phase == "begin":
            self._states.log(f"{one.hand}/{one.kind}", one.t_ns, one.name)
            self._states.at(one.t_ns)
        if one.kind == "pose":
            self._name(path, one.name, at[5] + _LABEL_M, colour)
        elif one.kind == "pinch":
            self._pinch(path, one, at, colour)
        elif one.kind == "dial" and np.isfinite(one.direction).all() and np.isfinite(one.origin_m).all():
            self._dial(path, one, colour)
        elif one.kind == "point" and np.isfinite(one.direction).all() and np.isfinite(one.origin_m).all():
            ray_m = 0.35
            arrow = rr.Arrows3D(
                origins=[one.origin_m], vectors=[ray_m * one.direction], radii=_LINE_M, colors=[colour]
            )
            self._rec.log(path, arrow)

    def _name(self, path: str, name: str, at: Float, colour: Rgb) -> None:
        if np.isfinite(at).all():
            self._rec.log(
                path, rr.Points3D([at], radii=1e-4, colors=[colour], labels=[name], show_labels=True)
            )

    def _pinch(self, path: str, one: Gesture, at: Float, colour: Rgb) -> None:
        ends = at[[0, FINGERS.index(one.name)]] if one.name in FINGERS else at[:0]
        strip = ends if len(ends) == 2 and np.isfinite(ends).all() else np.tile(one.origin_m, (2, 1))
        if not np.isfinite(strip).all():
            return
        closed = 0.35 + 0.65 * (one.strength if isfinite(one.strength) else 0.0)
        bright = [round(part * closed) for part in colour]
        line = rr.LineStrips3D(
            [strip], radii=2 * _LINE_M, colors=[bright], labels=[label_of(one)], show_labels=True
        )
        self._rec.log(path, line)

    def _dial(self, path: str, one: Gesture, colour: Rgb) -> None:
        dial_m = 0.045
        circle = dial_m * arc(one.direction, 2.0 * np.pi) + one.origin_m
        thin = rr.LineStrips3D([circle], radii=0.4 * _LINE_M, colors=[colour])
        self._rec.log(path, thin)
        if not isfinite(one.angle_rad):
            return
        rotated = dial_m * arc(one.direction, one.angle_rad) + one.origin_m
        strip = np.concatenate([one.origin_m[None], rotated, one.origin_m[None]])
        thick = rr.LineStrips3D(
            [strip], radii=2.0 * _LINE_M, colors=[colour], labels=[label_of(one)], show_labels=True
        )
        self._rec.log(f"{path}/turned", thick)


def arc(axis: Float, angle_rad: float) -> Float:
    """Return points (N, 3) of a unit circle arc about an axis (3,).

    From its top (the side of -y) on, by an angle about the axis.
    """
    first = np.array([0.0, -1.0, 0.0]) - axis * -axis[1]
    if np.linalg.norm(first) < 1e-3:
        first = np.array([1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    angles = np.linspace(0.0, angle_rad, 2 + int(abs(angle_rad) / _ARC_STEP_RAD))[:, None]
    return np.cos(angles) * first + np.sin(angles) * np.cross(axis, first)


def label_of(one: Gesture) -> str:
    """A gesture in words."""
    if one.kind == "pinch":
        return f"{one.name} {one.distance_m * 1e3:.0f} mm" if isfinite(one.distance_m) else one.name
    if one.kind == "dial":
        return f"dial {np.rad2deg(one.angle_rad):+.0f}°" if isfinite(one.angle_rad) else "dial"
    what = {"tap": f"key {one.name}", "point": "pointing"}.get(one.kind, one.name)
    return what if one.kind == "tap" else f"{what} {one.confidence:.2f}"
