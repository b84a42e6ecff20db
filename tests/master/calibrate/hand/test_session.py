"""A person is led through the routine: a step without markers is done again, and its first try is dropped."""

import numpy as np
import pytest

from common.clock import Clock
from common.errors import FitError
from common.hand.routine import STEPS
from common.messages import HandPose, Source
from master.calibrate.hand.session import Track, guide, unseen
from master.calibrate.session import Person as Guided
from master.calibrate.session import Session

NAMES = ("thumb", "index", "middle", "ring", "little", "back")
TIPS = (0, 1, 2, 3, 4)


def pose_at(t_ns: int, hidden: tuple[int, ...] = ()) -> HandPose:
    points = np.full((6, 3), 0.1)
    points[list(hidden)] = np.nan
    cov = np.where(np.isfinite(points[:, :1, None]), 1e-6 * np.eye(3), np.nan)
    return HandPose(
        hand="me", t_ns=t_ns, position_m=np.zeros((26, 3)), orientation_wxyz=np.tile([1.0, 0, 0, 0], (26, 1)),
        radius_m=np.ones(26), valid=np.ones(26, bool), tracked=np.ones(26, bool), cov_m2=np.zeros((26, 3, 3)),
        source=np.full(26, Source.SOLVED), angles_rad=np.zeros((5, 4)), markers_m=points, markers_raw_m=points,
        markers_cov_m2=cov, inside_volume=np.ones(26, bool),
    )  # fmt: skip


class Person(Clock):
    """A clock that each pose moves on by 20 ms; between two times some markers are hidden. Holds the time."""

    def __init__(self, hidden: tuple[int, ...] = (), first_s: float = 0.0, last_s: float = 0.0) -> None:
        self.t_ns = 0
        self.output: list[str] = []
        self._hidden, self._first_s, self._last_s = hidden, first_s, last_s

    def now_ns(self) -> int:
        return self.t_ns

    def receive(self, _timeout_s: float) -> HandPose:
        self.t_ns += 20_000_000
        dark = self._first_s <= 1e-9 * self.t_ns < self._last_s
        return pose_at(self.t_ns, self._hidden if dark else ())

    def guide(self) -> Track:
        return guide(Session(self.receive, Guided(self.output.append), self), TIPS, NAMES)


def test_all_steps_are_reported_in_order_and_kept() -> None:
    person = Person()
    t_ns, points, cov = person.guide().arrays()
    steps = [line for line in person.output if f" of {len(STEPS)}: " in line]
    assert [line.split(": ")[0] for line in steps] == [
        f"{n} of {len(STEPS)}" for n in range(1, len(STEPS) + 1)
    ]
    assert (np.diff(t_ns) > 0).all()
    assert points.shape == (len(t_ns), 6, 3)
    assert cov.shape == (len(t_ns), 6, 3, 3)


def test_a_step_that_is_not_seen_is_done_again_and_its_first_try_is_dropped() -> None:
    person, other = Person(hidden=(2,), first_s=6.0, last_s=11.0), Person()
    track, whole = person.guide(), other.guide()
    assert any("middle in" in line and "this step again" in line for line in person.output)
    assert person.t_ns > other.t_ns + 5e9
    assert np.isfinite(track.arrays()[1]).mean() > 0.97
    assert abs((track.t_ns[-1] - track.t_ns[0]) - (whole.t_ns[-1] - whole.t_ns[0])) < 1e9


def test_a_finger_that_has_nothing_to_do_may_be_hidden() -> None:
    index = next(n for n, step in enumerate(STEPS) if step.name == "index")
    poses = [pose_at(t, hidden=(4,)) for t in range(1, 20)]
    assert unseen(STEPS[index], index, poses, TIPS, NAMES) == ""
    assert "little in 0 %" in unseen(STEPS[0], 0, poses, TIPS, NAMES)


def test_a_master_that_is_silent_or_blind_ends_it() -> None:
    person = Person(hidden=(1,), first_s=0.0, last_s=99.0)
    with pytest.raises(FitError, match="not seen in 3 tries"):
        person.guide()
    assert "no pose came" in unseen(STEPS[0], 0, [], TIPS, NAMES)
