"""Plain-text labels for the state of hands, objects and gestures.

Pure: messages in, text out.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence

from common.hand.model import JOINTS
from common.messages import Contact, Gesture, HandPose, ObjectPose, ObjectSource, Source

SOURCES = {
    Source.NONE: "unknown",
    Source.MEASURED: "measured",
    Source.SOLVED: "solved",
    Source.HELD: "held",
    Source.WRIST: "wrist device",
}
_OBJECT_SOURCES = {
    ObjectSource.NONE: "not seen",
    ObjectSource.MARKERS: "by its beads",
    ObjectSource.TAGS: "by its tags",
    ObjectSource.TRACKER: "by its tracker",
    ObjectSource.HELD: "held where it was last seen",
}
FINGERS = ("thumb", "index", "middle", "ring", "little")


def joint_states(pose: HandPose) -> list[tuple[str, str, bool]]:
    """Return (joint, state, tracked now) for all 26 joints.

    The state is `unknown` where the joint is not valid.
    """
    return [
        (name, SOURCES[Source(int(source))] if valid else "unknown", bool(tracked))
        for name, source, valid, tracked in zip(JOINTS, pose.source, pose.valid, pose.tracked, strict=True)
    ]


def hand_line(pose: HandPose) -> str:
    """How much of a hand is known, in one line."""
    states = joint_states(pose)
    count = Counter(state for _, state, _ in states)
    tracked = sum(1 for *_, now in states if now)
    parts = [f"{count[word]} {word}" for word in SOURCES.values() if count[word]]
    return f"{tracked} of {len(states)} joints seen now: {', '.join(parts)}"


def object_line(pose: ObjectPose, contacts: Sequence[Contact]) -> str:
    """Where an object is, and what holds or touches it."""
    source = _OBJECT_SOURCES[ObjectSource(pose.source)]
    if any(math.isnan(x) for x in pose.position_m):
        return f"not seen; {pose.seen} of {pose.expected} features"
    x, y, z = (1e3 * float(v) for v in pose.position_m)
    parts = [f"at {x:.0f}, {y:.0f}, {z:.0f} mm", source]
    if pose.occluded:
        parts.append("partly hidden")
    for contact in contacts:
        fingers = [name for name, on in zip(FINGERS, contact.touching, strict=True) if on]
        if contact.held:
            parts.append(f"in the grip of {contact.hand}")
        elif fingers:
            parts.append(f"touched by {', '.join(fingers)}")
    return ", ".join(parts)


def gesture_line(gesture: Gesture) -> str:
    """One gesture: what, how much, how sure."""
    sure = f"{100 * gesture.confidence:.0f} %"
    match gesture.kind:
        case "pose":
            return f"pose {readable(gesture.name)} ({sure})"
        case "pinch":
            return f"pinch with the {gesture.name} finger, {1e3 * gesture.distance_m:.0f} mm apart ({sure})"
        case "dial":
            return f"dial turned by {math.degrees(gesture.angle_rad):+.0f}° ({sure})"
        case "tap":
            return f"tap on key {gesture.name} ({sure})"
        case "point":
            return f"points ({sure})"


def readable(name: str) -> str:
    """A name of ours as words."""
    return name.replace("_", " ")


def gesture_lines(gestures: Mapping[tuple[str, str], Gesture], hand: str) -> list[str]:
    """Return text lines for the current gestures of one hand."""
    return [gesture_line(one) for (whose, _), one in sorted(gestures.items()) if whose == hand]
