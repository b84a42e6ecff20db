"""Pipelines are constructed from a rig's files, for each kind of rig."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from math import hypot, nan, sqrt
from typing import Protocol, cast

import numpy as np

from common.arrays import Float
from common.errors import CalibrationError
from common.geometry.transforms import cross
from common.kernels import log_if_slow
from common.messages import Detections
from master.estimator.estimator import Estimator
from master.estimator.pipeline import MarkerPipeline, SolvedPose
from master.estimator.priors import WristModel, loosened
from master.estimator.sensors import CameraArrays
from master.estimator.settings import Settings
from master.estimator.smoothing import HandOneEuro
from master.estimator.wrist_pipeline import WristPipeline, WristSide
from master.fabrik.caps import CapTables
from master.fabrik.depth import CalibrationResidual, depth_law, law_contradicts, law_residual
from master.fabrik.intersection import limits_of, rehearse
from master.fabrik.one_euro import OneEuroParameters, PointFilter
from master.fabrik.rays import RayTriangulator
from master.fabrik.settings import DEPTH, RAYS
from master.fabrik.solver import FabrikSolver, Stage
from master.fabrik.sync import FrameSync
from master.fabrik.triangulate import DepthTriangulator, disparity_tables
from master.rig.setup import RigSetup

_MOUNTED_RAD = np.radians(0.5)  # standard deviation of the pitch of cameras mounted by eye


class Pipeline(Protocol):
    """Push machine from the cameras of a rig of either kind to poses of one hand."""

    @property
    def counts(self) -> Counter[str]:
        """Events since the start."""
        ...

    def push(self, message: Detections) -> list[SolvedPose]:
        """Take one camera's detections; return the poses they complete, oldest first."""
        ...

    def push_orientation(self, t_ns: int, orientation_wxyz: Float, heading_sigma_rad: float = nan) -> None:
        """Take the IMU's estimate of its own orientation (4,)."""
        ...

    def flush(self) -> list[SolvedPose]:
        """At the end of a recording: the poses that still wait for something."""
        ...


def _point_filter(setup: RigSetup) -> PointFilter:
    """Return the rig file's point filter, along its cameras' mean view and across it."""
    poses = np.array([model.T_rig_camera for model in setup.models.values()])
    ahead = poses[:, :3, 2].sum(axis=0)
    across = cross(poses[0, :3, 1], ahead)
    view = np.stack([across, cross(ahead, across), ahead])
    return PointFilter(
        OneEuroParameters.of(setup.rig.filter), view / np.linalg.norm(view, axis=1, keepdims=True)
    )


def _hand_filter(setup: RigSetup) -> HandOneEuro:
    # of a palm, and of a finger on it, where it is solved elsewhere: 5 mm a frame at 60 Hz
    blend_m_s = None if setup.wrist is None else 0.3
    hand = setup.hand if setup.wrist is None else loosened(setup.hand)
    return HandOneEuro(hand, setup.hand_markers, OneEuroParameters.of(setup.rig.filter), blend_m_s)


def _rays(setup: RigSetup) -> RayTriangulator | None:
    """Triangulation by the rays of all cameras; None: there is but one."""
    cameras = tuple(setup.models.values())
    if len(cameras) < 2:
        return None
    caps = CapTables.of(setup.hand, setup.rig.markers)
    rays = RayTriangulator(cameras, caps, CalibrationResidual.of(setup.rig).rays_px)
    nothing = np.full((len(cameras), len(setup.rig.markers)), np.nan)
    rays(np.stack([nothing, nothing], axis=-1), nothing, nothing, None, 0.0)  # compiled now, not later
    return rays


def _estimator(
    setup: RigSetup,
    *,
    continuous: bool,
    natural: bool = False,
    settings: Settings | None = None,
    fused: bool = False,
) -> Estimator:
    """Return the estimator of a rig's hand; `fused`: with the rows of a wrist device."""
    markers, wrist = setup.hand_markers, None
    if fused:
        assert setup.wrist is not None
        wrist = WristModel.of(setup.wrist, loose=setup.wrist.imu is not None)
    return Estimator(
        tuple(setup.models.values()),
        setup.hand if wrist is None else loosened(setup.hand),
        setup.rig.markers,
        markers,
        continuous=continuous,
        natural=natural,
        settings=settings or setup.settings,
        wrist=wrist,
    )


def line_of(setup: RigSetup, stage: Stage, *, continuous: bool = True) -> FabrikSolver:
    """The card's line of a marker rig.

    `continuous` False: every frame is an unrelated pose; no filter, no memory.

    Raises:
        CalibrationError: The depth model does not fit the rig, or the estimator cannot start from it.
    """
    rig, cameras = setup.rig, tuple(setup.models.values())
    rates = {name: setup.cameras[name].frame_rate_hz for name in setup.models}
    residual = CalibrationResidual.of(rig)
    law = depth_law(rig, cameras)
    triangulate: DepthTriangulator | RayTriangulator
    if law is None:
        triangulate = RayTriangulator(cameras, CapTables.of(setup.hand, rig.markers), residual.rays_px)
    else:
        if contradiction := law_contradicts(rig, cameras):
            raise CalibrationError(
                f"rig {rig.name!r}: {contradiction}: calibrate the cameras and the depth again, or set solver to"
                " 'fabrik', which takes the depth alone"
            )
        off, _ = law_residual(law, cameras, rig.volume)
        tilt_px = 0.0 if off <= DEPTH.law_residual else float(cameras[0].matrix[1, 1]) * _MOUNTED_RAD
        row_px = hypot(sqrt(2.0) * RAYS.rig_px, tilt_px)
        tables = disparity_tables(cameras, law, residual.law, row_px, float(limits_of(2)[2]))
        triangulate = DepthTriangulator(tables, CapTables.of(setup.hand, rig.markers))
    any_curl_rad = 100.0  # a finger that is not seen may be bent anyhow
    line = FabrikSolver(
        setup.models,
        setup.hand,
        rig.markers,
        setup.hand_markers,
        sync=FrameSync(setup.models, rates, len(rig.markers), policy=rig.frame_sync, continuous=continuous),
        triangulate=triangulate,
        one_euro=_point_filter(setup) if continuous else None,
        palm=_estimator(setup, continuous=continuous, natural=True),
        once=_estimator(
            setup, continuous=False, natural=True, settings=replace(setup.settings, curled_rad=any_curl_rad)
        ),
        stage=stage,
    )
    line.rehearse()
    rehearse(CameraArrays.of(tuple(setup.models.values())))
    return line


def build_pipeline(
    setup: RigSetup,
    stage: Stage,
    *,
    continuous: bool = True,
    side: WristSide | None = None,
    counts: Counter[str] | None = None,
    dropped_epochs: Callable[[], bool] | None = None,
) -> MarkerPipeline:
    """Build the pipeline that this marker rig's file describes.

    `continuous` False: every frame is an unrelated pose; no filter, no memory. `side` has wrist device and
    IMU; None: there are none, or they are left out. `counts` None: counts of its own. `dropped_epochs` is
    asked for each epoch whether it is dropped.

    Raises:
        CalibrationError: The depth model or the solver does not fit the rig, or it is no marker rig.
    """
    rig = setup.rig
    if not setup.has_markers:
        raise CalibrationError(f"rig {rig.name!r}: kind is 'wrist', this needs a rig of 'markers'")
    refine = rig.solver == "estimator"
    if not refine and (side is not None or rig.imu is not None):
        sensor = "an IMU" if side is None else "a wrist device"
        raise CalibrationError(
            f"rig {rig.name!r}: solver 'fabrik' knows markers alone, but {sensor} watches this hand too: set solver to"
            " 'estimator'"
        )
    with log_if_slow():
        return MarkerPipeline(
            setup.models,
            setup.hand,
            rig.markers,
            line=line_of(setup, stage, continuous=continuous),
            rays=_rays(setup),
            rays_px=CalibrationResidual.of(rig).rays_px,
            estimator=_estimator(setup, continuous=continuous, fused=side is not None) if refine else None,
            smooth=_hand_filter(setup) if continuous and refine else None,
            stamp_offset_us=rig.stamp_offset_us,
            volume=rig.volume,
            imu=rig.imu if side is None else None,
            side=side,
            slowest_hz=min(setup.cameras[name].frame_rate_hz for name in setup.models),
            counts=counts,
            stage=stage,
            dropped_epochs=dropped_epochs,
        )


def pipeline_of(
    setup: RigSetup,
    stage: Stage,
    *,
    continuous: bool = True,
    dropped_epochs: Callable[[], bool] | None = None,
) -> Pipeline:
    """Build the pipeline of a rig of either kind, or of both, as `build_pipeline`.

    What is pushed is of cameras of these rigs: the link refuses one that sends what those of the other kind
    do.
    """
    if setup.wrist is None:
        return build_pipeline(setup, stage, continuous=continuous, dropped_epochs=dropped_epochs)
    try:
        if setup.has_markers:
            counts = Counter[str]()
            side = WristSide(setup.wrist, counts, continuous=continuous)
            return build_pipeline(
                setup, stage, continuous=continuous, side=side, counts=counts, dropped_epochs=dropped_epochs
            )
        return cast(
            Pipeline, WristPipeline(setup.wrist, continuous=continuous, stage=stage, settings=setup.settings)
        )
    except CalibrationError as error:
        raise CalibrationError(f"rig {setup.rig.name!r}: {error}") from error
