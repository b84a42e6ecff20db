"""`phalanx-slave tracker`: sends where a tracker on an object is."""

import argparse
import os
import threading
from collections.abc import Callable

from common.calibration import RigCalibration
from common.clock import SkewedClock, SystemClock
from common.errors import PhalanxError
from common.object_profile import ObjectProfile
from slave import devices
from slave.commands.device_options import add_tracker_options
from slave.commands.options import (
    add_link,
    add_rig,
    add_simulated,
    clock_of,
    epoch_of,
    rig_of,
    secrets_of,
    world_of,
)
from slave.service import ConnectionLost, Service
from slave.sources import TrackerSource
from slave.stopping import stop_by_signal

PURPOSE = "send where a Vive tracker is"
EXAMPLES = """\
  phalanx-slave tracker tracker --rig desk-tracker --device openvr --key-file rig.key
        by SteamVR on this PC: needs the extra `vive` and SteamVR running; docs/tracker.md
  phalanx-slave tracker tracker --rig desk-tracker --device survive --serial LHR-1A2B3C4D --key-file rig.key
        by libsurvive: starts survive-cli and reads its lines
  phalanx-slave tracker tracker --rig desk-tracker --device survive:walk.rec.gz --key-file rig.key
        what survive-cli --record wrote, at its pace
  phalanx-slave tracker tracker --rig desk-tracker --device synthetic --scene object --bind 127.0.0.1 --key-file rig.key
        a tracker on the object of the simulated scene
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """The options of `tracker`."""
    command.add_argument("name", metavar="NAME", help="the `tracker` of an object of the rig")
    add_rig(command)
    add_tracker_options(command)
    add_link(command)
    add_simulated(command.add_argument_group("synthetic tracker").add_argument)


def run(options: argparse.Namespace, notify: Callable[[str], None]) -> int:
    """Send poses until it is told to end.

    Raises:
        PhalanxError: A file, the tracker, a key or the network is not as it must be.
    """
    from slave.sender import Sender, send_poses
    from slave.uplink import Uplink

    rig = rig_of(options)
    profile = devices.object_with(options.calibration, rig, options.name)
    true_clock = SystemClock()
    clock = clock_of(options, true_clock)
    key, access = secrets_of(options)

    def tell(line: str) -> None:
        notify(f"{options.name}: {line}")

    service = Service(os.environ, noun="poses")
    with stop_by_signal() as stop:
        source = _open(options, rig, profile, clock, true_clock, stop, service.connection_lost)
        try:
            uplink = Uplink(options.name, key, clock, options.beacon_port, options.bind)
        except PhalanxError:
            source.close()
            raise
        recorded = options.device.startswith("survive:")
        sender = Sender(options.name, uplink, clock, stop, tell, service, access)
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
    if options.device != "synthetic":
        named = options.device, options.serial, options.program
        return devices.open_tracker(options.name, *named, clock, stop, connection_lost)
    from slave.simulated import TRACKER_HZ, SyntheticSensor, poses_of, tracker_of

    epoch_ns = epoch_of(options, true_clock)
    tracker = tracker_of(*world_of(options, rig), options.scene, options.seed, profile)
    return SyntheticSensor(poses_of(options.name, tracker), TRACKER_HZ, epoch_ns, clock, stop)
