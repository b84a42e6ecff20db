"""`phalanx-slave run --tracker`: sends where a tracker on an object is."""

import argparse
import os
import threading

from common.calibration import RigCalibration
from common.calibration.object_profile import ObjectProfile
from common.clock import SkewedClock, SystemClock
from common.errors import PhalanxError
from common.terminal import echo
from slave import devices
from slave.commands.options import clock_of, epoch_of, rig_of, secrets_of, tree_of, world_of
from slave.service import ConnectionLost, Service
from slave.sources import TrackerSource
from slave.stopping import stop_by_signal


def send_tracker(options: argparse.Namespace) -> int:
    """Send poses until stopped.

    Raises:
        PhalanxError: A file, the tracker, a key or the network is not as it must be.
    """
    from slave.sender import Sender, send_poses
    from slave.uplink import Uplink

    rig = rig_of(options)
    profile = devices.object_with(tree_of(options), rig, options.name)
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
        sender = Sender(options.name, uplink, clock, stop, print_line, service, access)
        send_poses(sender, source, recorded)
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
        return devices.open_tracker(options.name, *named, clock, stop, connection_lost)
    from slave.simulated import TRACKER_HZ, SyntheticSensor, poses_of, tracker_of

    epoch_ns = epoch_of(options, true_clock)
    tracker = tracker_of(*world_of(options, rig), options.scene, options.seed, profile)
    return SyntheticSensor(poses_of(options.name, tracker), TRACKER_HZ, epoch_ns, clock, stop)
