"""What a running master tells of time: clocks of the slaves, phases of the cameras, stamps that lie.

Gauges for `Health`, and lines for a person. Nothing here corrects anything.
"""

from collections.abc import Callable

import msgspec

from common.clock_offset import ClockEstimate
from common.messages import Detections, MarkerDetections
from master.phases import CameraPhases
from master.rig import RigSetup
from master.stereo.timing import ResidualTiming
from master.stereo.timing_fit import TimeOffset

WARN_NS = 1e6
WARN_SIGMAS = 3.0
_LOOKS = 5  # in a row: one wild second is no lie
_AGAIN = 60  # looks until the same camera is named again
_NAME = 64  # characters of a name in `Health`


class _Machines:
    """What is measured with one state of the rig's files."""

    def __init__(self, setup: RigSetup) -> None:
        rates = {name: camera.frame_rate_hz for name, camera in setup.cameras.items()}
        self.setup = setup
        self.late_ns = {name: round(1e3 * us) for name, us in setup.rig.stamp_offset_us.items()}
        self.phases = CameraPhases(rates)
        self.residual = ResidualTiming(setup.models, rates)

    def push(self, message: MarkerDetections) -> None:
        if late_ns := self.late_ns.get(message.camera):
            message = msgspec.structs.replace(message, t_ns=message.t_ns + late_ns)
        self.phases.push(message)
        self.residual.push(message)


class TimeWatch:
    """Push machine in the loop; `follow`, `look` and `gauges` belong to the thread that reports, once a second.

    Holds the machines for phases and residual offsets, what the latter found last, and for how long a camera has
    been suspect.
    """

    def __init__(self, setup: RigSetup) -> None:
        """Watch the cameras of a rig."""
        self._others = setup.rig.cameras[1:]
        self._now = _Machines(setup)
        self._found: dict[str, TimeOffset] = {}
        self._suspect = dict.fromkeys(self._others, 0)

    def push(self, message: Detections) -> None:
        """Take one camera's detections, on the master's clock by its stamps; that of a wrist device has no other."""
        if isinstance(message, MarkerDetections):
            self._now.push(message)

    def follow(self, setup: RigSetup) -> None:
        """Go on with other files of the same cameras: what was measured with the old ones is forgotten."""
        if setup is not self._now.setup:
            self._now = _Machines(setup)

    def look(self) -> list[str]:
        """Measure anew; return what a person should know: a stamp that lies, a lock that came or went."""
        now = self._now
        measured = {name: now.residual.offset_of(name) for name in self._others}
        self._found = {name: offset for name, offset in measured.items() if offset is not None}
        lines = now.phases.look()
        for name in self._others:
            offset = self._found.get(name)
            wrong = offset is not None and abs(offset.offset_ns) > max(WARN_NS, WARN_SIGMAS * offset.sigma_ns)
            self._suspect[name] = self._suspect[name] + 1 if wrong else 0
            if offset is not None and self._suspect[name] % _AGAIN == _LOOKS:
                lines.append(warning(name, offset))
        return lines

    def gauges(self, clock_of: Callable[[str], ClockEstimate | None]) -> dict[str, float]:
        """<camera>.<quantity>: clock_*, phase_*, residual_*; what is not known is not told."""
        out: dict[str, float] = {}
        for name in self._now.setup.rig.cameras:
            clock = clock_of(name)
            if clock is not None:
                out |= _named(
                    name,
                    clock_offset_us=1e-3 * clock.offset_ns,
                    clock_sigma_us=1e-3 * clock.sigma_at(clock.t_ns),
                    clock_drift_ppm=clock.drift_ppm,
                )
        for name, phase in self._now.phases.phases().items():
            out |= _named(name, phase_us=phase.phase_us, phase_spread_us=phase.spread_us)
        for name, offset in self._found.items():
            out |= _named(
                name,
                residual_offset_us=1e-3 * offset.offset_ns,
                residual_sigma_us=1e-3 * offset.sigma_ns,
            )
        return out


def warning(camera: str, offset: TimeOffset) -> str:
    """What a person is told of a camera whose stamps lie."""
    late, sigma = 1e-6 * offset.offset_ns, 1e-6 * offset.sigma_ns
    return (
        f"camera {camera}: its frames are {abs(late):.1f} ms (sigma {sigma:.1f}) {'later' if late > 0 else 'earlier'}"
        " than its stamps say: record a moving hand, then"
        " `phalanx-master calibrate time RECORDING --detections DIR --out DIR`"
    )


def _named(camera: str, **quantities: float) -> dict[str, float]:
    """Gauges of a camera by their full names, cut to the length of a name at the camera's expense."""
    return {
        f"{camera[: _NAME - 1 - len(quantity)]}.{quantity}": round(value, 3)
        for quantity, value in quantities.items()
    }
