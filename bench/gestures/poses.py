"""The six study poses as the master recognises them: simulated people before rigs.

**Rigs**: a person with bones of its own, solved with bones as a calibration measures them. Rendered at 30 Hz; hands
turn by up to 35 degrees. **Wrist**: trials of the study. A frame is right if the pose held in truth is recognised, from
the third frame after it was formed on; an episode is right if it is recognised by then.
"""

import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from bench.both.scene import Observed, in_order, solve
from bench.played import START_NS, found_by, times_of
from bench.report import CALIBRATION, Row, rig_files
from bench.study.trials import Participant, Task, participant, performed
from common.arrays import Float
from common.calibration.gesture_settings import default_gestures
from common.hand.model import HandModel
from common.messages import JOINT_COUNT, HandPose, Source
from common.sim.motion import POSES, StudyPoses
from common.sim.scene import Scene, view_centre
from master.gestures.features import FeatureExtractor
from master.gestures.poses import PoseRecogniser
from master.rig.setup import RigSetup, load_setup

_NONE = "none"


@dataclass(slots=True)
class RecognisedPoses:
    """Counts of held poses: (true, recognised) -> frames; episodes, and those in time."""

    frames: Counter[tuple[str, str]] = field(default_factory=Counter[tuple[str, str]])
    episodes: int = 0
    in_time: int = 0

    def add(self, truth: Sequence[str | None], found: Sequence[str | None]) -> None:
        """Count those of one hand, frame by frame."""
        begin, formed = 0, 2  # frames in which a formed pose need not be recognised yet
        for k in range(1, len(truth) + 1):
            if k < len(truth) and truth[k] == truth[begin]:
                continue
            name = truth[begin]
            if name is not None and k - begin > formed:
                self.episodes += 1
                self.in_time += found[begin + formed] == name
                self.frames.update((name, found[j] or _NONE) for j in range(begin + formed, k))
            begin = k

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
        note = f"{goal}; of {self.episodes}"
        yield Row("  episodes recognised within 2 frames", share, "%", note)
        for name in POSES:
            of = {found: n for (true, found), n in self.frames.items() if true == name}
            if set(of) - {name}:
                yield Row(f"  {name}", 100.0 * of.get(name, 0) / sum(of.values()), "%", str(of))


def pose_of(
    model: HandModel, t_ns: int, place_m: Float, turned_wxyz: Float, angles_rad: Float, sigma_m: float = 2e-3
) -> HandPose:
    """Return the pose of joints (26, 3) [m] and (26, 4) that are all seen, known to `sigma_m`."""
    whole, nothing = np.ones(JOINT_COUNT, np.bool_), np.full((1, 3), np.nan)
    cov = np.tile(sigma_m**2 * np.eye(3), (JOINT_COUNT, 1, 1))
    source = np.full(JOINT_COUNT, Source.SOLVED, np.uint8)
    return HandPose(
        model.profile.name, t_ns, place_m, turned_wxyz, model.radius_m, whole, whole, cov, source, angles_rad,
        nothing, nothing, np.full((1, 3, 3), np.nan), whole,
    )  # fmt: skip


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


PERSON = 20
_RATE_HZ, _SECONDS = 30.0, 15.0  # one round of the six poses
_MOTION, _WRIST_PEOPLE = 100, 3


def rows() -> Iterator[Row]:
    """Measure a table of confusions for each rig, of one person, and of a wrist device."""
    for rig, one in _by_markers(PERSON).items():
        yield from one.rows(f"{rig}, one person", "no goal: fingers hide" if rig == "desk" else "goal 98")
    yield from _worn().rows(f"wrist device, {_WRIST_PEOPLE} people")


def _by_markers(number: int) -> dict[str, RecognisedPoses]:
    """One person before four cameras, and before two of them."""
    four = _setup("desk4")
    who = _person(number, four)
    motion = StudyPoses(HandModel.of(who.hand), view_centre(four.rig), _MOTION + number)
    messages = _detected(Scene.of_motion(four.rig, four.cameras, who.hand, motion, _MOTION + number))
    return {name: _found(_known(_setup(name), who), messages, motion) for name in ("desk", "desk4")}


def _detected(scene: Scene) -> list[Observed]:
    times = {camera: times_of(scene, camera, _SECONDS, _RATE_HZ) for camera in scene.rig.cameras}
    return in_order([m for camera, t in times.items() for m in found_by(scene, camera, t)])


def _found(setup: RigSetup, messages: Sequence[Observed], motion: StudyPoses) -> RecognisedPoses:
    poses, out = solve(setup, messages), RecognisedPoses()
    out.add([motion.held(1e-9 * (pose.t_ns - START_NS)) for pose in poses], recognised(poses, setup.hand))
    return out


def _setup(rig: str) -> RigSetup:
    """A shipped rig at the bench's rate."""
    setup = load_setup(CALIBRATION, rig)
    slower = {name: replace(one, frame_rate_hz=_RATE_HZ) for name, one in setup.cameras.items()}
    return RigSetup.of(setup.rig, slower, setup.hand)


def _known(setup: RigSetup, who: Participant) -> RigSetup:
    """The rig with somebody's bones as measured."""
    return RigSetup.of(setup.rig, setup.cameras, HandModel.of(who.measured))


def _person(number: int, setup: RigSetup) -> Participant:
    """Somebody with the markers of the rig's hand."""
    return participant(1, number, rig_files("wrist")[0], setup.hand.profile)


def _worn() -> RecognisedPoses:
    """Trials of the study before a wrist device."""
    rig, cameras, hand = rig_files("wrist")
    task, out = Task(rig, cameras[rig.cameras[0]], hand, 31, blocks=1), RecognisedPoses()
    for number in range(1, _WRIST_PEOPLE + 1):
        with tempfile.TemporaryDirectory() as folder:
            done = performed(task, number, Path(folder))
        poses = done.poses.messages()
        truth = [next((t.pose for t in done.held if t.from_ns <= p.t_ns <= t.to_ns), None) for p in poses]
        out.add(truth, recognised(poses, HandModel.of(done.hand)))
    return out
