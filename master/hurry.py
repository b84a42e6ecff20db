"""What a master that falls behind leaves out: it solves the newest instant, and no message is lost for it.

Solving a hand takes about the same time whether two cameras saw it or sixteen; messages must be taken whatever comes of
them, for a camera's past tells where its markers are at every instant. So at overload instants are left out (*shed*),
evenly, and counted (`instants_shed`): first every other one, then three of four, until what waits is worked off.

How much waits is looked at once for each message that is taken, and nothing but `Hurry.leave_out` comes of it: with the
messages and that number, what is solved can be solved again bit for bit (`master.recording`).

A machine that is fast enough works off a short pause by itself, and every pose is told; so it begins where the lag is
longer than such pauses last.
"""

from collections.abc import Callable

BEGIN_S = 0.125  # of lag
BEGIN_FRAMES, HARD_FRAMES, END_FRAMES = (
    4,
    8,
    1,
)  # of each camera that wait; the first, where it is longer than that lag
_SOME, _MOST = 1, 3  # instants that are left out between two that are solved


class Hurry:
    """How far a master is behind.

    Attributes:
        waiting: How many frames, of all cameras, have come and were not taken yet.
        leave_out: How many instants are left out between two that are solved, of each hand; 0: none.
    """

    def __init__(self, cameras: int = 1, frame_rate_hz: float = 60.0) -> None:
        """Of a master of so many cameras, at the rate of the fastest, that is not behind."""
        self.waiting: Callable[[], int] = lambda: 0
        self.leave_out = 0
        self._cameras = max(cameras, 1)
        self._begin = max(BEGIN_S * frame_rate_hz, BEGIN_FRAMES)

    def look(self) -> None:
        """A message was taken: see what waits behind it."""
        frames = self.waiting() / self._cameras
        if frames <= (END_FRAMES if self.leave_out else self._begin):
            self.leave_out = 0
        else:
            self.leave_out = _MOST if frames > HARD_FRAMES else _SOME


class Shedding:
    """Asked for each instant of one hand whether it is left out. Holds how many in a row were."""

    def __init__(self, hurry: Hurry) -> None:
        """Leave out what `hurry` says."""
        self._hurry = hurry
        self._in_a_row = 0

    def __call__(self) -> bool:
        """Whether the next instant is left out."""
        self._in_a_row = self._in_a_row + 1 if self._in_a_row < self._hurry.leave_out else 0
        return self._in_a_row > 0


def never() -> bool:
    """Nothing is left out: what is solved offline has time."""
    return False
