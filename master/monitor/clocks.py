"""Clock monitor reports the residual time offset between the cameras.

A stamp can lie: a USB camera without a clock of its own is stamped when its first packet arrives, late by
exposure and transfer, 8 to 10 ms; nothing that travels with the frame shows it. The tracks do
(`master.monitor.timing_fit`). A second of frames is compared at once, one step of the work with each message.
Nothing is corrected here: `Health` gets metrics (clocks of the slaves, phases, residual offsets), a person
gets lines, and `phalanx calibrate cameras time` writes the rig.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from common.arrays import Float
from common.geometry.camera_model import CameraModel
from common.link.clock_offset import ClockEstimate
from common.messages import Detections, MarkerDetections, restamped
from master.monitor.rates import CameraPhases
from master.monitor.timing_fit import TENTHS, CameraPair, TimeOffset, Track, fit_offset, unit_sums
from master.rig.setup import RigSetup

BLOCK_NS = 1_000_000_000
KEPT_BLOCKS = 32
_DONE = object()


class ResidualTiming:
    """Estimator of the residual time offset between cameras; push machine."""

    def __init__(
        self,
        cameras: Mapping[str, CameraModel],
        frame_rate_hz: Mapping[str, float],
        *,
        kept_blocks: int = KEPT_BLOCKS,
        rate_hz: float = 30.0,
    ) -> None:
        """Take the cameras in the rig's order; the first one is the reference.

        Args:
            frame_rate_hz: Nominal rates.
            kept_blocks: How many seconds of motion count.
            rate_hz: About how many frames of a second are compared at most: a hand moves below 10 Hz.
        """
        self._models = tuple(cameras.values())
        self._index = {name: c for c, name in enumerate(cameras)}
        self._pairs = tuple(CameraPair.of(self._models[0], model) for model in self._models)
        rates = [frame_rate_hz[name] for name in cameras]
        gap_periods = 2.5
        self._gap_s = tuple(gap_periods / min(rate, rates[0]) for rate in rates)
        self._stride = max(1, round(rates[0] / rate_hz))
        margin_frames = 4  # the cubic reaches two frames out, and the slowest camera may be one late
        self._margin_ns = int(margin_frames * 1e9 / min(rates))
        window_s = (BLOCK_NS + 2 * self._margin_ns) * 1e-9
        spare = 2  # times as many frames are kept as a block needs
        self._frames = tuple(
            deque[MarkerDetections](maxlen=int(spare * rate * window_s) + len(rates)) for rate in rates
        )
        self._blocks = tuple(deque[Float](maxlen=kept_blocks) for _ in rates)
        self._work: deque[Iterator[None]] = deque(maxlen=len(rates))  # comparisons, one for each camera
        self._block_ns: int | None = None
        self._reference: tuple[int, Track] | None = None

    def push(self, message: MarkerDetections) -> None:
        """Take one camera's detections, on the master's clock; ignore other cameras."""
        c = self._index.get(message.camera)
        if c is None:
            return
        frames = self._frames[c]
        if frames and (
            message.session != frames[-1].session
            or len(message.area) != len(frames[-1].area)
            or message.t_ns < frames[-1].t_ns - BLOCK_NS  # its clock was known wrongly before
        ):
            self._forget(c)
        if frames and message.t_ns <= frames[-1].t_ns:
            return
        frames.append(message)
        if c == 0:
            self._begin(message.t_ns)
        if self._work and next(self._work[0], _DONE) is _DONE:
            self._work.popleft()

    def flush(self) -> None:
        """At the end of a recording: compare what is left."""
        self._finish()
        while self._block_ns is not None and self._frames[0] and self._block_ns < self._frames[0][-1].t_ns:
            self._work.extend(self._compare(c, self._block_ns) for c in range(1, len(self._models)))
            self._block_ns += BLOCK_NS
            self._finish()

    def _finish(self) -> None:
        while self._work:
            for _ in self._work.popleft():
                pass

    def offset_of(self, camera: str) -> TimeOffset | None:
        """Offset of a camera from the last half minute of motion; None: too little."""
        c = self._index[camera]
        blocks = self._blocks[c].copy()
        return fit_offset(np.stack(blocks)) if c and blocks else None

    def _forget(self, c: int) -> None:
        """A camera's process began anew: its stamps may lie differently."""
        self._frames[c].clear()
        for other in range(len(self._models)) if c == 0 else (c,):
            self._blocks[other].clear()
        if c == 0:
            self._work.clear()
            self._block_ns = self._reference = None

    def _begin(self, t_ns: int) -> None:
        """Begin to compare the block that is complete with this frame of the reference."""
        if self._block_ns is None:
            self._block_ns = t_ns
        if t_ns - self._block_ns < BLOCK_NS + self._margin_ns:
            return
        self._work.extend(self._compare(c, self._block_ns) for c in range(1, len(self._models)))
        self._block_ns += BLOCK_NS
        if t_ns - self._block_ns > BLOCK_NS + self._margin_ns:  # after a pause
            self._block_ns = t_ns

    def _compare(self, c: int, begin_ns: int) -> Iterator[None]:
        """Compare a block, in steps that each take a fraction of a millisecond."""
        if self._reference is None or self._reference[0] != begin_ns:
            self._reference = (begin_ns, self._track(0, begin_ns))
            yield
        reference, other = self._reference[1], self._track(c, begin_ns)
        yield
        if len(reference.t_s) < 3 or len(other.t_s) < 4:
            return
        part = reference.t_s[1:-1].mean(axis=1) * (1e9 * TENTHS / BLOCK_NS)
        rows = np.flatnonzero((part >= 0.0) & (part < TENTHS))[:: self._stride]
        if not len(rows):
            return
        evidence = self._pairs[c].evidence(reference, other, rows + 1, self._gap_s[c])
        yield
        sums = unit_sums(evidence, reference.t_s.shape[1], part[rows].astype(np.int64))
        known = (np.maximum(sums[..., 1].sum(axis=0), 0.0) / sums[0, :, -1]).sum()
        useless_s = 5e-3  # a block that could at best resolve this much is uninformative
        if known > useless_s**-2:
            self._blocks[c].append(sums)

    def _track(self, c: int, begin_ns: int) -> Track:
        """Frames about a block, times [s] from its begin; ambiguous markers: not seen."""
        model, margin = self._models[c], self._margin_ns
        low, high = begin_ns - margin, begin_ns + BLOCK_NS + margin
        frames = [frame for frame in self._frames[c] if low <= frame.t_ns < high]
        if not frames:
            return Track(np.empty((0, 0)), np.empty((0, 0, 2)))
        uv = np.array([frame.uv for frame in frames])
        for k, frame in enumerate(frames):
            if frame.has_alternatives:
                uv[k, np.isfinite(frame.alt_uv[:, 0])] = np.nan
        rows = np.where(np.isnan(uv[..., 1]), 0.5 * (model.height_px - 1), uv[..., 1])
        t_s = np.array([(frame.t_ns - begin_ns) * 1e-9 for frame in frames])[:, None]
        return Track(t_s + 1e-9 * model.row_time_ns * rows, model.undistort(uv))


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
    """

    def __init__(self, setups: Sequence[RigSetup]) -> None:
        """Watch the marker cameras of all hands, and the clocks of all senders."""
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
        """Continue with new files of the same cameras; forget what the old ones gave."""
        for number, k in enumerate(self._which):
            if setups[k] is not self._now[number].setup:
                self._now[number] = _Machines(setups[k])

    def look(self) -> list[str]:
        """Measure again; return lines on wrong stamps, and locks that came or went."""
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
        """Known metrics <sender>.clock_*, and of a marker camera phase_* and residual_*."""
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
                name, residual_offset_us=1e-3 * offset.offset_ns, residual_sigma_us=1e-3 * offset.sigma_ns
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
    """Return the warning about a camera whose time stamps are wrong."""
    late, sigma = 1e-6 * offset.offset_ns, 1e-6 * offset.sigma_ns
    return (
        f"camera {camera}: its frames are {abs(late):.1f} ms (sigma {sigma:.1f}) {'later' if late > 0 else 'earlier'}"
        " than its stamps say: record a moving hand, then"
        " `phalanx calibrate cameras time RECORDING --detections DIR --out DIR`"
    )


def _named(sender: str, **quantities: float) -> dict[str, float]:
    """Metrics under their full names, cut in the sender's part where too long."""
    name = 64  # characters of a name in `Health`
    return {
        f"{sender[: name - 1 - len(quantity)]}.{quantity}": round(value, 3)
        for quantity, value in quantities.items()
    }
