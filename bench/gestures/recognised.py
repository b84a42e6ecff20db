"""Hand poses of given joints, and which study pose is recognised of them, frame by frame."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.report import Row
from common.arrays import Float
from common.calibration.gesture_settings import default_gestures
from common.hand.model import HandModel
from common.messages import JOINT_COUNT, HandPose, Source
from common.sim.motion import POSES
from master.gestures.features import FeatureExtractor
from master.gestures.poses import PoseRecogniser

FORMED = 2  # frames in which a formed pose need not be recognised yet
_NONE = "none"


@dataclass(slots=True)
class RecognisedPoses:
    """Counts of held poses: (true, recognised) -> frames; episodes, those in time, and events while none fits."""

    frames: Counter[tuple[str, str]] = field(default_factory=Counter[tuple[str, str]])
    episodes: int = 0
    in_time: int = 0
    passing: int = 0

    def add(self, truth: Sequence[str | None], found: Sequence[str | None]) -> None:
        """Count those of one hand, frame by frame."""
        begin = 0
        for k in range(1, len(truth) + 1):
            if k < len(truth) and truth[k] == truth[begin]:
                continue
            name = truth[begin]
            if name is not None and k - begin > FORMED:
                self.episodes += 1
                self.in_time += found[begin + FORMED] == name
                self.frames.update((name, found[j] or _NONE) for j in range(begin + FORMED, k))
            begin = k
        self.passing += _passing(truth, found)

    def join(self, other: "RecognisedPoses") -> None:
        """Count those of others as well."""
        self.frames.update(other.frames)
        self.episodes += other.episodes
        self.in_time += other.in_time
        self.passing += other.passing

    @property
    def right(self) -> float:
        """Percent of the frames."""
        right = sum(n for (a, b), n in self.frames.items() if a == b)
        return 100.0 * right / max(sum(self.frames.values()), 1)

    @property
    def wrong(self) -> float:
        """Percent of the frames in which another pose is recognised, rather than none."""
        other = sum(n for (a, b), n in self.frames.items() if b not in (a, _NONE))
        return 100.0 * other / max(sum(self.frames.values()), 1)

    def rows(self, what: str, goal: str = "goal 98") -> Iterator[Row]:
        """Return the rows, with the confusions of every pose that is not always right."""
        note = f"{goal}; another pose {self.wrong:.2f}; of {sum(self.frames.values())} frames"
        yield Row(f"{what}: frames right", self.right, "%", note)
        share = 100.0 * self.in_time / max(self.episodes, 1)
        note = f"{goal}; of {self.episodes}; passing {self.passing}"
        yield Row("  episodes recognised within 2 frames", share, "%", note)
        for name in POSES:
            of = {found: n for (true, found), n in self.frames.items() if true == name}
            if set(of) - {name}:
                yield Row(f"  {name}", 100.0 * of.get(name, 0) / sum(of.values()), "%", str(of))


def pose_of(
    model: HandModel,
    t_ns: int,
    place_m: Float,
    turned_wxyz: Float,
    angles_rad: Float,
    sigma_m: float = 2e-3,
) -> HandPose:
    """Return the pose of joints (26, 3) [m] and (26, 4) that are all seen, known to `sigma_m`."""
    whole, nothing = np.ones(JOINT_COUNT, np.bool_), np.full((1, 3), np.nan)
    return HandPose(
        hand=model.profile.name,
        t_ns=t_ns,
        position_m=place_m,
        orientation_wxyz=turned_wxyz,
        radius_m=model.radius_m,
        valid=whole,
        tracked=whole,
        cov_m2=np.tile(sigma_m**2 * np.eye(3), (JOINT_COUNT, 1, 1)),
        source=np.full(JOINT_COUNT, Source.SOLVED, np.uint8),
        angles_rad=angles_rad,
        markers_m=nothing,
        markers_raw_m=nothing,
        markers_cov_m2=np.full((1, 3, 3), np.nan),
        inside_volume=whole,
    )


def recognised(poses: Sequence[HandPose], model: HandModel) -> list[str | None]:
    """Return the study pose that is held after each hand pose."""
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


def _passing(truth: Sequence[str | None], found: Sequence[str | None]) -> int:
    """Poses that are recognised between two held ones, and are neither of them."""
    held = [k for k, name in enumerate(truth) if name is not None]
    count = 0
    for k in range(1, len(found)):
        if found[k] is None or found[k] == found[k - 1] or not held or not held[0] < k < held[-1]:
            continue
        before = next(truth[j] for j in range(k, -1, -1) if truth[j] is not None)
        after = next(truth[j] for j in range(k, len(truth)) if truth[j] is not None)
        count += found[k] not in (before, after)
    return count
