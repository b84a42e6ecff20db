"""Objects, contact and gestures in the viewer: what is logged, and from when to when."""

from dataclasses import replace as with_fields
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from msgspec.structs import replace

from common.calibration.object_profile import (
    Bead,
    BoxShape,
    CylinderShape,
    ObjectProfile,
    SphereShape,
    Tag,
    Tags,
)
from common.messages import Contact, Gesture, ObjectPose, ObjectSource
from master.outputs.drawing import ObjectAppearance
from master.outputs.poses import Poses
from master.outputs.rerun import write_rrd
from master.outputs.rerun_results import arc, label_of
from tests.master.outputs.test_outputs_rerun import SETUP, STEP_NS, Viewing, moving_hand, rows_of
from tests.memory_bus import LoopbackBus
from tests.results import EYE_WXYZ, object_pose

START_NS = 10**15
ROTATED = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (0.0, 1.0, 0.0, 0.05), (0.0, 0.0, 0.0, 1.0))
BAR = ObjectProfile(
    version=1,
    name="bar",
    markers={f"b{i}": Bead(position_m=(0.01 * i, 0.02 * i * i, 0.0)) for i in range(3)},
    tags=Tags(family="apriltag_36h11", tags=(Tag(id=3, edge_m=0.03, T_object_tag=ROTATED),)),
    shape=(
        CylinderShape(radius_m=0.012, length_m=0.18),
        BoxShape(size_m=(0.04, 0.04, 0.02), T_object_part=ROTATED),
        SphereShape(radius_m=0.01),
    ),
)
WATCHED = with_fields(SETUP, objects=(BAR,))


def bar(row: int, *, tracked: bool = True, occluded: bool = False, known: bool = True) -> ObjectPose:
    lost = np.nan if not known else 0.0
    return object_pose(
        "bar",
        np.array([0.01 * row, 0.0, 0.5]) + lost,
        EYE_WXYZ + lost,
        t_ns=START_NS + row * STEP_NS,
        cov=np.eye(6) * 1e-6,
        residual_m=1e-3,
        source=int(ObjectSource.MARKERS if tracked else ObjectSource.HELD),
        tracked=tracked,
        occluded=occluded,
    )


def contact(row: int, distance_m: list[float], *, held: bool = False) -> Contact:
    distance = np.array(distance_m)
    return Contact(
        hand="test-hand",
        object="bar",
        t_ns=START_NS + row * STEP_NS,
        distance_m=distance,
        sigma_m=np.full(5, 1e-3),
        point_m=np.where(np.isnan(distance)[:, None], np.nan, [[0.01, 0.02, 0.5]]),
        touching=distance < 0.001,
        palm_distance_m=0.02,
        held=held,
    )


def gesture(row: int, kind: str, phase: str, **more: object) -> Gesture:
    name = {"pose": "open_palm", "pinch": "index", "tap": "5"}.get(kind, kind)
    typical = {"hand": "test-hand", "name": name, "began_t_ns": START_NS, "confidence": 0.9}
    return Gesture(t_ns=START_NS + row * STEP_NS, kind=kind, phase=phase, **(typical | more))  # type: ignore[arg-type]


def column(path: Path, entity: str, component: str) -> tuple[list[int], list[list[object]]]:
    """Times [ns] and values, in the order of time, of one component that not every row of the entity has."""
    found: list[tuple[int, list[object] | None]] = []
    for chunk in rr.chunk.RrdReader(path).stream():
        if chunk.entity_path != entity or chunk.is_static:
            continue
        table = chunk.to_record_batch()
        for name in (key for key in table.schema.names if key.endswith(component)):
            at = table.column("capture").cast("int64").to_pylist()
            found += zip(at, table.column(name).to_pylist(), strict=True)
    known = sorted(((t, value) for t, value in found if value is not None), key=lambda row: row[0])
    return [t for t, _ in known], [value for _, value in known]


def times(path: Path, entity: str, component: str) -> list[int]:
    """Rows of the hand's frames at which a component of an entity is logged."""
    return [round((t - START_NS) / STEP_NS) for t in column(path, entity, component)[0]]


def test_the_look_of_an_object_is_how_well_its_place_is_known() -> None:
    looks = [bar(0), bar(0, occluded=True), bar(0, tracked=False), bar(0, tracked=False, known=False)]
    assert [ObjectAppearance.of(one) for one in looks] == list(ObjectAppearance)


def test_an_object_goes_its_way_and_is_dressed_only_when_its_look_changes(tmp_path: Path) -> None:
    results = [
        bar(0),
        bar(1),
        bar(2, occluded=True),
        bar(3, tracked=False),
        bar(4, known=False, tracked=False),
        bar(5),
    ]
    write_rrd(tmp_path / "run.rrd", Poses.of(moving_hand(6)), WATCHED, results=results)
    path, root = tmp_path / "run.rrd", "/world/objects/bar"
    assert times(path, root, "translation") == [0, 1, 2, 3, 5]
    moved = column(path, root, "translation")[1]
    np.testing.assert_allclose(
        np.array(moved)[:, 0], [[0.01 * i, 0.0, 0.5] for i in (0, 1, 2, 3, 5)], atol=1e-6
    )
    for kind in ("boxes", "cylinders", "balls"):
        assert times(path, f"{root}/shape/{kind}", "colors") == [0, 2, 3, 5]
    assert times(path, f"{root}/beads", "positions") == [0, 5]  # as it appears
    assert times(path, f"{root}/tags/3", "vertex_positions") == [0, 5]
    assert times(path, root, "Clear:is_recursive") == [4]


def test_a_tag_lies_where_its_file_says_with_its_top_up(tmp_path: Path) -> None:
    write_rrd(tmp_path / "run.rrd", Poses.of(moving_hand(1)), WATCHED, results=[bar(0)])
    corners = np.array(column(tmp_path / "run.rrd", "/world/objects/bar/tags/3", "vertex_positions")[1][0])
    # Printed x along the object's x, printed y along its z, so the paper looks along -y.
    np.testing.assert_allclose(corners[0], [-0.015, -3e-4, 0.05 + 0.015], atol=1e-6)
    np.testing.assert_allclose(corners[2], [0.015, -3e-4, 0.05 - 0.015], atol=1e-6)


def test_contact_shows_what_is_near_and_plots_everything(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    results = [
        contact(0, [0.2, 0.02, np.nan, 0.04, 0.029]),
        contact(1, [0.0, -0.002, 0.01, 0.05, 0.05], held=True),
    ]
    write_rrd(path, Poses.of(moving_hand(3)), WATCHED, results=results)
    root = "/world/contact/test-hand/bar"
    assert [len(row) for row in column(path, f"{root}/points", "positions")[1]] == [2, 3]
    assert column(path, f"{root}/gaps", ":labels")[1] == [["20 mm", "29 mm"], ["0 mm", "-2 mm", "10 mm"]]
    assert column(path, "/plots/contact_mm/bar/index", "scalars")[1] == [[20.0], [-2.0]]
    assert np.isnan(np.array(column(path, "/plots/contact_mm/bar/middle", "scalars")[1][0], np.float64)).all()
    assert column(path, "/states/test-hand/bar", "state")[1] == [["held"]]


def test_the_gap_of_a_pose_that_is_not_known_is_left_out(tmp_path: Path) -> None:
    late = replace(contact(0, [0.01] * 5), t_ns=START_NS + 5)  # of no pose
    write_rrd(tmp_path / "run.rrd", Poses.of(moving_hand(1)), WATCHED, results=[late])
    root = "/world/contact/test-hand/bar"
    assert len(column(tmp_path / "run.rrd", f"{root}/points", "positions")[1][0]) == 5
    assert column(tmp_path / "run.rrd", f"{root}/gaps", "strips")[1] == [[]]


def test_gestures_stand_at_the_hand_and_go_when_they_end(tmp_path: Path) -> None:
    path, hand = tmp_path / "run.rrd", Poses.of(moving_hand(40))
    at, way = np.array([0.0, 0.0, 0.4]), np.array([0.0, 0.0, 1.0])
    results = [
        gesture(0, "pose", "begin"),
        gesture(1, "pinch", "begin", distance_m=0.004, strength=0.8, origin_m=at),
        gesture(1, "dial", "begin", angle_rad=0.0, origin_m=at, direction=way),
        gesture(2, "dial", "update", angle_rad=np.pi / 2, origin_m=at, direction=way),
        gesture(2, "point", "begin", origin_m=at, direction=way),
        gesture(3, "tap", "end"),
        gesture(4, "pose", "update"),
        gesture(6, "pinch", "end"),
        gesture(7, "pose", "end"),
        gesture(39, "point", "update", origin_m=at, direction=way),
    ]
    write_rrd(path, hand, WATCHED, results=results)
    root = "/world/gestures/test-hand"
    assert times(path, f"{root}/pose", ":labels") == [0, 4]
    assert times(path, f"{root}/pose", "Clear:is_recursive") == [7]
    assert column(path, f"{root}/pinch", ":labels")[1] == [["index 4 mm"]]
    line = np.array(column(path, f"{root}/pinch", "strips")[1][0][0])
    np.testing.assert_allclose(line, hand.position_m[1][[5, 10]], atol=1e-6)
    assert column(path, f"{root}/dial/turned", ":labels")[1][-1] == ["dial +90°"]
    assert times(path, f"{root}/ray", "vectors") == [2, 39]
    assert times(path, f"{root}/tap", ":labels") == [3]
    assert times(path, f"{root}/tap", "Clear:is_recursive") == [39]  # half a second later it goes
    assert column(path, "/states/test-hand/pose", "state")[1] == [["open_palm"]]
    assert times(path, "/states/test-hand/pose", "Clear:is_recursive") == [7]
    lines = column(path, "/events/test-hand", "text")[1]
    assert lines[0] == ["begin pose: open_palm 0.90"]
    assert ["end tap: key 5"] in lines
    assert len(lines) == 7


@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.6, 0.0, -0.8]])
def test_an_arc_is_a_rotation_about_its_axis(axis: list[float]) -> None:
    points = arc(np.array(axis), 1.0)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0)
    np.testing.assert_allclose(points @ axis, 0.0, atol=1e-12)
    assert points[0] @ points[-1] == pytest.approx(np.cos(1.0))
    assert np.cross(points[0], points[-1]) @ axis == pytest.approx(np.sin(1.0))


def test_what_is_not_known_is_said_without_a_number() -> None:
    assert label_of(gesture(0, "pinch", "begin")) == "index"
    assert label_of(gesture(0, "dial", "begin")) == "dial"


def test_the_viewer_shows_what_is_on_the_bus_and_an_object_nobody_described(tmp_path: Path) -> None:
    path, bus = tmp_path / "live.rrd", LoopbackBus()
    with Viewing(bus, path):
        for row, pose in enumerate(moving_hand(5)):
            bus.publish("hand", pose.hand, pose)
            bus.publish("object", "mug", replace(bar(row), object="mug"))
            bus.publish("contact", pose.hand, contact(row, [0.01] * 5))
            bus.publish("gesture", pose.hand, gesture(row, "pose", "update" if row else "begin"))
    rows = rows_of(path)
    assert rows["/world/objects/mug"] == 5
    assert rows["/world/objects/mug/shape"] == 1
    assert rows["/world/contact/test-hand/bar/points"] == 5
    assert rows["/states/test-hand/pose"] == 1
    bus.close()


def test_a_run_without_objects_has_no_plot_of_them(tmp_path: Path) -> None:
    write_rrd(tmp_path / "run.rrd", Poses.of(moving_hand(2)), SETUP)
    assert not [
        entity for entity in rows_of(tmp_path / "run.rrd") if "contact" in entity or "object" in entity
    ]
    assert len(rr.chunk.RrdReader(tmp_path / "run.rrd").blueprints()) == 1
