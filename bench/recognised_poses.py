"""Hands of given joints as poses, and what is told of them: what the benches of gestures share."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.row import Row
from common.arrays import Float
from common.calibration.gesture_settings import default_gestures
from common.hand.model import HandModel
from common.messages import JOINT_COUNT, HandPose, Source
from common.sim.motion import POSES
from master.gestures.features import FeatureExtractor
from master.gestures.poses import PoseRecogniser

FORMED = 2  # frames in which a formed pose may not be told yet
_NONE = "none"
_SIGMA_M = 2e-3  # claimed of every joint


@dataclass(slots=True)
class RecognisedPoses:
    """What was told of held poses: (true, told) -> frames; episodes, those told in time, and events while none fits."""

    frames: Counter[tuple[str, str]] = field(default_factory=Counter[tuple[str, str]])
    episodes: int = 0
    in_time: int = 0
    passing: int = 0

    def add(self, truth: Sequence[str | None], recognised: Sequence[str | None]) -> None:
        """Of one hand, frame by frame."""
        begin = 0
        for k in range(1, len(truth) + 1):
            if k < len(truth) and truth[k] == truth[begin]:
                continue
            name = truth[begin]
            if name is not None and k - begin > FORMED:
                self.episodes += 1
                self.in_time += recognised[begin + FORMED] == name
                self.frames.update((name, recognised[j] or _NONE) for j in range(begin + FORMED, k))
            begin = k
        self.passing += _passing(truth, recognised)

    def join(self, other: "RecognisedPoses") -> None:
        """What was told of others as well."""
        self.frames.update(other.frames)
        self.episodes += other.episodes
        self.in_time += other.in_time
        self.passing += other.passing

    @property
    def right(self) -> float:
        """Percent of the frames."""
        return (
            100.0 * sum(n for (a, b), n in self.frames.items() if a == b) / max(sum(self.frames.values()), 1)
        )

    @property
    def wrong(self) -> float:
        """Percent of the frames in which another pose is told, rather than none."""
        other = sum(n for (a, b), n in self.frames.items() if b not in (a, _NONE))
        return 100.0 * other / max(sum(self.frames.values()), 1)

    def rows(self, what: str, goal: str = "goal 98") -> Iterator[Row]:
        """For the table, with the confusions of every pose that is not always right."""
        note = f"{goal}; another pose {self.wrong:.2f}; of {sum(self.frames.values())} frames"
        yield Row(f"{what}: frames right", self.right, "%", note)
        share = 100.0 * self.in_time / max(self.episodes, 1)
        yield Row(
            "  episodes told within 2 frames",
            share,
            "%",
            f"{goal}; of {self.episodes}; passing {self.passing}",
        )
        for name in POSES:
            of = {recognised: n for (true, recognised), n in self.frames.items() if true == name}
            if set(of) - {name}:
                yield Row(f"  {name}", 100.0 * of.get(name, 0) / sum(of.values()), "%", str(of))


def pose_of(
    model: HandModel, t_ns: int, place_m: Float, orientation_wxyz: Float, angles_rad: Float
) -> HandPose:
    """The pose of joints (26, 3) [m] and (26, 4) that are all seen."""
    whole = np.ones(JOINT_COUNT, np.bool_)
    return HandPose(
        hand=model.profile.name,
        t_ns=t_ns,
        position_m=place_m,
        orientation_wxyz=orientation_wxyz,
        radius_m=model.radius_m,
        valid=whole,
        tracked=whole,
        cov_m2=np.tile(_SIGMA_M**2 * np.eye(3), (JOINT_COUNT, 1, 1)),
        source=np.full(JOINT_COUNT, Source.SOLVED, np.uint8),
        angles_rad=angles_rad,
        markers_m=np.zeros((0, 3)),
        markers_raw_m=np.zeros((0, 3)),
        markers_cov_m2=np.zeros((0, 3, 3)),
        inside_volume=whole,
    )


def recognised_in(poses: Sequence[HandPose], model: HandModel) -> list[str | None]:
    """The pose that is held after each."""
    extractor, recogniser = FeatureExtractor(model), PoseRecogniser(default_gestures())
    out: list[str | None] = []
    for pose in poses:
        features = extractor.of(pose)
        if features is None:
            recogniser.lose(pose.hand, pose.t_ns)
        else:
            recogniser.push(features)
        out.append(recogniser.held)
    return out


def _passing(truth: Sequence[str | None], recognised: Sequence[str | None]) -> int:
    """Poses that are told between two held ones, and are neither of them."""
    held = [k for k, name in enumerate(truth) if name is not None]
    count = 0
    for k in range(1, len(recognised)):
        if (
            recognised[k] is None
            or recognised[k] == recognised[k - 1]
            or not held
            or not held[0] < k < held[-1]
        ):
            continue
        before = next(truth[j] for j in range(k, -1, -1) if truth[j] is not None)
        after = next(truth[j] for j in range(k, len(truth)) if truth[j] is not None)
        count += recognised[k] not in (before, after)
    return count
