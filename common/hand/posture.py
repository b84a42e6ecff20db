"""Posture prior of a person.

Joint angles of recorded joints, and a normal distribution fitted to them.

It is one distribution of all 20 angles, for fingers move together: four that each had their own would count four times
how the palm is turned. A recording is one sample of how a person moves, so it is shrunk towards a wide prior as if that
had been seen in `_PRIOR_SAMPLES` independent frames (the normal-inverse-Wishart mean; Gelman et al., "Bayesian Data
Analysis", 3rd edition 2013, section 3.6). How many independent frames there are follows from the correlation of one
frame with the next: T (1 - r) / (1 + r).
"""

import numpy as np
from msgspec.structs import replace

from common.arrays import Float
from common.calibration import FingerLimits, Limits, Posture
from common.errors import CalibrationError
from common.hand.model import CHAINS, FINGERS, HandModel

# What is expected of any hand: means and standard deviations [deg], rounded, of hands at work.
_PRIOR_MEAN = np.radians([[5.0, 5.0, 10.0, 15.0], *[[0.0, 20.0, 30.0, 15.0]] * 4])
_PRIOR_SIGMA = np.radians([[15.0, 15.0, 20.0, 25.0], *[[8.0, 25.0, 30.0, 18.0]] * 4])
_LEAST_RAD = np.radians(0.5)  # no angle is known better by the others, whatever its tracker reports


def joint_angles(model: HandModel, fingers_m: Float) -> Float:
    """Angles (T, 5, 4) [rad] of recorded joints, regardless of limits.

    Args:
        model: The hand.
        fingers_m: (T, 5, 4, 3) [m] joints of `CHAINS`, palm frame.

    Returns:
        Flexions by the hinges of the model; an abduction is 0 where a finger points straight down or up: it shows none.
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
    """Return the flexion axis (T, 3) of a joint, in the palm frame.

    It is -x of the joint, at abduction angles (T,).
    """
    about = np.zeros((len(angle), 3, 3))
    about[:, 0, 0] = about[:, 2, 2] = np.cos(angle)
    about[:, 0, 2], about[:, 2, 0], about[:, 1, 1] = np.sin(angle), -np.sin(angle), 1.0
    return -(rest @ about)[:, :, 0] if thumb else -(about @ rest)[:, :, 0]


def fit_posture(angles_rad: Float) -> Posture:
    """Fit the posture prior to a motion, shrunk as its length demands.

    Args:
        angles_rad: (T, 5, 4) [rad], evenly spaced in time.

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
    """The limits, moved out to where a motion went for a hundredth of its time.

    Args:
        limits: Those of a preset.
        angles_rad: (T, 5, 4) [rad].
    """
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
    """Return the effective number of independent samples of a motion (T, K).

    From the correlation of neighbours.
    """
    off = samples - samples.mean(axis=0)
    correlation = np.clip(
        (off[1:] * off[:-1]).sum(axis=0) / np.maximum((off * off).sum(axis=0), 1e-12), 0.0, 0.9999
    )
    return float(np.median(len(samples) * (1.0 - correlation) / (1.0 + correlation)))


def _numbers(values: Float) -> tuple[float, ...]:
    return tuple(round(float(value), 6) for value in values)
