"""A person shows a few examples, and a pose template is learnt.

An example is a hold of some frames; of each quantity it has the median. Over the examples a quantity has a mean and a
spread, which nobody repeats better than `_FLOOR` another day; few examples widen it as Student's t does (the factor
that holds 86 % of new ones, n - 1 degrees of freedom). The range is the mean and that much either way, the border is
as wide again.

Only what was known in every example is asked, and of redundant quantities only one. A pose is refused where an
existing one fits the examples: it would be called by both names. Where it is meant as a special case of that one, it
has a greater weight, and so is preferred where both fit.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.special import stdtrit

from common.arrays import Bool, Float
from common.calibration.gesture_settings import GestureSettings, PoseShape, Quantity, Span
from common.clock import Clock
from common.errors import FitError
from common.hand.model import FINGERS, HandModel
from common.messages import HandPose
from master.gestures.features import FeatureExtractor, HandFeatures
from master.gestures.poses import QUANTITIES, FingerSpeed, PoseTable, Quantities, known_bends

FEWEST = 3  # examples
SHORTEST = 5  # frames of one
_FLOOR: Mapping[str, float] = {"deg": 7.0, "mm": 7.0, "": 0.09}  # by unit: what a hold varies from day to day
# Examples that differ by more show no one pose.
_WIDEST: Mapping[str, float] = {"deg": 25.0, "mm": 25.0, "": 0.35}
_ASKED: tuple[Quantity, ...] = (
    *("index_mcp_deg", "index_pip_deg", "middle_mcp_deg", "middle_pip_deg"),
    *("ring_mcp_deg", "ring_pip_deg", "little_mcp_deg", "little_pip_deg"),
    *("thumb_bend_deg", "thumb_across", "thumb_below", "thumb_ahead", "thumb_index_gap_mm"),
    *("index_middle_spread_deg", "middle_ring_spread_deg", "ring_little_spread_deg"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One hold.

    Attributes:
        quantities: Medians over the frames in which each was known, and their standard deviations; unknown: inf.
        known: (5,) fingers that were known in most frames.
    """

    quantities: Quantities
    known: Bool

    @classmethod
    def of(cls, frames: Sequence[HandFeatures]) -> "Example":
        """Of the frames of one hold.

        Raises:
            FitError: They are too few.
        """
        if len(frames) < SHORTEST:
            raise FitError(f"an example of {len(frames)} frames: hold it longer, for {SHORTEST} at least")
        each = [Quantities.of(frame) for frame in frames]
        measured = np.array([one.known for one in each])
        known_share = 0.6  # of an example's frames
        enough = measured.mean(axis=0) >= known_share
        value = np.where(measured, np.array([one.value for one in each]), np.nan)
        sigma = np.where(measured, np.array([one.sigma for one in each]), np.nan)
        known = np.mean([frame.known for frame in frames], axis=0) >= known_share
        medians = [np.full(len(QUANTITIES), fill) for fill in (0.0, np.inf)]
        for median, of in zip(medians, (value, sigma), strict=True):
            median[enough] = np.nanmedian(of[:, enough], axis=0)
        return cls(Quantities(*medians), known)


@dataclass(frozen=True, slots=True, eq=False)
class PoseTemplate:
    """A pose that was learnt, lines about it for the user, residuals for provenance."""

    shape: PoseShape
    stated: tuple[str, ...]
    residual: dict[str, float]


def learn(
    name: str, examples: Sequence[Example], settings: GestureSettings, within: str | None = None
) -> PoseTemplate:
    """Return the pose that the examples show.

    Args:
        name: Of the pose; one of that name is replaced.
        settings: The poses that there are.
        within: The pose that this one is a special case of.

    Raises:
        FitError: Too few or too different examples, too little is known of the hand, or it is too like
            another pose. The text states which and why.
    """
    most = 10  # examples
    if not FEWEST <= len(examples) <= most:
        raise FitError(f"{name}: {len(examples)} examples, {FEWEST} to {most} are needed")
    others = {other: shape for other, shape in settings.poses.items() if other != name}
    if within is not None and within not in others:
        raise FitError(f"{name}: there is no pose {within!r} that it could be a special case of")
    special = 4.0  # weight of a special case
    shape = _shape(name, examples, 1.0 if within is None else special)
    _refuse_alike(name, shape, examples, others, within)
    agree = _agreement(name, examples)
    asked = [f"{span.low:.4g} to {span.high:.4g} {quantity}" for quantity, span in shape.ranges.items()]
    stated = [
        f"{name}: distinguished by {', '.join(asked)}",
        f"each example fits the others by {agree:.2f} or better",
    ]
    stated += [_difference(other, of, examples) for other, of in others.items()]
    return PoseTemplate(
        shape, tuple(stated), {"examples": float(len(examples)), "agreement": round(agree, 3)}
    )


def _shape(name: str, examples: Sequence[Example], weight: float) -> PoseShape:
    """Ranges of what is known in all examples."""
    known = np.all([example.quantities.known for example in examples], axis=0)
    value = np.array([example.quantities.value for example in examples])
    total_sigma = np.sqrt(
        np.mean([np.where(known, example.quantities.sigma, 0.0) ** 2 for example in examples], axis=0)
    )
    n = len(examples)
    wider = float(stdtrit(n - 1, 0.93)) * sqrt(1.0 + 1.0 / n)
    ranges: dict[Quantity, Span] = {}
    for quantity in _ASKED:
        column, unit = QUANTITIES.index(quantity), _unit(quantity)
        if not known[column] or total_sigma[column] > _WIDEST[unit]:
            continue
        spread = float(value[:, column].std(ddof=1))
        if spread > _WIDEST[unit]:
            raise FitError(
                f"{name}: the examples do not show one pose: {quantity} is"
                f" {', '.join(f'{one:.3g}' for one in value[:, column])}"
            )
        half, middle = max(_FLOOR[unit], wider * spread), float(value[:, column].mean())
        ranges[quantity] = Span(
            low=round(middle - half, 3), high=round(middle + half, 3), soft=round(half, 3)
        )
    fingers = np.all([example.known for example in examples], axis=0)
    if len(ranges) < len(_ASKED) // 2:
        hidden = ", ".join(np.array(FINGERS)[~fingers]) or "too many fingers"
        raise FitError(f"{name}: {hidden} cannot be seen in this pose; turn the hand to the cameras")
    return PoseShape(ranges=ranges, weight=weight)


def _refuse_alike(
    name: str,
    shape: PoseShape,
    examples: Sequence[Example],
    others: Mapping[str, PoseShape],
    within: str | None,
) -> None:
    """Refuse examples that another pose fits, or whose shape fits its middle."""
    for other, of in others.items():
        if other == within:
            continue
        fits = max(_scores(of, examples))
        middle = _middle(of)
        back = _scores(shape, [middle])[0] if middle is not None else 0.0
        like = 0.25  # an example that another pose fits so well would be called by its name
        if max(fits, back) >= like:
            special = f", or, where it is a special case of it, say so (--within {other})"
            hint = "" if middle is not None else special
            raise FitError(
                f"{name}: too like {other!r}, which fits by {max(fits, back):.2f}; {_difference(other, of, examples)}."
                f" Show a pose that differs more{hint}"
            )


def _middle(shape: PoseShape) -> Example | None:
    """Middle of a template pose; None: a range has one side, the pose is wider."""
    value, sigma = np.zeros(len(QUANTITIES)), np.full(len(QUANTITIES), np.inf)
    for quantity, span in shape.ranges.items():
        if span.high - span.low > 4.0 * span.soft:
            return None
        column = QUANTITIES.index(quantity)
        value[column], sigma[column] = 0.5 * (span.low + span.high), 0.0
    return Example(Quantities(value, sigma), np.ones(len(FINGERS), np.bool_))


def _scores(shape: PoseShape, examples: Sequence[Example]) -> list[float]:
    """How well a pose fits each example, as seen by what is known of it."""
    return [float(np.exp(-0.5 * (_residuals(shape, example) ** 2).sum())) for example in examples]


def _residuals(shape: PoseShape, example: Example) -> Float:
    alone = GestureSettings(version=1, name="alone", poses={"one": shape})
    return PoseTable(alone).fit(example.quantities, example.known).residuals[0]


def _difference(other: str, shape: PoseShape, examples: Sequence[Example]) -> str:
    """What distinguishes the examples from another pose, most distinctive first."""
    residuals = np.median([_residuals(shape, example) for example in examples], axis=0)
    value = np.median([example.quantities.value for example in examples], axis=0)
    parts: list[str] = []
    most = 3  # quantities that are named where two poses differ
    columns: list[int] = np.argsort(-residuals)[:most].tolist()
    for column in columns:
        if residuals[column] < 0.5:
            break
        quantity: Quantity = QUANTITIES[column]
        span = shape.ranges[quantity]
        bound = f"at most {span.high:.3g}" if value[column] > span.high else f"at least {span.low:.3g}"
        parts.append(f"{quantity} is {value[column]:.3g}, there {bound}")
    return f"from {other}: {'; '.join(parts) or 'nothing that it asks'}"


def _agreement(name: str, examples: Sequence[Example]) -> float:
    """Worst leave-one-out fit of an example; of three, too few for it, to the whole."""
    if len(examples) <= FEWEST:
        return min(_scores(_shape(name, examples, 1.0), examples))
    return min(
        _scores(_shape(name, [*examples[:k], *examples[k + 1 :]], 1.0), [example])[0]
        for k, example in enumerate(examples)
    )


def _unit(quantity: str) -> str:
    unit = quantity.rsplit("_", 1)[-1]
    return unit if unit in ("deg", "mm") else ""


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
        notify: Called with one line at a time.

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
    """Features of poses that have a hand, in order of time, each epoch once."""
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
