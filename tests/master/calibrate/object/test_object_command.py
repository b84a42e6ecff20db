"""`calibrate object` from rendered frames to a file that tracks, what it refuses, and the motion with a person."""

import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from bench.played import START_NS
from common.calibration import HandProfile, RigCalibration, load, save
from common.calibration.object_profile import ObjectProfile
from common.clock import Clock
from common.geometry.transforms import fit_rigid, transform
from common.messages import HandPose
from common.sim.record import record_scene
from common.sim.scenes import scene_by_name
from master.__main__ import main
from master.calibrate.object.beads import progress_of
from master.calibrate.object.command import guide
from master.calibrate.session import Person, Session
from master.objects.line import ObjectLine
from master.replay.recorded import recorded_detections
from master.rig.setup import load_setup
from slave.commands.offline import detect_recording, save_detections
from tests.master.calibrate.object.motions import BEADS, CALIB, CAMERAS, RIG, seen

WAND = load(CALIB / "objects" / "wand.json", ObjectProfile)
TRUE_M = np.array([WAND.markers[name].position_m for name in BEADS])
START_S, SECONDS, SEED = 3.0, 1.5, 41
Run = Callable[..., int]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of the scene `object` and what the slaves found in it."""
    folder = tmp_path_factory.mktemp("object")
    hand = load(CALIB / "hands" / f"{RIG.hand}.json", HandProfile)
    scene = scene_by_name("object", RIG, CAMERAS, hand, SEED, {"wand": WAND})
    record_scene(folder / "recording", scene, SECONDS, START_S)
    (folder / "found").mkdir()
    for camera in RIG.cameras:
        path = folder / "found" / f"detections_{camera}.npz"
        save_detections(path, detect_recording(folder / "recording", camera))
    return folder


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A calibration tree without any object, whose rig has the beads."""
    folder = tmp_path / "tree"
    (folder / "rigs").mkdir(parents=True)
    for kind in ("cameras", "hands", "gestures"):
        (folder / kind).symlink_to(CALIB / kind)
    save(folder / "rigs" / "desk-wand.json", replace(RIG, objects=()))
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    """The command, by its exit code."""

    def command(*arguments: object) -> int:
        monkeypatch.setattr(sys, "argv", ["phalanx-master", "calibrate", "object", *map(str, arguments)])
        try:
            return main()
        except SystemExit as end:
            return int(end.code or 0)

    return command


def shown(recorded: Path, tree: Path) -> tuple[object, ...]:
    folders = ("--recording", recorded / "recording", "--detections", recorded / "found")
    return "wand", *folders, "--rig", "desk-wand", "--calibration", tree, "--out", tree


def test_rendered_beads_are_measured_and_the_file_tracks(run: Run, recorded: Path, tree: Path) -> None:
    beads = ("--markers", ",".join(BEADS), "--radius-mm", 9, "--add-to-rig")
    outputs = ("--json", tree / "report.json", "--picture", tree / "wand.png")
    assert run(*shown(recorded, tree), *beads, *outputs) == 0
    profile = load(tree / "objects" / "wand.json", ObjectProfile)
    places = np.array([profile.markers[name].position_m for name in BEADS])
    T_true_own = fit_rigid(TRUE_M, places)
    off_m = np.linalg.norm(transform(T_true_own, places) - TRUE_M, axis=1)
    assert off_m.max() < 3e-4
    assert [bead.radius_m for bead in profile.markers.values()] == [0.009] * 3
    assert profile.shape == ()
    assert profile.provenance["markers"].residual["wand1_rms_mm"] < 3.0
    assert load(tree / "rigs" / "desk-wand.json", RigCalibration).objects == ("wand",)
    assert (tree / "wand.png").stat().st_size > 10_000
    assert json.loads((tree / "report.json").read_text())["beads"]["wand1"]["outlier_share"] < 0.1

    setup = load_setup(tree, "desk-wand")
    line = ObjectLine(profile, setup.rig, setup.models)
    messages = sorted(
        (m for camera in RIG.cameras for m in recorded_detections(recorded / "found", camera, 9)),
        key=lambda message: message.t_ns,
    )
    poses = [solved.pose for message in messages for solved in line.push(message)]
    hand = load(CALIB / "hands" / f"{RIG.hand}.json", HandProfile)
    scene = scene_by_name("object", RIG, CAMERAS, hand, SEED, {"wand": WAND})
    off = [
        np.linalg.norm(
            pose.position_m
            - transform(scene.truth((pose.t_ns - START_NS) * 1e-9).objects["wand"] @ T_true_own, np.zeros(3))
        )
        for pose in poses
        if pose.tracked
    ]
    assert len(off) > 0.8 * len(poses)
    assert np.median(off) < 1e-3


def test_the_frame_and_the_shape_of_a_file_are_kept(run: Run, recorded: Path, tree: Path) -> None:
    like = ("--like", CALIB / "objects" / "wand.json")
    assert run(*shown(recorded, tree), *like) == 0
    profile = load(tree / "objects" / "wand.json", ObjectProfile)
    places = np.array([profile.markers[name].position_m for name in BEADS])
    assert np.linalg.norm(places - TRUE_M, axis=1).max() < 3e-4
    assert profile.shape == WAND.shape
    assert profile.markers["wand1"].radius_m == WAND.markers["wand1"].radius_m
    # Now it has a file of its own, whose frame is kept.
    assert run(*shown(recorded, tree)) == 0
    assert load(tree / "objects" / "wand.json", ObjectProfile).markers == profile.markers


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--markers", "wand1,wand2"), "three different beads"),
        (("--markers", "wand1,wand2,knob"), "'knob' is not among them"),
        (("--live",), "give --live, or --recording"),
    ],
)
def test_what_is_asked_wrongly_is_refused(
    run: Run,
    recorded: Path,
    tree: Path,
    options: tuple[str, ...],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(*shown(recorded, tree), *options) != 0
    assert message in capsys.readouterr().err
    assert not (tree / "objects").exists()


class SetClock(Clock):
    """A clock that goes on by 1/60 s each time it is read."""

    def __init__(self) -> None:
        """Begin at 0."""
        self._now_ns = 0

    def now_ns(self) -> int:
        """The time [ns]."""
        self._now_ns += 16_666_667
        return self._now_ns


def test_a_person_is_warned_that_nothing_comes() -> None:
    output: list[str] = []
    with pytest.raises(Exception, match="no pose came"):
        guide(Session(lambda wait_s: None, Person(output.append), SetClock()), RIG, BEADS, 3.0)
    assert any("phalanx run" in line for line in output[1:])


def test_progress_counts_ways_of_turning_and_names_what_is_not_seen() -> None:
    motion = seen(5, 4.5)
    found = progress_of(motion)
    assert found.enough
    assert found.line().startswith("100 %")
    assert found.line().endswith("done")
    hidden = motion.value.copy()
    hidden[-60:, 1] = np.nan
    assert "not seen by two cameras: wand2" in progress_of(dataclasses.replace(motion, value=hidden)).line()


def test_markers_of_poses_are_what_is_measured() -> None:
    """A session of poses as a master publishes them is what was placed from the detections."""
    motion = seen(5, 1.5)
    poses = iter([*map(_pose, range(len(motion.t_s)), motion.t_s, motion.value, motion.cov)])
    session = Session(lambda wait_s: next(poses, None), Person(lambda line: None), SetClock())
    np.testing.assert_array_equal(guide(session, RIG, BEADS, 4.0).value, motion.value)


def _pose(number: int, t_s: float, points: np.ndarray, cov: np.ndarray) -> HandPose:
    places, covs = np.full((9, 3), np.nan), np.full((9, 3, 3), np.nan)
    places[6:], covs[6:] = points, cov
    no, joints = np.zeros(26, np.bool_), np.full((26, 3), np.nan)
    return HandPose(
        hand=RIG.hand,
        t_ns=round(t_s * 1e9),
        position_m=joints,
        orientation_wxyz=np.full((26, 4), np.nan),
        radius_m=np.full(26, 0.01),
        valid=no,
        tracked=no,
        cov_m2=np.full((26, 3, 3), np.nan),
        source=np.zeros(26, np.uint8),
        angles_rad=np.full((5, 4), np.nan),
        markers_m=places,
        markers_raw_m=places,
        markers_cov_m2=covs,
        inside_volume=no,
    )
