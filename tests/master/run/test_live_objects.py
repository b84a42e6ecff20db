"""A live master of a rig with an object: tags, tracker, markers come by datagram, poses and contact go to the bus."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from shutil import copytree

import msgspec
import pytest

from common.bus.bus import Subscription
from common.calibration import RigCalibration, load, save
from common.calibration.object_profile import ObjectProfile
from common.clock import SystemClock
from common.messages import (
    Contact,
    Gesture,
    HandPose,
    ObjectPose,
    ObjectSource,
    TrackerPose,
)
from master.monitor.report import cameras_line
from master.outputs.result_files import Contacts, ObjectPoses, contact_path, object_path
from master.rig.setup import RigFiles
from tests.master.run.live_master import LiveMaster
from tests.network_helpers import until
from tests.object_run import (
    START_NS,
    T_OBJECT_TRACKER,
    T_RIG_TRACKING,
    ObjectRun,
    matrix,
    object_run,
    tracker_pose,
)

FRAMES = 30
STREAMS = ("hand", "object", "contact", "gesture")


@pytest.fixture
def tree(root: Path, tmp_path: Path) -> Path:
    """The shipped files, with a tracker on the cube."""
    copytree(root / "calib_json", tmp_path / "calib")
    rig_path, cube_path = tmp_path / "calib/rigs/desk-cube.json", tmp_path / "calib/objects/cube.json"
    rig, cube = load(rig_path, RigCalibration), load(cube_path, ObjectProfile)
    save(rig_path, msgspec.structs.replace(rig, T_rig_tracking=matrix(T_RIG_TRACKING)))
    cube = msgspec.structs.replace(cube, tracker="puck", T_object_tracker=matrix(T_OBJECT_TRACKER))
    save(cube_path, cube)
    return tmp_path / "calib"


@pytest.fixture
def master(tree: Path, tmp_path: Path) -> Iterator[LiveMaster]:
    with ExitStack() as stack:
        yield LiveMaster(stack, RigFiles(tree, ("desk-cube",)), ("left", "right", "puck"), tmp_path)


def play(shown: ObjectRun, master: LiveMaster) -> None:
    """Send all of the run, at its pace and as if it were now."""
    shift_ns = SystemClock().now_ns() - shown.messages[0].t_ns + 50_000_000
    for one in shown.messages:
        changes = {"t_ns": one.t_ns + shift_ns}
        if not isinstance(one, TrackerPose):
            changes["ready_t_ns"] = one.ready_t_ns + shift_ns
        due_ns = changes.get("ready_t_ns", changes["t_ns"]) - SystemClock().now_ns()
        master.stop.wait(max(due_ns * 1e-9, 0.0))
        master.send(one, **changes)


def test_objects_and_contact_come_on_the_bus_and_into_files(
    master: LiveMaster, root: Path, tmp_path: Path
) -> None:
    inboxes = {name: master.bus.subscribe(name, depth=4 * FRAMES) for name in STREAMS}
    master.ask("report")  # who is answered is subscribed
    shown = object_run(root, "desk-cube", FRAMES, "grasp", 60, master.setups[0])
    play(shown, master)
    assert until(lambda: master.counts().get("left.tags_received", 0) == FRAMES // 3)
    assert until(lambda: any(line.startswith("cameras: left, right; tracker: puck") for line in master.lines))
    master.stop.wait(0.6)  # longer than cameras are preferred
    for k in range(5):
        master.send(tracker_pose("puck", shown.pose("cube", START_NS), k, SystemClock().now_ns()))
        master.stop.wait(0.01)
    assert until(lambda: master.counts().get("puck.received", 0) == 5)
    counts = master.counts()
    for event in ("left.lost", "left.skipped", "right.lost", "right.skipped", "refused.impostor"):
        assert event not in counts, "what never happened is not told"
    assert counts["object.cube.tracked"] >= FRAMES // 2
    master.end()
    poses = [one for one in drained(inboxes["object"]) if isinstance(one, ObjectPose)]
    assert {ObjectSource(one.source) for one in poses if one.tracked} == {
        ObjectSource.TAGS,
        ObjectSource.TRACKER,
    }
    seen = [one for one in poses if one.source == ObjectSource.TAGS]
    assert seen
    assert all(one.latency_ns > 0 for one in seen)
    # A tracker's pose is handed over when it holds, on a clock that is known to a fraction of a millisecond.
    assert all(one.latency_ns > -2_000_000 for one in poses)
    hands = [one for one in drained(inboxes["hand"]) if isinstance(one, HandPose)]
    contacts = [one for one in drained(inboxes["contact"]) if isinstance(one, Contact)]
    assert len(hands) == len(contacts) > 0
    dropped_epochs = counts.get("instants_shed", 0)  # what a busy machine leaves out is counted
    assert len(hands) + dropped_epochs > FRAMES // 2
    assert {(one.hand, one.object) for one in contacts} == {("default-right", "cube")}
    assert all(isinstance(one, Gesture) for one in drained(inboxes["gesture"]))
    assert len(ObjectPoses.load(object_path(tmp_path, "cube"))) == len(poses)
    assert len(Contacts.load(contact_path(tmp_path, "default-right", "cube"))) == len(contacts)
    report = msgspec.json.decode((tmp_path / "live.json").read_bytes())
    assert report["counts"]["objects"] == sum(one.tracked for one in poses)
    assert report["object_latency_p50_ms"] > 0.0


def drained(inbox: Subscription) -> list[object]:
    found: list[object] = []
    while (message := inbox.get(0.1)) is not None:
        found.append(message)
    return found


def test_who_is_there_is_said_by_kind() -> None:
    output = cameras_line(("left",), frozenset({"left", "palm", "puck"}), ("puck", "other"))
    assert output == "cameras: left; IMU: palm; tracker: puck"
