"""Read what the options of several commands name: files, clocks, keys.

A file or key that is not as it must be raises the `PhalanxError` of its kind.
"""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from common.calibration import CameraCalibration, RigCalibration, load
from common.calibration.object_profile import ObjectProfile
from common.clock import Clock, SkewedClock
from common.errors import CalibrationError

if TYPE_CHECKING:
    from common.bus.keys import Access
    from common.link.datagram import LinkKey

DEFAULT_RIG = "desk"
DEFAULT_TREE = Path("calib_json")


def rig_of(options: argparse.Namespace, typical: str = DEFAULT_RIG) -> RigCalibration:
    """The rig; `typical` if none is named."""
    return load(rig_path(options, typical), RigCalibration)


def camera_of(options: argparse.Namespace) -> tuple[RigCalibration, CameraCalibration]:
    """The rig, and the camera of this slave."""
    rig = rig_of(options)
    if options.name not in rig.cameras:
        raise CalibrationError(
            f"rig {rig.name!r} has no camera {options.name!r}; it has {', '.join(rig.cameras)}"
        )
    return rig, load(camera_path(options, options.name), CameraCalibration)


def objects_of(options: argparse.Namespace, rig: RigCalibration) -> dict[str, ObjectProfile]:
    """The objects of the rig, by name."""
    return {name: load(tree_of(options) / "objects" / f"{name}.json", ObjectProfile) for name in rig.objects}


def tree_of(options: argparse.Namespace) -> Path:
    """The calib_json tree."""
    return options.calibration or DEFAULT_TREE


def rig_path(options: argparse.Namespace, typical: str = DEFAULT_RIG) -> Path:
    """The rig file; of the rig `typical` if none is named."""
    return tree_of(options) / "rigs" / f"{options.rig or typical}.json"


def camera_path(options: argparse.Namespace, camera: str) -> Path:
    """The file of a camera."""
    return tree_of(options) / "cameras" / f"{camera}.json"


def world_of(options: argparse.Namespace, rig: RigCalibration) -> tuple[Path, RigCalibration, str, int]:
    """Folder and rig of the simulated world, and name and seed of its scene.

    See `slave.commands.simulated.world_of`.
    """
    from slave.commands.simulated import world_of as world

    return *world(tree_of(options), rig, options.truth, options.truth_rig), options.scene, options.seed


def clock_of(options: argparse.Namespace, true_clock: Clock) -> SkewedClock:
    """The slave's clock, which a simulated machine may have ahead of the true one."""
    return SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)


def skew_of(options: argparse.Namespace, true_clock: Clock) -> str:
    """How the slave's clock differs from the machine's, to compare recordings by."""
    skewed = f" {options.clock_offset_ms:+g} ms" if options.clock_offset_ms else ""
    return skewed + (f" {options.clock_ppm:+g} ppm from {true_clock.now_ns()}" if options.clock_ppm else "")


def secrets_of(options: argparse.Namespace) -> "tuple[LinkKey, Access]":
    """What this device seals its datagrams by, and how it comes to the bus."""
    from common.bus.keys import access_of, link_key

    access = access_of(os.environ, options.name, options.keys, options.open)
    if access.folder is not None:
        access.identity()  # reported now, not when a master is received
    return link_key(os.environ, options.key_file, options.keys, options.name), access
