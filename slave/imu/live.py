"""A live slave beside an IMU: sample in, one sealed datagram out, reports meanwhile, until it is told to stop."""

import gc
import threading
from collections.abc import Callable

from msgspec.structs import replace

from common.clock import Clock
from common.zenoh_bus import ZenohBus
from slave.app import Sender, wait_for_start
from slave.imu.source import ImuSource
from slave.report import Reporter
from slave.tally import Tally
from slave.uplink import Uplink


class SampleTally:
    """Counts samples, and those left out, for `Health`. Holds the counters, one sample like one frame."""

    def __init__(self) -> None:
        """Count from nothing."""
        self._tally = Tally(())

    def sample(self, seq: int) -> None:
        """Count one sample; a gap in their numbers counts as left out."""
        self._tally.part(seq)

    def counts(self) -> dict[str, int]:
        """Event -> how often since the start: samples, skipped."""
        counts = self._tally.counts()
        return {"samples": counts["frames"], "skipped": counts["dropped"]}

    def gauges(self) -> dict[str, float]:
        """rate_hz since the last call."""
        return {"rate_hz": self._tally.gauges()["rate_hz"]}


def run(source: ImuSource, sender: Sender, tally: SampleTally, stop: threading.Event) -> None:
    """Send every sample until the source ends or `stop` is set.

    Raises:
        ImuError: The IMU is gone.
    """
    while not stop.is_set() and (sample := source.read()) is not None:
        sender.send(replace(sample, session=sender.session))
        tally.sample(sample.seq)


def run_live(
    name: str,
    source: ImuSource,
    uplink: Uplink,
    clock: Clock,
    stop: threading.Event,
    say: Callable[[str], None],
) -> None:
    """Wait for the master, then send until `stop` is set or the source ends; closes source and uplink.

    Args:
        name: The rig's IMU.
        source: The open IMU.
        uplink: Where samples go.
        clock: The slave's clock.
        stop: Set by a signal handler, or by the command "stop" on the bus.
        say: Told one line when it is ready, and one at the end.

    Raises:
        ImuError: The IMU is gone.
    """
    tally = SampleTally()
    reporter = Reporter(name, uplink, tally, clock, lambda endpoint: ZenohBus(None, endpoint), stop.set)
    try:
        gc.collect()
        gc.freeze()  # what lives until the end is never walked again: no pause in the loop
        say("ready, waiting for the master")
        if wait_for_start(uplink, stop):
            run(source, uplink, tally, stop)
    finally:
        reporter.close()
        uplink.close()
        source.close()
    say(f"{tally.counts()['samples']} samples, sent {uplink.counts['sent']}")
