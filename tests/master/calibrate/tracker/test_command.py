"""The command of a registration: from a kept motion to both files; what it refuses; and the guided motion."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from msgspec.structs import replace

from common.calibration import RigCalibration, load, save
from common.calibration.object_profile import ObjectProfile
from common.clock import Clock
from common.errors import FitError, RecordingError
from common.messages import ObjectPose, ObjectSource, TrackerPose
from common.recording.recorded_files import write_npz
from master.__main__ import main
from master.calibrate.session import Person, Session
from master.calibrate.tracker.registration import read_motion, write_motion
from master.calibrate.tracker.tracks import coverage_of, guide, object_track, tracker_track
from master.objects.tracker import TrackerLine
from master.outputs.bus import publishing_devices
from tests.master.calibrate.tracker.simulated import ZERO_NS, Motion
from tests.memory_bus import LoopbackBus

CALIB = Path(__file__).resolve().parents[4] / "calib_json"
SECOND = 1_000_000_000
Run = Callable[..., int]
SHAPES: dict[str, tuple[int, ...]] = {"t_ns": (), "position_m": (3,), "orientation_wxyz": (4,)}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A calibration tree whose cube has a tracker that is not registered."""
    folder = tmp_path / "tree"
    (folder / "objects").mkdir(parents=True)
    (folder / "rigs").mkdir()
    for kind in ("cameras", "hands"):
        (folder / kind).symlink_to(CALIB / kind)
    rig = load(CALIB / "rigs" / "desk-cube.json", RigCalibration)
    save(folder / "rigs" / "desk-cube.json", replace(rig, T_rig_tracking=None))
    cube = load(CALIB / "objects" / "cube.json", ObjectProfile)
    save(folder / "objects" / "cube.json", replace(cube, tracker="tracker"))
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    """The command, by its exit code."""

    def command(*arguments: object) -> int:
        monkeypatch.setattr(sys, "argv", ["phalanx", "calibrate", "tracker", *map(str, arguments)])
        try:
            return main()
        except SystemExit as end:
            return int(end.code or 0)

    return command


def test_from_a_kept_motion_to_files_that_the_line_takes(
    run: Run, tree: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    motion, path, report = Motion(12), tmp_path / "motion.npz", tmp_path / "report.json"
    write_motion(path, motion.objects(), motion.tracked())
    picture = tmp_path / "tracker.png"
    assert (
        run(
            "cube",
            "--motion",
            path,
            "--calibration",
            tree,
            "--out",
            tree,
            "--json",
            report,
            "--picture",
            picture,
        )
        == 0
    )
    output = capsys.readouterr().out
    assert "an object's pose by the tracker is then known to" in output
    assert picture.read_bytes().startswith(b"\x89PNG")
    rig = load(tree / "rigs" / "desk-cube.json", RigCalibration)
    cube = load(tree / "objects" / "cube.json", ObjectProfile)
    np.testing.assert_allclose(np.array(rig.T_rig_tracking), motion.X, atol=5e-3)
    np.testing.assert_allclose(np.array(cube.T_object_tracker), motion.Y, atol=5e-3)
    assert cube.stamp_offset_us == pytest.approx(1e6 * motion.late_s, abs=2000.0)
    assert cube.tags is not None
    for file in (rig.provenance["T_rig_tracking"], cube.provenance["T_object_tracker"]):
        assert (file.tool, file.data) == ("calibrate tracker", ("motion.npz",))
        assert {"position_mm", "rotation_deg", "position_sigma_mm", "rotation_sigma_deg"} <= set(
            file.residual
        )
    numbers = json.loads(report.read_text())
    assert numbers["late_ms"] == pytest.approx(1e3 * motion.late_s, abs=2.0)
    [solved] = TrackerLine(cube, rig).push(motion.tracked()[300])
    _, place = motion.truth(np.array([1e-9 * (solved.pose.t_ns - ZERO_NS)]))
    assert np.linalg.norm(solved.pose.position_m - place[0]) < 3e-3


def test_what_it_needs_is_said(
    run: Run, tree: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    motion = tmp_path / "motion.npz"
    poor = Motion(1, rotations=(1.0, 0.0, 0.0))
    write_motion(motion, poor.objects(), poor.tracked())
    before = (tree / "rigs" / "desk-cube.json").read_bytes()
    cube = load(tree / "objects" / "cube.json", ObjectProfile)
    save(tree / "objects" / "bare.json", replace(cube, name="bare", tags=None))
    save(tree / "objects" / "free.json", replace(cube, name="free", tracker=None))
    for arguments, text in (
        (("cube",), "give --live, or --motion"),
        (("cube", "--live", "--motion", motion), "give --live, or --motion"),
        (("cube", "--motion", motion, "--out", tree), "motion.npz: poses would be known to"),
        (("cube", "--motion", tmp_path / "no.npz"), "cannot read"),
        (("bare", "--motion", motion), "neither markers nor tags"),
        (("free", "--motion", motion), "no device is named"),
        (("free", "--motion", motion, "--device", "tracker"), "motion.npz: poses would be known to"),
        (("cube", "--motion", motion, "--rig", "wrist"), "this needs a rig of 'markers'"),
    ):
        rigs = tree if "wrist" not in arguments else CALIB
        assert run(*arguments, "--calibration", rigs) == 1, arguments
        assert text in capsys.readouterr().err.replace("\n", " "), arguments
    assert (tree / "rigs" / "desk-cube.json").read_bytes() == before


@pytest.mark.parametrize(
    ("key", "array", "text"),
    [
        ("tracker_t_ns", None, "'tracker_t_ns' is missing"),
        ("object_position_m", np.zeros((3, 3)), "object_position_m: shape"),
        ("tracker_orientation_wxyz", np.full((5, 4), "x"), "tracker_orientation_wxyz"),
        ("object_cov", np.zeros((2, 6, 6)), "object_cov"),
        ("tracker_position_m", np.full((5, 3), np.inf), "inf is not within"),
    ],
)
def test_a_broken_motion_is_refused(
    tmp_path: Path, key: str, array: npt.NDArray[np.generic] | None, text: str
) -> None:
    arrays: dict[str, npt.NDArray[np.generic]] = {
        f"{who}_{part}": np.zeros((5, *shape))
        for who in ("object", "tracker")
        for part, shape in SHAPES.items()
    }
    arrays.pop(key, None)
    if array is not None:
        arrays[key] = array
    path = tmp_path / "motion.npz"
    write_npz(path, arrays)
    with pytest.raises(RecordingError, match=text):
        read_motion(path, load(CALIB / "objects" / "cube.json", ObjectProfile))


def test_a_motion_comes_back_as_it_was_kept(tmp_path: Path) -> None:
    motion, path = Motion(2, seconds=2.0), tmp_path / "motion.npz"
    write_motion(path, motion.objects(), motion.tracked())
    objects, tracked = read_motion(path, load(CALIB / "objects" / "cube.json", ObjectProfile))
    for kept, was in zip([*objects, *tracked], [*motion.objects(), *motion.tracked()], strict=True):
        assert kept.t_ns == was.t_ns
        np.testing.assert_array_equal(kept.position_m, was.position_m)
    assert (objects[0].source, objects[0].tracked) == (ObjectSource.TAGS, True)


def test_coverage_reports_which_axis_and_what_else_is_missing() -> None:
    def of(motion: Motion) -> tuple[str, ...]:
        seen, device = object_track(motion.objects(), ZERO_NS), tracker_track(motion.tracked(), ZERO_NS)
        found = coverage_of(seen, device, motion.late_s)
        assert 0.0 <= found.share <= 1.0
        return found.missing

    assert of(Motion(7, strays=0.0)) == ()
    [rotation] = of(Motion(7, strays=0.0, rotations=(1.0, 1.0, 0.1)))
    assert "about its z axis as well" in rotation
    assert any("hand's width" in line for line in of(Motion(7, strays=0.0, way_m=0.02)))
    assert any("together for 8 s" in line for line in of(Motion(7, seconds=4.0)))
    assert any("faster" in line for line in of(Motion(7, strays=0.0, pace=0.02)))


class SetClock(Clock):
    """The time of the poses that came."""

    def __init__(self) -> None:
        self.t_ns = ZERO_NS

    def now_ns(self) -> int:
        return self.t_ns


def played(
    messages: list[ObjectPose | TrackerPose], clock: SetClock
) -> Callable[[float], ObjectPose | TrackerPose | None]:
    """Messages at their times, then nothing."""
    waiting = sorted(messages, key=lambda one: one.t_ns)

    def receive(timeout_s: float) -> ObjectPose | TrackerPose | None:
        if waiting and waiting[0].t_ns <= clock.t_ns + round(timeout_s * SECOND):
            clock.t_ns = max(clock.t_ns, waiting[0].t_ns)
            return waiting.pop(0)
        clock.t_ns += round(timeout_s * SECOND)
        return None

    return receive


def test_the_guided_motion_ends_by_itself_and_says_what_is_missing_until_then() -> None:
    motion, clock, output = Motion(9, seconds=40.0), SetClock(), list[str]()
    held = replace(motion.objects()[0], tracked=False, source=ObjectSource.HELD)
    receive = played([held, *motion.objects(), *motion.tracked()], clock)
    session = guide(Session(receive, Person(output.append), clock), 60.0)
    assert 15.0 < 1e-9 * (clock.t_ns - ZERO_NS) < 30.0
    assert "as well" in " ".join(output[1:4])
    assert output[-1].startswith("100 %")
    assert output[-1].endswith("done")
    assert all(one.tracked for one in session.objects)
    assert output[0].startswith("hold the object")


@pytest.mark.parametrize(
    ("rejected", "text"),
    [
        ("tracker", "no tracker data received"),
        ("object", "the cameras do not see the object"),
        ("place", "does not know where it is"),
        ("both", "no tracker data received"),
    ],
)
def test_who_is_silent_is_said(rejected: str, text: str) -> None:
    motion, clock, output = Motion(9, seconds=8.0), SetClock(), list[str]()
    nowhere = [replace(one, position_m=np.full(3, np.nan)) for one in motion.tracked()]
    messages: list[ObjectPose | TrackerPose] = [] if rejected in ("object", "both") else [*motion.objects()]
    messages += {"tracker": [], "both": [], "place": nowhere}.get(rejected, motion.tracked())
    try:
        guide(Session(played(messages, clock), Person(output.append), clock), 7.0)
    except FitError as error:
        output.append(str(error))
    assert any(text in line for line in output)


def test_what_a_tracker_says_goes_on_the_bus_as_it_came() -> None:
    class Source:
        def __init__(self) -> None:
            self.messages: list[object] = [*Motion(1, seconds=0.1).tracked()[:3], "a frame"]

        def get(self, timeout_s: float) -> object | None:
            return self.messages.pop(0) if self.messages else None

    bus = LoopbackBus()
    received = bus.subscribe("device", "tracker")
    passing = publishing_devices(Source().get, bus)
    taken = [passing(0.0) for _ in range(5)]
    assert taken[3:] == ["a frame", None]
    for was in taken[:3]:
        came = received.get(0.1)
        assert isinstance(was, TrackerPose)
        assert isinstance(came, TrackerPose)
        assert came.t_ns == was.t_ns
    assert received.get(0.0) is None
