"""From JSON to pipeline: reads rig, cameras and hand of a calibration folder and joins the parts they name."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.camera_model import CameraModel
from common.errors import CalibrationError
from common.geometry import cross
from common.hand_model import HandModel
from master.filters import OneEuroParameters, PointFilter
from master.ik.hand_filter import HandFilter
from master.ik.tracker import HandTracker
from master.stereo.depth import depth_law
from master.stereo.pairing import Pairing
from master.stereo.pipeline import MarkerPipeline, Stage
from master.stereo.place import CalibrationResidual


@dataclass(frozen=True, slots=True, eq=False)
class RigSetup:
    """A rig with everything its file refers to, checked.

    Attributes:
        rig: The rig file.
        cameras: Camera files by name, in the rig's order.
        models: The same as camera models, placed in the rig.
        hand: The hand model.
    """

    rig: RigCalibration
    cameras: dict[str, CameraCalibration]
    models: dict[str, CameraModel]
    hand: HandModel

    @property
    def hand_markers(self) -> tuple[str, ...]:
        """The rig's markers that sit on the hand, in the rig's order."""
        return tuple(name for name in self.rig.markers if name not in self.rig.free_markers)

    @property
    def imus(self) -> tuple[str, ...]:
        """The rig's IMU, if it has one."""
        return () if self.rig.imu is None else (self.rig.imu.name,)

    @classmethod
    def of(cls, rig: RigCalibration, cameras: dict[str, CameraCalibration], hand: HandModel) -> "RigSetup":
        """Join the files.

        Raises:
            CalibrationError: A camera of the rig is missing or has no intrinsics, fewer than two cameras, a
                marker the hand does not mount and that is not free, or a rig that is not of kind "markers".
        """
        if rig.kind != "markers":
            raise CalibrationError(f"rig {rig.name!r}: kind is {rig.kind!r}, this command needs 'markers'")
        if len(rig.cameras) < 2:
            raise CalibrationError(f"rig {rig.name!r}: cameras: two or more are needed")
        missing = [name for name in rig.cameras if name not in cameras]
        if missing:
            raise CalibrationError(f"rig {rig.name!r}: no camera file for {missing[0]!r}")
        for name in rig.markers:
            if name not in rig.free_markers:
                hand.mount(name)
        ordered = {name: cameras[name] for name in rig.cameras}
        models = {name: CameraModel.of(camera, rig.camera_pose(name)) for name, camera in ordered.items()}
        return cls(rig, ordered, models, hand)


def load_setup(calibration: Path, rig_name: str, hand_file: Path | None = None) -> RigSetup:
    """Read rigs/<rig>.json, its cameras and its hand from a calib_json tree.

    Raises:
        CalibrationError: A file is missing, broken or contradicts another.
    """
    rig = load(calibration / "rigs" / f"{rig_name}.json", RigCalibration)
    cameras = {
        name: load(calibration / "cameras" / f"{name}.json", CameraCalibration) for name in rig.cameras
    }
    return RigSetup.of(rig, cameras, load_hand(calibration, rig.hand, hand_file))


def load_hand(calibration: Path | None, name: str, hand_file: Path | None) -> HandModel:
    """The hand of a rig: `hand_file` if given, else <calibration>/hands/<name>.json.

    Raises:
        CalibrationError: Neither is there, or the profile is broken.
    """
    if hand_file is None:
        if calibration is None:
            raise CalibrationError(
                f"hand {name!r}: give --hand FILE, or --calibration DIR with hands/{name}.json"
            )
        hand_file = calibration / "hands" / f"{name}.json"
        if not hand_file.exists():
            raise CalibrationError(f"{hand_file}: no such hand profile: give --hand FILE")
    profile = load(hand_file, HandProfile)
    try:
        return HandModel.of(profile)
    except CalibrationError as error:
        raise CalibrationError(f"{hand_file}: {error}") from error


def point_filter(setup: RigSetup) -> PointFilter:
    """The filter this rig's file describes, along the mean sight of its cameras and across it."""
    settings = setup.rig.filter
    poses = np.array([model.T_rig_camera for model in setup.models.values()])
    ahead = poses[:, :3, 2].sum(axis=0)
    across = cross(poses[0, :3, 1], ahead)
    view = np.stack([across, cross(ahead, across), ahead])
    return PointFilter(
        OneEuroParameters(settings.min_cutoff_hz, settings.beta, settings.d_cutoff_hz),
        settings.jitter_m,
        view / np.linalg.norm(view, axis=1, keepdims=True),
    )


def hand_filter(setup: RigSetup) -> HandFilter:
    """The filter of the solved hand, which leaves no more jitter than that of the points may."""
    return HandFilter(setup.hand, setup.hand_markers, setup.rig.filter.jitter_m)


def build_pipeline(
    setup: RigSetup, stage: Stage, *, continuous: bool = True, tracker: HandTracker | None = None
) -> MarkerPipeline:
    """The pipeline this rig's file describes.

    Args:
        setup: The rig.
        stage: Measures the stages.
        continuous: False: every frame is an unrelated pose; no filter, no memory.
        tracker: Tracks the hand; None: a new one, which takes most of the time.

    Raises:
        CalibrationError: The depth model does not fit the rig.
    """
    rates = {name: camera.frame_rate_hz for name, camera in setup.cameras.items()}
    return MarkerPipeline(
        setup.models,
        setup.hand,
        setup.rig.markers,
        pairing=Pairing(setup.models, rates, policy=setup.rig.pairing, continuous=continuous),
        law=depth_law(setup.rig),
        residual=CalibrationResidual.of(setup.rig),
        smooth=point_filter(setup) if continuous else None,
        tracker=HandTracker(setup.hand, setup.hand_markers, continuous=continuous)
        if tracker is None
        else tracker,
        steady=hand_filter(setup) if continuous else None,
        stamp_offset_us=setup.rig.stamp_offset_us,
        volume=setup.rig.volume,
        imu=setup.rig.imu,
        stage=stage,
    )
