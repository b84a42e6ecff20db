"""Counting frames: nothing is counted twice, nothing forgotten."""

from hypothesis import given
from hypothesis import strategies as st

from master.sequence import REMEMBERED, CameraCounts, Sequence


@given(st.lists(st.integers(0, 300), min_size=1, max_size=200, unique=True))
def test_received_lost_and_late_make_up_the_span(order: list[int]) -> None:
    sequence = Sequence()
    used = [seq for seq in order if sequence.take(7, seq)]
    assert used == sorted(used)
    counts = sequence.counts
    assert counts.received == len(used)
    assert counts.late == len(order) - len(used)
    early = sum(seq < order[0] for seq in order)  # before the first: late, but never missing
    assert counts.received + counts.lost + counts.late - early == max(order) - order[0] + 1


def test_a_frame_sent_twice_does_not_heal_a_loss() -> None:
    sequence = Sequence()
    assert [sequence.take(7, seq) for seq in (0, 3, 1, 1, 3)] == [True, True, False, False, False]
    assert sequence.counts == CameraCounts(received=2, lost=1, late=3)


def test_a_restart_is_no_loss_and_keeps_the_counts() -> None:
    sequence = Sequence()
    for session, seq in ((7, 1000), (7, 1002), (8, 0), (8, 1)):
        assert sequence.take(session, seq)
    assert sequence.counts == CameraCounts(received=4, lost=1)


def test_a_huge_gap_costs_no_memory() -> None:
    sequence = Sequence()
    sequence.take(7, 0)
    sequence.take(7, 2**62)
    sequence.take(7, 2**62 + 10)
    assert sequence.counts.lost == 2**62 - 1 + 9
    assert len(sequence._missing) <= REMEMBERED
