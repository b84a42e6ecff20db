"""What the options of several commands name: files of calib_json, clocks, keys."""

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
    from common.link.link_key import LinkKey

USUAL_RIG = "desk"
USUAL_TREE = Path("calib_json")


def rig_of(options: argparse.Namespace, typical: str = USUAL_RIG) -> RigCalibration:
    """The rig; `typical` if none is named.

    Raises:
        CalibrationError: Its file is missing or broken.
    """
    return load(rig_path(options, typical), RigCalibration)


def camera_of(options: argparse.Namespace) -> tuple[RigCalibration, CameraCalibration]:
    """The rig, and the camera of this slave.

    Raises:
        CalibrationError: It is none of the rig, or a file is missing or broken.
    """
    rig = rig_of(options)
    if options.name not in rig.cameras:
        raise CalibrationError(
            f"rig {rig.name!r} has no camera {options.name!r}; it has {', '.join(rig.cameras)}"
        )
    return rig, load(camera_path(options, options.name), CameraCalibration)


def objects_of(options: argparse.Namespace, rig: RigCalibration) -> dict[str, ObjectProfile]:
    """The objects of the rig, by name.

    Raises:
        CalibrationError: A file is missing or broken.
    """
    return {name: load(tree_of(options) / "objects" / f"{name}.json", ObjectProfile) for name in rig.objects}


def tree_of(options: argparse.Namespace) -> Path:
    """The calib_json tree."""
    return options.calibration or USUAL_TREE


def rig_path(options: argparse.Namespace, typical: str = USUAL_RIG) -> Path:
    """The rig file; of the rig `typical` if none is named."""
    return tree_of(options) / "rigs" / f"{options.rig or typical}.json"


def camera_path(options: argparse.Namespace, camera: str) -> Path:
    """The file of a camera."""
    return tree_of(options) / "cameras" / f"{camera}.json"


def world_of(options: argparse.Namespace, rig: RigCalibration) -> tuple[Path, RigCalibration]:
    """Return folder and rig of the files that describe the simulated world.

    Raises:
        CalibrationError: As `slave.simulated.world_of`.
    """
    from slave.simulated import world_of as world

    return world(tree_of(options), rig, options.truth, options.truth_rig)


def epoch_of(options: argparse.Namespace, true_clock: Clock) -> int:
    """Scene time 0 on the true clock [ns]."""
    return true_clock.now_ns() if options.scene_epoch_ns is None else options.scene_epoch_ns


def clock_of(options: argparse.Namespace, true_clock: Clock) -> SkewedClock:
    """The slave's clock, which a simulated machine may have ahead of the true one."""
    return SkewedClock(round(options.clock_offset_ms * 1e6), options.clock_ppm, true_clock)


def skew_of(options: argparse.Namespace, true_clock: Clock) -> str:
    """Describe how the slave's clock differs from the machine's.

    It is for whoever compares two recordings; empty if there is no difference.
    """
    skewed = f" {options.clock_offset_ms:+g} ms" if options.clock_offset_ms else ""
    return skewed + (f" {options.clock_ppm:+g} ppm from {true_clock.now_ns()}" if options.clock_ppm else "")


def secrets_of(options: argparse.Namespace) -> "tuple[LinkKey, Access]":
    """What this device seals its datagrams by, and how it comes to the bus.

    Raises:
        PhalanxError: There is no rig key, or the keys folder has no certificate or no secret of this device.
    """
    from common.bus.keys import access_of, link_key

    access = access_of(os.environ, options.name, options.keys, options.open)
    if access.folder is not None:
        access.identity()  # reported now, not when a master is received
    return link_key(os.environ, options.key_file, options.keys, options.name), access
