"""Which of libsurvive's devices is ours, and its poses on the slave's clock.

libsurvive calls devices by kind and order of appearance (WM0, T20), which a restart may turn about; what stays is the
serial number. Without a choice there must be one device only: with two, a guess would show one object as the other.

A stamp is the program's own time when it wrote the line. The clock behind it is this machine's wall clock, which may be
set or slewed, so stamps become times of the slave's clock as those of any foreign device do (`DeviceClock`): by the
least delay, whatever jitter and bunches the arrivals have. How late a pose is when its line is written nobody says;
that is constant, and `phalanx calibrate tracker` measures it.
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from common.errors import TrackerChoiceError
from common.messages import TrackerPose
from slave.imu.device_clock import ClockSteppedError, DeviceClock
from slave.objects.survive_lines import Fault, Found, Gone, LineDecoder, Pose, Serial

SLEWED = 600e-6  # at most 500 ppm by NTP, and the crystals


class SurviveDevice:
    """Push machine. Holds who is there, the clock of the program, and number and time of the newest pose."""

    def __init__(self, name: str, wanted: str | None) -> None:
        """Begin with a program that was just started.

        Args:
            name: Of the device in our messages.
            wanted: Its serial number, or what libsurvive calls it; None: there is one only.
        """
        self._name, self._wanted = name, wanted
        self._decoder = LineDecoder()
        self._clock = DeviceClock(SLEWED)
        self._serials: dict[str, str] = {}
        self._posed: list[str] = []
        self._seq = -1
        self._last_ns: int | None = None
        self._counts: Counter[str] = Counter()

    def push(self, data: bytes, arrival_ns: int) -> list[TrackerPose]:
        """Take bytes that were there at `arrival_ns`, slave's clock; return the poses that they complete.

        Raises:
            TrackerChoiceError: A second device has poses, and nobody said which one is meant.
        """
        ours = [one for found in self._decoder.push(data) if (one := self._ours(found)) is not None]
        dated = [(one, self._observe(one, arrival_ns)) for one in ours]  # all, before one becomes a time
        poses: list[TrackerPose] = []
        for one, possible in dated:
            t_ns = self._clock.at(round(one.t_s * 1e9))
            if not possible or (self._last_ns is not None and t_ns <= self._last_ns):
                self._counts["broken.time"] += 1
                continue
            poses.append(self.numbered(t_ns, one))
        return poses

    def numbered(self, t_ns: int, pose: Pose | None) -> TrackerPose:
        """The next message; None: it does not know where it is."""
        self._seq += 1
        self._last_ns = t_ns
        place = np.full(3, np.nan) if pose is None else np.array(pose.position_m)
        quaternion = np.full(4, np.nan) if pose is None else np.array(pose.orientation_wxyz)
        return TrackerPose(self._name, 0, self._seq, t_ns, place, quaternion)

    @property
    def last_ns(self) -> int | None:
        """When its newest message holds [ns]; None: there is none yet."""
        return self._last_ns

    @property
    def counts(self) -> Mapping[str, int]:
        """Lines by what was wrong with them (`broken.`), `clock_steps`, `gone`, poses of other devices (`others`)."""
        return self._counts

    def there(self) -> str:
        """Which devices have told anything, as text for people."""
        names = list(dict.fromkeys([*self._posed, *self._serials]))
        return ", ".join(self._called(one) for one in names) or "no device at all"

    def _ours(self, found: Found) -> Pose | None:
        """The pose if it is one of the device that is meant."""
        if isinstance(found, Fault):
            self._counts[f"broken.{found.name.lower()}"] += 1
        elif isinstance(found, Serial):
            self._serials[found.device] = found.serial
        elif isinstance(found, Gone):
            self._counts["gone"] += self._is_ours(found.device)
        else:
            if found.device not in self._posed:
                self._posed.append(found.device)
            if self._is_ours(found.device):
                return found
            self._counts["others"] += 1
        return None

    def _is_ours(self, device: str) -> bool:
        if self._wanted is not None:
            return self._wanted in (device, self._serials.get(device))
        if len(self._posed) > 1:
            raise TrackerChoiceError(
                f"several devices have poses: {self.there()}; say with --serial which one sits on the object"
            )
        return True

    def _called(self, device: str) -> str:
        serial = self._serials.get(device)
        return device if serial is None else f"{device} (serial {serial})"

    def _observe(self, pose: Pose, arrival_ns: int) -> bool:
        try:
            return self._clock.observe(round(pose.t_s * 1e9), arrival_ns)
        except ClockSteppedError:  # somebody set the wall clock
            self._counts["clock_steps"] += 1
            self._clock = DeviceClock(SLEWED)
            return self._clock.observe(round(pose.t_s * 1e9), arrival_ns)
