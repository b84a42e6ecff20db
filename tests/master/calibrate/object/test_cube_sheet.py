"""The net of a box folds into the object of its file, and a page of it reads as its tags."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from common.calibration import parse, save
from common.calibration.object_profile import ObjectProfile, tag_corners
from common.errors import CalibrationError
from common.geometry.tag_family import tag_image
from master.calibrate.object.cube_sheet import TagBox, dark_squares, print_box
from tests.cli import calibrate, invoke

BOX = TagBox("box", "aruco_5x5_100", 3, 0.04, 0.03)


def drawn(px_per_mm: int = 8) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    image = np.full((140 * px_per_mm, 140 * px_per_mm), 255, np.uint8)
    for left, low, size in dark_squares(BOX):
        x, y = (left + 70.0) * px_per_mm, (70.0 - low - size) * px_per_mm
        image[round(y) : round(y + size * px_per_mm), round(x) : round(x + size * px_per_mm)] = 0
    return image


def test_each_face_folds_to_where_the_file_has_its_tag() -> None:
    finder = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    found, ids, _ = finder.detectMarkers(drawn())
    tags = BOX.profile().tags
    assert tags is not None
    assert sorted(np.ravel(ids).tolist()) == [tag.id for tag in tags.tags] == [3, 4, 5, 6, 7]
    seen = dict(zip(np.ravel(ids).tolist(), found, strict=True))
    for tag in tags.tags:
        T = np.array(tag.T_object_tag)
        corners = tag_corners(tag.edge_m) @ T[:3, :3].T + T[:3, 3]
        out = T[:2, 2]
        # Unfolded about the edge of the top: what is below it lies further out.
        flat = 1e3 * (corners[:, :2] + np.outer(0.02 - corners[:, 2], out))
        net = (seen[tag.id].reshape(4, 2) + 0.5) / 8.0 * [1.0, -1.0] + [-70.0, 70.0]
        np.testing.assert_allclose(net, flat, atol=0.2)


def test_the_file_is_a_valid_object(tmp_path: Path) -> None:
    path = tmp_path / "box.json"
    save(path, BOX.profile())
    assert parse(path.read_bytes(), ObjectProfile, "box") == BOX.profile()


def test_as_many_cells_are_black_as_in_the_tags() -> None:
    assert len(dark_squares(BOX)) == sum(int((tag_image("aruco_5x5_100", n) == 0).sum()) for n in range(3, 8))


@pytest.mark.parametrize("ending", ["pdf", "svg"])
def test_a_page_is_written(tmp_path: Path, ending: str) -> None:
    print_box(tmp_path / f"box.{ending}", BOX)
    assert (tmp_path / f"box.{ending}").stat().st_size > 1000


def test_what_cannot_be_printed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="white"):
        TagBox("box", "aruco_5x5_100", 0, 0.04, 0.036)
    with pytest.raises(CalibrationError, match="first"):
        TagBox("box", "aruco_4x4_50", 46, 0.04, 0.03)
    with pytest.raises(CalibrationError, match="A4"):
        TagBox("box", "aruco_5x5_100", 0, 0.07, 0.03)
    with pytest.raises(CalibrationError, match="pdf"):
        print_box(tmp_path / "box.png", BOX)


def test_the_command_prints_a_box_and_writes_its_object(tmp_path: Path) -> None:
    page, tree = tmp_path / "mug.pdf", ("--calibration", tmp_path)
    box = ("--kind", "box", "--name", "mug", "--side-mm", 50, "--edge-mm", 38, *tree, "-o", page)
    assert "objects/mug.json" in calibrate("board", *box)
    assert page.read_bytes().startswith(b"%PDF")
    mug = parse((tmp_path / "objects/mug.json").read_bytes(), ObjectProfile, "mug")
    assert mug == TagBox("mug", "aruco_5x5_100", 0, 0.05, 0.038).profile()
    again = invoke("calibrate", "board", *box)
    assert (again.exit_code, "not overwritten" in again.output) == (2, True)
    for option, value in (("--board", "9x6"), ("--paper", "A3"), ("--square-mm", 20), ("--marker-mm", 15)):
        refused = invoke("calibrate", "board", *box, option, value)
        assert (refused.exit_code, f"{option}: is of a board" in refused.output) == (2, True)
