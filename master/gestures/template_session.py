"""Interactive recording of a pose template with a person.

For each example there is a countdown, a hold that must be still, and then the hand moves.
"""

from collections.abc import Callable

from common.clock import Clock
from common.errors import FitError
from common.hand.model import HandModel
from common.messages import HandPose
from master.gestures.features import FeatureExtractor, HandFeatures
from master.gestures.poses import FingerSpeed
from master.gestures.quantities import known_bends
from master.gestures.templates import SHORTEST, Example

Receive = Callable[[float], HandPose | None]


def template_session(
    receive: Receive,
    model: HandModel,
    name: str,
    count: int,
    clock: Clock,
    notify: Callable[[str], None],
) -> list[Example]:
    """Lead a person through `count` examples of the pose `name`.

    Args:
        receive: The next pose of the hand, waiting at most so long [s].
        model: The hand.
        name: Of the pose.
        count: How many examples.
        clock: For the countdown.
        say: Called with one line at a time.

    Raises:
        FitError: No hand was seen, or it did not keep still, three times.
    """
    out: list[Example] = []
    for number in range(count):
        tries = 3
        for _ in range(tries):
            notify(f"{number + 1} of {count}: show {name!r}, as you will later")
            count_down_s = 3
            for left in range(count_down_s, 0, -1):
                notify(f"{left} ...")
                during(receive, clock, 1.0)
            hold_s = 1.0
            notify(f"hold still ({hold_s:g} s)")
            started_s = 0.2  # until a hand that obeys has stopped
            during(receive, clock, started_s)
            frames = held(during(receive, clock, hold_s), model)
            lacking = what_lacks(frames)
            if not lacking:
                out.append(Example.of(frames))
                break
            notify(f"{lacking}; once more")
        else:
            raise FitError(
                f"example {number + 1}: not seen at rest in {tries} tries; the poses that were there stay"
            )
        if number + 1 < count:
            notify("good; open the hand, move it, turn it a little")
            rest_s = 1.0
            during(receive, clock, rest_s)
    return out


def held(poses: list[HandPose], model: HandModel) -> list[HandFeatures]:
    """Return the features of poses that have a hand.

    They are in order of time, each epoch once.
    """
    extractor, out = FeatureExtractor(model), list[HandFeatures]()
    for pose in poses:
        features = extractor.of(pose)
        if features is not None and (not out or features.t_ns > out[-1].t_ns):
            out.append(features)
    return out


def what_lacks(frames: list[HandFeatures]) -> str:
    """Why a hold is no example; nothing where it is one."""
    if len(frames) < SHORTEST:
        return "no hand was seen; is `phalanx run` running, on this --bus, with the hand in sight"
    speed = FingerSpeed()
    speeds = sorted(speed.push(one.t_ns, *known_bends(one)) for one in frames)
    middle = speeds[len(speeds) // 2]
    still_deg_s = 45.0  # half of the frames of a hold are slower; noise of a resting hand is a third of that
    if middle > still_deg_s:
        return f"the fingers moved, by {middle:.0f} degrees a second"
    return ""


def during(receive: Receive, clock: Clock, seconds: float) -> list[HandPose]:
    """The poses that come within a time."""
    until = clock.now_ns() + round(1e9 * seconds)
    poses: list[HandPose] = []
    while clock.now_ns() < until:
        wait_s = 0.05
        pose = receive(wait_s)
        if pose is not None:
            poses.append(pose)
    return poses
