"""From a rig to the pipeline that its files describe: joins the parts, for each kind of rig."""

from collections import Counter
from collections.abc import Callable
from math import nan
from typing import Protocol, cast

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.geometry import cross
from common.messages import Detections
from master.fabrik.one_euro import OneEuroParameters, PointFilter
from master.fusion.pipeline import FusedPipeline, WristSide
from master.hurry import never
from master.ik.hand_one_euro import HandOneEuro
from master.ik.tracker import HandTracker
from master.rig_setup import RigSetup
from master.stereo.depth import depth_law
from master.stereo.pairing import Pairing
from master.stereo.pipeline import MarkerPipeline, OtherSensors, SolvedPose, Stage
from master.stereo.place import CalibrationResidual
from master.wrist.pipeline import WristPipeline

_LEAD_M_S = 0.12  # of a palm, and of a finger on it, when another sensor takes over: 4 mm a frame at 60 Hz


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


def _point_filter(setup: RigSetup) -> PointFilter:
    """The filter this rig's file describes, along the mean sight of its cameras and across it."""
    poses = np.array([model.T_rig_camera for model in setup.models.values()])
    ahead = poses[:, :3, 2].sum(axis=0)
    across = cross(poses[0, :3, 1], ahead)
    view = np.stack([across, cross(ahead, across), ahead])
    return PointFilter(
        OneEuroParameters.of(setup.rig.filter),
        view / np.linalg.norm(view, axis=1, keepdims=True),
    )


def _hand_filter(setup: RigSetup) -> HandOneEuro:
    """The filter of the solved hand, by the same settings."""
    lead_m_s = None if setup.wrist is None else _LEAD_M_S
    return HandOneEuro(setup.hand, setup.hand_markers, OneEuroParameters.of(setup.rig.filter), lead_m_s)


def build_pipeline(
    setup: RigSetup,
    stage: Stage,
    *,
    continuous: bool = True,
    tracker: HandTracker | None = None,
    others: OtherSensors | None = None,
    counts: Counter[str] | None = None,
    shed: Callable[[], bool] = never,
) -> MarkerPipeline:
    """The pipeline this marker rig's file describes; of a wrist device beside it nothing is used but through `others`.

    Args:
        setup: The rig.
        stage: Measures the stages.
        continuous: False: every frame is an unrelated pose; no filter, no memory.
        tracker: Tracks the hand; None: a new one, which takes most of the time.
        others: What else watches the hand; None: nothing does.
        counts: Counted into; None: counts of its own.
        shed: Asked for each instant whether it is left out.

    Raises:
        CalibrationError: The depth model does not fit the rig, or it is no marker rig.
    """
    if not setup.has_markers:
        raise CalibrationError(f"rig {setup.rig.name!r}: kind is 'wrist', this needs a rig of 'markers'")
    rates = {name: setup.cameras[name].frame_rate_hz for name in setup.models}
    return MarkerPipeline(
        setup.models,
        setup.hand,
        setup.rig.markers,
        pairing=Pairing(setup.models, rates, policy=setup.rig.pairing, continuous=continuous),
        law=depth_law(setup.rig),
        residual=CalibrationResidual.of(setup.rig),
        smooth=_point_filter(setup) if continuous else None,
        tracker=HandTracker(setup.hand, setup.hand_markers, continuous=continuous)
        if tracker is None
        else tracker,
        steady=_hand_filter(setup) if continuous else None,
        stamp_offset_us=setup.rig.stamp_offset_us,
        volume=setup.rig.volume,
        imu=setup.rig.imu,
        others=others,
        counts=counts,
        stage=stage,
        shed=shed,
    )


def pipeline_of(
    setup: RigSetup,
    stage: Stage,
    *,
    continuous: bool = True,
    tracker: HandTracker | None = None,
    shed: Callable[[], bool] = never,
) -> Pipeline:
    """The pipeline of a rig of either kind, or of both; arguments and errors as of `build_pipeline`.

    A wrist device alone has no tracker. What is pushed is of cameras of these rigs: the link refuses one that sends
    what those of the other kind do.
    """
    if setup.wrist is None:
        return cast(Pipeline, build_pipeline(setup, stage, continuous=continuous, tracker=tracker, shed=shed))
    try:
        if setup.has_markers:
            side = WristSide.of(setup.wrist, counts := Counter[str](), stage, continuous=continuous)
            markers = build_pipeline(
                setup, stage, continuous=continuous, tracker=tracker, others=side, counts=counts, shed=shed
            )
            return FusedPipeline(
                markers, side, min(setup.cameras[name].frame_rate_hz for name in setup.models)
            )
        return cast(Pipeline, WristPipeline(setup.wrist, continuous=continuous, stage=stage))
    except CalibrationError as error:
        raise CalibrationError(f"rig {setup.rig.name!r}: {error}") from error
