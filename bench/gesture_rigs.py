"""The six study poses of simulated people before each rig that a user may have, through rendered frames.

Everybody has bones of his own and is solved with bones as a calibration measures them; a wrist device sits a little
otherwise than its file says, by what `calibrate wrist extrinsics` leaves (docs/calibrate.md). Hands turn by up to 35
degrees and hide their fingers. One rendering serves two rigs: two cameras are half of four, and markers are half of
what is fused. Frames come at 30 Hz, so that two of them are 67 ms.

    python -m bench.gesture_rigs --people 20 21 22
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
from msgspec.structs import replace

from bench.fusion_scene import Both, Observed, in_order, orientations
from bench.fusion_watched import cycles_of
from bench.played import START_NS, message_of, times_of
from bench.recognised_poses import RecognisedPoses, recognised_in
from bench.row import Row
from common.calibration import CameraCalibration, RigCalibration, load
from common.hand.model import HandModel
from common.messages import HandPose, ImuSample
from common.sim.poses import StudyPoses
from common.sim.render import Renderer
from common.sim.scene import Scene, view_centre
from common.sim.together import FlexedWrist
from common.sim.wrist.scene import WristScene
from master.rig.files import load_setup
from master.rig.pipeline import pipeline_of
from master.rig.setup import RigSetup
from master.run.stages import StageTimes
from master.study.participant import Participant, participant, rotated
from slave.markers.light_adaptive import detector_for
from slave.markers.workers import Inline

CALIBRATION = Path(__file__).parent.parent / "calib_json"
RATE_HZ, SECONDS = 30.0, 15.0  # one round of the six poses
PEOPLE = (20,)  # a minute or two each; more by the command line
_SEED, _MOTION = 1, 100
_ROTATION_RAD, _SHIFT_M = np.radians(0.75), 0.65e-3  # per axis, what a calibrated mounting is off by


def rows(people: Sequence[int] = PEOPLE) -> Iterator[Row]:
    """A table of confusions for each rig, of these people together."""
    recognised: dict[str, RecognisedPoses] = {}
    for number in people:
        for rig, one in (*by_markers(number).items(), *by_both(number).items()):
            recognised.setdefault(rig, RecognisedPoses()).join(one)
    goals = {"desk": "no goal: fingers hide"}
    for rig, one in recognised.items():
        yield from one.rows(f"{rig}, people: {len(people)}", goals.get(rig, "goal 98"))


def by_markers(number: int, seconds: float = SECONDS) -> dict[str, RecognisedPoses]:
    """One person before four cameras, and what two of them tell."""
    four = _setup("desk4")
    who = _person(number, four)
    model = HandModel.of(who.hand)
    motion = StudyPoses(model, view_centre(four.rig), _MOTION + number)
    scene = Scene.of_motion(four.rig, four.cameras, who.hand, motion, _MOTION + number)
    messages = _monitored(scene, seconds)
    return {name: _recognised(_known(_setup(name), who), messages, motion) for name in ("desk", "desk4")}


def by_both(number: int, seconds: float = SECONDS) -> dict[str, RecognisedPoses]:
    """One person before two cameras with three markers on the back, and what a wrist device adds."""
    marked, wrist_setup = _setup("desk-back3"), load_setup(CALIBRATION, "wrist-back3")
    who = _person(number, marked)
    model, seed = HandModel.of(who.hand), _MOTION + number
    motion = FlexedWrist(posed := StudyPoses(model, view_centre(marked.rig), seed), seed)
    scene = Scene.of_motion(marked.rig, marked.cameras, who.hand, motion, seed)
    rng = np.random.default_rng([number, 77])
    true = replace(wrist_setup.rig, T_camera_palm=who.rig.T_camera_palm)
    file = rotated(true, rng.normal(0.0, _ROTATION_RAD, 3), rng.normal(0.0, _SHIFT_M, 3))
    device = WristScene(true, wrist_setup.cameras, model, motion, seed=seed, reflectance=who.reflectance)
    alone = _known(marked, who)
    wrist = RigSetup.of(file, wrist_setup.cameras, alone.hand)
    both = Both("both-poses", seed, scene, device, alone, wrist)
    markers = _monitored(scene, seconds)
    everything = in_order([*markers, *orientations(both, seconds), *cycles_of(both, seconds)[0]])
    return {
        "desk-back3": _recognised(alone, markers, posed),
        "desk-back3 + wrist-back3": _recognised(both.fused, everything, posed),
    }


def _monitored(scene: Scene, seconds: float) -> list[Observed]:
    """What the cameras' slaves send of the scene."""
    out: list[Observed] = []
    for camera in scene.rig.cameras:
        renderer = Renderer(scene, camera)
        detector = detector_for(
            scene.cameras[camera], scene.rig.markers, Inline(), free=scene.rig.free_markers
        )
        for seq, t in enumerate(times_of(scene, camera, seconds, RATE_HZ).tolist()):
            t_ns = START_NS + round(t * 1e9)
            out.append(message_of(camera, seq, t_ns, detector.push(renderer.render(t), t_ns)))
    return in_order(out)


def _recognised(setup: RigSetup, messages: Sequence[Observed], motion: StudyPoses) -> RecognisedPoses:
    """What is told of a rig's share of the messages."""
    pipeline = pipeline_of(setup, StageTimes())
    poses: list[HandPose] = []
    for message in messages:
        if isinstance(message, ImuSample):
            pipeline.push_orientation(message.t_ns, message.orientation_wxyz, message.heading_sigma_rad)
        elif message.camera in setup.cameras:
            poses += [one.pose for one in pipeline.push(message)]
    out = RecognisedPoses()
    out.add([motion.held(1e-9 * (pose.t_ns - START_NS)) for pose in poses], recognised_in(poses, setup.hand))
    return out


def _setup(rig: str) -> RigSetup:
    """A shipped rig at the bench's rate."""
    setup = load_setup(CALIBRATION, rig)
    return RigSetup.of(setup.rig, _slower(setup.cameras), setup.hand)


def _slower(cameras: Mapping[str, CameraCalibration]) -> dict[str, CameraCalibration]:
    return {name: replace(one, frame_rate_hz=RATE_HZ) for name, one in cameras.items()}


def _known(setup: RigSetup, who: Participant) -> RigSetup:
    """The rig with somebody's bones as measured."""
    return RigSetup.of(setup.rig, setup.cameras, HandModel.of(who.measured))


def _person(number: int, setup: RigSetup) -> Participant:
    """Somebody with the markers of the rig's hand."""
    wrist = load(CALIBRATION / "rigs/wrist.json", RigCalibration)
    return participant(_SEED, number, wrist, setup.hand.profile)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the rows of some people; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.gesture_rigs", description=__doc__)
    parser.add_argument("--people", nargs="+", type=int, default=list(PEOPLE), metavar="N")
    options = parser.parse_args(arguments)
    for row in rows(cast(list[int], options.people)):
        print(f"{row.name:52s} {row.value:8.4g} {row.unit:4s} {row.note}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
