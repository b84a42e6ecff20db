"""Kernels that only other kernels call, made callable for tests."""

from typing import Any

import numpy as np

from common.arrays import Bool, Float
from common.kernels import kernel
from master.estimator.covariance import CovarianceScratch, add_second_order, linear, surer
from master.estimator.finger_surface import MOVES, laser_centroid, look
from master.estimator.kinematics import Scratch, angles_of, chains, twist_hand
from master.estimator.parameters import truncated_mean
from master.estimator.posterior import Model
from master.estimator.priors import PosturePrior
from master.estimator.problem import Observations, Problem, Rig, marker_rows, rotation_vector_jacobian
from master.estimator.sensors import CameraArrays, flexed_palm, project
from master.estimator.solve import linearise
from master.estimator.state import grow, hide, keep_extras, predict_extras

__all__ = ["CovarianceScratch", "Scratch"]


@kernel
def project_at(cameras: CameraArrays, c: int, point: Float, uv: Float, J: Float) -> bool:
    """`master.estimator.sensors.project`."""
    return project(cameras, c, point, uv, J)


@kernel
def marker_rows_at(
    cameras: CameraArrays, observed: Observations, m: int, point: Float, boxed_work: Any
) -> tuple[float, float]:
    """`master.estimator.problem.marker_rows`; the record in its array."""
    return marker_rows(cameras, observed, m, point, boxed_work[0])


@kernel
def linearise_at(
    model: Model,
    posture_prior: PosturePrior,
    boxed_prior: Any,
    observed: Observations,
    h: int,
    boxed_at: Any,
    boxed_search: Any,
) -> float:
    """`master.estimator.solve.linearise`; records in their arrays."""
    rig = Rig(model.hand[0], model.settings[0], model.mounts, model.cameras, model.device[0])
    problem = Problem(rig, posture_prior, boxed_prior[0], observed)
    return linearise(problem, h, boxed_at[0], boxed_search[0])


@kernel
def truncated_mean_at(
    boxed_hand: Any, normal: Float, gradient: Float, x: Float, boxed_cut: Any, mean: Float
) -> None:
    """`master.estimator.parameters.truncated_mean`; records in their arrays."""
    truncated_mean(boxed_hand[0], normal, gradient, x, boxed_cut[0], mean)


@kernel
def surer_at(now: Float, past: Float, boxed_scratch: Any, out: Float) -> None:
    """`master.estimator.covariance.surer`; the record in its array."""
    surer(now, past, boxed_scratch[0], out)


@kernel
def hide_at(
    boxed_hand: Any, boxed_settings: Any, boxed_state: Any, t_ns: int, shown: Bool, boxed_hidden: Any
) -> None:
    """`master.estimator.state.hide`; records in their arrays."""
    hide(boxed_hand[0], boxed_settings[0], boxed_state[0], t_ns, shown, boxed_hidden[0])


@kernel
def grow_at(
    boxed_hand: Any,
    boxed_settings: Any,
    boxed_state: Any,
    dt_s: float,
    T: Float,
    palm_shown: bool,
    boxed_hidden: Any,
) -> None:
    """`master.estimator.state.grow`; records in their arrays."""
    grow(boxed_hand[0], boxed_settings[0], boxed_state[0], dt_s, T, palm_shown, boxed_hidden[0])


@kernel
def joint_covariances(
    model: Model,
    T: Float,
    x: Float,
    cov: Float,
    seen: Bool,
    information: Float,
    boxed_work: Any,
    boxed_scratch: Any,
    straight: Float,
    whole: Float,
) -> None:
    """Write the joints' covariances (26, 3, 3) [m^2] by derivatives alone, and with arcs."""
    hand, work, scratch = model.hand[0], boxed_work[0], boxed_scratch[0]
    rig = Rig(hand, model.settings[0], model.mounts, model.cameras, model.device[0])
    angles_of(hand, x, work)
    chains(hand, T, work)
    linear(hand, T, cov, work, scratch, straight)
    linear(hand, T, cov, work, scratch, whole)
    add_second_order(rig, T, cov, seen, information, work, scratch, whole)


@kernel
def rotation_vector_jacobian_at(rotation: Float, J: Float) -> None:
    """`master.estimator.problem.rotation_vector_jacobian`."""
    rotation_vector_jacobian(rotation, J)


@kernel
def look_at(
    boxed_hand: Any,
    boxed_device: Any,
    wrist_angles: Float,
    twist: Float,
    angles: Float,
    f: int,
    boxed_work: Any,
) -> None:
    """`master.estimator.finger_surface.look` at a wrist that is bent by (2,) and hinges rolled by (5,)."""
    T, axes, hand, device = np.zeros((4, 4)), np.zeros((2, 3)), boxed_hand[0], boxed_device[0]
    twist_hand(hand, twist)
    flexed_palm(device.palm, wrist_angles[0], wrist_angles[1], T, axes)
    look(hand, device, T, axes, angles, f, MOVES, boxed_work[0])


@kernel
def laser_centroid_at(boxed_device: Any, f: int, boxed_work: Any) -> float:
    """`master.estimator.finger_surface.laser_centroid`, after `look_at`."""
    return laser_centroid(boxed_device[0], f, boxed_work[0])


@kernel
def predict_extras_at(
    boxed_settings: Any,
    boxed_state: Any,
    dt_s: float,
    process_noise_rad2: float,
    boxed_prior: Any,
    boxed_scratch: Any,
) -> None:
    """`master.estimator.state.predict_extras`; records in their arrays."""
    predict_extras(
        boxed_settings[0], boxed_state[0], dt_s, process_noise_rad2, boxed_prior[0], boxed_scratch[0]
    )


@kernel
def keep_extras_at(
    boxed_settings: Any,
    boxed_state: Any,
    dt_s: float,
    boxed_prior: Any,
    z: Float,
    cov: Float,
    scale: float,
    boxed_scratch: Any,
) -> None:
    """`master.estimator.state.keep_extras`; records in their arrays."""
    keep_extras(boxed_settings[0], boxed_state[0], dt_s, boxed_prior[0], z, cov, scale, boxed_scratch[0])
