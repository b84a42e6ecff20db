"""A live slave beside a tracking system: pose in, one sealed datagram out, reports meanwhile, until told to stop."""

import gc
import threading
from collections.abc import Callable

from msgspec.structs import replace

from common.clock import Clock
from common.keys import Access
from common.zenoh_bus import ZenohBus
from slave.app import POLL_S, Barrier, Sender, nothing
from slave.objects.counters import PoseCounters
from slave.report import Reporter
from slave.service import Service
from slave.sources import TrackerSource
from slave.uplink import Uplink

CHECK_S = 0.5e-3  # between two poses it is looked whether the master has started


def wait_for_start(
    source: TrackerSource,
    barrier: Barrier,
    stop: threading.Event,
    recorded: bool = False,
    alive: Callable[[], None] = nothing,
) -> bool:
    """Wait for the master as long as it takes; False if told to stop before, or the source has ended.

    Poses are read meanwhile, and forgotten, so that none grows old in a buffer; those of a recording wait.

    Raises:
        TrackerError: The tracking system is gone.
    """
    while not stop.is_set():
        if barrier.wait_for_start(POLL_S if recorded else CHECK_S):
            return True
        if not recorded and source.read() is None:
            return False
        alive()
    return False


def run(
    source: TrackerSource,
    sender: Sender,
    counters: PoseCounters,
    stop: threading.Event,
    alive: Callable[[], None] = nothing,
) -> None:
    """Send every pose until the source ends or `stop` is set.

    Raises:
        TrackerError: The tracking system is gone.
    """
    while not stop.is_set() and (pose := source.read()) is not None:
        sender.send(replace(pose, session=sender.session))
        counters.pose(pose)
        alive()


def run_live(
    name: str,
    source: TrackerSource,
    uplink: Uplink,
    clock: Clock,
    stop: threading.Event,
    notify: Callable[[str], None],
    service: Service,
    access: Access,
    recorded: bool = False,
) -> None:
    """Wait for the master, then send until `stop` is set or the source ends; closes source and uplink.

    Args:
        name: The `tracker` of an object of the rig.
        source: The open tracker.
        uplink: Where poses go.
        clock: The slave's clock.
        stop: Set by a signal handler, or by the command "stop" on the bus.
        say: Told one line when it is ready, and one at the end.
        service: Told what it does, for the system's service manager.
        access: How it comes to the master's bus.
        recorded: The source is a recording, of which nothing is to be missed.

    Raises:
        TrackerError: The tracking system is gone.
    """
    counters = PoseCounters(source)
    reporter = Reporter(
        name, uplink, counters, clock, lambda endpoint: ZenohBus(None, endpoint, access), stop.set
    )
    try:
        gc.collect()
        gc.freeze()  # what lives until the end is never walked again: no pause in the loop
        notify("ready, waiting for the master")
        service.ready(lambda: uplink.started)
        if wait_for_start(source, uplink, stop, recorded, service.waiting):
            run(source, uplink, counters, stop, service.working)
    finally:
        service.stopping()
        reporter.close()
        uplink.close()
        source.close()
    counts = counters.counts()
    notify(f"{counts['poses']} poses, {counts['nowhere']} of them nowhere, sent {uplink.counts['sent']}")
