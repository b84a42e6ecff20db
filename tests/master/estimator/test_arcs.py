"""Tests of what joints are off their tangents: as much as drawn hands are, and nothing where a marker is seen."""

import numpy as np

from common.arrays import Bool, Float
from common.geometry import rotation_vector_to_matrix
from common.hand_model import CHAINS, TIPS, WRIST, HandModel
from master.estimator.attached import Attached
from master.estimator.parameters import HandParameters
from master.ik.arcs import Arcs
from master.ik.hand import HandSolution, HandSolver
from tests.hand_helpers import FACING, LEFT, MARKERS, RIGHT, natural_angles, palm, small_cov

BACK = MARKERS.index("back")
NONE = np.zeros(6, bool)
REGION = 7.815
DRAWS = 4000


def solution(model: HandModel = RIGHT) -> HandSolution:
    joints = model.forward(palm(), natural_angles(np.random.default_rng(3)))
    found = HandSolver(model, MARKERS).solve(
        model.marker_points(joints, MARKERS), small_cov(), None, 0.0, None, FACING
    )
    assert found is not None
    return found


def arcs(found: HandSolution, cov: Float, seen: Bool, model: HandModel = RIGHT) -> Float:
    return Arcs(model, HandParameters.of(model), MARKERS).covariance(found, cov, small_cov()[seen], seen)


def drawn(found: HandSolution, step: Float, model: HandModel = RIGHT) -> Float:
    """Joints (T, 26, 3) [m] of hands that are off the found one by steps (T, 6 + n)."""
    parameters = HandParameters.of(model)
    angles = parameters.angles(parameters.of_angles(found.angles_rad) + step[:, 6:])
    R = rotation_vector_to_matrix(step[:, :3]) @ found.T_rig_palm[:3, :3]
    local = Attached.joints(model, parameters).place(model.chains(angles))
    return local @ np.swapaxes(R, 1, 2) + (found.T_rig_palm[:3, 3] + step[:, 3:6])[:, None]


def unsure(found: HandSolution, turn_rad: float, angle_rad: float) -> Float:
    n = len(found.alone)
    return np.diag(np.concatenate([np.full(3, turn_rad), np.full(3, 1e-4), np.full(n - 6, angle_rad)]) ** 2)


def test_what_is_left_of_the_tangent_is_that_of_drawn_hands() -> None:
    for model in (RIGHT, LEFT):
        found = solution(model)
        cov = unsure(found, 0.3, 0.1)
        step = np.random.default_rng(1).multivariate_normal(np.zeros(len(cov)), cov, DRAWS)
        tangent = found.joints.position_m + np.einsum("pin,tn->tpi", found.moved, step)
        off = drawn(found, step, model) - tangent
        expected = np.einsum("tpi,tpj->pij", off, off) / DRAWS
        for joint in (*CHAINS[:, 0], *TIPS):
            size = np.trace(expected[joint])
            np.testing.assert_allclose(
                arcs(found, cov, NONE, model)[joint], expected[joint], atol=0.12 * size
            )


def about_the_back(found: HandSolution) -> Float:
    """A covariance (6 + n, 6 + n): the palm turns by 20 degrees about each axis, the marker on its back is seen."""
    cov = unsure(found, np.radians(20.0), 1e-4)
    arm = RIGHT.marker_points(found.joints, MARKERS)[BACK] - found.T_rig_palm[:3, 3]
    x, y, z = arm
    pulled = -np.array(
        [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    )  # the shift that a turn about the marker needs
    follow = np.eye(len(cov))
    follow[3:6, :3] = pulled
    cov[3:6, 3:6] = 1e-6 * np.eye(3)
    return follow @ cov @ follow.T


def test_a_palm_turns_on_arcs_about_the_marker_on_its_back() -> None:
    found = solution()
    cov = about_the_back(found)
    step = np.random.default_rng(1).multivariate_normal(np.zeros(len(cov)), cov, DRAWS)
    place = RIGHT.marker_points(found.joints, MARKERS)[BACK]
    arm = place - found.T_rig_palm[:3, 3]
    # Exactly about the marker, beside the millimetre that its place is unsure by.
    off_m = step[:, 3:6] + np.cross(step[:, :3], arm)
    step[:, 3:6] = arm + off_m - rotation_vector_to_matrix(step[:, :3]) @ arm
    off = (drawn(found, step) - found.joints.position_m)[:, WRIST]
    linear = found.moved[WRIST] @ cov @ found.moved[WRIST].T
    claimed = linear + arcs(found, cov, np.arange(6) == BACK)[WRIST]

    def inside(region: Float) -> float:
        return float((np.vecdot(off, np.linalg.solve(region, off.T).T) < REGION).mean())

    assert 0.9 < inside(claimed) < 0.99
    assert inside(linear) < 0.8


def test_tips_that_are_seen_stay_where_they_are() -> None:
    found = solution()
    far = np.trace(arcs(found, 4.0 * found.alone, NONE)[TIPS], axis1=1, axis2=2)
    seen = np.trace(arcs(found, 4.0 * found.alone, np.ones(6, bool))[TIPS], axis1=1, axis2=2)
    assert (seen < 1.0e-3**2).all()
    assert (far > 9.0 * seen).all()


def test_a_hand_that_is_sure_has_no_arcs() -> None:
    found = solution()
    assert not arcs(found, unsure(found, 0.01, 0.01), np.ones(6, bool)).any()
