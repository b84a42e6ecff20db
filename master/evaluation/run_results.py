"""Results of a simulated run beside the hands.

As messages again, and as figures that a person understands.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import Bool, Int
from common.messages import Gesture, ResultMessage
from common.sim.gestures import Annotation, Gestures
from common.sim.scene import Scene
from master.evaluation.score import ObjectTruth, score_object, score_objects
from master.outputs.result_files import (
    GESTURES,
    Contacts,
    ObjectPoses,
    contact_path,
    load_gesture_messages,
    object_path,
)
from master.rig.setup import RigSetup

_LATE_S = 0.4  # a gesture that is reported so long after it was made is not that one


@dataclass(frozen=True, slots=True, eq=False)
class RunResults:
    """Results of a run for one hand and its objects."""

    objects: tuple[ObjectPoses, ...] = ()
    contacts: tuple[Contacts, ...] = ()
    gestures: tuple[Gesture, ...] = ()  # in the order of time

    @classmethod
    def load(cls, folder: Path, setup: RigSetup, from_ns: int) -> "RunResults":
        """Read the files beside poses.npz, gestures from a time on; RecordingError."""
        names, hand = [one.name for one in setup.objects], setup.hand.profile.name
        objects = [object_path(folder, name) for name in names]
        contacts = [contact_path(folder, hand, name) for name in names]
        spoken = folder / GESTURES
        gestures = load_gesture_messages(spoken) if spoken.exists() else []
        return cls(
            tuple(ObjectPoses.load(path) for path in objects if path.exists()),
            tuple(Contacts.load(path) for path in contacts if path.exists()),
            tuple(one for one in gestures if one.hand == hand and one.t_ns >= from_ns),
        )

    def messages(self) -> list[ResultMessage]:
        """All of it, each kind in the order of time."""
        out: list[ResultMessage] = [*self.gestures]
        for poses in self.objects:
            out += poses.messages()
        for near in self.contacts:
            out += near.messages()
        return out

    def figures(self, scene: Scene | None, epoch_ns: int, from_ns: int, until_ns: int) -> dict[str, object]:
        """Figures of the summary, of poses from a time to a time.

        Returns:
            Those of `score_objects`; held_s, how long an object was held; gestures, how often each was made
            (kind and name -> count). Where the scene's hand knows what it signals: gestures_right, of those that it
            made how many were reported, gestures_made, gestures_false, those not made; dial_deg, median error of
            the dial's angle.
        """
        out: dict[str, object] = {}
        if scene is not None and self.objects:
            scores = {
                poses.object: score_object(poses, truth_of_object(scene, poses, epoch_ns))
                for poses in self.objects
            }
            out |= score_objects(scores)
        if self.contacts:
            out["held_s"] = round(max(_seconds(near.t_ns, near.held) for near in self.contacts), 1)
        made = Counter(_label(one) for one in _beginnings(self.gestures))
        if made:
            out["gestures"] = dict(made.most_common())
        if scene is not None and isinstance(scene.motion, Gestures):
            out |= judge_gestures(self.gestures, scene.motion, epoch_ns, from_ns, until_ns)
        return out


def truth_of_object(scene: Scene, poses: ObjectPoses, epoch_ns: int) -> ObjectTruth:
    """Where the scene has an object while there are poses of it."""
    if len(poses) == 0:
        return ObjectTruth(np.empty(0, np.int64), np.empty((0, 4, 4)))
    first, last = max(int(poses.t_ns[0]), epoch_ns), int(poses.t_ns[-1])
    truth_hz = 60.0
    t_ns = np.arange(first, max(last, first) + 1, round(1e9 / truth_hz), dtype=np.int64)
    true = [scene.truth(float(t - epoch_ns) * 1e-9).objects[poses.object] for t in t_ns.tolist()]
    return ObjectTruth(t_ns, np.array(true))


def judge_gestures(
    published: Sequence[Gesture], motion: Gestures, epoch_ns: int, from_ns: int, until_ns: int
) -> dict[str, object]:
    """Compare the published gestures, but poses, with those of a scene's hand.

    Args:
        published: Gestures in the order of time.
        epoch_ns: Scene time 0 on the clock of the messages.
        from_ns, until_ns: The first and last pose of the run.
    """
    begun = [one for one in _beginnings(published) if one.kind != "pose"]
    first_s, end_s = (from_ns - epoch_ns) * 1e-9, (until_ns - epoch_ns) * 1e-9
    turns_s = [turn * motion.period_s for turn in range(int(end_s // motion.period_s) + 1)]
    spans = [(one, one.start_s + t_s, one.stop_s + t_s) for t_s in turns_s for one in motion.annotations]
    made = [span for span in spans if first_s <= span[1] and span[2] <= end_s]
    received: set[int] = set()
    right = 0
    for span in made:
        own = [k for k, one in enumerate(begun) if k not in received and _is(one, span, epoch_ns)]
        right += bool(own)
        received.update(own)
    # One that begin or end of the run cut off was made all the same.
    part = [span for span in spans if span[1] < first_s or span[2] > end_s]
    left = [one for k, one in enumerate(begun) if k not in received]
    cut = [one for one in left if any(_is(one, span, epoch_ns) for span in part)]
    out: dict[str, object] = {
        "gestures_right": right,
        "gestures_made": len(made),
        "gestures_false": len(begun) - len(received) - len(cut),
    }
    dials = [one for one in published if one.kind == "dial" and np.isfinite(one.angle_rad)]
    began_s = [(one.began_t_ns - epoch_ns) * 1e-9 for one in dials]
    error = [
        abs(one.angle_rad - motion.dial_rad(_seconds_of(one, epoch_ns)) + motion.dial_rad(t_s))
        for one, t_s in zip(dials, began_s, strict=True)
    ]
    return out | ({"dial_deg": round(float(np.degrees(np.median(error))), 2)} if error else {})


def _beginnings(published: Sequence[Gesture]) -> list[Gesture]:
    """One message of each gesture: its first, of a tap the only one."""
    return [one for one in published if one.phase == "begin" or one.kind == "tap"]


def _label(one: Gesture) -> str:
    return one.kind if one.name == one.kind else f"{one.kind} {one.name}"


def _is(published: Gesture, span: tuple[Annotation, float, float], epoch_ns: int) -> bool:
    """Whether it is that which the hand made from a time to a time [s]."""
    made, start_s, stop_s = span
    same = (published.kind, published.name) == (made.kind, made.name)
    return same and start_s <= _seconds_of(published, epoch_ns) <= stop_s + _LATE_S


def _seconds_of(one: Gesture, epoch_ns: int) -> float:
    return (one.t_ns - epoch_ns) * 1e-9


def _seconds(t_ns: Int, holds: Bool) -> float:
    """How long something held [s], a gap in the rows not counted."""
    step = np.diff(t_ns)
    gap_ns = 200_000_000  # between two rows of one contact
    return float(step[holds[:-1] & (step < gap_ns)].sum() * 1e-9) if len(t_ns) > 1 else 0.0
