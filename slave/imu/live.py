"""A live slave beside an IMU: sample in, one sealed datagram out, reports meanwhile, until it is told to stop."""

import gc
import threading
from collections.abc import Callable

from msgspec.structs import replace

from common.clock import Clock
from common.keys import Access
from common.zenoh_bus import ZenohBus
from slave.app import Barrier, Sender, nothing
from slave.imu.counters import Orientation, SampleCounters
from slave.report import Reporter
from slave.service import Service
from slave.sources import ImuSource
from slave.uplink import Uplink

CHECK_S = 0.5e-3  # between two samples it is looked whether the master has started


def wait_for_start(
    source: ImuSource,
    barrier: Barrier,
    stop: threading.Event,
    orientation: Orientation | None = None,
    alive: Callable[[], None] = nothing,
    failed: Callable[[int, Exception], None] | None = None,
) -> bool:
    """Wait for the master as long as it takes; False if told to stop before, or the source has ended.

    Samples are read meanwhile, and forgotten: none grows old in a buffer, and the filter knows its bias when it starts.
    `failed` is told of a sample of which the filter raised something.

    Raises:
        ImuError: The IMU is gone.
    """
    while not stop.is_set():
        if barrier.wait_for_start(CHECK_S):
            return True
        if (sample := source.read()) is None:
            return False
        try:
            if orientation is not None:
                orientation.push(sample)
        except Exception as error:
            if failed is None:
                raise
            failed(sample.seq, error)
        alive()
    return False


def run(
    source: ImuSource,
    sender: Sender,
    counters: SampleCounters,
    stop: threading.Event,
    orientation: Orientation | None = None,
    alive: Callable[[], None] = nothing,
) -> None:
    """Send every sample until the source ends or `stop` is set.

    Its orientation is that of the filter, without one the sensor's own; rates and forces stay as they were measured. A
    sample of which the filter raises something is left out.

    Raises:
        ImuError: The IMU is gone.
    """
    while not stop.is_set() and (sample := source.read()) is not None:
        try:
            levelled = sample if orientation is None else orientation.push(sample)
            sender.send(replace(levelled, session=sender.session))
            counters.sample(sample.seq)
            alive()
        except Exception as error:  # noqa: BLE001 - one sample; it is counted and logged
            counters.failed(sample.seq, error)


def run_live(
    name: str,
    source: ImuSource,
    orientation: Orientation | None,
    uplink: Uplink,
    clock: Clock,
    stop: threading.Event,
    notify: Callable[[str], None],
    service: Service,
    access: Access,
) -> None:
    """Wait for the master, then send until `stop` is set or the source ends; closes source and uplink.

    Args:
        name: The rig's IMU.
        source: The open IMU.
        orientation: Makes the orientation of the samples; None: the sensor's own is sent.
        uplink: Where samples go.
        clock: The slave's clock.
        stop: Set by a signal handler, or by the command "stop" on the bus.
        say: Told one line when it is ready, and one at the end.
        service: Told what it does, for the system's service manager.
        access: How it comes to the master's bus.

    Raises:
        ImuError: The IMU is gone.
    """
    counters = SampleCounters(source, orientation)
    reporter = Reporter(
        name, uplink, counters, clock, lambda endpoint: ZenohBus(None, endpoint, access), stop.set
    )
    try:
        gc.collect()
        gc.freeze()  # what lives until the end is never walked again: no pause in the loop
        notify("ready, waiting for the master")
        service.ready(lambda: uplink.started)
        if wait_for_start(source, uplink, stop, orientation, service.waiting, counters.failed):
            run(source, uplink, counters, stop, orientation, service.working)
    finally:
        service.stopping()
        reporter.close()
        uplink.close()
        source.close()
    notify(f"{counters.counts()['samples']} samples, sent {uplink.counts['sent']}")
