"""FABRIK: reachable targets, limits, flags, restarts without a seed."""

import math
from functools import cache
from typing import Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.hands.chains import ChainResult, Fabrik, Reach, least_root_to_end
from common.arrays import Float
from common.hand.model import FINGERS, HandModel
from common.hand.profiles import generated_profile, preset_couplings, preset_limits
from master.fabrik.fabrik import Chain, Coupling, Link
from master.fabrik.joints import Hinge, Rotor, abduction_span, rotation
from master.fabrik.linear_algebra import (
    IDENTITY,
    Vector,
    as_vector,
    length,
    product,
    rotate,
    rotate_back,
    rotation_about,
)
from master.fabrik.solver import Finger, finger_chain

Preset = Literal["K", "D"]


@cache
def _finger(side: str, preset: Preset, finger: int) -> tuple[Fabrik, Finger]:
    profile = msgspec.structs.replace(
        generated_profile("made", side), limits_rad=preset_limits(preset), couplings=preset_couplings(preset)
    )
    model = HandModel.of(profile)
    solver = Finger.of(model, finger, model.mounts[FINGERS[finger]].offset_m)
    return Fabrik.of(solver.chain), solver


@cache
def _narrowing(finger: int, left: float, coupled: bool) -> Fabrik:
    """A finger of preset D, that keeps a share of its abduction in a fist."""
    limits = preset_limits("D")
    of = msgspec.structs.replace(getattr(limits, FINGERS[finger]), spread_at_full_flexion=left)
    limits = msgspec.structs.replace(limits, **{FINGERS[finger]: of})
    model = HandModel.of(msgspec.structs.replace(generated_profile("made", "left"), limits_rad=limits))
    return Fabrik.of(finger_chain(model, finger, np.zeros(3), coupled=coupled))


def _with_initial(fabrik: Fabrik, closed_form: Finger, target: Vector) -> ChainResult:
    """FABRIK from the closed form's pose; target in the palm frame [m]."""
    return fabrik.solve(target, np.array(closed_form.closed_form(target)[:4]), closed_form.root)


def _random_target(solver: Finger, rng: np.random.Generator) -> Vector:
    """Where the point is at random legal angles, every tenth in a corner."""
    shares = rng.random(4)
    if rng.random() < 0.1:
        shares = np.round(shares)
    low, high = solver.chain.spans.T
    a, f, pip, dip = solver.chain.clamp(low + shares * (high - low)).tolist()
    return solver.forward((a, f, pip, dip))


def _violated(chain: Chain, angles: Float) -> bool:
    flat = angles.tolist()
    outside = any(not low <= q <= high for q, (low, high) in zip(flat, chain.spans, strict=True))
    root = chain.links[0].joint
    if isinstance(root, Rotor):  # the parabola, written out once more
        a, f = flat[:2]
        left = 1.0 - (1.0 - root.spread_at_full_flexion) * (max(f, 0.0) / root.flexion_rad[1]) ** 2
        outside |= not left * root.abduction_rad[0] - 1e-15 <= a <= left * root.abduction_rad[1] + 1e-15
    c = chain.coupling
    return outside or (
        c is not None
        and abs(flat[-1] - min(max(c.ratio * flat[-2], chain.spans[-1][0]), chain.spans[-1][1])) > 1e-12
    )


def _consistent(chain: Chain, result: ChainResult, root: Vector) -> bool:
    """Positions and orientations are those of the angles."""
    positions, orientations = chain.forward(result.angles)
    moved = np.array(positions) + root
    return np.allclose(result.positions, moved, atol=1e-12) and np.allclose(result.orientations, orientations)


def test_without_a_seed_restarts_heal_the_deadlock() -> None:
    rng = np.random.default_rng(3)
    plain = missed = 0
    for k in range(150):
        fabrik, closed_form = _finger("right", "K", 1 + k % 4)
        target = _random_target(closed_form, rng)
        result = fabrik.solve(target, None, closed_form.root)
        missed += result.residual_m > 1e-4
        alone = Fabrik.of(fabrik.chain, restarts=0)
        plain += alone.solve(target, None, closed_form.root).residual_m > 1e-3
        assert not _violated(fabrik.chain, result.angles)
        assert _consistent(fabrik.chain, result, closed_form.root)
    assert missed == 0
    assert plain > 60  # published FABRIK misses most reachable targets from the rest pose


@settings(max_examples=60)
@given(
    finger=st.integers(0, 4),
    left=st.sampled_from([0.0, 0.2, 0.625, 1.0]),
    local=st.tuples(*[st.floats(-0.12, 0.12)] * 3),
    coupled=st.booleans(),
    with_initial=st.booleans(),
)
def test_whatever_flexion_leaves_of_the_abduction_is_kept(
    finger: int, left: float, local: Vector, coupled: bool, with_initial: bool
) -> None:
    fabrik = _narrowing(finger, left, coupled)
    seed = np.array([0.3, 1.5, 0.5, 0.4]) if with_initial else None  # itself outside
    result = fabrik.solve(local, seed)
    assert not _violated(fabrik.chain, result.angles)
    assert result.residual_m == pytest.approx(math.dist(result.positions[-1], local), abs=1e-12)


def test_the_limit_test_sees_a_planted_violation() -> None:
    chain = _narrowing(1, 0.2, True).chain
    low, high = chain.spans[0]
    assert not _violated(chain, np.array([high, 0.0, 0.3, 0.2]))
    assert _violated(chain, np.array([high, 1.0, 0.3, 0.2]))
    assert _violated(chain, np.array([low, 1.0, 0.3, 0.2]))
    assert _violated(chain, np.array([0.0, 1.0, 0.3, 0.4]))  # the coupling


WIDE = Hinge(-2.8, 2.8)
ARM = Chain(
    (
        Link(IDENTITY, Rotor((-3.0, 3.0), (-3.0, 3.0)), (0.0, 0.0, -0.3)),
        Link(IDENTITY, WIDE, (0.0, 0.0, -0.25)),
        Link(IDENTITY, WIDE, (0.0, 0.0, -0.1)),
    )
)


@settings(max_examples=40)
@given(
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    st.floats(0.3, 1.2),
    st.floats(0.3, 1.2),
    st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
)
def test_iteration_itself_converges_from_a_nearby_pose(
    swing: tuple[float, float], elbow: float, wrist: float, off: tuple[float, float]
) -> None:
    pose = np.array([*swing, elbow, wrist])
    target, seed = as_vector(ARM.forward(pose)[0][-1]), np.add(pose, [*off, *off])
    result = Fabrik.of(ARM, 1e-4, 200, restarts=0).solve(target, seed)
    assert math.dist(result.positions[-1], target) < 1e-4 + 1e-12
    assert result.reached
    assert result.iterations > 0 or max(map(abs, off)) < 1e-3


def test_rotor_in_the_middle_and_world_hinge_obey_their_limits() -> None:
    ball = Rotor((-0.4, 0.4), (-0.5, 0.9), shape="ellipse")
    level = Hinge(-0.6, 0.6, (0.0, 1.0, 0.0), frame="world")
    links = (
        Link(IDENTITY, Rotor((-1.0, 1.0), (-1.0, 1.0)), (0.0, 0.0, -0.2)),
        Link(IDENTITY, ball, (0.0, 0.0, -0.2)),
        Link(IDENTITY, level, (0.0, 0.0, -0.15)),
    )
    chain, rng = Chain(links), np.random.default_rng(2)
    fabrik = Fabrik.of(chain, 1e-4)
    reached = 0
    for _ in range(40):
        legal = chain.clamp(rng.uniform([-1.0, -1.0, -0.5, -0.5, -0.6], [1.0, 1.0, 0.9, 0.9, 0.6]))
        result = fabrik.solve(as_vector(chain.forward(legal)[0][-1]))
        reached += result.residual_m < 2e-3
        legal = chain.clamp(result.angles)
        assert legal == pytest.approx(result.angles, abs=1e-9)
        assert _consistent(chain, result, (0.0, 0.0, 0.0))
        # the world hinge keeps its bone level whatever carries it
        assert abs(result.positions[3][1] - result.positions[2][1]) < 1e-12
    assert reached >= 30


def test_a_narrowing_rotor_in_the_middle_and_a_world_rotor_obey_their_limits() -> None:
    narrow = Rotor((-0.6, 0.6), (-0.3, 1.2), spread_at_full_flexion=0.1)
    upright = Rotor((-0.5, 0.5), (-0.4, 0.8), spread_at_full_flexion=0.3, frame="world")
    links = (
        Link(IDENTITY, Rotor((-1.0, 1.0), (-1.0, 1.0)), (0.0, 0.0, -0.2)),
        Link(IDENTITY, narrow, (0.01, 0.0, -0.2)),
        Link(rotation_about((1.0, 0.0, 0.0), 0.3), upright, (0.0, 0.01, -0.15)),
    )
    chain, rng = Chain(links), np.random.default_rng(5)
    fabrik = Fabrik.of(chain, 1e-4)
    reached = 0
    for _ in range(60):
        legal = chain.clamp(rng.uniform(-1.0, 1.2, 6))
        result = fabrik.solve(as_vector(chain.forward(legal)[0][-1]))
        reached += result.reached
        for (a, f), rotor in zip(result.angles.reshape(3, 2)[1:], (narrow, upright), strict=True):
            low, high = abduction_span(rotor.limits, f)
            assert low <= a <= high
            assert rotor.flexion_rad[0] <= f <= rotor.flexion_rad[1]
        assert _consistent(chain, result, (0.0, 0.0, 0.0))
    assert reached >= 45


@given(st.integers(0, 4), st.tuples(*[st.floats(-0.12, 0.12)] * 3), st.sampled_from(["right", "left"]))
def test_no_joint_twists(finger: int, local: Vector, side: str) -> None:
    # a twist of a bone about itself would show in the axis of the next hinge, which only the angles may turn
    fabrik, closed_form = _finger(side, "D", finger)
    x, y, z = (a + b for a, b in zip(local, closed_form.root, strict=True))
    for result in (
        fabrik.solve((x, y, z), None, closed_form.root),
        _with_initial(fabrik, closed_form, (x, y, z)),
    ):
        parent = np.eye(3)
        for k, link in enumerate(fabrik.chain.links):
            child = np.array(result.orientations[k])
            own = np.array(link.rotation).T @ parent.T @ child
            if isinstance(link.joint, Hinge):
                assert own @ np.array(link.joint.axis) == pytest.approx(np.array(link.joint.axis), abs=1e-12)
            else:  # no turn about y and then about x gives the row of y another x than the rest pose has
                assert own[1, 0] == pytest.approx(link.joint.rest[1][0], abs=1e-12)
            parent = child


def test_the_twist_test_sees_a_planted_twist() -> None:
    rest = rotation(Rotor((-1.0, 1.0), (-1.0, 1.0)).limits, (0.3, 0.4))
    twisted = product(rest, rotation_about((0.0, 0.0, 1.0), 0.01))
    assert rest[1][0] == pytest.approx(0.0, abs=1e-12)
    assert abs(twisted[1][0]) > 1e-3


def test_root_and_frame_only_move_the_answer() -> None:
    fabrik, closed_form = _finger("right", "K", 1)
    frame = product(rotation_about((0.0, 1.0, 0.0), 1.0), rotation_about((1.0, 0.0, 0.0), -2.0))
    root = (0.3, -0.2, 0.9)
    x, y, z = closed_form.forward((0.1, 0.7, 0.8, closed_form.ratio * 0.8))
    local = (x - closed_form.root[0], y - closed_form.root[1], z - closed_form.root[2])
    moved = rotate(frame, local)
    target = (moved[0] + root[0], moved[1] + root[1], moved[2] + root[2])
    a, b = fabrik.solve(local), fabrik.solve(target, None, root, frame)
    assert b.angles[:2] == pytest.approx(a.angles[:2], abs=1e-6)
    back = [rotate_back(frame, as_vector(p - root)) for p in b.positions]
    assert np.array(back) == pytest.approx(a.positions, abs=1e-7)
    assert as_vector(b.positions[0]) == root


def test_too_far_is_stretched_and_flagged() -> None:
    fabrik, closed_form = _finger("right", "K", 1)
    assert fabrik.farthest_m == pytest.approx(sum(fabrik.chain.lengths))
    direction = np.array(closed_form.forward((0.0, 0.4, 0.0, 0.0))) - closed_form.root
    target = tuple((np.array(closed_form.root) + 4 * direction).tolist())
    for seed in (None, np.array([0.1, 0.9, 1.0, 0.6])):
        result = fabrik.solve(target, seed, closed_form.root)
        assert result.reach is Reach.TOO_FAR
        assert not result.reached
        tip = np.array(result.positions[-1]) - closed_form.root
        assert tip @ direction / np.linalg.norm(tip) / np.linalg.norm(direction) > 0.99
        assert not _violated(fabrik.chain, result.angles)


def test_too_near_is_flagged() -> None:
    # two bones of 3 and 2 with an elbow of at most 90 deg: nearest is sqrt(13)
    links = (
        Link(IDENTITY, Rotor((-1.0, 1.0), (-1.0, 1.0)), (0.0, 0.0, -0.03)),
        Link(IDENTITY, Hinge(0.0, math.pi / 2), (0.0, 0.0, -0.02)),
    )
    assert least_root_to_end(Chain(links)) == pytest.approx(math.sqrt(13) / 100, abs=1e-6)
    result = Fabrik.of(Chain(links)).solve((0.0, -0.01, -0.01))
    assert result.reach is Reach.TOO_NEAR
    assert not result.reached
    assert math.isfinite(result.residual_m)


@given(
    st.integers(0, 4),
    st.one_of(
        st.tuples(*[st.floats(-0.2, 0.2)] * 3),
        st.sampled_from(
            [(0.0, 0.0, 0.0), (0.0, 0.0, 0.05), (0.0, 0.0, -0.05), (1e-12, 0.0, 0.0), (1e8, 0.0, 0.0)]
        ),
    ),
)
def test_no_finite_target_gives_nan_or_raises(finger: int, local: Vector) -> None:
    fabrik, closed_form = _finger("right", "D", finger)
    target = tuple(a + b for a, b in zip(local, closed_form.root, strict=True))
    for result in (
        fabrik.solve((target[0], target[1], target[2]), None, closed_form.root),
        _with_initial(fabrik, closed_form, (target[0], target[1], target[2])),
    ):
        assert np.isfinite(result.positions).all()
        assert np.isfinite(result.orientations).all()
        assert not _violated(fabrik.chain, result.angles)
        assert result.residual_m == pytest.approx(
            math.dist(result.positions[-1], target), rel=1e-9, abs=1e-12
        )
        assert result.reached == (result.residual_m <= 1e-5)
        assert result.degenerate == (length(local) < 1e-9)


def test_not_seen_is_nan_and_says_so() -> None:
    fabrik, closed_form = _finger("right", "K", 0)
    for result in (
        fabrik.solve((math.nan, 0.0, 0.0)),
        _with_initial(fabrik, closed_form, (0.0, math.inf, 0.0)),
    ):
        assert result.reach is Reach.NOT_SEEN
        assert not result.reached
        assert np.isnan(result.positions).all()
        assert result.angles.shape == (4,)


def test_a_bone_without_length_is_flagged_and_solved_round() -> None:
    links = (
        Link(IDENTITY, Rotor((-1.0, 1.0), (-1.0, 1.0)), (0.0, 0.0, -0.03)),
        Link(IDENTITY, Hinge(0.0, 1.5), (0.0, 0.0, 0.0)),
        Link(IDENTITY, Hinge(0.0, 1.5), (0.0, 0.0, -0.02)),
    )
    chain = Chain(links)
    target = as_vector(chain.forward(np.array([0.2, 0.3, 0.4, 0.5]))[0][-1])
    result = Fabrik.of(chain).solve(target)
    assert result.degenerate
    assert np.isfinite(result.positions).all()
    assert result.residual_m < 1e-3


def test_wrong_chains_and_settings_are_refused() -> None:
    link = Link(IDENTITY, Hinge(0.0, 1.0), (0.0, 0.0, -0.1))
    with pytest.raises(ValueError, match="needs a link"):
        Chain(())
    with pytest.raises(ValueError, match="coupling"):
        Chain((link, link), Coupling(1, 0, 0.7))
    with pytest.raises(ValueError, match="positive"):
        Fabrik.of(Chain((link,)), 0.0)
    with pytest.raises(ValueError, match="0 to 3"):
        Fabrik.of(Chain((link,)), restarts=4)
    with pytest.raises(ValueError, match="2 angles for a chain that has 1"):
        Fabrik.of(Chain((link,))).solve((0.0, 0.0, -0.1), np.array([0.1, 0.2]))


def test_uncoupled_finger_keeps_the_dip_free() -> None:
    model = HandModel.of(generated_profile("made", "right"))
    assert finger_chain(model, 1, np.zeros(3)).coupling == Coupling(1, 2, 2 / 3)
    assert finger_chain(model, 1, np.zeros(3), coupled=False).coupling is None
    assert finger_chain(model, 0, np.zeros(3)).coupling is None
