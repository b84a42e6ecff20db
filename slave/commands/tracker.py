"""`phalanx-slave run --tracker`: sends where a tracker on an object is."""

import argparse
import os
import threading

from common.calibration import RigCalibration
from common.clock import SkewedClock, SystemClock
from common.errors import PhalanxError
from common.object_profile import ObjectProfile
from common.terminal import echo
from slave.commands.options import clock_of, epoch_of, rig_of, secrets_of, tree_of, world_of
from slave.objects import factory
from slave.objects.source import TrackerSource
from slave.service import ConnectionLost, Service
from slave.stopping import stop_by_signal


def send_tracker(options: argparse.Namespace) -> int:
    """Send poses until it is told to end.

    Raises:
        PhalanxError: A file, the tracker, a key or the network is not as it must be.
    """
    from slave.objects.live import run_live
    from slave.uplink import Uplink

    rig = rig_of(options)
    profile = factory.object_with(tree_of(options), rig, options.name)
    true_clock = SystemClock()
    clock = clock_of(options, true_clock)
    key, access = secrets_of(options)

    def print_line(line: str) -> None:
        echo(f"{options.name}: {line}")

    service = Service(os.environ, noun="poses")
    with stop_by_signal() as stop:
        source = _open(options, rig, profile, clock, true_clock, stop, service.connection_lost)
        try:
            uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)
        except PhalanxError:
            source.close()
            raise
        recorded = options.tracker.startswith("survive:")
        run_live(options.name, source, uplink, clock, stop, print_line, service, access, recorded)
    return 0


def _open(
    options: argparse.Namespace,
    rig: RigCalibration,
    profile: ObjectProfile,
    clock: SkewedClock,
    true_clock: SystemClock,
    stop: threading.Event,
    connection_lost: ConnectionLost,
) -> TrackerSource:
    if options.tracker != "synthetic":
        named = options.tracker, options.serial, options.program
        return factory.open_real(options.name, *named, clock, stop, connection_lost)
    from slave.objects.synthetic import SyntheticTracker
    from slave.simulated import tracker_of

    epoch_ns = epoch_of(options, true_clock)
    tracker = tracker_of(*world_of(options, rig), options.scene, options.seed, profile)
    return SyntheticTracker(options.name, tracker, epoch_ns, clock, stop)
