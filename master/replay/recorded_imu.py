"""IMU data of a recording for one hand.

With the setup that has the accuracy of these data.
"""

import logging
from dataclasses import replace as with_fields
from math import isfinite

import numpy as np
from msgspec.structs import replace

from common.calibration import ImuCalibration
from common.imu.fusion import OrientationFilter
from common.imu.recording import IMU, read_imu
from common.messages import ImuSample
from common.recording.frame_recording import FrameRecording
from master.rig.setup import RigSetup

_UNPLACED = (
    "imu.q_palm_imu and imu.q_rig_world do not both state how the IMU is mounted and how its world lies to the rig; a "
    "wrist rig alone needs the former"
)
_LOG = logging.getLogger(__name__)


def recorded_samples(recording: FrameRecording, setup: RigSetup) -> tuple[tuple[ImuSample, ...], RigSetup]:
    """Return the recording's IMU samples with orientation, and their setup.

    The setup has the accuracy of these samples.

    A recording without quaternions is of a sensor that measures only rates and forces: the filter of a live slave makes
    its orientation of them. The heading of that begins anywhere, whatever the rig's file states of it.

    Raises:
        RecordingError: imu.csv is broken.
    """
    imu = _imu_of(setup)
    if imu is None or not (imu.placed if setup.has_markers else imu.q_palm_imu is not None):
        others = imu is None and any(rig.imu is not None for rig in recording.manifest.all_rigs)
        if (path := recording.folder / IMU).exists() and not others:
            _LOG.warning("%s: not used: rig %r: %s", path, setup.rig.name, _UNPLACED)
        return (), setup
    samples = read_imu(recording.folder, imu.name)
    oriented = any(np.isfinite(one.orientation_wxyz).all() for one in samples)
    reckoned = not oriented or any(isfinite(one.heading_sigma_rad) for one in samples)
    if reckoned and samples and imu.heading_sigma_rad is not None:
        _LOG.warning(
            "%s: orientations of rates and forces: imu.heading_sigma_rad not used", recording.folder / IMU
        )
        setup = _with_imu(setup, replace(imu, heading_sigma_rad=None))
    if oriented:
        return samples, setup
    fusion = OrientationFilter(imu.rate_hz)
    return tuple(fusion.push(one) for one in samples), setup


def _imu_of(setup: RigSetup) -> ImuCalibration | None:
    """The hand's IMU: on the palm, or on the forearm."""
    if setup.rig.imu is not None or setup.wrist_rig is None:
        return setup.rig.imu
    return setup.wrist_rig.imu


def _with_imu(setup: RigSetup, imu: ImuCalibration) -> RigSetup:
    """Return the setup with the accuracy of its IMU replaced."""
    if setup.has_markers and setup.rig.imu is not None:
        return with_fields(setup, rig=replace(setup.rig, imu=imu))
    if setup.wrist is None or setup.wrist_rig is None:
        return setup
    wrist_rig = replace(setup.wrist_rig, imu=imu)
    rig = setup.rig if setup.has_markers else wrist_rig
    return with_fields(setup, rig=rig, wrist=with_fields(setup.wrist, imu=imu), wrist_rig=wrist_rig)
