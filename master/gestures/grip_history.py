"""Recent width and rotation of a grip.

It is kept so that a grip that loosens rotates nothing.

Fingers that let go of a knob go apart, and not alike: taken for a turn it is some degrees. They are quick, so that a
grip that is suddenly wider than it was is loosening, or the epoch is a bad one; a grip that slowly gets wider, as the
picture of a hand that turns does, is not. While it loosens the angle goes on as it went, ever less: a hand that rests
before it lets go stands still, and a bad epoch in a quick turn is led over.
"""

from collections import deque
from math import exp
from statistics import median


class GripHistory:
    """Recent history of a grip.

    Push machine. Holds width [m] and angle [rad] of the last tenth of a second, and since when the grip loosens.
    """

    def __init__(self, quick_m: float) -> None:
        """Set the change of width at which a grip counts as loosening [m].

        A grip that is wider, or narrower, by so much than it recently was is loosening.
        """
        self._quick_m = quick_m
        self._late: deque[tuple[int, float, float]] = deque()
        self._since_ns: int | None = None

    @property
    def loosens(self) -> bool:
        """Return whether the grip was loosening at the last epoch."""
        return self._since_ns is not None

    def sound(self, t_ns: int, wide_m: float, most_m: float) -> bool:
        """Check whether the fingers rotate the knob at an epoch.

        At the epoch they are wider by `wide_m` than when they closed.

        `most_m`: a grip that is wider than that is loose, however long it has been so.
        """
        if not self._late:
            good = abs(wide_m) <= most_m
        else:
            typical = median(wide for _, wide, _ in self._late)
            hold_s = 0.15  # a grip that is wider for so long is just wider
            lasts = self._since_ns is not None and (t_ns - self._since_ns) * 1e-9 > hold_s
            good = abs(wide_m) <= most_m and (lasts or abs(wide_m - typical) <= self._quick_m)
            if good and lasts:
                self._late.clear()
        if good:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = t_ns
        return good

    def push(self, t_ns: int, wide_m: float, angle_rad: float) -> None:
        """Take width and angle of a sound epoch."""
        self._late.append((t_ns, wide_m, angle_rad))
        late_s = 0.1  # what counts as of late
        while len(self._late) > 2 and (t_ns - self._late[0][0]) * 1e-9 > late_s:
            self._late.popleft()

    def ahead_rad(self, t_ns: int) -> float | None:
        """Extrapolate the angle to an epoch after the last sound one.

        The epochs at which nothing had begun to loosen yet are used; None: there was none.
        """
        if not self._late:
            return None
        typical = median(wide for _, wide, _ in self._late)
        firm = len(self._late)
        # of what is quick: from there on the last epochs before it may be of it
        while firm > 1 and abs(self._late[firm - 1][1] - typical) > 0.3 * self._quick_m:
            firm -= 1
        kept = list(self._late)[:firm]
        times = [(t - kept[-1][0]) * 1e-9 for t, _, _ in kept]
        middle = sum(times) / len(times)
        off = [t - middle for t in times]
        rate = sum(t * angle for t, (_, _, angle) in zip(off, kept, strict=True))
        rate = rate / max(sum(t * t for t in off), 1e-12) if len(times) > 2 else 0.0
        gone = (t_ns - kept[-1][0]) * 1e-9
        fade_s = 0.06  # in which a turn that nobody sees fades
        return kept[-1][2] + rate * fade_s * (1.0 - exp(-gone / fade_s))
