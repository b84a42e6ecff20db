"""Tests of the hand model: against a naive chain, conventions worked out by hand, limits, and rendered hands."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from common.arrays import Float
from common.calibration import Couplings, HandProfile, MarkerMount, parse
from common.errors import CalibrationError
from common.geometry.transforms import quaternion_to_matrix, rigid
from common.hand.model import CHAINS, FINGER_JOINTS, JOINTS, WEBXR_JOINTS, HandModel
from common.hand.profiles import generated_profile, preset_couplings, preset_limits
from tests.hand_helpers import LEFT, MARKERS, RIGHT, any_rotation, palm, rendered

MIRROR = np.diag([-1.0, 1.0, 1.0])
BY_SIDE = {"right": RIGHT, "left": LEFT}
seeds = st.integers(0, 2**32 - 1)
# OpenXR 1.0, XrHandJointEXT: the 26 joints and their numbers.
OPENXR = {"palm": 0, "wrist": 1, "thumb-metacarpal": 2, "thumb-tip": 5, "index-finger-metacarpal": 6}
OPENXR |= {
    "index-finger-tip": 10,
    "middle-finger-metacarpal": 11,
    "ring-finger-tip": 20,
    "pinky-finger-tip": 25,
}


def random_pose(seed: int) -> tuple[Float, Float]:
    rng = np.random.default_rng(seed)
    low, high = RIGHT.limits_rad[..., 0], RIGHT.limits_rad[..., 1]
    T = rigid(any_rotation(rng), rng.normal(0.0, 0.5, 3))
    return T, rng.uniform(low, high)


def naive(profile: HandProfile, T_rig_palm: Float, angles: Float) -> dict[str, Float]:
    """Joint poses (4, 4) by name, joint by joint, from the file alone."""
    rest = {
        name: rigid(quaternion_to_matrix(np.array(j.orientation_wxyz)), np.array(j.position_m))
        for name, j in profile.rest_joints.items()
    }
    sign = 1.0 if profile.side == "right" else -1.0
    out = {name: T_rig_palm @ T for name, T in rest.items()}

    def about(axis: str, angle: float) -> Float:
        return rigid(Rotation.from_euler(axis, angle).as_matrix(), np.zeros(3))

    for f, joints in enumerate(FINGER_JOINTS):
        names = [JOINTS[j] for j in joints][-4:]
        abduction, flexion, pip, dip = (float(a) for a in angles[f])
        root = rest[names[0]]
        at, rotation = rigid(np.eye(3), root[:3, 3]), rigid(root[:3, :3], np.zeros(3))
        swing = about("y", sign * abduction)
        now = at @ (rotation @ swing if f == 0 else swing @ rotation) @ about("x", -flexion)
        out[names[0]] = T_rig_palm @ now
        for before, name, bend in zip(names, names[1:], (pip, dip, 0.0), strict=False):
            now = now @ np.linalg.inv(rest[before]) @ rest[name] @ about("x", -bend)
            out[name] = T_rig_palm @ now
    return out


@pytest.mark.parametrize("side", ["right", "left"])
@given(seeds)
def test_forward_is_the_naive_chain(side: str, seed: int) -> None:
    model, (T, angles) = BY_SIDE[side], random_pose(seed)
    joints = model.forward(T, angles)
    expected = naive(model.profile, T, angles)
    for name in WEBXR_JOINTS:
        index = JOINTS.index(name)
        np.testing.assert_allclose(joints.position_m[index], expected[name][:3, 3], atol=1e-9)
        np.testing.assert_allclose(joints.rotation[index], expected[name][:3, :3], atol=1e-9)
    middle = [expected[f"middle-finger-{part}"][:3, 3] for part in ("metacarpal", "phalanx-proximal")]
    np.testing.assert_allclose(joints.position_m[0], np.mean(middle, axis=0), atol=1e-9)
    np.testing.assert_allclose(joints.rotation[0], joints.rotation[1])


@given(seeds)
def test_left_hand_is_the_mirror_image_of_the_right(seed: int) -> None:
    T, angles = random_pose(seed)
    mirrored = rigid(MIRROR @ T[:3, :3] @ MIRROR, MIRROR @ T[:3, 3])
    right, left = RIGHT.forward(T, angles), LEFT.forward(mirrored, angles)
    np.testing.assert_allclose(left.position_m, right.position_m @ MIRROR, atol=2e-7)  # files hold 0.1 um
    np.testing.assert_allclose(left.rotation, MIRROR @ right.rotation @ MIRROR, atol=1e-6)
    points = [m.marker_points(j, MARKERS) for m, j in ((LEFT, left), (RIGHT, right))]
    np.testing.assert_allclose(points[0], points[1] @ MIRROR, atol=3e-7)


@given(seeds)
def test_bones_keep_their_length_and_the_palm_its_shape(seed: int) -> None:
    T, angles = random_pose(seed)
    rest, bent = RIGHT.forward(np.eye(4), np.zeros((5, 4))), RIGHT.forward(T, angles)
    for joints in FINGER_JOINTS:
        length = [np.linalg.norm(np.diff(j.position_m[list(joints)], axis=0), axis=1) for j in (rest, bent)]
        np.testing.assert_allclose(length[1], length[0], atol=1e-12)
    fixed = [0, 1, *CHAINS[:, 0], 6, 11, 16, 21]
    np.testing.assert_allclose(
        bent.position_m[fixed], rest.position_m[fixed] @ T[:3, :3].T + T[:3, 3], atol=1e-12
    )
    identity = np.swapaxes(bent.rotation, 1, 2) @ bent.rotation
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), (26, 3, 3)), atol=1e-12)


def test_many_poses_at_once_are_the_same_as_one_by_one() -> None:
    poses = [random_pose(seed) for seed in range(6)]
    T, angles = np.array([p[0] for p in poses]), np.array([p[1] for p in poses])
    together = RIGHT.forward(T.reshape(2, 3, 4, 4), angles.reshape(2, 3, 5, 4))
    markers = RIGHT.marker_points(together, MARKERS)
    assert markers.shape == (2, 3, 6, 3)
    for i in range(6):
        alone = RIGHT.forward(T[i], angles[i])
        np.testing.assert_allclose(together.position_m.reshape(6, 26, 3)[i], alone.position_m, atol=1e-14)
        np.testing.assert_allclose(together.rotation.reshape(6, 26, 3, 3)[i], alone.rotation, atol=1e-14)
        np.testing.assert_allclose(
            markers.reshape(6, 6, 3)[i], RIGHT.marker_points(alone, MARKERS), atol=1e-14
        )


def test_joint_order_is_that_of_openxr() -> None:
    assert len(JOINTS) == 26
    assert {name: JOINTS.index(name) for name in OPENXR} == OPENXR
    for chain, joints in zip(CHAINS, FINGER_JOINTS, strict=True):
        assert tuple(chain) == joints[-4:]


# Conventions, worked out by hand on the generated hand of 0.19 m: index MCP, its straight bones along
# (sin 1 deg, 0, cos 1 deg), proximal bone 0.245 of the hand's length.
PROXIMAL_M = 0.245 * 0.19


def bone(model: HandModel, finger: int, angles: Float) -> Float:
    joints = model.forward(np.eye(4), angles)
    return joints.position_m[CHAINS[finger, 1]] - joints.position_m[CHAINS[finger, 0]]


@pytest.mark.parametrize("side", ["right", "left"])
def test_flexion_of_a_quarter_turn_points_the_finger_out_of_the_palm(side: str) -> None:
    angles = np.zeros((5, 4))
    angles[1, 1] = np.pi / 2
    np.testing.assert_allclose(bone(BY_SIDE[side], 1, angles), [0.0, -PROXIMAL_M, 0.0], atol=1e-6)


@pytest.mark.parametrize(("side", "to_thumb"), [("right", 1.0), ("left", -1.0)])
def test_abduction_is_positive_towards_the_thumb(side: str, to_thumb: float) -> None:
    model, angles = BY_SIDE[side], np.zeros((5, 4))
    assert np.sign(model.rest_position_m[CHAINS[0, 0], 0]) == to_thumb
    angles[1, 0] = np.radians(14.0)
    expected = PROXIMAL_M * np.array([to_thumb * np.sin(np.radians(15.0)), 0.0, np.cos(np.radians(15.0))])
    np.testing.assert_allclose(bone(model, 1, angles), expected, atol=1e-6)


def test_pip_of_a_quarter_turn_bends_only_what_follows() -> None:
    angles = np.zeros((5, 4))
    angles[2, 2] = np.pi / 2
    joints = RIGHT.forward(np.eye(4), angles)
    rest = RIGHT.rest_position_m
    np.testing.assert_allclose(joints.position_m[CHAINS[2, :2]], rest[CHAINS[2, :2]], atol=1e-15)
    np.testing.assert_allclose(
        joints.position_m[CHAINS[2, 2]], rest[CHAINS[2, 1]] + [0.0, -0.170 * 0.19, 0.0], atol=1e-6
    )
    others = np.delete(np.arange(26), CHAINS[2, 2:])
    np.testing.assert_allclose(joints.position_m[others], rest[others], atol=1e-15)


# Limits of the two presets [deg]: MCP flexion, abduction, PIP, DIP of index ... little.
PRESETS = {
    "K": ((0, 90), (-15, 15), (0, 110), (0, 90), (0, 0)),
    "D": ((0, 100), (-20, 20), (0, 120), (0, 101), (-20, 20)),
}


@pytest.mark.parametrize("preset", ["K", "D"])
def test_presets_hold_the_published_limits(preset: str) -> None:
    limits = preset_limits("K" if preset == "K" else "D")
    flexion, abduction, pip, dip, middle = PRESETS[preset]
    for finger in ("index", "middle", "ring", "little"):
        of = getattr(limits, finger)
        np.testing.assert_allclose(np.degrees(of.flexion_rad), flexion)
        np.testing.assert_allclose(np.degrees(of.abduction_rad), middle if finger == "middle" else abduction)
        np.testing.assert_allclose(np.degrees(of.pip_rad), pip)
        np.testing.assert_allclose(np.degrees(of.dip_rad), dip)
        assert (
            of.spread_at_full_flexion == 15 / 24
        )  # Lutsky et al. 2014: 15 deg at 90 deg of flexion, 24 at 0
    thumb = limits.thumb
    assert thumb.spread_at_full_flexion == 1.0
    np.testing.assert_allclose(np.degrees(thumb.flexion_rad), (-15, 50))
    np.testing.assert_allclose(np.degrees(thumb.abduction_rad), (-20, 50))
    np.testing.assert_allclose(np.degrees(thumb.pip_rad), (-10, 60))
    np.testing.assert_allclose(np.degrees(thumb.dip_rad), (-15, 85))


def test_presets_hold_the_published_couplings() -> None:
    assert preset_couplings("K").dip_per_pip == pytest.approx(2 / 3)
    assert preset_couplings("D") == Couplings(dip_per_pip=0.84, mcp_per_pip=0.54)
    assert RIGHT.dip_per_pip == pytest.approx(2 / 3)  # K is what a profile without limits gets
    np.testing.assert_allclose(np.degrees(RIGHT.limits_rad[1, 2]), (0, 110))


@pytest.mark.parametrize("preset", ["K", "D"])
def test_a_profile_may_name_a_preset(preset: str) -> None:
    text = msgspec.json.encode(generated_profile("named", "right")).decode()
    named = text.replace(
        '"limits_rad":null,"couplings":null', f'"limits_rad":"{preset}","couplings":"{preset}"'
    )
    model = HandModel.of(parse(named.encode(), HandProfile, "named.json"))
    written = preset_limits("K" if preset == "K" else "D")
    spelt = HandModel.of(msgspec.structs.replace(RIGHT.profile, limits_rad=written))
    np.testing.assert_array_equal(model.limits_rad, spelt.limits_rad)
    assert model.dip_per_pip == pytest.approx(2 / 3 if preset == "K" else 0.84)
    with pytest.raises(CalibrationError, match=r"named.json.*limits_rad"):
        parse(
            named.replace(f'"limits_rad":"{preset}"', '"limits_rad":"Q"').encode(), HandProfile, "named.json"
        )


def test_limits_are_checked_angle_by_angle() -> None:
    angles = np.zeros((5, 4))
    angles[3, 2] = np.radians(110.1)
    inside = RIGHT.within_limits(angles)
    assert not inside[3, 2]
    assert inside.sum() == 19
    assert not RIGHT.within_limits(np.full((5, 4), np.nan)).any()


def narrowed(share: float, preset: str = "D") -> HandModel:
    """A hand whose index keeps a share of its abduction in a fist."""
    limits = preset_limits("K" if preset == "K" else "D")
    index = msgspec.structs.replace(limits.index, spread_at_full_flexion=share)
    limits = msgspec.structs.replace(limits, index=index)
    return HandModel.of(msgspec.structs.replace(RIGHT.profile, limits_rad=limits))


def test_abduction_narrows_by_a_parabola() -> None:
    model = narrowed(0.4)
    flexion = np.radians([[-5.0], [0.0], [50.0], [100.0], [120.0]]) * np.ones(5)
    low, high = model.abduction_limits_rad(flexion)
    # 20 deg, of which 60 % go with the square of the flexion: half way a quarter of them.
    np.testing.assert_allclose(np.degrees(high[:, 1]), [20, 20, 20 * (1 - 0.6 / 4), 8, 8])
    np.testing.assert_allclose(low[:, 1], -high[:, 1])
    np.testing.assert_allclose(np.degrees(high[:, 2]), [20, 20, 20 * (1 - 9 / 24 / 4), 12.5, 12.5])
    still = HandModel.of(msgspec.structs.replace(RIGHT.profile, limits_rad=preset_limits("D")))
    np.testing.assert_allclose(np.degrees(narrowed(1.0).abduction_limits_rad(flexion)[1][:, 1]), 20.0)
    np.testing.assert_allclose(high[:, 0], still.limits_rad[0, 0, 1])  # the thumb's stays


def test_a_spread_fist_is_outside_and_cut() -> None:
    model = narrowed(0.4)
    angles = np.zeros((2, 5, 4))
    angles[:, 1, 0] = np.radians(15.0)
    angles[1, 1, 1] = np.radians(100.0)
    inside = model.within_limits(angles)
    assert inside[0].all()
    assert not inside[1, 1, 0]
    assert inside.sum() == 39
    assert narrowed(1.0).within_limits(angles).all()
    cut = model.clamp(angles)
    np.testing.assert_array_equal(cut[0], angles[0])
    assert np.degrees(cut[1, 1, 0]) == pytest.approx(8.0)
    assert model.within_limits(cut, 0.0).all()
    angles[0, 1, 1] = np.nan
    assert not model.within_limits(angles)[0, 1, :2].any()


def test_couplings_are_off_soft_or_fixed() -> None:
    def of(couplings: Couplings) -> HandModel:
        return HandModel.of(msgspec.structs.replace(RIGHT.profile, couplings=couplings))

    assert (RIGHT.dip_spread_rad, RIGHT.neighbours) == (0.0, True)
    assert of(Couplings(dip_per_pip=None)).dip_per_pip is None
    soft = of(Couplings(dip_per_pip=0.84, dip_spread_rad=0.1, mcp_per_pip=None, neighbours=False))
    assert (soft.dip_per_pip, soft.dip_spread_rad, soft.mcp_per_pip, soft.neighbours) == (
        0.84,
        0.1,
        None,
        False,
    )


def test_marker_of_the_palm_follows_the_palm_and_of_a_tip_its_joint() -> None:
    T = palm(np.array([20.0, -10.0, 5.0]))
    joints = RIGHT.forward(T, np.zeros((5, 4)))
    points = RIGHT.marker_points(joints, ("back", "index"))
    offset = np.array(RIGHT.profile.markers["back"].offset_m)
    np.testing.assert_allclose(points[0], T[:3, :3] @ offset + T[:3, 3])
    ahead = -RIGHT.profile.markers["index"].offset_m[2]
    np.testing.assert_allclose(points[1], joints.position_m[10] - ahead * joints.rotation[10, :, 2])
    assert RIGHT.mount("back").finger is None
    assert RIGHT.mount("little").finger == 4


# Broken profiles: what is done to the file, and what the error must name.
def without(profile: HandProfile) -> HandProfile:
    joints = {k: v for k, v in profile.rest_joints.items() if k != "ring-finger-tip"}
    return msgspec.structs.replace(profile, rest_joints=joints)


def with_joint(profile: HandProfile, name: str, **changes: object) -> HandProfile:
    old = profile.rest_joints.get(name, profile.rest_joints["wrist"])
    return msgspec.structs.replace(
        profile, rest_joints={**profile.rest_joints, name: msgspec.structs.replace(old, **changes)}
    )


def crossed(profile: HandProfile) -> HandProfile:
    limits = preset_limits("K")
    ring = msgspec.structs.replace(limits.ring, pip_rad=(1.0, 0.5))
    return msgspec.structs.replace(profile, limits_rad=msgspec.structs.replace(limits, ring=ring))


def spread_without_zero(profile: HandProfile) -> HandProfile:
    limits = preset_limits("K")
    ring = msgspec.structs.replace(limits.ring, abduction_rad=(0.1, 0.2), spread_at_full_flexion=0.5)
    return msgspec.structs.replace(profile, limits_rad=msgspec.structs.replace(limits, ring=ring))


def spread_without_ratio(profile: HandProfile) -> HandProfile:
    return msgspec.structs.replace(profile, couplings=Couplings(dip_per_pip=None, dip_spread_rad=0.1))


def mounted(profile: HandProfile) -> HandProfile:
    mounts = {**profile.markers, "index": MarkerMount(joint="elbow", offset_m=(0.0, 0.0, 0.0))}
    return msgspec.structs.replace(profile, markers=mounts)


BROKEN: dict[str, tuple[Callable[[HandProfile], HandProfile], tuple[str, ...]]] = {
    "missing joint": (without, ("rest_joints", "ring-finger-tip")),
    "unknown joint": (lambda p: with_joint(p, "elbow"), ("rest_joints", "elbow")),
    "no bone": (
        lambda p: with_joint(p, "thumb-tip", position_m=p.rest_joints["thumb-phalanx-distal"].position_m),
        ("rest_joints", "1 mm"),
    ),
    "crossed limits": (crossed, ("limits_rad.ring.pip_rad",)),
    "narrowing away from zero": (spread_without_zero, ("limits_rad.ring.spread_at_full_flexion", "0.1")),
    "straying from nothing": (spread_without_ratio, ("couplings.dip_spread_rad", "dip_per_pip")),
    "unknown mount": (mounted, ("markers.index.joint", "elbow")),
    "unknown radius": (lambda p: msgspec.structs.replace(p, radius_m={"elbow": 0.01}), ("radius_m", "elbow")),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_profile_is_refused_by_hand_and_key(case: str) -> None:
    spoil, words = BROKEN[case]
    with pytest.raises(CalibrationError) as error:
        HandModel.of(spoil(generated_profile("mine", "right")))
    for word in ("'mine'", *words):
        assert word in str(error.value)


def test_unknown_marker_is_refused_with_those_there_are() -> None:
    with pytest.raises(CalibrationError, match=r"made-right.*'tail'.*thumb, index"):
        RIGHT.mount("tail")


def test_radii_are_complete_where_the_profile_has_none() -> None:
    model = HandModel.of(msgspec.structs.replace(generated_profile("mine", "right"), radius_m=None))
    assert model.radius_m.shape == (26,)
    # The share of the middle finger's proximal bone: 0.145 * 0.266 * 190 mm is a finger tip of 7.3 mm.
    assert model.radius_m[15] == pytest.approx(0.145 * 0.266 * 0.19, rel=1e-3)
    one = msgspec.structs.replace(model.profile, radius_m={"wrist": 0.03})
    assert HandModel.of(one).radius_m[1] == 0.03


@pytest.mark.parametrize(
    "name", ["calib_colors", "static", "flex90", "poses_left", "translate_8ms", "lights_0_warm"]
)
def test_rendered_hands_have_their_joints_where_the_model_puts_them(datasets: Path, name: str) -> None:
    model, T, angles, truth = rendered(datasets / "stereo" / name)
    joints = model.forward(T, angles)
    error_mm = 1e3 * np.linalg.norm(joints.position_m[:, 1:] - truth, axis=-1)
    # The renderer's hinge axes are those of its mesh, ours the joints' own x: about a millimetre at bent tips.
    fingers = np.r_[0, 5:25]
    assert error_mm[:, fingers].mean() < 1.5
    assert error_mm[:, [0, 5, 10, 15, 20]].max() < 0.01
