"""Plain tables and the exports of optical systems, as text, read back; what is wrong in them is named."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from common.errors import RecordingError
from common.hand.model import JOINTS
from master.mocap.csv_file import read_csv
from master.mocap.read import Reading, read_motion
from tests.master.mocap.moved import hand_at, ns, write_table
from tests.master.recording.export.made import poses_of
from tests.master.recording.export.test_export_tables import exported, run_of

MOTIVE = """Format Version,1.23,Take Name,grab,Capture Frame Rate,100.000000,Rotation Type,XYZ,Length Units,Millimeters
,
,Type,Bone,Bone,Bone,Bone,Bone,Bone,Bone,Marker,Marker,Marker
,Name,S:RHand,S:RHand,S:RHand,S:RHand,S:RHand,S:RHand,S:RHand,S:RIndex3,S:RIndex3,S:RIndex3
,ID,1,1,1,1,1,1,1,2,2,2
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,X,Y,Z
0,0.000000,0.1,0.2,0.3,0.9,10,20,30,1,2,3
1,0.010000,0.1,0.2,0.3,0.9,11,21,31,,,
"""
VICON = """Trajectories
200
,,Me:RWrist,,,Me:index_tip,,
Frame,Sub Frame,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm
101,0,10,20,30,1,2,3
102,0,11,21,31,,,

Model Outputs
200
"""
QUALISYS = """NO_OF_FRAMES\t2
FREQUENCY\t100
MARKER_NAMES\twrist\tindex_tip
TRAJECTORY_TYPES\tMeasured\tMixed
Frame\tTime\twrist X\twrist Y\twrist Z\tindex_tip X\tindex_tip Y\tindex_tip Z
1\t0.00000\t10\t20\t30\t1\t2\t3
2\t0.01000\t11\t21\t31\t0\t0\t0
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("name", "text", "first_s", "step_s"),
    [("a.csv", MOTIVE, 0.0, 0.01), ("b.csv", VICON, 101 / 200, 0.005), ("c.tsv", QUALISYS, 0.0, 0.01)],
)
def test_exports_of_optical_systems(
    tmp_path: Path, name: str, text: str, first_s: float, step_s: float
) -> None:
    table = read_csv(written(tmp_path / name, text), None)
    assert len(table.names) == 2
    np.testing.assert_allclose(table.t_s, [first_s, first_s + step_s])
    np.testing.assert_allclose(table.position[:, 0], [[10.0, 20.0, 30.0], [11.0, 21.0, 31.0]])
    np.testing.assert_allclose(table.position[:, 1], [[1.0, 2.0, 3.0], [np.nan] * 3])
    assert table.unit == "mm"


@pytest.mark.parametrize(("name", "text"), [("a.csv", MOTIVE), ("b.csv", VICON), ("c.tsv", QUALISYS)])
def test_an_export_that_is_cut_is_refused_or_read_up_to_there(tmp_path: Path, name: str, text: str) -> None:
    path, frames = tmp_path / name, set[int]()
    for size in range(0, len(text), 7):
        path.write_text(text[:size])
        with suppress(RecordingError):
            frames.add(len(read_csv(path, None).t_s))
    assert max(frames) <= 2


def test_a_plain_table_in_any_order_is_the_motion(tmp_path: Path) -> None:
    t_s = np.arange(20) / 50.0 + 3.0
    exact = hand_at(t_s).position_m
    exact[4, 6] = np.nan
    found = read_motion(write_table(tmp_path / "plain.csv", t_s, JOINTS, exact))
    assert found.names == JOINTS
    np.testing.assert_array_equal(found.t_ns, ns(t_s))
    np.testing.assert_allclose(found.position_m, exact, atol=1e-9)


def test_our_own_tables_are_read(tmp_path: Path) -> None:
    from master.recording.export.run import Wanted

    poses = poses_of(3, 5)
    exported(run_of(tmp_path, poses), Wanted("csv"))
    found = read_motion(tmp_path / "poses.csv")
    assert found.names == JOINTS
    np.testing.assert_array_equal(found.t_ns, [pose.t_ns for pose in poses])
    np.testing.assert_allclose(found.position_m, [pose.position_m for pose in poses], atol=1e-6)


@pytest.mark.parametrize(
    ("header", "seconds"),
    [("t_ns", 1e-9), ("t_ms", 1e-3), ("time", 1.0), ("Time (Seconds)", 1.0), ("timestamp [us]", 1e-6)],
)
def test_times_have_the_unit_of_their_name(tmp_path: Path, header: str, seconds: float) -> None:
    step = 0.01 / seconds
    rows = "".join(f"{step * k};{k};2;3\n" for k in range(3))
    table = read_csv(written(tmp_path / "t.csv", f"{header};wristX;wristY;wristZ\n{rows}"), None)
    np.testing.assert_allclose(table.t_s, [0.0, 0.01, 0.02])
    assert table.unit is None


HEAD = "time,wrist_x_m,wrist_y_m,wrist_z_m\n"


@pytest.mark.parametrize(
    ("text", "output"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "no columns NAME_x"),
        ("wrist_x_m,wrist_y_m,wrist_z_m\n1,2,3\n", "--rate"),
        ("time,wrist_x_m,wrist_y_mm,wrist_z_m\n0,1,2,3\n", "in m and in mm: use one unit"),
        ("time,wrist_x,wrist_x,wrist_y,wrist_z\n0,1,1,2,3\n", "two columns of wrist x"),
        (HEAD + "0,1,2,3\n0.01,here,2,3\n", "line 3, column 2: 'here' is no number"),
        (HEAD + "0,1,2,3\n0,1,2,3\n", "it must rise"),
        (HEAD + "0,1,2,3\n,1,2,3\n", "time of frame 2 is nan"),
        (HEAD + "0,1,2,3\n16,1,2,3\n33,1,2,3\n", "are times not in seconds"),
        (HEAD, "has no frame"),
        ("time,nose_x,nose_y,nose_z\n0,1,2,3\n", "no name in it is that of a joint of a hand; it has nose"),
        ("time,wrist_x,wrist_y,wrist_z\n0,1,2,3\n", "give --unit"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_table_is_said(tmp_path: Path, text: str, output: str) -> None:
    with pytest.raises(RecordingError, match=r"broken\.csv") as caught:
        read_motion(written(tmp_path / "broken.csv", text))
    assert output in str(caught.value)


@pytest.mark.parametrize(
    ("scale", "unit"), [(1.0, "m"), (10.0, "dm"), (100.0, "cm"), (1e3, "mm"), (1 / 0.0254, "in")]
)
def test_the_size_of_a_hand_determines_the_unit(tmp_path: Path, scale: float, unit: str) -> None:
    t_s = np.arange(4) / 50.0
    exact = hand_at(t_s).position_m
    path = write_table(tmp_path / "plain.csv", t_s, JOINTS, 1e-3 * scale * exact)
    path.write_text(path.read_text().replace("_mm", ""))
    found = read_motion(path)
    np.testing.assert_allclose(found.position_m, exact, atol=1e-6)
    assert f"with {unit} there are" in found.remarks[0]
    assert len(read_motion(path, Reading(unit="mm")).remarks) == 0
