"""Objects and gestures in the picture of a run."""

from pathlib import Path

import cv2
import numpy as np

from master.evaluation.run_results import RunResults
from master.outputs.picture import best_row, draw_summary
from master.outputs.picture_overlays import STRIP_BOX, ResultPicture, spans
from master.outputs.poses import Poses, RunFiles
from tests.master.outputs.test_outputs_rerun import MODEL, RIG, moving_hand
from tests.master.outputs.test_outputs_results import START_NS, STEP_NS, WATCHED, bar, contact, gesture

GREEN = np.array([115, 158, 0])  # BGR of a tracked object


def shown(tmp_path: Path, *, held_row: int, known: bool = True) -> ResultPicture:
    files = RunFiles(tmp_path / "poses.npz", {"test-hand": 6}, ("bar",))
    for row in range(6):
        files.write(bar(row, known=known, tracked=known))
        files.write(contact(row, [0.0, 0.1, 0.1, 0.1, 0.1], held=row == held_row))
    files.close()
    run = RunResults.load(tmp_path, WATCHED, 0)
    output = [gesture(0, "pinch", "begin"), gesture(3, "pinch", "end"), gesture(4, "tap", "end")]
    return ResultPicture(WATCHED.objects, run.objects, run.contacts, output)


def test_a_span_ends_with_its_message_or_with_the_run() -> None:
    output = [gesture(0, "pinch", "begin"), gesture(3, "pinch", "end")]
    again = [gesture(5, "pinch", "begin", began_t_ns=START_NS + 5 * STEP_NS)]
    assert spans([*output, *again], "pinch", START_NS + 9 * STEP_NS) == [
        ("index", START_NS, START_NS + 3 * STEP_NS),
        ("index", START_NS + 5 * STEP_NS, START_NS + 9 * STEP_NS),
    ]
    assert spans(output, "dial", START_NS) == []


def test_the_moment_that_is_shown_is_one_that_holds_the_object(tmp_path: Path) -> None:
    poses = Poses.of(moving_hand(6))
    assert best_row(poses, shown(tmp_path, held_row=2)) == 2
    assert best_row(poses, shown(tmp_path, held_row=5)) == 5
    assert best_row(poses) == best_row(poses, ResultPicture())


def test_the_picture_has_the_object_and_the_strip(tmp_path: Path) -> None:
    poses, picture = Poses.of(moving_hand(6)), shown(tmp_path, held_row=2)
    images = []
    for name, what in (
        ("with", picture),
        ("without", None),
        ("lost", shown(tmp_path, held_row=2, known=False)),
    ):
        draw_summary(tmp_path / f"{name}.png", poses, RIG, MODEL, {}, None, 2, None, what)
        image = cv2.imread(str(tmp_path / f"{name}.png"))
        assert image is not None
        assert image.shape == (900, 1600, 3)
        images.append(image.astype(np.int16))
    left, bottom, width, height = STRIP_BOX
    strip = (
        slice(round(900 * (1 - bottom - height)), round(900 * (1 - bottom))),
        slice(round(1600 * left), round(1600 * (left + width))),
    )
    pink = [int((np.abs(image[strip] - [167, 121, 204]).max(axis=2) < 12).sum()) for image in images]
    assert pink[0] > 1000
    assert pink[1] == 0
    assert pink[2] == pink[0]
    hand = (slice(100, 640), slice(300, 990))
    edge = [int((np.abs(image[hand] - GREEN).max(axis=2) < 25).sum()) for image in images]
    assert edge[0] > edge[2] + 200  # of an object that nobody knows nothing is drawn
