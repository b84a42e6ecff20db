"""Timing report of a running master.

It covers the clocks of the slaves, the phases of the cameras and wrong time stamps.

Metrics for `Health`, and lines for a person. Nothing here corrects anything.
"""

from collections.abc import Callable, Sequence

from common.link.clock_offset import ClockEstimate
from common.messages import Detections, MarkerDetections, restamped
from master.monitor.phases import CameraPhases
from master.monitor.timing import ResidualTiming
from master.monitor.timing_fit import TimeOffset
from master.rig.setup import RigSetup


class _Machines:
    """What is measured of the marker cameras of one hand with one state of its files."""

    def __init__(self, setup: RigSetup) -> None:
        rates = {name: setup.cameras[name].frame_rate_hz for name in setup.models}
        self.setup, self.others = setup, setup.rig.cameras[1:]
        self.late_ns = {name: round(1e3 * us) for name, us in setup.rig.stamp_offset_us.items()}
        self.phases = CameraPhases(rates)
        self.residual = ResidualTiming(setup.models, rates)

    def push(self, message: MarkerDetections) -> None:
        if late_ns := self.late_ns.get(message.camera):
            message = restamped(message, t_ns=message.t_ns + late_ns)
        self.phases.push(message)
        self.residual.push(message)


class ClockMonitor:
    """Push machine in the loop that monitors clocks and camera timing.

    `follow`, `look` and `metrics` belong to the thread that reports, once a second.

    Holds the machines for phases and residual offsets, what the latter found last, and for how long a camera has
    been suspect. Cameras that watch two hands are measured once.
    """

    def __init__(self, setups: Sequence[RigSetup]) -> None:
        """Watch the cameras of all hands.

        Strobe cycles of a wrist device have no other cameras to be in step with.
        """
        self._senders = tuple(
            dict.fromkeys(name for setup in setups for name in (*setup.camera_names, *setup.imus))
        )
        self._which = _that_cover(setups)
        self._now = [_Machines(setups[k]) for k in self._which]
        self._found: dict[str, TimeOffset] = {}
        self._suspect: dict[str, int] = {}

    def push(self, message: Detections) -> None:
        """Take one camera's detections, on the master's clock by its stamps."""
        if isinstance(message, MarkerDetections):
            for machines in self._now:
                machines.push(message)

    def follow(self, setups: Sequence[RigSetup]) -> None:
        """Continue with new calibration files of the same cameras.

        What was measured with the old files is forgotten.
        """
        for number, k in enumerate(self._which):
            if setups[k] is not self._now[number].setup:
                self._now[number] = _Machines(setups[k])

    def look(self) -> list[str]:
        """Measure again and return the messages that a person should see.

        They report a wrong time stamp, or a lock that came or went.
        """
        measured = {name: now.residual.offset_of(name) for now in self._now for name in now.others}
        self._found = {name: offset for name, offset in measured.items() if offset is not None}
        lines = [line for now in self._now for line in now.phases.look()]
        for name in measured:
            offset = self._found.get(name)
            warn_ns = 1e6
            warn_sigmas = 3.0
            wrong = offset is not None and abs(offset.offset_ns) > max(warn_ns, warn_sigmas * offset.sigma_ns)
            self._suspect[name] = self._suspect.get(name, 0) + 1 if wrong else 0
            looks = 5  # in a row: one wild second is no lie
            again = 60  # looks until the same camera is named again
            if offset is not None and self._suspect[name] % again == looks:
                lines.append(warning(name, offset))
        return lines

    def metrics(self, clock_of: Callable[[str], ClockEstimate | None]) -> dict[str, float]:
        """Return the timing metrics, keyed `<sender>.<quantity>`.

        The quantities are clock_*, and for a marker camera phase_* and residual_*; unknown ones are omitted.
        """
        out: dict[str, float] = {}
        for name in self._senders:
            clock = clock_of(name)
            if clock is not None:
                out |= _named(
                    name,
                    clock_offset_us=1e-3 * clock.offset_ns,
                    clock_sigma_us=1e-3 * clock.sigma_at(clock.t_ns),
                    clock_drift_ppm=clock.drift_ppm,
                )
        phases = [pair for now in self._now for pair in now.phases.phases().items()]
        for name, phase in phases:
            out |= _named(name, phase_us=phase.phase_us, phase_spread_us=phase.spread_us)
        for name, offset in self._found.items():
            out |= _named(
                name,
                residual_offset_us=1e-3 * offset.offset_ns,
                residual_sigma_us=1e-3 * offset.sigma_ns,
            )
        return out


def _that_cover(setups: Sequence[RigSetup]) -> list[int]:
    """Which setups together have every marker camera, those with most of them first."""
    marked = [k for k, setup in enumerate(setups) if setup.has_markers]
    marked.sort(key=lambda k: -len(setups[k].models))
    chosen: list[int] = []
    covered = set[str]()
    for k in marked:
        if not covered.issuperset(setups[k].models):
            chosen.append(k)
            covered.update(setups[k].models)
    return chosen


def warning(camera: str, offset: TimeOffset) -> str:
    """Return the warning about a camera whose time stamps are wrong.

    It is addressed to a person.
    """
    late, sigma = 1e-6 * offset.offset_ns, 1e-6 * offset.sigma_ns
    return (
        f"camera {camera}: its frames are {abs(late):.1f} ms (sigma {sigma:.1f}) {'later' if late > 0 else 'earlier'}"
        " than its stamps say: record a moving hand, then"
        " `phalanx calibrate time RECORDING --detections DIR --out DIR`"
    )


def _named(sender: str, **quantities: float) -> dict[str, float]:
    """Return the metrics of a camera or IMU under their full names.

    A name too long is cut to the length limit by shortening the sender's part.
    """
    name = 64  # characters of a name in `Health`
    return {
        f"{sender[: name - 1 - len(quantity)]}.{quantity}": round(value, 3)
        for quantity, value in quantities.items()
    }
