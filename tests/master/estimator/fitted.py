"""What the tests of the estimator share: hands fitted to exact points and pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.geometry.transforms import matrix_to_rotation_vector
from common.hand.model import CHAINS, FINGER_JOINTS, HandJoints, HandModel
from master.estimator.epoch import Epoch, Fitted, FittedHand, OrientationMeasurement, SolvedHand
from master.estimator.estimator import Estimator
from master.estimator.parameters import HandParameters
from master.estimator.priors import WristModel
from master.estimator.settings import DEFAULT, Settings
from tests.conftest import ROOT
from tests.hand_helpers import (
    BACK_NORMAL,
    MARKERS,
    RIGHT,
    camera_models,
    palm,
    rig_file,
    small_cov,
)
from tests.wrist_run import wrist_setup

STEP_NS = 16_666_667
PAIR = tuple(camera_models(rig_file()).values())
PARAMETERS = HandParameters.of(RIGHT)
FREE = len(PARAMETERS.free)


def estimator(
    model: HandModel = RIGHT,
    markers: tuple[str, ...] = MARKERS,
    *,
    cameras: Sequence[CameraModel] = PAIR,
    continuous: bool = True,
    natural: bool = False,
    settings: Settings = DEFAULT,
) -> Estimator:
    """An estimator of a hand of which every marker is on the hand.

    One whose DIPs are free wears a device that sees nothing, and moves nothing: kernels of so many free angles are
    compiled for wrist devices anyway, and take two minutes.
    """
    wrist = None if len(HandParameters.of(model).free) == FREE else _blind(model)
    return Estimator(
        cameras,
        model,
        markers,
        markers,
        continuous=continuous,
        natural=natural,
        settings=settings,
        wrist=wrist,
    )


def _blind(model: HandModel) -> WristModel:
    """A wrist device on the forearm of this hand."""
    setup = wrist_setup(ROOT).wrist
    assert setup is not None
    return WristModel.of(replace(setup, model=model), loose=True)


@lru_cache(maxsize=32)
def forgetful(
    model: HandModel = RIGHT,
    markers: tuple[str, ...] = MARKERS,
    natural: bool = False,
    settings: Settings = DEFAULT,
) -> Estimator:
    """One that remembers nothing, for every test that asks for such a one."""
    return estimator(model, markers, continuous=False, natural=natural, settings=settings)


def fit(
    points: Float,
    cov: Float,
    *,
    by: Estimator | None = None,
    back_normal: Float = BACK_NORMAL,
    orientation: OrientationMeasurement | None = None,
    start: SolvedHand | None = None,
) -> FittedHand | None:
    """The hand of points (M, 3) [m] of one epoch alone."""
    epoch = Epoch(10**9, points, back_normal, cov_m2=cov, orientation=orientation, start=start)
    return (by or forgetful()).push(epoch).solution


def found(hand: FittedHand | None) -> FittedHand:
    """The hand, which there is."""
    assert hand is not None
    return hand


def places(T: Float, angles: Float, model: HandModel = RIGHT, markers: tuple[str, ...] = MARKERS) -> Float:
    """Where markers are (M, 3) [m] on a hand."""
    return model.marker_points(model.forward(T, angles), markers)


def orientation_of(rotation: Float, cov_rad2: Float, *, sure: bool = True) -> OrientationMeasurement:
    """A palm's rotation (3, 3) by an IMU, with its covariance (3, 3)."""
    return OrientationMeasurement(rotation, np.asarray(np.linalg.inv(cov_rad2), np.float64), sure)


def residual_m(hand: FittedHand, points: Float, model: HandModel = RIGHT) -> Float:
    """How far markers (M,) are from where they are seen [m]; NaN: not seen."""
    names = MARKERS
    return np.linalg.norm(model.marker_points(hand.joints, names) - points, axis=1)


def joint_mm(hand: FittedHand | None, truth: Float) -> Float:
    """Errors (26,) of joints."""
    return 1e3 * np.linalg.norm(found(hand).joints.position_m - truth, axis=1)


def palm_deg(hand: FittedHand | None, T: Float) -> float:
    """By how much the palm is turned from T (4, 4)."""
    off = found(hand).T_rig_palm[:3, :3] @ T[:3, :3].T
    return float(np.degrees(np.linalg.norm(matrix_to_rotation_vector(off))))


def pip_deg(hand: FittedHand | None, truth: Float) -> float:
    """Mean error of the four PIPs."""
    return float(np.degrees(np.abs(found(hand).angles_rad[1:, 2] - truth[1:, 2])).mean())


def region_m(hand: Fitted) -> Float:
    """Half the largest axes of the 95 % regions of the joints (26,)."""
    return np.sqrt(7.815 * np.linalg.eigvalsh(found(hand.solution).cov_m2)[:, -1])


def sure(hand: Fitted, most_m: float = DEFAULT.tracked_m) -> Bool:
    """Whether the regions of the joints (26,) and of their fingers' PIPs are that small."""
    small, of_pip = region_m(hand) < most_m, np.ones(26, np.bool_)
    for finger in range(1, 5):
        of_pip[list(FINGER_JOINTS[finger])] = small[CHAINS[finger, 1]]
    return small & of_pip


@dataclass(frozen=True)
class Seen:
    """A hand before cameras: the truth of an epoch in pixels."""

    joints: HandJoints
    uv: Float
    points: Float

    def epoch(
        self,
        t_ns: int,
        *,
        cameras: Sequence[int] | None = None,
        gone: Sequence[int] = (),
        sigma_px: float = 0.1,
        orientation: OrientationMeasurement | None = None,
        start: SolvedHand | None = None,
    ) -> Epoch:
        """The epoch as these cameras see it, without some markers; the centroids are exact."""
        uv, points = self.uv.copy(), self.points.copy()
        kept = range(len(uv)) if cameras is None else cameras
        uv[np.setdiff1d(np.arange(len(uv)), kept)] = np.nan
        uv[:, list(gone)] = np.nan
        points[np.isfinite(uv[..., 0]).sum(axis=0) < 2] = np.nan
        variance = np.where(np.isfinite(uv[..., 0]), sigma_px**2, np.nan)
        return Epoch(
            t_ns,
            points,
            BACK_NORMAL,
            uv=uv,
            variance_px2=variance,
            own_m2=np.zeros((uv.shape[1], 3, 3)),
            orientation=orientation,
            start=start,
        )


def seen(T: Float, angles: Float, cameras: Sequence[CameraModel] = PAIR, model: HandModel = RIGHT) -> Seen:
    """What cameras see of a hand; caps are corrected before the fit."""
    joints = model.forward(T, angles)
    points = model.marker_points(joints, MARKERS)
    return Seen(joints, np.stack([camera.project(points) for camera in cameras]), points)


def bent(t_s: float, speed_deg_s: float = 120.0) -> Float:
    """A fist that closes: PIP from 20 deg on."""
    pip = np.radians(20.0 + speed_deg_s * t_s)
    angles = np.zeros((5, 4))
    angles[0] = np.radians([8.0, 8.0, 12.0, 12.0])
    angles[1:] = [0.0, 0.54 * pip, pip, pip * 2 / 3]
    return angles


def push(
    machine: Estimator,
    t_ns: int,
    points: Float,
    cov: Float | None = None,
    *,
    orientation: OrientationMeasurement | None = None,
    start: SolvedHand | None = None,
) -> Fitted:
    """Push points (M, 3) [m]."""
    epoch = Epoch(
        t_ns,
        points,
        BACK_NORMAL,
        cov_m2=small_cov() if cov is None else cov,
        orientation=orientation,
        start=start,
    )
    return machine.push(epoch)


def bent_points(angles: Float, gone: Sequence[int] = ()) -> Float:
    """Markers (6, 3) [m] of a hand with the palm at rest, without some."""
    points = places(palm(), angles)
    points[list(gone)] = np.nan
    return points


def run(
    machine: Estimator, frames: range, gone: Sequence[int] = (), speed_deg_s: float = 120.0
) -> list[Fitted]:
    """Frames of the fist that closes, without some markers."""
    return [push(machine, k * STEP_NS, bent_points(bent(k / 60.0, speed_deg_s), gone)) for k in frames]
