"""From JSON to pipeline: reads rig, cameras and hand of a calibration folder and joins the parts they name."""

from collections import Counter
from dataclasses import dataclass
from math import nan
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from common.arrays import Float
from common.calibration import CameraCalibration, HandProfile, RigCalibration, load
from common.camera_model import CameraModel
from common.errors import CalibrationError
from common.geometry import cross
from common.hand_model import HandModel
from common.messages import Detections
from master.filters import OneEuroParameters, PointFilter
from master.ik.hand_filter import HandFilter
from master.ik.tracker import HandTracker
from master.stereo.depth import depth_law
from master.stereo.pairing import Pairing
from master.stereo.pipeline import MarkerPipeline, SolvedPose, Stage
from master.stereo.place import CalibrationResidual
from master.wrist.pipeline import WristPipeline
from master.wrist.setup import WristSetup


class Pipeline(Protocol):
    """What makes poses of what the cameras of one rig saw, whichever kind of rig it is: a push machine."""

    counts: Counter[str]

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, oldest first."""
        ...

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take what the IMU says of its own orientation (4,)."""
        ...

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for something."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class RigSetup:
    """A rig with everything its file refers to, checked; of markers, or of a wrist device.

    Attributes:
        rig: The rig file.
        cameras: Camera files by name, in the rig's order.
        models: The same as camera models, placed in the rig.
        hand: The hand model.
        wrist: Laser plane and palm of a wrist device; None: a marker rig.
    """

    rig: RigCalibration
    cameras: dict[str, CameraCalibration]
    models: dict[str, CameraModel]
    hand: HandModel
    wrist: WristSetup | None = None

    @property
    def markers(self) -> tuple[str, ...]:
        """Names of the rig's markers; a wrist device has none."""
        return self.rig.markers if self.wrist is None else ()

    @property
    def wrist_cameras(self) -> tuple[str, ...]:
        """The cameras that send strobed triples and no markers."""
        return () if self.wrist is None else self.rig.cameras

    @property
    def hand_markers(self) -> tuple[str, ...]:
        """The rig's markers that sit on the hand, in the rig's order."""
        return tuple(name for name in self.markers if name not in self.rig.free_markers)

    @property
    def imus(self) -> tuple[str, ...]:
        """The rig's IMU, if it has one."""
        return () if self.rig.imu is None else (self.rig.imu.name,)

    @classmethod
    def of(cls, rig: RigCalibration, cameras: dict[str, CameraCalibration], hand: HandModel) -> "RigSetup":
        """Join the files.

        Raises:
            CalibrationError: A camera of the rig is missing or has no intrinsics; of a marker rig: fewer than two
                cameras, or a marker the hand does not mount and that is not free; of a wrist device: no laser plane
                or no palm pose.
        """
        if rig.kind == "markers" and len(rig.cameras) < 2:
            raise CalibrationError(f"rig {rig.name!r}: cameras: two or more are needed")
        missing = [name for name in rig.cameras if name not in cameras]
        if missing:
            raise CalibrationError(f"rig {rig.name!r}: no camera file for {missing[0]!r}")
        ordered = {name: cameras[name] for name in rig.cameras}
        models = {name: CameraModel.of(camera, rig.camera_pose(name)) for name, camera in ordered.items()}
        if rig.kind == "wrist":
            return cls(rig, ordered, models, hand, WristSetup.of(rig, ordered[rig.cameras[0]], hand))
        for name in rig.markers:
            if name not in rig.free_markers:
                hand.mount(name)
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
    """The pipeline this marker rig's file describes.

    Args:
        setup: The rig.
        stage: Measures the stages.
        continuous: False: every frame is an unrelated pose; no filter, no memory.
        tracker: Tracks the hand; None: a new one, which takes most of the time.

    Raises:
        CalibrationError: The depth model does not fit the rig, or it is no marker rig.
    """
    if setup.wrist is not None:
        raise CalibrationError(f"rig {setup.rig.name!r}: kind is 'wrist', this needs a rig of 'markers'")
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


def pipeline_of(
    setup: RigSetup, stage: Stage, *, continuous: bool = True, tracker: HandTracker | None = None
) -> Pipeline:
    """The pipeline of a rig of either kind; arguments and errors as of `build_pipeline`, a wrist device has no tracker.

    It takes what the cameras of its own kind of rig send, and nothing else is ever pushed: the link refuses a camera
    that sends what those of the other kind do.
    """
    if setup.wrist is None:
        return cast(Pipeline, build_pipeline(setup, stage, continuous=continuous, tracker=tracker))
    try:
        return cast(Pipeline, WristPipeline(setup.wrist, continuous=continuous, stage=stage))
    except CalibrationError as error:
        raise CalibrationError(f"rig {setup.rig.name!r}: {error}") from error
