"""Tests of what joints are off their tangents: as much as drawn hands are, and nothing where a marker is seen."""

from functools import lru_cache

import numpy as np

from common.arrays import Bool, Float
from common.geometry.transforms import rotation_vector_to_matrix
from common.hand.model import CHAINS, TIPS, WRIST, HandModel
from common.records import boxed, record
from master.estimator.covariance import CovarianceScratch
from master.estimator.epoch import FittedHand
from master.estimator.kinematics import Scratch
from master.estimator.parameters import HandParameters, HandTables, Mounts
from master.estimator.posterior import Model
from master.estimator.sensors import CameraArrays, Device
from master.estimator.settings import DEFAULT
from tests.hand_helpers import LEFT, MARKERS, RIGHT, natural_angles, palm, small_cov
from tests.master.estimator.fitted import PAIR, fit, forgetful, found, places
from tests.master.estimator.kernels import joint_covariances

BACK = MARKERS.index("back")
NONE = np.zeros(6, bool)
REGION = 7.815
DRAWS = 4000


@lru_cache
def solution(model: HandModel = RIGHT) -> FittedHand:
    points = places(palm(), natural_angles(np.random.default_rng(3)), model)
    return found(fit(points, small_cov(), by=forgetful(model)))


def covariances(hand: FittedHand, cov: Float, seen: Bool, model: HandModel = RIGHT) -> tuple[Float, Float]:
    """Of the joints (26, 3, 3): by derivatives alone, and with arcs; markers that are seen hold their places."""
    tables = HandTables.of(model, HandParameters.of(model))
    rig = Model(
        boxed(tables),
        boxed(DEFAULT.record()),
        Mounts.of(model, MARKERS),
        CameraArrays.of(PAIR),
        boxed(record(Device)),
    )
    straight, whole = np.empty((26, 3, 3)), np.empty((26, 3, 3))
    storage = record(CovarianceScratch, N=len(cov), M=16)
    information = np.asarray(np.linalg.inv(small_cov()), np.float64)
    T, work = hand.T_rig_palm, boxed(record(Scratch))
    joint_covariances(rig, T, hand.x, cov, seen, information, work, boxed(storage), straight, whole)
    return straight, whole


def second_order(hand: FittedHand, cov: Float, seen: Bool, model: HandModel = RIGHT) -> Float:
    """What arcs add (26, 3, 3)."""
    straight, whole = covariances(hand, cov, seen, model)
    return whole - straight


def drawn(hand: FittedHand, step: Float, model: HandModel = RIGHT) -> Float:
    """Joints (T, 26, 3) [m] of hands that are off the found one by steps (T, 6 + n)."""
    parameters = HandParameters.of(model)
    angles = parameters.angles(hand.x + step[:, 6:])
    R = rotation_vector_to_matrix(step[:, :3]) @ hand.T_rig_palm[:3, :3]
    local = model.forward(np.eye(4), angles).position_m
    return local @ np.swapaxes(R, 1, 2) + (hand.T_rig_palm[:3, 3] + step[:, 3:6])[:, None]


def jacobians(hand: FittedHand, model: HandModel = RIGHT) -> Float:
    """How the joints move (26, 3, 6 + n), by finite differences."""
    step = 1e-6 * np.eye(6 + len(hand.x))
    return np.moveaxis(drawn(hand, step, model) - drawn(hand, -step, model), 0, 2) / 2e-6


def unsure(hand: FittedHand, rotation_rad: float, angle_rad: float) -> Float:
    n = len(hand.measurement_cov)
    return np.diag(
        np.concatenate([np.full(3, rotation_rad), np.full(3, 1e-4), np.full(n - 6, angle_rad)]) ** 2
    )


def test_what_is_left_of_the_tangent_is_that_of_drawn_hands() -> None:
    for model in (RIGHT, LEFT):
        hand = solution(model)
        cov = unsure(hand, 0.3, 0.1)
        step = np.random.default_rng(1).multivariate_normal(np.zeros(len(cov)), cov, DRAWS)
        tangent = hand.joints.position_m + np.einsum("pin,tn->tpi", jacobians(hand, model), step)
        off = drawn(hand, step, model) - tangent
        expected = np.einsum("tpi,tpj->pij", off, off) / DRAWS
        for joint in (*CHAINS[:, 0], *TIPS):
            size = np.trace(expected[joint])
            np.testing.assert_allclose(
                second_order(hand, cov, NONE, model)[joint], expected[joint], atol=0.12 * size
            )


def about_the_back(hand: FittedHand) -> Float:
    """A covariance (6 + n, 6 + n): the palm turns by 20 degrees about each axis, the marker on its back is seen."""
    cov = unsure(hand, np.radians(20.0), 1e-4)
    arm = RIGHT.marker_points(hand.joints, MARKERS)[BACK] - hand.T_rig_palm[:3, 3]
    x, y, z = arm
    pulled = -np.array(
        [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    )  # the shift that a turn about the marker needs
    follow = np.eye(len(cov))
    follow[3:6, :3] = pulled
    cov[3:6, 3:6] = 1e-6 * np.eye(3)
    return follow @ cov @ follow.T


def test_an_uncertain_palm_rotation_widens_joints_around_the_marker_on_its_back() -> None:
    hand = solution()
    cov = about_the_back(hand)
    step = np.random.default_rng(1).multivariate_normal(np.zeros(len(cov)), cov, DRAWS)
    place = RIGHT.marker_points(hand.joints, MARKERS)[BACK]
    arm = place - hand.T_rig_palm[:3, 3]
    # Exactly about the marker, beside the millimetre that its place is unsure by.
    off_m = step[:, 3:6] + np.cross(step[:, :3], arm)
    step[:, 3:6] = arm + off_m - rotation_vector_to_matrix(step[:, :3]) @ arm
    off = (drawn(hand, step) - hand.joints.position_m)[:, WRIST]
    straight, whole = covariances(hand, cov, np.arange(6) == BACK)
    linear, claimed = straight[WRIST], whole[WRIST]
    np.testing.assert_allclose(
        linear, jacobians(hand)[WRIST] @ cov @ jacobians(hand)[WRIST].T, rtol=1e-5, atol=1e-12
    )

    def inside(region: Float) -> float:
        return float((np.vecdot(off, np.linalg.solve(region, off.T).T) < REGION).mean())

    assert 0.9 < inside(claimed) < 0.99
    assert inside(linear) < 0.8


def test_tips_that_are_seen_stay_where_they_are() -> None:
    hand = solution()
    far = np.trace(second_order(hand, 4.0 * hand.measurement_cov, NONE)[TIPS], axis1=1, axis2=2)
    seen = np.trace(second_order(hand, 4.0 * hand.measurement_cov, np.ones(6, bool))[TIPS], axis1=1, axis2=2)
    assert (seen < 1.0e-3**2).all()
    assert (far > 9.0 * seen).all()


def test_a_sure_hand_has_no_second_order_covariance() -> None:
    hand = solution()
    assert not second_order(hand, unsure(hand, 0.01, 0.01), np.ones(6, bool)).any()
