"""Joint limits: what comes out is inside, idempotent, and nearest for a hinge."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from common.hand.model import HandModel
from common.hand.profiles import generated_profile, preset_limits
from master.fabrik.joints import (
    Hinge,
    Joint,
    Rotor,
    abduction_span,
    clamp,
    fit,
    narrowing,
    rotation,
    swing_and_flex,
)
from master.fabrik.linear_algebra import (
    IDENTITY,
    Matrix,
    Vector,
    between,
    length,
    product,
    rotate,
    rotate_back,
    rotation_about,
)
from master.fabrik.solver import finger_chain

DEGREE = math.pi / 180
FINGER = Hinge(0.0, 110 * DEGREE)
OBLIQUE = Hinge(-30 * DEGREE, 70 * DEGREE, (0.6, 0.0, 0.8))
BOX = Rotor((-15 * DEGREE, 15 * DEGREE), (-10 * DEGREE, 90 * DEGREE))
CONE = Rotor((-15 * DEGREE, 25 * DEGREE), (-20 * DEGREE, 90 * DEGREE), shape="ellipse")
TILTED = rotation_about((0.6, 0.8, 0.0), 0.1)
SHRINKING = Rotor(
    (-20 * DEGREE, 20 * DEGREE), (0.0, 90 * DEGREE), spread_at_full_flexion=0.2, sign=-1.0, rest=TILTED
)
NARROW_CONE = Rotor(
    (-25 * DEGREE, 10 * DEGREE), (-30 * DEGREE, 80 * DEGREE), shape="ellipse", spread_at_full_flexion=0.5
)
MIDDLE = Rotor((0.0, 0.0), (0.0, 90 * DEGREE))
BONE: Vector = (0.002, -0.001, -0.045)
JOINTS: list[Joint] = [FINGER, OBLIQUE, BOX, CONE, SHRINKING, NARROW_CONE, MIDDLE]
ZERO = {True: (0.0,), False: (0.0, 0.0)}

component = st.floats(-1.0, 1.0)
directions = st.tuples(component, component, component).filter(lambda v: length(v) > 1e-3)
frames = st.tuples(directions, st.floats(-3.0, 3.0)).map(
    lambda p: rotation_about((p[0][0] / length(p[0]), p[0][1] / length(p[0]), p[0][2] / length(p[0])), p[1])
)


def _zero(joint: Joint) -> tuple[float, ...]:
    return ZERO[isinstance(joint, Hinge)]


Angles = tuple[float, ...]


def _pair(angles: Angles) -> tuple[float, float]:
    return angles[0], angles[1] if len(angles) > 1 else 0.0


def _rotation(joint: Joint, angles: Angles) -> Matrix:
    return rotation(joint.limits, _pair(angles))


def _clamp(joint: Joint, angles: Angles) -> Angles:
    return clamp(joint.limits, _pair(angles))[: len(angles)]


def _fit(joint: Joint, bone: Vector, direction: Vector, now: Angles) -> Angles:
    return fit(joint.limits, bone, direction, _pair(now))[: len(now)]


def clamp_direction(
    joint: Joint, frame: Matrix, bone: Vector, direction: Vector, now: Angles
) -> tuple[Vector, Angles]:
    """Legal bone direction nearest to a wanted one (world), and its angles."""
    angles = _fit(joint, bone, rotate_back(frame, direction), now)
    return rotate(frame, rotate(_rotation(joint, angles), bone)), angles


def _inside(joint: Joint, angles: tuple[float, ...]) -> bool:
    """The definition of each limit, written out once more."""
    slack = 1e-9
    if isinstance(joint, Hinge):
        return joint.low_rad - slack <= angles[0] <= joint.high_rad + slack
    a, f = angles
    (al, ah), (fl, fh) = joint.abduction_rad, joint.flexion_rad
    share = 1.0 - (1.0 - joint.spread_at_full_flexion) * (max(f, 0.0) / fh) ** 2
    box = al * share - slack <= a <= ah * share + slack and fl - slack <= f <= fh + slack
    if joint.shape == "box":
        return box
    return box and (a / (ah if a > 0 else al)) ** 2 + (f / (fh if f > 0 else fl)) ** 2 <= 1.0 + 1e-6


@pytest.mark.parametrize("joint", JOINTS)
@given(frame=frames, wanted=directions)
def test_clamped_is_inside_and_idempotent(joint: Joint, frame: Matrix, wanted: Vector) -> None:
    out, angles = clamp_direction(joint, frame, BONE, wanted, _zero(joint))
    assert _inside(joint, angles)
    assert length(out) == pytest.approx(length(BONE), abs=1e-12)
    again, _ = clamp_direction(joint, frame, BONE, out, angles)
    assert again == pytest.approx(out, abs=1e-9)


@pytest.mark.parametrize("joint", JOINTS)
@given(frame=frames, share=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), stretch=st.floats(0.01, 50.0))
def test_a_legal_direction_is_unchanged(
    joint: Joint, frame: Matrix, share: tuple[float, float], stretch: float
) -> None:
    if isinstance(joint, Hinge):
        legal: tuple[float, ...] = (joint.low_rad + share[0] * (joint.high_rad - joint.low_rad),)
    else:
        f = joint.flexion_rad[0] + share[1] * (joint.flexion_rad[1] - joint.flexion_rad[0])
        low, high = abduction_span(joint.limits, f)
        legal = (low + share[0] * (high - low), f)
    assert _inside(joint, legal)
    direction = rotate(frame, rotate(_rotation(joint, legal), BONE))
    x, y, z = direction
    out, angles = clamp_direction(joint, frame, BONE, (stretch * x, stretch * y, stretch * z), legal)
    assert out == pytest.approx(direction, abs=1e-8)
    if isinstance(joint, Hinge):
        assert angles == pytest.approx(legal, abs=1e-9)


@pytest.mark.parametrize("joint", [FINGER, OBLIQUE])
@given(frame=frames, wanted=directions)
def test_a_hinge_gives_the_nearest_direction(joint: Hinge, frame: Matrix, wanted: Vector) -> None:
    def closeness(v: Vector) -> float:
        return float(np.dot(v, wanted)) / (length(v) * length(wanted))

    out, _ = clamp_direction(joint, frame, BONE, wanted, (0.0,))
    grid = np.linspace(joint.low_rad, joint.high_rad, 241)
    best = max(closeness(rotate(frame, rotate(_rotation(joint, (float(a),)), BONE))) for a in grid)
    assert closeness(out) >= best - 1e-9


def test_flexion_turns_towards_the_palm_and_abduction_to_the_thumb() -> None:
    # flat hand, -z along the bone, +y dorsal: flexion by 90 deg points to -y; R_y(a) turns -z to -x
    out, angles = clamp_direction(FINGER, IDENTITY, (0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (0.0,))
    assert out == pytest.approx((0.0, -1.0, 0.0), abs=1e-12)
    assert angles[0] == pytest.approx(90 * DEGREE)
    a = 10 * DEGREE
    for sign in (1.0, -1.0):
        rotor = Rotor((-0.3, 0.3), (0.0, 1.5), sign=sign)
        _, pair = clamp_direction(
            rotor, IDENTITY, (0.0, 0.0, -1.0), (-math.sin(a), 0.0, -math.cos(a)), (0.0, 0.0)
        )
        assert pair == pytest.approx((sign * a, 0.0), abs=1e-9)


def test_shapes_by_hand() -> None:
    # half-angles 25 and 90 deg: the ellipse leaves 25 * sqrt(1 - 0.5^2) = 21.65 deg at 45 deg
    assert abduction_span(CONE.limits, 45 * DEGREE)[1] / DEGREE == pytest.approx(25 * math.sqrt(0.75))
    assert abduction_span(CONE.limits, -10 * DEGREE)[0] / DEGREE == pytest.approx(-15 * math.sqrt(0.75))
    assert _clamp(CONE, (50 * DEGREE, 0.0))[0] / DEGREE == pytest.approx(25.0)
    # 45 of 90 deg flexed: a quarter of the 80 % loss
    assert abduction_span(SHRINKING.limits, 45 * DEGREE)[1] / DEGREE == pytest.approx(20 * 0.8)
    assert _clamp(BOX, (1.0, 2.0)) == pytest.approx((15 * DEGREE, 90 * DEGREE))
    assert _clamp(MIDDLE, (0.2, 0.5)) == (0.0, 0.5)


@settings(max_examples=30)
@given(flexion=st.floats(-0.5, 2.0), left=st.floats(0.0, 1.0))
def test_rotor_and_hand_model_narrow_by_one_law(flexion: float, left: float) -> None:
    limits = preset_limits("D")
    limits = msgspec.structs.replace(
        limits, ring=msgspec.structs.replace(limits.ring, spread_at_full_flexion=left)
    )
    model = HandModel.of(msgspec.structs.replace(generated_profile("one", "right"), limits_rad=limits))
    low, high = model.abduction_limits_rad(np.full(5, flexion))
    root = finger_chain(model, 3, np.zeros(3)).links[0].joint
    assert isinstance(root, Rotor)
    assert abduction_span(root.limits, flexion) == (low[3], high[3])  # to the last bit


@given(flexion=st.floats(0.01, 1.5), left=st.floats(0.0, 1.0))
def test_the_derivative_of_the_narrowing(flexion: float, left: float) -> None:
    rotor = Rotor((-0.3, 0.3), (0.0, 1.6), spread_at_full_flexion=left)
    step = 1e-6
    above, below = narrowing(rotor.limits, flexion + step)[0], narrowing(rotor.limits, flexion - step)[0]
    assert narrowing(rotor.limits, flexion)[1] == pytest.approx((above - below) / (2 * step), abs=1e-8)


def test_hinge_goes_round_the_shorter_way() -> None:
    hinge = Hinge(-10 * DEGREE, 100 * DEGREE)
    assert _clamp(hinge, (-170 * DEGREE,)) == (100 * DEGREE,)  # 90 past one end, 160 past the other
    assert _clamp(hinge, (-100 * DEGREE,)) == (-10 * DEGREE,)


@given(
    bone=directions,
    pair=st.tuples(st.floats(-1.4, 1.4), st.floats(-1.5, 1.5)),
    sign=st.sampled_from([-1.0, 1.0]),
)
def test_swing_and_flex_inverts_the_rotation(bone: Vector, pair: tuple[float, float], sign: float) -> None:
    assume(math.hypot(bone[1], bone[2]) > 0.05)
    rotor = Rotor((-3.0, 3.0), (-3.0, 3.0), sign=sign, rest=TILTED)
    target = rotate(_rotation(rotor, pair), bone)
    for found in swing_and_flex(bone, target, TILTED, sign):
        assert rotate(_rotation(rotor, found), bone) == pytest.approx(target, abs=1e-6)


@pytest.mark.parametrize("joint", JOINTS)
def test_no_direction_keeps_the_present_angles(joint: Joint) -> None:
    now = _clamp(joint, (0.1, 0.4)[: len(_zero(joint))])
    assert _fit(joint, BONE, (0.0, 0.0, 0.0), now) == now
    assert _fit(joint, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), now) == now
    if isinstance(joint, Hinge):
        assert _fit(joint, BONE, joint.axis, now) == now  # on the axis every angle is as good


def test_impossible_limits_are_refused() -> None:
    with pytest.raises(ValueError, match="low first"):
        Hinge(1.0, 0.5)
    with pytest.raises(ValueError, match="unit vector"):
        Hinge(0.0, 1.0, (0.0, 0.0, 2.0))
    with pytest.raises(ValueError, match="0 inside"):
        Rotor((0.1, 0.3), (0.0, 1.0), shape="ellipse")
    with pytest.raises(ValueError, match="0 inside"):
        Rotor((-0.1, 0.3), (0.2, 1.0), shape="ellipse")
    with pytest.raises(ValueError, match="0 inside"):
        Rotor((0.1, 0.3), (0.0, 1.0), spread_at_full_flexion=0.5)
    with pytest.raises(ValueError, match="0 \\.\\.\\. 1"):
        Rotor((-0.1, 0.3), (0.0, 1.0), spread_at_full_flexion=1.5)


@pytest.mark.parametrize("flexion", [(0.2, 0.2), (0.2, 1.0), (-0.5, -0.1)])
def test_a_stiff_knuckle_narrows_as_the_hand_model_has_it(flexion: tuple[float, float]) -> None:
    limits = preset_limits("K")
    limits = msgspec.structs.replace(limits, ring=msgspec.structs.replace(limits.ring, flexion_rad=flexion))
    model = HandModel.of(msgspec.structs.replace(generated_profile("one", "right"), limits_rad=limits))
    root = finger_chain(model, 3, np.zeros(3)).links[0].joint
    assert isinstance(root, Rotor)
    for f in flexion:
        low, high = model.abduction_limits_rad(np.full(5, f))
        assert abduction_span(root.limits, f) == pytest.approx((low[3], high[3]))


@given(a=directions, b=directions)
def test_shortest_turn(a: Vector, b: Vector) -> None:
    m = between(a, b)
    assert np.cross(rotate(m, a), b) == pytest.approx(np.zeros(3), abs=1e-7)
    assert np.dot(rotate(m, a), b) > 0
    assert np.array(product(m, tuple(zip(*m, strict=True)))) == pytest.approx(np.eye(3), abs=1e-7)  # pyright: ignore[reportArgumentType]
    back = between(a, (-a[0], -a[1], -a[2]))
    assert rotate(back, a) == pytest.approx((-a[0], -a[1], -a[2]), abs=1e-9)
