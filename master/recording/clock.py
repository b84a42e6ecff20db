"""Playback clock of a recording.

Where in the recording the player is; it can be paused, moved, and run at any speed.

It reads no clock itself: it is passed the time.
"""


class ReplayClock:
    """Map from local time to time in the recording.

    Holds a pair of both that belong together, the speed and the pause.

    At speed 0 there is no such map: everything is due at once.
    """

    def __init__(self, begin_t_ns: int, speed: float, now_ns: int) -> None:
        """Stand at `begin_t_ns` of the recording at `now_ns` here.

        Raises:
            ValueError: A speed below 0, or none.
        """
        self.paused = False
        self._at_ns, self._since_ns = begin_t_ns, now_ns
        self.speed = _checked(speed)

    def position_ns(self, now_ns: int) -> int:
        """Where it is [ns], recording's time."""
        if self.paused or self.speed == 0.0:
            return self._at_ns
        return self._at_ns + round((now_ns - self._since_ns) * self.speed)

    def wait_s(self, t_ns: int, now_ns: int) -> float | None:
        """How long until what came at `t_ns` is due [s]; None: not before `resume`."""
        if self.paused:
            return None
        if self.speed == 0.0:
            self._at_ns = max(self._at_ns, t_ns)
            return 0.0
        return max((t_ns - self.position_ns(now_ns)) * 1e-9 / self.speed, 0.0)

    def pause(self, now_ns: int) -> None:
        """Stand still."""
        self.seek(self.position_ns(now_ns), now_ns)
        self.paused = True

    def resume(self, now_ns: int) -> None:
        """Go on."""
        self._since_ns = now_ns
        self.paused = False

    def set_speed(self, factor: float, now_ns: int) -> None:
        """Go on at another speed; 0: as fast as it goes.

        Raises:
            ValueError: Below 0, or no number.
        """
        factor = _checked(factor)
        self.seek(self.position_ns(now_ns), now_ns)
        self.speed = factor

    def seek(self, t_ns: int, now_ns: int) -> None:
        """Stand at `t_ns` now."""
        self._at_ns, self._since_ns = t_ns, now_ns


def _checked(speed: float) -> float:
    if not 0.0 <= speed <= 1000.0:
        raise ValueError(f"speed {speed:g}: must be 0 (as fast as it goes) to 1000")
    return speed
