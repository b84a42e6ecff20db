"""Counting frames: nothing is counted twice, nothing forgotten."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from master.run.sequence import CYCLE_FRAMES, REMEMBERED, CameraCounts, Counted, Losses, Sequence


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
def test_cycles_are_counted_as_cycles_wherever_their_laser_frame_lies(
    slips: list[int], order: list[int]
) -> None:
    sequence = Sequence(CYCLE_FRAMES)
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
def test_what_is_missing_between_cycles(numbers: tuple[int, ...], lost: int) -> None:
    sequence = Sequence(CYCLE_FRAMES)
    for seq in numbers:
        sequence.take(7, seq)
    assert sequence.counts.lost == lost


def test_losses_of_an_hour_cost_no_memory() -> None:
    losses = Losses()
    for k in range(10 * REMEMBERED):
        losses.gap(2 * k, 2 * k + 2, numbers=1, datagrams=1)
    assert losses.lost == 10 * REMEMBERED
    assert len(losses._gaps) == REMEMBERED


def test_numbers_that_rise_as_they_like_miss_nothing() -> None:
    counted = Counted(Sequence(None))

    def nobody(after: int, before: int) -> int:
        raise AssertionError(f"nothing is missing between {after} and {before}")

    assert [counted.take(7, seq, 2 * k + 1, nobody) for k, seq in enumerate((5, 90, 91, 20, 91))] == [
        *(True, True, True),
        *(False, False),
    ]
    assert counted.sequence.counts == CameraCounts(received=3, late=2)
    assert counted.losses.lost == 0


def nothing_missing(_after: int, _before: int) -> int:
    return 0


def test_a_number_that_leaps_again_and_again_has_a_bound_in_time() -> None:
    counted, t_ns, seq = Counted(Sequence()), 10**12, 0
    assert counted.plausible(1, seq, t_ns)
    counted.take(1, seq, 1, nothing_missing)
    taken = 0
    for k in range(1000):
        t_ns += 1_000_000
        if counted.plausible(1, seq + 2000, t_ns):
            seq, taken = seq + 2000, taken + 1
            assert counted.take(1, seq, 2 + k, nothing_missing)
    assert 50 <= taken <= 60, "100 000 at once, 10 000 in the second"


def test_a_sender_that_went_on_while_this_machine_slept_is_taken_at_once() -> None:
    """A clock of the kernel stands still in suspend; the camera of another machine does not."""
    counted, t_ns = Counted(Sequence()), 10**12
    for seq in range(100):
        assert counted.plausible(7, seq, t_ns + seq)
        counted.take(7, seq, seq + 1, nothing_missing)
    slept = 8 * 3600 * 90
    assert not counted.plausible(7, slept, t_ns + 10**9), "without a new session it is a leap"
    counted.begin_session()
    assert counted.plausible(7, slept, t_ns + 2 * 10**9)
    assert counted.take(7, slept, 1, nothing_missing)
    assert counted.sequence.counts.lost == 0
    assert not counted.plausible(7, 2 * slept, t_ns + 3 * 10**9)
