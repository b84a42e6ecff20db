"""Counting frames: nothing is counted twice, nothing forgotten."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from master.sequence import REMEMBERED, TRIPLE, CameraCounts, Sequence


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


@given(
    st.lists(st.integers(0, 1), min_size=100, max_size=100),
    st.lists(st.integers(0, 99), min_size=1, max_size=99, unique=True),
)
def test_triples_are_counted_as_triples_wherever_their_laser_frame_lies(
    slips: list[int], order: list[int]
) -> None:
    sequence = Sequence(TRIPLE)
    seq = [3 * k + 1 + slips[k] for k in range(100)]  # numbers 2, 3 and 4 apart
    used = [k for k in order if sequence.take(7, seq[k])]
    assert used == sorted(used)
    counts = sequence.counts
    assert counts.received == len(used)
    assert counts.late == len(order) - len(used)
    early = sum(k < order[0] for k in order)
    assert counts.received + counts.lost + counts.late - early == max(order) - order[0] + 1


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ((1, 4, 7, 10), 0),
        ((1, 4, 6, 9, 13, 16), 0),  # one frame fewer, one more
        ((1, 4, 10), 1),
        ((1, 4, 9), 1),  # a triple with a frame missing
        ((1, 301), 99),
        ((1, 7, 4), 0),  # late
        ((1, 7, 5), 0),
        ((1, 2, 3), 0),
    ],
)
def test_what_is_missing_between_triples(numbers: tuple[int, ...], lost: int) -> None:
    sequence = Sequence(TRIPLE)
    for seq in numbers:
        sequence.take(7, seq)
    assert sequence.counts.lost == lost
