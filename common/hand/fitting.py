"""A fit adapts a hand profile and its posture prior to recorded joints.

The posture prior is one normal distribution of all 20 angles, for fingers move together. A recording is one sample of
how a person moves, so it is shrunk towards a wide prior as if that had been seen in `prior_samples` independent frames
(the normal-inverse-Wishart mean; Gelman et al., "Bayesian Data Analysis", 3rd edition 2013, section 3.6). Of T frames
T (1 - r) / (1 + r) are independent, with r the correlation of one frame with the next.

The profile comes from another tracker (Leap, WebXR). One that reports joint *frames* (WebXR) shows the rest pose
itself in one flat hand. One that reports joint *places* shows it in a motion: bones are the mean distances, the palm
the median places of the roots, and the hinges follow from the planes in which fingers bend. With n the normal of that
plane,

    finger   n = R_y(abduction) n_rest: its height in the palm is the same in every frame and gives the hinge's roll
    thumb    n = R_rest R_y(abduction) x: all n lie in one plane, whose normal is the abduction's axis

A finger's rest heading is the median of where its first bone points in the palm's plane, less what the roll of its
hinge turns it by at its flexion: so abduction is zero in the middle of the motion. At rest all bones of a finger are
in one line. What is left is how far our joints (`docs/frames.md`) differ from the recorded ones: abduction turns about
the palm's y for every finger, and other hands lean that axis by 10 to 20 degrees.

Three back markers lie above metacarpals, where skin moves least, and span a triangle as large as the back of a hand
allows: noise of 1 mm turns one with sides of 4 to 5 cm by a degree or two.
"""

import logging

import numpy as np
from msgspec.structs import replace

from common.arrays import Float, Int
from common.calibration import (
    Couplings,
    FingerLimits,
    HandProfile,
    Limits,
    MarkerMount,
    Posture,
    Quaternion,
    RestJoint,
    Vector3,
)
from common.errors import CalibrationError
from common.geometry.transforms import matrix_to_quaternion
from common.hand.model import CHAINS, FINGERS, JOINTS, METACARPALS, PALM_FRAME, TIPS, WEBXR_JOINTS, HandModel
from common.hand.profiles import THUMB_DORSAL, joint_frame, preset_limits

# What is expected of any hand: means and standard deviations [deg], rounded, of hands at work.
_PRIOR_MEAN = np.radians([[5.0, 5.0, 10.0, 15.0], *[[0.0, 20.0, 30.0, 15.0]] * 4])
_PRIOR_SIGMA = np.radians([[15.0, 15.0, 20.0, 25.0], *[[8.0, 25.0, 30.0, 18.0]] * 4])
_LEAST_RAD = np.radians(0.5)  # no angle is known better by the others, whatever its tracker reports


def joint_angles(model: HandModel, fingers_m: Float) -> Float:
    """Angles (T, 5, 4) [rad] of recorded joints, regardless of limits.

    `fingers_m` (T, 5, 4, 3) [m]: joints of `CHAINS`, palm frame. Flexions are about the hinges of the model; an
    abduction is 0 where a finger points straight down or up: it shows none.
    """
    bones = np.diff(fingers_m, axis=2)
    bones = bones / np.linalg.norm(bones, axis=3, keepdims=True)
    rest = model.rest_rotation[CHAINS[:, 0]]
    angles = np.empty((len(bones), 5, 4))
    for f in range(5):
        # The first bone is R_y(s a) R (0, -sin b, -cos b): of fingers R is the rest frame and R_y turns in the palm,
        # of the thumb it is the other way round.
        bone = bones[:, f, 0] @ rest[f] if f == 0 else bones[:, f, 0]
        frame = np.eye(3) if f == 0 else rest[f]
        level = np.hypot(frame[1, 1], frame[1, 2])
        lean = np.arctan2(frame[1, 2], frame[1, 1])  # by which the bone is raised at flexion 0
        flexion: Float = np.arcsin(np.clip(-bone[:, 1] / level, -1.0, 1.0)) - lean
        ahead = np.stack([np.zeros_like(flexion), -np.sin(flexion), -np.cos(flexion)], axis=1) @ frame.T
        angle: Float = np.arctan2(bone[:, 0], bone[:, 2]) - np.arctan2(ahead[:, 0], ahead[:, 2])
        angle = (angle + np.pi) % (2.0 * np.pi) - np.pi
        beyond = np.abs(angle) > 0.5 * np.pi  # bent by more than a right angle, not turned about
        flexion = np.where(beyond, np.pi - flexion - 2.0 * lean, flexion)
        angle = np.where(beyond, angle - np.copysign(np.pi, angle), angle)
        upright = 0.3  # cosine of the flexion beyond which a finger shows no abduction
        angles[:, f, 0] = np.where(np.cos(flexion) > upright, model.side_sign * angle, 0.0)
        angles[:, f, 1] = flexion
        hinge = _hinge(rest[f], angle, f == 0)
        for k in (1, 2):
            sine_of = (np.cross(bones[:, f, k - 1], bones[:, f, k]) * hinge).sum(axis=1)
            angles[:, f, 1 + k] = np.arctan2(sine_of, (bones[:, f, k - 1] * bones[:, f, k]).sum(axis=1))
    return angles


def _hinge(rest: Float, angle: Float, thumb: bool) -> Float:
    """Flexion axis (T, 3), palm frame: -x of the joint at abduction angles (T,)."""
    about = np.zeros((len(angle), 3, 3))
    about[:, 0, 0] = about[:, 2, 2] = np.cos(angle)
    about[:, 0, 2], about[:, 2, 0], about[:, 1, 1] = np.sin(angle), -np.sin(angle), 1.0
    return -(rest @ about)[:, :, 0] if thumb else -(about @ rest)[:, :, 0]


def fit_posture(angles_rad: Float) -> Posture:
    """Fit the posture prior to a motion (T, 5, 4) [rad], evenly spaced in time.

    Raises:
        CalibrationError: There are fewer than 20 frames.
    """
    fewest = 20  # frames below which a motion carries no information
    if len(angles_rad) < fewest:
        raise CalibrationError(f"posture: a motion of {len(angles_rad)} frames; {fewest} are needed")
    known = angles_rad.reshape(len(angles_rad), 20)
    count = _independent(known)
    prior_samples = 1.0
    share = count / (count + prior_samples)
    off = known.mean(axis=0) - _PRIOR_MEAN.ravel()
    mean = _PRIOR_MEAN.ravel() + share * off
    cov = share * np.cov(known.T) + (1.0 - share) * (_prior_cov() + share * np.outer(off, off))
    cov += _LEAST_RAD**2 * np.eye(20)
    return Posture(_numbers(mean), tuple(_numbers(row) for row in cov))


def _prior_cov() -> Float:
    """(20, 20) [rad^2]: neighbouring fingers move alike, the thumb by itself."""
    f, g = np.indices((5, 5))
    # correlation of an angle with that of the next finger
    alike = np.where((f > 0) & (g > 0), 0.8 ** np.abs(f - g), f == g)
    joint = np.kron(alike, np.eye(4))
    return np.asarray(joint * np.outer(_PRIOR_SIGMA, _PRIOR_SIGMA), np.float64)


def reached_limits(limits: Limits, angles_rad: Float) -> Limits:
    """Limits, moved out to where a motion (T, 5, 4) [rad] went for 1 % of its time."""
    low, high = np.percentile(angles_rad, [1.0, 99.0], axis=0)
    fingers: dict[str, FingerLimits] = {}
    for f, name in enumerate(FINGERS):
        own: FingerLimits = getattr(limits, name)
        spans: dict[str, tuple[float, float]] = {}
        for k, angle in enumerate(("abduction_rad", "flexion_rad", "pip_rad", "dip_rad")):
            least, most = getattr(own, angle)
            spans[angle] = round(min(least, float(low[f, k])), 4), round(max(most, float(high[f, k])), 4)
        fingers[name] = replace(own, **spans)
    return Limits(**fingers)


def _independent(samples: Float) -> float:
    """Effective number of independent samples of a motion (T, K)."""
    off = samples - samples.mean(axis=0)
    correlation = np.clip(
        (off[1:] * off[:-1]).sum(axis=0) / np.maximum((off * off).sum(axis=0), 1e-12), 0.0, 0.9999
    )
    return float(np.median(len(samples) * (1.0 - correlation) / (1.0 + correlation)))


def _numbers(values: Float) -> tuple[float, ...]:
    return tuple(round(float(value), 6) for value in values)


_LOG = logging.getLogger(__name__)

_BENT = np.radians(5.0)  # a finger that never bends further has no plane
_LEVEL = 0.5  # cosine of the flexion beyond which the heading of a finger is not observable
_LEAST_SPREAD = np.radians(2.0)  # of a DIP about its share of the PIP: no hand is a gear


def profile_from_rest(
    name: str,
    side: str,
    position_m: Float,
    rotation: Float,
    limits: Limits | None = None,
    couplings: Couplings | None = None,
) -> HandProfile:
    """The profile of a hand whose flat pose is known with all joint frames.

    Args:
        name: Of the profile.
        side: "left" or "right".
        position_m: (25, 3) [m] WebXR joints, in the frame of the wrist joint (OpenXR: -z to the fingers, +y dorsal).
        rotation: (25, 3, 3) their frames in that one.
        limits, couplings: None: the default.

    Raises:
        CalibrationError: The side is neither.
    """
    if side not in ("left", "right"):
        raise CalibrationError(f"hand {name!r}: side {side!r}: left or right")
    to_palm = np.diag([-1.0, 1.0, -1.0])  # our palm frame has its z to the fingers
    place, rotated = position_m @ to_palm, to_palm @ rotation
    joints = {
        joint: RestJoint(position_m=_vector(place[k]), orientation_wxyz=_quaternion(rotated[k]))
        for k, joint in enumerate(WEBXR_JOINTS)
    }
    knuckle, base = place[CHAINS[2, 0] - 1], place[METACARPALS[1] - 1]
    back_m = 0.012  # the skin of the back above the bones
    back = 0.5 * (knuckle + base) + [0.0, back_m, 0.0]
    tips = {
        marker: MarkerMount(joint=JOINTS[int(tip)], offset_m=(0.0, 0.0, 0.0))
        for marker, tip in zip(FINGERS, TIPS, strict=True)
    }
    return HandProfile(
        version=1,
        name=name,
        side="right" if side == "right" else "left",
        rest_joints=joints,
        markers={**tips, "back": MarkerMount(joint=PALM_FRAME, offset_m=_vector(back))},
        limits_rad=limits,
        couplings=couplings,
    )


def profile_from_joints(
    name: str, side: str, fingers_m: Float, limits: Limits | None = None, couplings: Couplings | None = None
) -> HandProfile:
    """The profile of a hand whose joints were recorded in motion.

    Args:
        name: Of the profile.
        side: "left" or "right".
        fingers_m: (T, 5, 4, 3) [m] joints of the fingers' chains (`CHAINS`) in the palm frame, origin at the wrist.
        limits: Of the angles; None: those of preset K, moved out to where the motion went.
        couplings: None: couplings and posture prior are fitted to the motion.

    Raises:
        CalibrationError: The side is neither, or a finger never bends by 5 degrees: its hinge is not known.
    """
    roots = np.median(fingers_m[:, :, 0], axis=0)
    steps = np.diff(fingers_m, axis=2)
    lengths = np.linalg.norm(steps, axis=3)
    bones = steps / lengths[..., None]
    normals = np.cross(bones[:, :, :2], bones[:, :, 1:]).sum(axis=2)  # (T, 5, 3), as long as it is bent
    position, rotation = np.zeros((26, 3)), np.tile(np.eye(3), (26, 1, 1))
    rotation[:] = joint_frame(np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]))
    for f, chain in enumerate(CHAINS):
        if np.linalg.norm(normals[:, f], axis=1).max() < 2.0 * np.sin(_BENT):
            raise CalibrationError(
                f"hand {name!r}: the {FINGERS[f]} never bends by 5 degrees, so its hinge is not known: record a fist"
            )
        rest = (
            _finger_rest(bones[:, f], normals[:, f])
            if f
            else _thumb_rest(bones[:, 0], normals[:, 0], side == "right")
        )
        ends = np.concatenate([[0.0], np.cumsum(lengths[:, f].mean(axis=0))])
        position[chain] = roots[f] - ends[:, None] * rest[:, 2]
        rotation[chain] = rest
    for base, knuckle in zip(METACARPALS, CHAINS[1:, 0], strict=True):
        # metacarpal joints lie about there on the way from the wrist to the knuckles
        position[base] = 0.3 * position[knuckle]
        rotation[base] = joint_frame(position[knuckle], np.array([0.0, 1.0, 0.0]))
    from_palm = np.diag([-1.0, 1.0, -1.0])
    profile = profile_from_rest(
        name, side, position[1:] @ from_palm, from_palm @ rotation[1:], limits, couplings
    )
    model = HandModel.of(profile)
    angles = joint_angles(model, fingers_m)
    _warn(model, fingers_m, angles)
    if limits is None:
        profile = replace(profile, limits_rad=reached_limits(preset_limits("K"), angles))
    return profile if couplings is not None else _with_posture(profile, angles)


def _warn(model: HandModel, fingers_m: Float, angles: Float) -> None:
    """Warn of fingers that the profile does not follow, or rests unlike the motion."""
    off = np.linalg.norm(model.chains(angles).position_m - fingers_m, axis=3).mean(axis=(0, 2))
    steps = np.diff(fingers_m[:, 1:, :2], axis=2)[:, :, 0]
    flat = np.hypot(steps[..., 0], steps[..., 2]) > _LEVEL * np.linalg.norm(steps, axis=2)
    azimuth = np.where(flat, np.arctan2(steps[..., 0], steps[..., 2]), np.nan)
    rest = -model.rest_rotation[CHAINS[1:, 0], :, 2]
    opened = flat.any(axis=0)
    aside = np.zeros(4)
    aside[opened] = np.nanmedian(azimuth[:, opened], axis=0) - np.arctan2(rest[:, 0], rest[:, 2])[opened]
    aside = np.degrees((aside + np.pi) % (2.0 * np.pi) - np.pi)
    for f, finger in enumerate(FINGERS):
        followed_m = 5e-3  # mean distance of recorded joints beyond which a finger is not followed
        if off[f] > followed_m:
            _LOG.warning(
                "hand %r: the %s of the profile is %.0f mm off the recorded joints: its hinges differ from ours",
                model.profile.name,
                finger,
                1e3 * off[f],
            )
        aside_deg = 15.0  # of a rest heading, from the median of the motion
        if f and abs(aside[f - 1]) > aside_deg:
            _LOG.warning(
                "hand %r: the rest heading of the %s is %.0f degrees off the median of the motion: record it open, too",
                model.profile.name,
                finger,
                aside[f - 1],
            )


def _with_posture(profile: HandProfile, angles: Float) -> HandProfile:
    """The profile with couplings and posture prior fitted to angles (T, 5, 4) [rad]."""
    flexion, pip, dip = angles[:, 1:, 1].ravel(), angles[:, 1:, 2].ravel(), angles[:, 1:, 3].ravel()
    power = float(pip @ pip)
    ratio = max(float(pip @ dip) / power, 0.0)
    spread = max(float((dip - ratio * pip).std()), _LEAST_SPREAD)
    couplings = Couplings(
        dip_per_pip=round(ratio, 4),
        dip_spread_rad=round(spread, 4),
        mcp_per_pip=round(max(float(pip @ flexion) / power, 0.0), 4),
    )
    return replace(profile, couplings=couplings, posture=fit_posture(angles))


def _finger_rest(bones: Float, normals: Float) -> Float:
    """Rest frame (3, 3) of a finger, of unit bones (T, 3, 3) and normals (T, 3)."""
    height = normals[:, 1].sum() / np.linalg.norm(normals, axis=1).sum()
    level = np.sqrt(1.0 - height * height)  # cosine of the roll of the hinge, `height` its sine
    # The proximal bone at flexion a: -level sin a above the palm, and ahead and aside of the rest heading in it.
    sine = np.clip(-bones[:, 0, 1] / level, -1.0, 1.0)
    ahead = np.sqrt(1.0 - sine * sine)
    rotated = np.arctan2(bones[:, 0, 0], bones[:, 0, 2]) - np.arctan2(height * sine, ahead)
    shows = ahead > _LEVEL
    if not shows.any():  # a finger that is never opened: across the hinge
        shows = np.linalg.norm(normals, axis=1) > 2.0 * np.sin(_BENT)
        rotated = np.arctan2(-normals[:, 2], normals[:, 0])
    rotated = rotated[shows]
    middle = np.arctan2(np.sin(rotated).mean(), np.cos(rotated).mean())
    middle += np.median((rotated - middle + np.pi) % (2.0 * np.pi) - np.pi)
    heading = np.array([np.sin(middle), 0.0, np.cos(middle)])
    across = np.cross([0.0, 1.0, 0.0], heading)
    hinge = -(level * across + height * np.array([0.0, 1.0, 0.0]))
    return np.stack([hinge, np.cross(-heading, hinge), -heading], axis=1)


def _thumb_rest(bones: Float, normals: Float, right: bool) -> Float:
    """Rest frame (3, 3) of the thumb's CMC; its y is what abduction turns about."""
    _, spread, axes = np.linalg.svd(normals)
    heading = bones[_extended(bones), 0].mean(axis=0)
    # Without a motion of the CMC, any axis across the one hinge would do: that across the rest direction.
    dorsal = axes[2] if spread[1] > 5.0 * spread[2] else np.cross(axes[0], heading)
    dorsal = dorsal * np.sign(dorsal @ (np.array(THUMB_DORSAL) * [1.0 if right else -1.0, 1.0, 1.0]))
    dorsal /= np.linalg.norm(dorsal)
    return joint_frame(heading - (heading @ dorsal) * dorsal, dorsal)


def _extended(bones: Float) -> Int:
    """The tenth of the frames in which a finger (T, 3, 3) is straightest and level."""
    straight = (bones[:, 0] * bones[:, 1]).sum(axis=1)
    level = 1.0 - np.abs(bones[:, 0, 1])
    extended = 0.1  # share of the frames that counts as most extended, of a thumb
    return np.argsort(-(straight + level))[: max(1, round(extended * len(bones)))]


def _vector(value: Float) -> Vector3:
    x, y, z = (float(number) for number in value)
    return x, y, z


def _quaternion(rotation: Float) -> Quaternion:
    w, x, y, z = (float(number) for number in matrix_to_quaternion(rotation))
    return w, x, y, z


# Marker: joints at both ends of a metacarpal, and how far along it.
_PLACES = {
    "back": ("middle-finger-metacarpal", "middle-finger-phalanx-proximal", 0.1),
    "back2": ("index-finger-metacarpal", "index-finger-phalanx-proximal", 0.75),
    "back3": ("pinky-finger-metacarpal", "pinky-finger-phalanx-proximal", 0.75),
}


def with_three_back_markers(profile: HandProfile, name: str) -> HandProfile:
    """The hand under another name with markers `back` (moved), `back2` and `back3`.

    Raises:
        CalibrationError: The profile is broken.
    """
    model = HandModel.of(profile)
    mounts = {
        marker: MarkerMount(joint=PALM_FRAME, offset_m=_above(model, *at)) for marker, at in _PLACES.items()
    }
    return replace(profile, name=name, markers=profile.markers | mounts)


def _above(model: HandModel, near: str, far: str, share: float) -> Vector3:
    """Place (3,) [m], palm frame, on the skin above a metacarpal."""
    a, b = (JOINTS.index(joint) for joint in (near, far))
    middle: Float = (1.0 - share) * model.rest_position_m[a] + share * model.rest_position_m[b]
    radius = (1.0 - share) * model.radius_m[a] + share * model.radius_m[b]
    thickness_m = 0.0015  # from skin to the middle of what is painted
    x, y, z = np.round(middle + np.array([0.0, radius + thickness_m, 0.0]), 7).tolist()
    return x, y, z
