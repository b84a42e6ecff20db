"""The objects and gestures of rigs: files that are read, checked and followed while a master runs."""

from dataclasses import replace as with_fields
from pathlib import Path
from shutil import copytree

import msgspec
import numpy as np
import pytest

from common.calibration import RigCalibration, load, save
from common.calibration.gesture_settings import default_gestures
from common.calibration.object_profile import Bead, ObjectProfile
from common.errors import CalibrationError
from master.rig.merge import in_world, load_gestures, merged_rig, objects_of, refuse_shared_objects
from master.rig.setup import RigFiles, load_setup, load_setups, setups_with_hands
from master.run.app import StageTimes
from master.run.dispatcher import Dispatcher
from master.run.tuning import LivePipeline, RigTuning, refuse_restart
from tests.loopback.test_kinds_link import sample
from tests.master.rig.test_rig_merge import ASIDE, rows


@pytest.fixture
def tree(root: Path, tmp_path: Path) -> Path:
    copytree(root / "calib_json", tmp_path / "calib")
    return tmp_path / "calib"


def changed(tree: Path, path: str, **changes: object) -> None:
    content = msgspec.json.decode((tree / path).read_bytes())
    (tree / path).write_bytes(msgspec.json.encode(content | changes))


def test_a_rig_has_its_objects_and_its_gestures(tree: Path) -> None:
    (wand,) = load_setups(tree, ("desk-wand",))
    assert [one.name for one in wand.objects] == ["wand"]
    assert wand.gestures == default_gestures()
    assert load_setup(tree, "desk-wand").objects == wand.objects
    (bare,) = load_setups(tree, ("desk",))
    assert bare.objects == bare.trackers == ()
    mine = msgspec.structs.replace(default_gestures(), name="mine", poses={})
    save(tree / "gestures/mine.json", mine)
    changed(tree, "rigs/wrist.json", gestures="mine")
    (both,) = load_setups(tree, ("desk-wand", "wrist"))
    assert (both.gestures, [one.name for one in both.objects]) == (mine, ["wand"])
    changed(tree, "rigs/desk-wand.json", gestures="default")
    with pytest.raises(CalibrationError, match="'desk-wand' and 'wrist': gestures: differ"):
        load_setups(tree, ("desk-wand", "wrist"))


@pytest.mark.parametrize(
    ("path", "changes", "expected"),
    [
        ("rigs/desk-wand.json", {"objects": ["pen"]}, r"objects/pen\.json"),
        ("rigs/desk-wand.json", {"free_markers": ["wand1", "wand2"]}, "'wand3'"),
        ("rigs/desk-wand.json", {"gestures": "none"}, r"gestures/none\.json"),
        ("objects/wand.json", {"name": "stick"}, "the file of 'wand' calls it 'stick'"),
        ("objects/wand.json", {"markers": {}}, r"wand\.json: it needs markers, tags or a tracker"),
        ("gestures/default.json", {"poses": 3}, r"default\.json"),
    ],
)
def test_files_that_do_not_fit_are_refused_with_the_key(
    tree: Path, path: str, changes: dict[str, object], expected: str
) -> None:
    changed(tree, path, **changes)
    with pytest.raises(CalibrationError, match=expected):
        load_setups(tree, ("desk-wand",))


def test_a_bead_that_is_no_free_marker_is_named(tree: Path) -> None:
    rig = load(tree / "rigs/desk-wand.json", RigCalibration)
    wand = load(tree / "objects/wand.json", ObjectProfile)
    with pytest.raises(CalibrationError, match="free_markers: 'wand1' is missing, a marker of object 'wand'"):
        objects_of(msgspec.structs.replace(rig, free_markers=()), {"wand": wand})
    with pytest.raises(CalibrationError, match="no object file for 'wand'"):
        objects_of(rig, {})


def test_two_objects_share_nothing_that_they_are_seen_by(tree: Path) -> None:
    rig = msgspec.structs.replace(
        load(tree / "rigs/desk-wand.json", RigCalibration), objects=("wand", "twin")
    )
    wand = load(tree / "objects/wand.json", ObjectProfile)
    cube = load(tree / "objects/cube.json", ObjectProfile)
    puck = msgspec.structs.replace(cube, name="wand", tags=None, tracker="puck")
    for one, expected in (
        (wand, "'wand' and 'twin' both have marker 'wand1'"),
        (msgspec.structs.replace(cube, name="wand"), "both have tag 0 of"),
        (puck, "both have tracker 'puck'"),
    ):
        both = {"wand": one, "twin": msgspec.structs.replace(one, name="twin")}
        with pytest.raises(CalibrationError, match=expected):
            objects_of(rig, both)


def test_rigs_of_two_hands_do_not_both_have_an_object(tree: Path) -> None:
    (wand,) = load_setups(tree, ("desk-wand",))
    with pytest.raises(CalibrationError, match="'a' and 'b' both have object 'wand'"):
        refuse_shared_objects([("a", wand.objects), ("b", wand.objects)])
    refuse_shared_objects([("a", wand.objects), ("b", ())])


def test_merged_rigs_have_the_objects_of_all_in_the_shared_frame(tree: Path) -> None:
    rig = load(tree / "rigs/desk-cube.json", RigCalibration)
    neighbour = msgspec.structs.replace(
        rig,
        name="side",
        cameras=("left2", "right2"),
        objects=("cube", "box"),
        T_rig_camera={"left2": rows(np.eye(4)), "right2": ((1.0, 0.0, 0.0, 0.075), *rows(np.eye(4))[1:])},
        T_world_rig=rows(ASIDE),
        T_rig_tracking=rows(np.eye(4)),
    )
    both = merged_rig([rig, neighbour])
    assert both.objects == ("cube", "box")
    np.testing.assert_allclose(np.array(both.T_rig_tracking), ASIDE, atol=1e-12)
    assert in_world(neighbour).T_world_rig is None


def test_objects_of_a_recording_go_before_those_of_the_tree(tree: Path) -> None:
    rig = load(tree / "rigs/desk-wand.json", RigCalibration)
    (setup,) = load_setups(tree, ("desk-wand",))
    taken = msgspec.structs.replace(setup.objects[0], shape=())
    (found,) = setups_with_hands([rig], setup.cameras, tree, None, {"wand": taken})
    assert found.objects == (taken,)
    hand = tree / "hands/default-right.json"
    (found,) = setups_with_hands([rig], setup.cameras, None, hand, {"wand": taken})
    assert found.gestures == default_gestures()
    with pytest.raises(CalibrationError, match=r"'wand': give --calibration DIR with objects/wand\.json"):
        setups_with_hands([rig], setup.cameras, None, hand)
    with pytest.raises(CalibrationError, match=r"give --calibration DIR with gestures/mine\.json"):
        load_gestures(None, "mine")


class Running:
    """A master's files and world, and what it said."""

    def __init__(self, tree: Path) -> None:
        self.files = RigFiles(tree, ("desk-wand",))
        setups = self.files.load()
        self.lines = [LivePipeline(setup, StageTimes()) for setup in setups]
        self.dispatcher = Dispatcher(setups, self.lines, StageTimes())
        self.output: list[str] = []
        self.tuning = RigTuning(self.files, setups, self.lines, self.output.append, self.dispatcher)
        self.tuning.look()


def test_files_of_objects_and_gestures_are_followed_and_the_hand_is_left_alone(tree: Path) -> None:
    running = Running(tree)
    followed = {path.relative_to(tree).as_posix() for path in running.files.paths(running.tuning.setups)}
    assert {"objects/wand.json", "gestures/default.json"} <= followed
    wand = load(tree / "objects/wand.json", ObjectProfile)
    larger = {name: Bead(position_m=one.position_m, radius_m=0.011) for name, one in wand.markers.items()}
    save(tree / "objects/wand.json", msgspec.structs.replace(wand, markers=larger))
    running.tuning.look()
    assert running.output == ["changed files are in use"]
    assert not running.lines[0]._next, "no hand was built anew"
    assert len(running.dispatcher._next) == 1
    list(running.dispatcher.push(sample("nobody", 1, 1)))
    assert running.tuning.setups[0].objects[0].markers == larger
    save(tree / "gestures/default.json", msgspec.structs.replace(default_gestures(), poses={}))
    running.tuning.look()
    assert len(running.dispatcher._next) == 1
    (tree / "objects/wand.json").write_text("{")
    running.tuning.look()
    assert running.output[-1].startswith("changed files are not used")
    assert running.tuning.counts() == {"reload.applied": 2, "reload.refused": 1}


def test_what_slaves_were_started_with_needs_a_restart(tree: Path) -> None:
    (old,) = load_setups(tree, ("desk-wand",))
    tracked = with_fields(old, objects=(msgspec.structs.replace(old.objects[0], tracker="puck"),))
    with pytest.raises(
        CalibrationError, match=r"tracker of its objects: none cannot become puck .*: restart the"
    ):
        refuse_restart(old, tracked)
    with pytest.raises(
        CalibrationError, match="objects: wand cannot become none while it runs: give all processes"
    ):
        refuse_restart(old, with_fields(old, objects=()))
