"""FABRIK solves a chain of limited joints by passes back and forth.

A chain is in its root frame, its first joint at the origin; kernels see it as `ChainArrays`, its angles as
one array (n,). Link k turns from its parent's frame by the fixed `rotation`, then by its joint's Q(angles):

    O_k = O_{k-1} turn_k Q_k          p_{k+1} = p_k + O_k bone_k

Aristidou & Lasenby, "FABRIK: a fast, iterative solver for the inverse kinematics problem", 2011, with the
joint limits in both passes. One iteration:

    aim        turn the first joint so that the end lies towards the target
    backward   put the end on the target and walk to the root: each bone points as it did, as far as the joint
               between it and the bone behind it allows
    forward    put the root back and walk to the end: each bone points to its place of the backward pass, as far
               as its own joint allows

Aiming is ours: hinges hold the bones in one plane, and a backward pass that starts from a plane beside the
target tilts it the wrong way. The forward pass ends legal; joints keep full orientations, so bones need not
be straight or planar. A coupled hinge follows its leader there. FABRIK as published deadlocks on reachable
targets: a limit flattens a finger and a straight limited chain cannot leave its line. Hence the seed
(`master.fabrik.solver`), and, when an attempt stalls, restarts from bent poses turned to the target. No
finite target raises or gives NaN.
"""

from dataclasses import dataclass, field
from math import sqrt

import numpy as np

from common.arrays import Float
from common.kernels import inner, kernel
from master.fabrik.joints import (
    BONE,
    HINGE,
    KIND,
    ROOT,
    ROTATION,
    START,
    WORLD,
    ChainArrays,
    Hinge,
    Joint,
    Pair,
    angles_of,
    clamp,
    clamp_angles,
    end_of,
    fit,
    follow,
    forward,
    hinge_fit,
    limits_of,
    matrix_at,
    put_angles,
    put_matrix,
    put_vector,
    rest_frame,
    rotation,
    vector_at,
)
from master.fabrik.linear_algebra import (
    Matrix,
    Vector,
    between,
    inverse_3_plus,
    length,
    minus,
    plus,
    product,
    rotate,
    rotate_back,
    rotation_about,
    transposed,
)
from master.fabrik.settings import FABRIK


@dataclass(frozen=True, slots=True)
class Link:
    """One joint and the bone behind it."""

    rotation: Matrix  # rest orientation in the parent's frame (`world` joints: in the root frame)
    joint: Joint
    bone: Vector  # to the next joint, in the joint's own frame [m]


@dataclass(frozen=True, slots=True)
class Coupling:
    """A hinge that follows another within its own limits, by a ratio of angles."""

    leader: int
    follower: int
    ratio: float


@dataclass(frozen=True, slots=True)
class Chain:
    """Links from the root to the end effector; two hinges may be coupled."""

    links: tuple[Link, ...]
    coupling: Coupling | None = None
    arrays: ChainArrays = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.links:
            raise ValueError("a chain needs a link")
        c = self.coupling
        if c is not None:
            hinges = [isinstance(link.joint, Hinge) for link in self.links]
            if not 0 <= c.leader < c.follower < len(hinges) or not (hinges[c.leader] and hinges[c.follower]):
                raise ValueError(
                    f"a coupling leads from a hinge to a later one, not {c.leader} to {c.follower}"
                )
        object.__setattr__(self, "arrays", _arrays(self))

    @property
    def lengths(self) -> tuple[float, ...]:
        """Bone lengths [m]."""
        return tuple(length(link.bone) for link in self.links)

    @property
    def spans(self) -> Float:
        """Low and high (n, 2) of every angle [rad], the abduction not narrowed."""
        return self.arrays.spans

    def clamp(self, angles_rad: Float) -> Float:
        """The nearest legal angles (n,) [rad], coupling obeyed."""
        legal = np.array(angles_rad, np.float64)
        clamp_angles(self.arrays, legal)
        return legal

    def forward(self, angles_rad: Float) -> tuple[Float, Float]:
        """Joint positions (N + 1, 3) [m] and link orientations (N, 3, 3), root frame."""
        positions, orientations = np.zeros((len(self.links) + 1, 3)), np.zeros((len(self.links), 9))
        forward(self.arrays, angles_rad, positions, orientations)
        return positions, orientations.reshape(-1, 3, 3)


def _arrays(chain: Chain) -> ChainArrays:
    joints = [link.joint.limits for link in chain.links]
    counts = [_count(link.joint) for link in chain.links]
    spans: list[Pair] = []
    for joint in joints:
        spans.append((joint.low, joint.high))
        if joint.kind != HINGE:
            spans.append((joint.flexion_low, joint.flexion_high))
    kinds = [(j.kind, link.joint.frame == "world") for j, link in zip(joints, chain.links, strict=True)]
    rows = [
        np.concatenate(
            [np.ravel(link.rotation), np.ravel(j.rest), link.bone, j.axis, [j.spread_at_full_flexion, j.sign]]
        )
        for j, link in zip(joints, chain.links, strict=True)
    ]
    c = chain.coupling or Coupling(-1, -1, 0.0)
    return ChainArrays(
        joints=np.column_stack([kinds, np.cumsum([0, *counts[:-1]])]).astype(np.int64, order="C"),
        spans=np.array(spans, np.float64),
        links=np.array(rows, np.float64),
        leader=c.leader,
        follower=c.follower,
        ratio=float(c.ratio),
    )


def _count(joint: Joint) -> int:
    return 1 if isinstance(joint, Hinge) else 2


@inner
def aim(chain: ChainArrays, end: Vector, goal: Vector, angles: Float) -> None:
    """Turn the first joint so that the end lies towards the goal."""
    limits, now = limits_of(chain, ROOT), angles_of(chain, angles, ROOT)
    link_rotation = matrix_at(chain.links, ROOT, ROTATION)
    arm = rotate_back(rotation(limits, now), rotate_back(link_rotation, end))
    put_angles(chain, angles, ROOT, fit(limits, arm, rotate_back(link_rotation, goal), now))


@kernel
def backward_pass(
    chain: ChainArrays, positions: Float, orientations: Float, angles: Float, goal: Vector, places: Float
) -> None:
    """Write places (N + 1, 3) [m] of the joints, the end on the target, in limits."""
    last = len(chain.joints) - 1
    place = goal
    put_vector(places, last + 1, place)
    wanted = minus(place, vector_at(positions, last, START))
    behind = _pointed(chain, last, matrix_at(orientations, last, START), angles, wanted)
    place = minus(place, rotate(behind, vector_at(chain.links, last, BONE)))
    put_vector(places, last, place)
    for k in range(last - 1, -1, -1):
        wanted, bone = minus(place, vector_at(positions, k, START)), vector_at(chain.links, k, BONE)
        now = matrix_at(orientations, k, START)
        if chain.joints[k, WORLD] or chain.joints[k + 1, WORLD]:
            here = _pointed(chain, k, now, angles, wanted)
        elif chain.joints[k + 1, KIND] == HINGE:
            here = _before_hinge(chain, k, behind, angles, wanted)
        else:
            here = _before_rotor(chain, k, behind, angles, _rotated_towards(now, bone, wanted))
        place = minus(place, rotate(here, bone))
        put_vector(places, k, place)
        behind = here


@inner
def _rotated_towards(orientation: Matrix, bone: Vector, wanted: Vector) -> Matrix:
    """Orientation turned the shortest way so that its bone points as wanted."""
    return product(between(rotate(orientation, bone), wanted), orientation)


@kernel
def _pointed(chain: ChainArrays, k: int, now: Matrix, angles: Float, wanted: Vector) -> Matrix:
    """Orientation of link k, its bone as wanted; world axes: as far as allowed."""
    bone = vector_at(chain.links, k, BONE)
    if not chain.joints[k, WORLD]:
        return _rotated_towards(now, bone, wanted)
    limits, link_rotation = limits_of(chain, k), matrix_at(chain.links, k, ROTATION)
    fitted = fit(limits, bone, rotate_back(link_rotation, wanted), angles_of(chain, angles, k))
    return product(link_rotation, rotation(limits, fitted))


@inner
def _before_hinge(chain: ChainArrays, k: int, behind: Matrix, angles: Float, wanted: Vector) -> Matrix:
    """Orientation of link k, its bone as wanted as far as the next hinge allows.

    Seen from the bone `behind`, this bone turns the other way about the same axis.
    """
    limits, link_rotation = limits_of(chain, k + 1), matrix_at(chain.links, k + 1, ROTATION)
    seen = rotate_back(link_rotation, vector_at(chain.links, k, BONE))
    now = angles_of(chain, angles, k + 1)
    angle = hinge_fit(-limits.high, -limits.low, limits.axis, seen, rotate_back(behind, wanted), -now[0])
    return product(behind, product(rotation_about(limits.axis, angle), transposed(link_rotation)))


@inner
def _before_rotor(chain: ChainArrays, k: int, behind: Matrix, angles: Float, here: Matrix) -> Matrix:
    """Orientation `here` of link k, turned so that the next rotor allows `behind`."""
    limits, bone = limits_of(chain, k + 1), vector_at(chain.links, k + 1, BONE)
    frame = product(here, matrix_at(chain.links, k + 1, ROTATION))
    actual = rotate(behind, bone)
    fitted = fit(limits, bone, rotate_back(frame, actual), angles_of(chain, angles, k + 1))
    allowed = rotate(frame, rotate(rotation(limits, fitted), bone))
    return product(between(allowed, actual), here)


@inner
def forward_pass(
    chain: ChainArrays, places: Float, angles: Float, positions: Float, orientations: Float
) -> None:
    """Write the legal pose whose bones point to the places; `angles`: in, out [rad]."""
    place = (0.0, 0.0, 0.0)
    put_vector(positions, ROOT, place)
    parent = matrix_at(chain.links, ROOT, ROTATION)
    for k in range(len(chain.joints)):
        limits, bone = limits_of(chain, k), vector_at(chain.links, k, BONE)
        frame = rest_frame(chain, k, parent)
        if k == chain.follower:
            follow(chain, angles)
        else:
            wanted = rotate_back(frame, minus(vector_at(places, k + 1, START), place))
            put_angles(chain, angles, k, fit(limits, bone, wanted, angles_of(chain, angles, k)))
        parent = product(frame, rotation(limits, angles_of(chain, angles, k)))
        place = plus(place, rotate(parent, bone))
        put_vector(positions, k + 1, place)
        put_matrix(orientations, k, parent)


RESTART_BENDS = ((1.0, 1.0), (2.0, 0.5), (0.5, 2.0))
"""How a restart shares out its bend between the front and the back of the chain."""


@kernel
def solve_chain(
    chain: ChainArrays, goal: Vector, tolerance_m: float, max_iterations: int, restarts: int, angles: Float
) -> tuple[float, int]:
    """Bring the chain's end to `goal` [m]; return its distance [m], and iterations.

    `goal`: root frame, finite. `angles` (n,) [rad]; in: seed; out: the best legal pose found. `restarts`:
    attempts from bent poses as long as the target is not reached.
    """
    clamp_angles(chain, angles)
    residual, iterations = _attempt(chain, goal, tolerance_m, max_iterations, angles)
    trial = np.empty_like(angles)
    for front, back in RESTART_BENDS:
        if residual <= tolerance_m or restarts <= 0:
            break
        restarts -= 1
        _bend_to(chain, length(goal), front, back, trial)
        aim(chain, end_of(chain, trial), goal, trial)
        clamp_angles(chain, trial)
        found, more = _attempt(chain, goal, tolerance_m, max_iterations, trial)
        iterations += more
        if found < residual:
            residual = found
            for i in range(len(angles)):
                angles[i] = trial[i]
    return residual, iterations


@inner
def _bend_to(chain: ChainArrays, distance: float, front: float, back: float, angles: Float) -> None:
    """Write the bent pose whose end is as far from the root as the target."""
    low, high = 0.0, 1.0
    for _ in range(FABRIK.halvings):
        share = 0.5 * (low + high)
        _bend(chain, share, front, back, angles)
        if length(end_of(chain, angles)) > distance:
            low = share
        else:
            high = share
    _bend(chain, 0.5 * (low + high), front, back, angles)


@inner
def _bend(chain: ChainArrays, share: float, front: float, back: float, angles: Float) -> None:
    """Bend every hinge by a share of its longer way from rest, weighted."""
    last = max(len(chain.joints) - 1, 1)
    for k in range(len(chain.joints)):
        limits = limits_of(chain, k)
        rest = clamp(limits, (0.0, 0.0))
        if limits.kind == HINGE:
            end = limits.high if limits.high - rest[0] >= rest[0] - limits.low else limits.low
            weight = front + (back - front) * k / last
            rest = (rest[0] + min(share * weight, 1.0) * (end - rest[0]), 0.0)
        put_angles(chain, angles, k, rest)
    clamp_angles(chain, angles)


@kernel
def _attempt(
    chain: ChainArrays, goal: Vector, tolerance_m: float, max_iterations: int, angles: Float
) -> tuple[float, int]:
    """FABRIK from legal angles, which become the best, until it arrives or stalls."""
    best = length(minus(end_of(chain, angles), goal))
    if best <= tolerance_m:
        return best, 0
    count = len(chain.joints)
    positions, orientations = np.empty((count + 1, 3)), np.empty((count, 9))
    places, now = np.empty((count + 1, 3)), angles.copy()
    forward(chain, now, positions, orientations)
    slow, last = 0, best
    for iteration in range(1, max_iterations + 1):
        # hinges keep the chain in a plane, and only the first joint can turn that to the goal
        aim(chain, vector_at(positions, count, START), goal, now)
        forward(chain, now, positions, orientations)
        backward_pass(chain, positions, orientations, now, goal, places)
        forward_pass(chain, places, now, positions, orientations)
        residual = length(minus(vector_at(positions, count, START), goal))
        slow = slow + 1 if residual > FABRIK.stall * last else 0
        last = residual
        if residual < best:
            best = residual
            for i in range(len(angles)):
                angles[i] = now[i]
        if best <= tolerance_m or slow >= FABRIK.stalls:
            return best, iteration
    return best, max_iterations


@kernel
def back_normal_of(points: Float, area_px2: Float, centres: Float, focal_px: Float, out: Float) -> bool:
    """Write the unit vector from a hand to the cameras that see its back, if placed.

    A flat marker shows each camera its area times the cosine of its tilt, so the directions to the cameras,
    weighed by what each sees, add up to where it faces, as far as they constrain it.

    `points` (M, 3) [m], rig frame; NaN: not placed; none: return False. `area_px2` (C, K) of those on the
    back; NaN: not seen. `centres`, `focal_px`: (C, 3) [m] and (C,) of the cameras.
    """
    count = 0
    middle, back = np.zeros(3), np.empty(3)
    for m in range(points.shape[0]):
        if np.isfinite(points[m, 0]):
            count += 1
            for i in range(3):
                middle[i] += points[m, i]
    if count == 0:
        return False
    sum_px2, shown_px2 = 0.0, np.zeros(centres.shape[0])
    for c in range(centres.shape[0]):
        for k in range(area_px2.shape[1]):
            if np.isfinite(area_px2[c, k]):
                shown_px2[c] += area_px2[c, k]
        sum_px2 += shown_px2[c]
    for i in range(3):
        out[i] = 0.0
    for c in range(centres.shape[0]):
        squared = 0.0
        for i in range(3):
            back[i] = centres[c, i] - middle[i] / count
            squared += back[i] * back[i]
        weight = 1.0 if sum_px2 == 0.0 else shown_px2[c] * squared / (focal_px[c] * focal_px[c])
        for i in range(3):
            out[i] += weight * back[i] / sqrt(squared)
    length = sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    if length > 0.0:
        for i in range(3):
            out[i] /= length
    else:  # cameras on both sides
        for i in range(3):
            out[i] = 1.0 if i == 2 else 0.0
    return True


@kernel
def targets_of(points: Float, cov: Float, T: Float, fitted: Float, fit_m2: float, out: Float) -> None:
    """Write where fingers are to bring their markers (M, 3) [m], palm frame.

    Where they are measured (rig frame; NaN: not seen, as in `out`), as far as that is surer than where the
    fit of the palm T has them: `fitted` (M, 3) [m], rig frame, of variance `fit_m2`.
    """
    gain, off, target = np.empty((3, 3)), np.empty(3), np.empty(3)
    for m in range(points.shape[0]):
        inverse_3_plus(cov[m], fit_m2, gain)
        for i in range(3):
            off[i] = points[m, i] - fitted[m, i]
        for i in range(3):
            moved = fit_m2 * (gain[i, 0] * off[0] + gain[i, 1] * off[1] + gain[i, 2] * off[2])
            target[i] = fitted[m, i] + moved - T[i, 3]
        for i in range(3):
            out[m, i] = T[0, i] * target[0] + T[1, i] * target[1] + T[2, i] * target[2]
