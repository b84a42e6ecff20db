"""Camera frame rates and frame arrival rates.

How fast the cameras run, and how many of their frames arrive: two rates that are easily confused.

A camera's rate is that of its frame counter over its capture times, whether or not somebody had time for the frames
in between; the rate of arrival counts the frames that were searched, sent and received.
"""

from dataclasses import dataclass

from common.messages import Detections


@dataclass(slots=True)
class _Span:
    """Frame count of one camera.

    Its last frame, and the sums between the frames of one process of its slave.
    """

    session: int
    seq: int
    t_ns: int
    frames: int = 0
    received: int = 0
    span_ns: int = 0


class CameraRates:
    """Estimator of the frame rates of all cameras.

    Push machine. Holds for each camera the last frame, and frames, arrivals and time since the first.
    """

    def __init__(self) -> None:
        self._spans: dict[str, _Span] = {}

    def push(self, message: Detections) -> None:
        """Count one frame.

        A frame older than the last is not counted, and nothing between two processes of a slave.
        """
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
