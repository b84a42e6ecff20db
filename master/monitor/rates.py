"""Rates and exposure phases show when the cameras take their frames.

A camera's rate is that of its frame counter over its capture times, whether or not somebody had time for the
frames in between; the rate of arrival counts the frames that were searched, sent and received. The phase of a
camera is how much later than the leading camera's frame its own was taken, modulo the period: cameras that
run free drift through all phases, some period in minutes; locked ones stay where they are.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.messages import Detections, MarkerDetections


@dataclass(slots=True)
class _Span:
    """Last frame of one camera, and sums between frames of one slave process."""

    session: int
    seq: int
    t_ns: int
    frames: int = 0
    received: int = 0
    span_ns: int = 0


class CameraRates:
    """Estimator of the frame rates of all cameras; push machine."""

    def __init__(self) -> None:
        self._spans: dict[str, _Span] = {}

    def push(self, message: Detections) -> None:
        """Count one frame, unless it is older than the last or of another process."""
        known = self._spans.get(message.camera)
        if known is None:
            self._spans[message.camera] = _Span(message.session, message.seq, message.t_ns)
            return
        if message.session == known.session:
            if message.seq <= known.seq or message.t_ns <= known.t_ns:
                return
            known.frames += message.seq - known.seq
            known.received += 1
            known.span_ns += message.t_ns - known.t_ns
        known.session, known.seq, known.t_ns = message.session, message.seq, message.t_ns

    @property
    def camera_hz(self) -> dict[str, float]:
        """Camera -> frames it took per second; only cameras of which two frames came."""
        return {name: _hz(span.frames, span.span_ns) for name, span in self._running()}

    @property
    def received_hz(self) -> dict[str, float]:
        """Camera -> frames that were searched for markers and arrived, per second."""
        return {name: _hz(span.received, span.span_ns) for name, span in self._running()}

    def _running(self) -> list[tuple[str, _Span]]:
        # A copy at once: the loop pushes while a report is made.
        return [(name, span) for name, span in dict(self._spans).items() if span.span_ns > 0]


def _hz(frames: int, span_ns: int) -> float:
    return round(frames * 1e9 / span_ns, 2)


@dataclass(frozen=True, slots=True)
class Phase:
    """Phase of one camera."""

    phase_us: float  # later than the leading camera's frame [us], within half a period
    spread_us: float  # standard deviation [us] over the last frames


class CameraPhases:
    """Monitor of the exposure phases of the cameras; push machine."""

    def __init__(self, frame_rate_hz: Mapping[str, float]) -> None:
        """Take the cameras in the rig's order, the leading one first, with nominal rates."""
        self._leader = next(iter(frame_rate_hz))
        self._period_ns = 1e9 / frame_rate_hz[self._leader]
        self._lead_ns: int | None = None
        frames = 64
        self._fractions = {
            name: deque[float](maxlen=frames) for name in frame_rate_hz if name != self._leader
        }
        self._near = dict.fromkeys(self._fractions, 0)
        self._in_step: dict[str, bool | None] = dict.fromkeys(self._fractions)

    def push(self, message: MarkerDetections) -> None:
        """Take one frame, on the master's clock."""
        if message.camera == self._leader:
            self._lead_ns = message.t_ns
        elif self._lead_ns is not None and (fractions := self._fractions.get(message.camera)) is not None:
            fractions.append((message.t_ns - self._lead_ns) / self._period_ns)

    def phases(self) -> dict[str, Phase]:
        """Phase (mean direction on a circle) of each other camera with enough frames."""
        found: dict[str, Phase] = {}
        for name, fractions in self._fractions.items():
            kept = np.array(fractions.copy())
            at_least = 16
            if len(kept) < at_least:
                continue
            mean = np.exp(2j * np.pi * kept).mean()
            to_us = 1e-3 * self._period_ns / (2.0 * np.pi)
            spread = np.sqrt(-2.0 * np.log(min(max(abs(mean), 1e-9), 1.0)))
            found[name] = Phase(float(np.angle(mean)) * to_us, float(spread) * to_us)
        return found

    def look(self) -> list[str]:
        """Called once a second: a line for each camera that fell in step, or out of it."""
        lines: list[str] = []
        for name, phase in self.phases().items():
            # a third of the 1.5 ms that cost 2 % of depth at 1 m/s; libcamera's own synchronisation: some 10 us
            in_step_us = 500.0
            near = abs(phase.phase_us) <= in_step_us and phase.spread_us <= in_step_us
            self._near[name] = self._near[name] + 1 if near else 0
            was = self._in_step[name]
            looks = 10  # in a row: cameras whose rates differ by 50 ppm are out of the band after that
            now = self._near[name] >= looks if near else False
            if near and not now:
                continue  # not yet reported
            if now != was:
                self._in_step[name] = now
                state = "in step with" if now else "free of"
                lines.append(
                    f"camera {name}: {state} {self._leader}, {1e-3 * phase.phase_us:+.2f} ms"
                    f" (spread {1e-3 * phase.spread_us:.2f} ms)"
                )
        return lines
