"""What the network tests share: free addresses, patience, and messages to send."""

import random
import socket
import time
from collections.abc import Callable

import numpy as np

from bench.rigs.local import free_port
from common.clock import Clock
from common.messages import FINGER_COUNT, Health, MarkerDetections, WristDetections
from master.run.ingest import Ingest

PATIENCE_S = (
    60.0  # what a test waits for comes at once; a machine with other things to do may take as long as this
)


def free_endpoint() -> str:
    """Return a zenoh endpoint on 127.0.0.1 that nobody listens on."""
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"


def free_udp_port() -> int:
    """Return a UDP port that nobody is bound to."""
    return free_port(socket.SOCK_DGRAM)


def until(condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
    """Wait until `condition` holds; False if it never did."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


def clock_known(ingest: Ingest, sender: str, bound_ns: int = 5_000_000) -> bool:
    """Wait until times of `sender` are moved with an error of at most half a round trip of `bound_ns`."""

    def known() -> bool:
        estimate = ingest.clock_of(sender)
        return estimate is not None and estimate.bound_ns < bound_ns

    return until(known)


def health(source: str, frames: int = 0) -> Health:
    """Return a small message."""
    return Health(source, 1, 2, {"frames": frames}, {"rate_hz": 60.0})


class ManualClock(Clock):
    """A clock that stands still until it is told."""

    def __init__(self, t_ns: int = 0) -> None:
        self.t_ns = t_ns

    def now_ns(self) -> int:
        return self.t_ns


def detections(camera: str, session: int, seq: int, t_ns: int = 0) -> MarkerDetections:
    """Return a frame with six markers."""
    uv = np.arange(12.0).reshape(6, 2)
    ones, nowhere = np.ones(6), np.full((6, 2), np.nan)
    return MarkerDetections(
        camera, session, seq, t_ns, t_ns + 1000, uv, 50.0 * ones, ones, 0.1 * ones, nowhere
    )


def cycle(camera: str, session: int, seq: int, t_ns: int = 0) -> WristDetections:
    """Return what a wrist device saw in one strobed triple; nobody saw the little finger."""
    uv = np.arange(2.0 * FINGER_COUNT).reshape(FINGER_COUNT, 2)
    uv[-1] = np.nan
    seen = np.where(np.isnan(uv[:, 0]), np.nan, 1.0)
    return WristDetections(
        camera, session, seq, t_ns, t_ns + 1000, uv, 0.2 * seen, 9.0 * seen, uv + 30.0, seen, 0.1 * seen
    )


def seeded(seed: int) -> Callable[[int], bytes]:
    """Return a source of random bytes that repeats."""
    return random.Random(seed).randbytes
