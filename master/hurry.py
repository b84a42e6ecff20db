"""What a master that falls behind leaves out: it solves the newest instant, and no message is lost for it.

Solving a hand takes about the same time whether two cameras saw it or sixteen; messages must be taken whatever comes of
them, for a camera's past tells where its markers are at every instant. So at overload instants are left out (*shed*),
evenly, and counted (`instants_shed`): first every other one, then three of four, until what waits is worked off.
"""

from collections.abc import Callable

BEGIN_FRAMES, HARD_FRAMES, END_FRAMES = 4, 8, 1  # of each camera that wait
_SOME, _MOST = 1, 3  # instants that are left out between two that are solved


class Hurry:
    """How far a master is behind.

    Attributes:
        waiting: How many frames, of all cameras, have come and were not taken yet.
    """

    def __init__(self, cameras: int) -> None:
        """Of a master of so many cameras that is not behind."""
        self.waiting: Callable[[], int] = lambda: 0
        self._cameras = max(cameras, 1)

    @property
    def frames(self) -> float:
        """Frames of each camera that wait."""
        return self.waiting() / self._cameras


class Shedding:
    """Asked for each instant of one hand whether it is left out. Holds whether it is behind, and how many in a row
    were left out."""

    def __init__(self, hurry: Hurry) -> None:
        """Leave nothing out until it is behind."""
        self._hurry = hurry
        self._behind = False
        self._in_a_row = 0

    def __call__(self) -> bool:
        """Whether the next instant is left out."""
        frames = self._hurry.frames
        self._behind = frames > (END_FRAMES if self._behind else BEGIN_FRAMES)
        most = 0 if not self._behind else _MOST if frames > HARD_FRAMES else _SOME
        self._in_a_row = self._in_a_row + 1 if self._in_a_row < most else 0
        return self._in_a_row > 0


def never() -> bool:
    """Nothing is left out: what is solved offline has time."""
    return False
