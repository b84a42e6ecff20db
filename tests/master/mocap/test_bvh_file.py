"""BVH: our own files and a small one of another program, read as another reader reads them."""

from pathlib import Path

import numpy as np
import pytest

from common.arrays import Float
from common.errors import RecordingError
from common.hand.model import JOINTS
from master.mocap.bvh_file import read_bvh
from master.mocap.read import Reading, read_motion
from master.recording.export.bvh import Axes
from tests.master.recording.export.made import poses_of, positions
from tests.master.recording.export.test_export_bvh import reader, written

# Written for this test: two joints beside their parents in other orders of channels, one with a place of its own.
SMALL = """HIERARCHY
ROOT RightHand
{
  OFFSET 1.0 2.0 3.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT RightHandIndex1
  {
    OFFSET -9.0 0.5 2.0
    CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT RightHandIndex2
    {
      OFFSET -4.0 0.0 0.0
      CHANNELS 6 Xposition Yposition Zposition Xrotation Yrotation Zrotation
      JOINT RightHandIndex3
      {
        OFFSET -2.5 0.0 0.0
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {
          OFFSET -2.0 0.0 0.0
        }
      }
    }
  }
  JOINT Nothing
  {
    OFFSET 1.0 0.0 0.0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0.0 0.0 0.0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0083333
1 2 3 10 20 30 5 -15 25 -4.1 0.1 0.2 11 12 13 -30 2 3 0 0 0
1.5 2.5 3.5 -40 50 160 15 -65 2 -4.2 0.2 0.3 1 62 3 -80 12 -13 0 0 0
"""


def other_reader(path: Path) -> dict[str, Float]:
    """Places (T, 3) of all joints as bvhio reads them."""
    bvhio = reader()
    bvh = bvhio.readAsBvh(str(path))
    root = bvhio.convertBvhToHierarchy(bvh.Root).loadRestPose(recursive=True)
    frames: list[dict[str, list[float]]] = []
    for frame in range(bvh.FrameCount):
        root.loadPose(frame)
        frames.append({joint.Name: list(joint.PositionWorld) for joint, _, _ in root.layout()})
    return {name: np.array([one[name] for one in frames]) for name in frames[0]}


def test_places_are_those_of_another_reader(tmp_path: Path) -> None:
    path = tmp_path / "small.bvh"
    path.write_text(SMALL)
    table, other = read_bvh(path), other_reader(path)
    np.testing.assert_allclose(table.t_s, [0.0, 0.0083333])
    for name in ("RightHand", "RightHandIndex1", "RightHandIndex2", "RightHandIndex3", "Nothing"):
        np.testing.assert_allclose(table.position[:, table.names.index(name)], other[name], atol=1e-4)
    assert "Nothing_end" not in table.names
    last = table.position[:, table.names.index("RightHandIndex3_end")]
    length = np.linalg.norm(last - table.position[:, table.names.index("RightHandIndex3")], axis=1)
    np.testing.assert_allclose(length, 2.0)


def test_our_own_file_gives_its_poses_back(tmp_path: Path) -> None:
    poses = poses_of(7, 4)
    written(tmp_path / "hand.bvh", poses, axes=Axes("cm", "rig"))
    found = read_motion(tmp_path / "hand.bvh")
    assert found.names == JOINTS
    np.testing.assert_allclose(found.position_m, positions(poses), atol=1e-4)
    assert "with cm there are" in found.remarks[0]


def test_joints_of_a_program_are_ours(tmp_path: Path) -> None:
    path = tmp_path / "small.bvh"
    path.write_text(SMALL)
    found = read_motion(path, Reading(unit="cm"))
    assert found.side == "right"
    assert found.names == (
        "wrist",
        "index-finger-phalanx-proximal",
        "index-finger-phalanx-intermediate",
        "index-finger-phalanx-distal",
        "index-finger-tip",
    )
    assert any("Nothing" in remark for remark in found.remarks)


@pytest.mark.parametrize(
    ("old", "new", "output"),
    [
        ("HIERARCHY", "HIERARCHIE", "it has HIERARCHY and MOTION"),
        ("Frames: 2", "Frames: 3", "42 numbers, 3 frames of 21 channels have 63"),
        ("Xrotation Yrotation\n    End", "Xturn Yrotation\n    End", "broken BVH"),
        ("0.0083333", "0", "Frame Time: 0 s"),
        ("OFFSET -9.0 0.5 2.0", "OFFSET -9.0 far 2.0", "could not convert"),
        ("1 2 3 10", "1 nan 3 10", "no number"),
        ("}\nMOTION", "MOTION", "not closed"),
        ("{\n  OFFSET 1.0", "OFFSET 1.0", "broken BVH"),
    ],
)
def test_a_broken_file_is_refused(tmp_path: Path, old: str, new: str, output: str) -> None:
    assert old in SMALL
    path = tmp_path / "broken.bvh"
    path.write_text(SMALL.replace(old, new, 1))
    with pytest.raises(RecordingError, match=r"broken\.bvh") as caught:
        read_bvh(path)
    assert output in str(caught.value)


def test_a_file_that_breaks_off_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.bvh"
    for size in range(0, len(SMALL) - 10, 11):
        path.write_text(SMALL[:size])
        with pytest.raises(RecordingError, match=r"cut\.bvh"):
            read_bvh(path)
