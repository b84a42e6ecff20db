"""What a run told beside the hands: figures of gestures against a script, contact, and the messages again."""

from pathlib import Path

import numpy as np
import pytest

from common.messages import Contact, Gesture, ObjectPose
from common.sim.gestures import Annotation, Gestures
from master.evaluation.run_results import RunResults, judge_gestures
from master.outputs.poses import RunFiles
from tests.master.outputs.test_outputs_rerun import STEP_NS
from tests.master.outputs.test_outputs_results import START_NS, WATCHED, bar, contact, gesture

EPOCH_NS = START_NS


class Script(Gestures):
    """Says three things in 10 s, and turns a knob by half a radian a second."""

    period_s = 10.0

    def __init__(self) -> None:
        self.annotations = (
            Annotation("pinch", "index", 1.0, 2.0),
            Annotation("dial", "dial", 3.0, 5.0),
            Annotation("tap", "5", 6.0, 6.3),
        )

    def dial_rad(self, t_s: float) -> float:
        return 0.5 * t_s


def recognised(kind: str, name: str, at_s: float, phase: str = "begin", **more: float) -> Gesture:
    t_ns = EPOCH_NS + round(at_s * 1e9)
    return Gesture("h", t_ns, kind, name, phase, t_ns, 0.9, **more)  # type: ignore[arg-type]


def test_what_was_made_and_reported_is_right_and_what_was_not_made_is_false() -> None:
    received = [
        recognised("pinch", "index", 1.2),
        recognised("dial", "dial", 3.5, angle_rad=0.0),
        recognised("tap", "5", 6.5, "end"),
    ]
    made = judge_gestures(received, Script(), EPOCH_NS, EPOCH_NS, EPOCH_NS + 10 * 10**9)
    assert (made["gestures_right"], made["gestures_made"], made["gestures_false"]) == (3, 3, 0)
    wrong = [
        recognised("pinch", "ring", 1.2),
        recognised("tap", "5", 2.0, "end"),
        recognised("pose", "open_palm", 2.0),
    ]
    made = judge_gestures(wrong, Script(), EPOCH_NS, EPOCH_NS, EPOCH_NS + 10 * 10**9)
    assert (made["gestures_right"], made["gestures_made"], made["gestures_false"]) == (0, 3, 2)


def test_the_script_repeats_and_what_the_end_cuts_off_is_not_asked_for() -> None:
    received = [recognised("pinch", "index", 11.2), recognised("dial", "dial", 13.4, angle_rad=0.0)]
    made = judge_gestures(received, Script(), EPOCH_NS, EPOCH_NS, EPOCH_NS + 14 * 10**9)
    assert (made["gestures_right"], made["gestures_made"], made["gestures_false"]) == (1, 4, 0)


def test_what_the_beginning_of_the_run_cuts_off_is_neither_asked_for_nor_false() -> None:
    received = [
        recognised("pinch", "index", 1.6),
        recognised("tap", "5", 6.4, "end"),
        recognised("dial", "dial", 4.0, angle_rad=0.0),
    ]
    made = judge_gestures(received, Script(), EPOCH_NS, EPOCH_NS + 1_500_000_000, EPOCH_NS + 10**10)
    assert (made["gestures_right"], made["gestures_made"], made["gestures_false"]) == (2, 2, 0)
    other = [recognised("pinch", "ring", 1.6)]  # that one it did not make
    assert (
        judge_gestures(other, Script(), EPOCH_NS, EPOCH_NS + 1_500_000_000, EPOCH_NS + 10**10)[
            "gestures_false"
        ]
        == 1
    )


def test_too_late_is_not_right() -> None:
    made = judge_gestures(
        [recognised("pinch", "index", 2.6)], Script(), EPOCH_NS, EPOCH_NS, EPOCH_NS + 10**10
    )
    assert (made["gestures_right"], made["gestures_false"]) == (0, 1)


def test_the_angle_is_judged_from_where_the_dial_began() -> None:
    began = recognised("dial", "dial", 3.0, angle_rad=0.0)
    rotated = Gesture(
        "h", began.t_ns + 2 * 10**9, "dial", "dial", "update", began.t_ns, 0.9, angle_rad=1.0 + 0.05
    )
    assert judge_gestures([began, rotated, rotated], Script(), EPOCH_NS, EPOCH_NS, EPOCH_NS + 10**10)[
        "dial_deg"
    ] == pytest.approx(np.degrees(0.05), abs=0.01)


def test_the_files_of_a_run_are_its_messages_again(tmp_path: Path) -> None:
    files = RunFiles(tmp_path / "poses.npz", {"test-hand": 6}, ("bar",))
    rows = [contact(row, [0.0, 0.1, 0.1, 0.1, 0.1], held=row in (2, 3, 4)) for row in range(8)]
    for row in range(8):
        files.write(bar(row, occluded=row == 3))
        files.write(rows[row])
        files.write(gesture(row, "pinch", "begin" if row == 0 else "update", distance_m=0.001 * row))
    files.close()
    run = RunResults.load(tmp_path, WATCHED, START_NS + 1)
    kinds = [type(one) for one in run.messages()]
    assert (kinds.count(ObjectPose), kinds.count(Contact), kinds.count(Gesture)) == (8, 8, 7)
    poses = [one for one in run.messages() if isinstance(one, ObjectPose)]
    assert [one.occluded for one in poses] == [row == 3 for row in range(8)]
    np.testing.assert_array_equal(poses[5].position_m, bar(5).position_m)
    again = next(one for one in run.messages() if isinstance(one, Contact))
    np.testing.assert_array_equal(again.point_m, rows[0].point_m)
    assert run.contacts[0].held.sum() * STEP_NS * 1e-9 == pytest.approx(0.05)
    assert run.figures(None, EPOCH_NS, START_NS, START_NS + 8 * STEP_NS) == {
        "held_s": 0.1
    }  # 0.05, rounded up


def test_a_run_without_results_has_no_figures(tmp_path: Path) -> None:
    assert RunResults.load(tmp_path, WATCHED, 0).figures(None, 0, 0, 10**9) == {}
