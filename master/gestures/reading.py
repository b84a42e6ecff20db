"""Gestures of a recorded hand.

They are all gestures of its poses, and each from its begin to its end.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from common.calibration.gesture_settings import GestureSettings
from common.hand.model import HandModel
from common.messages import Gesture
from master.gestures.recogniser import GestureRecogniser
from master.outputs.poses import Poses


@dataclass(frozen=True, slots=True)
class Spoken:
    """One gesture from its begin to its end.

    Attributes:
        kind, name: As of the messages.
        began_t_ns, ended_t_ns: [ns]; where the poses end before it, its last message.
        confidence: The highest.
        value: What it reported last: a distance, a strength, an angle; empty for a pose.
    """

    kind: str
    name: str
    began_t_ns: int
    ended_t_ns: int
    confidence: float
    value: str

    def line(self, since_ns: int) -> str:
        """Return a readable line; times are since an epoch [ns]."""
        began, ended = (1e-9 * (t_ns - since_ns) for t_ns in (self.began_t_ns, self.ended_t_ns))
        who = self.kind if self.name == self.kind else f"{self.kind} {self.name}"
        return f"{began:9.3f} s to {ended:9.3f} s  {who:24s} {self.confidence:.2f}  {self.value}".rstrip()


def read_gestures(poses: Poses, settings: GestureSettings, model: HandModel) -> list[Gesture]:
    """Return all gestures of a hand in its poses."""
    recogniser = GestureRecogniser(settings, model)
    return [gesture for k in range(len(poses)) for gesture in recogniser.push(poses.pose(k))]


def spans_of(gestures: Iterable[Gesture]) -> list[Spoken]:
    """Each gesture once, in the order of their begins."""
    last: dict[tuple[str, str, int], Gesture] = {}
    most: dict[tuple[str, str, int], float] = {}
    for one in gestures:
        key = (one.kind, one.name, one.began_t_ns)
        most[key] = max(most.get(key, 0.0), one.confidence)
        last[key] = one
    spans = [
        Spoken(kind, name, began, one.t_ns, most[kind, name, began], _value(one))
        for (kind, name, began), one in last.items()
    ]
    return sorted(spans, key=lambda span: span.began_t_ns)


def lines_of(gesture: Gesture) -> str:
    """Return a message as a line of JSON.

    Arrays are lists, missing values are null.
    """
    fields = {name: getattr(gesture, name) for name in gesture.__struct_fields__}
    plain = {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in fields.items()
    }
    return msgspec.json.encode(plain).decode()


def _value(gesture: Gesture) -> str:
    parts: list[str] = []
    if np.isfinite(gesture.distance_m):
        parts.append(f"{1e3 * gesture.distance_m:.1f} mm")
    if np.isfinite(gesture.angle_rad):
        parts.append(f"{np.degrees(gesture.angle_rad):.1f} deg")
    return ", ".join(parts)
