"""glTF 2.0 holds a hand as an animated model with a skin mesh.

Blender, Unity, Unreal, Godot, three.js and model viewers read it. Its skeleton is 26 nodes named and turned
like the joints of OpenXR, in metres; its bind pose is the rest pose of the hand profile. Each pose is a key
at its own time, in seconds from the first; between keys a reader goes linearly in the frame of the parent,
over a gap the hand stands still. A joint has keys of its place only where its bone is not rigid.

The skin is closed convex pieces over the bones, each the hull of a few spheres: of a finger's bone those of
its two joints; over the wrist and neighbouring metacarpals; and the ball of the thumb. The pieces overlap,
and a sphere moves with one joint, so that nothing opens where a joint bends.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pygltflib as gl
from scipy.spatial import ConvexHull

from common.arrays import Float, Int
from common.calibration.files import replacing
from common.geometry.transforms import quaternion_to_matrix
from common.hand.model import FINGER_JOINTS, JOINTS, WRIST
from master.recording.export.bvh import RIGID_M, Up, upright
from master.recording.export.motion import (
    CHILDREN,
    Motion,
    Skeleton,
    local,
)

_ROUND = 140  # points of a sphere
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, slots=True, eq=False)
class Skin:
    """Triangles over a hand at rest."""

    vertex_m: Float  # (V, 3) [m], palm frame
    normal: Float  # (V, 3) outward unit normals
    joint: Int  # (V,) the joint that a vertex moves with
    triangle: Int  # (F, 3) vertices, anticlockwise as seen from outside


@dataclass(frozen=True, slots=True)
class _Ball:
    """A sphere of skin in the palm frame, and the joint that it moves with."""

    centre_m: Float
    radius_m: float
    joint: int


def skin_of(skeleton: Skeleton) -> Skin:
    """The skin of a hand at rest."""
    pieces = [_hull(balls) for balls in (*_fingers(skeleton), *_palm(skeleton))]
    first = np.cumsum([0, *(len(piece.vertex_m) for piece in pieces[:-1])])
    return Skin(
        vertex_m=np.concatenate([piece.vertex_m for piece in pieces]),
        normal=np.concatenate([piece.normal for piece in pieces]),
        joint=np.concatenate([piece.joint for piece in pieces]),
        triangle=np.concatenate([piece.triangle + start for piece, start in zip(pieces, first, strict=True)]),
    )


def _fingers(skeleton: Skeleton) -> list[list[_Ball]]:
    """Spheres of finger bones and thumb metacarpal, both ends on the nearer joint."""
    bones = [
        bone
        for chain in FINGER_JOINTS
        for bone in pairwise(chain if chain is FINGER_JOINTS[0] else chain[1:])
    ]
    return [[_ball(skeleton, a, a), _ball(skeleton, b, a)] for a, b in bones]


def _palm(skeleton: Skeleton) -> list[list[_Ball]]:
    """Spheres of what is rigid with the wrist, and of the ball of the thumb."""
    fingers = FINGER_JOINTS[1:]
    bones = [[_ball(skeleton, joint, WRIST) for joint in chain[:2]] for chain in fingers]
    wrist = _wrist(skeleton)
    webs = [[*wrist, *left, *right] for left, right in pairwise(bones)]
    metacarpal, proximal = FINGER_JOINTS[0][:2]
    index = bones[0]
    thumb = [
        _ball(skeleton, metacarpal, metacarpal),
        _between(skeleton, metacarpal, proximal, metacarpal),
        index[0],
        _between(skeleton, *fingers[0][:2], WRIST),
    ]
    heel = [*wrist, _ball(skeleton, metacarpal, WRIST), index[0]]
    return [*webs, heel, thumb]


def _wrist(skeleton: Skeleton) -> list[_Ball]:
    """Two spheres across the wrist, as wide as its radius states, and flat."""
    radius = float(skeleton.radius_m[WRIST])
    flat = 0.62  # a wrist is flat: of its radius, two such spheres side by side
    aside = np.array([(1.0 - flat) * radius, 0.0, 0.0])
    return [_Ball(skeleton.position_m[WRIST] + side * aside, flat * radius, WRIST) for side in (-1.0, 1.0)]


def _ball(skeleton: Skeleton, at: int, joint: int) -> _Ball:
    return _Ball(skeleton.position_m[at], float(skeleton.radius_m[at]), joint)


def _between(skeleton: Skeleton, a: int, b: int, joint: int) -> _Ball:
    ball = 0.55  # how far up the metacarpals the ball of the thumb reaches
    centre = (1.0 - ball) * skeleton.position_m[a] + ball * skeleton.position_m[b]
    radius = (1.0 - ball) * skeleton.radius_m[a] + ball * skeleton.radius_m[b]
    return _Ball(centre, float(radius), joint)


def _hull(balls: list[_Ball]) -> Skin:
    """Convex hull of spheres, with the spheres' own normals, so that it looks round."""
    directions = _directions()
    points = np.concatenate([ball.centre_m + ball.radius_m * directions for ball in balls])
    normals = np.tile(directions, (len(balls), 1))
    joints = np.repeat([ball.joint for ball in balls], len(directions))
    used, triangle = _convex(points)
    corners = points[used][triangle]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.vecdot(across, corners.mean(axis=1) - points.mean(axis=0)) < 0.0
    triangle[inward] = triangle[inward][:, ::-1]
    return Skin(points[used], normals[used], joints[used].astype(np.int64), triangle)


def _convex(points: Float) -> tuple[Int, Int]:
    """Indices (V,) of points (N, 3) on their convex hull, and its triangles (F, 3)."""
    hull: Any = ConvexHull(points)  # scipy has no types
    used: Int = np.array(hull.vertices, np.int64)
    place = np.zeros(len(points), np.int64)
    place[used] = np.arange(len(used))
    triangles: Int = np.array(hull.simplices, np.int64)
    return used, place[triangles]


def _directions() -> Float:
    """Unit vectors (_ROUND, 3) on Fibonacci's spiral from pole to pole."""
    z = 1.0 - 2.0 * (np.arange(_ROUND) + 0.5) / _ROUND
    across, angle = np.sqrt(1.0 - z * z), _GOLDEN * np.arange(_ROUND)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


_COLOUR = [0.80, 0.62, 0.52, 1.0]
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_TYPES = {"f": gl.FLOAT, "I": gl.UNSIGNED_INT, "B": gl.UNSIGNED_BYTE}


@dataclass(slots=True)
class _Data:
    """The model's bytes so far, and what stands where in them."""

    gltf: gl.GLTF2
    blob: bytearray = field(default_factory=bytearray)

    def add(self, array: npt.NDArray[np.generic], target: int | None = None, *, bounds: bool = False) -> int:
        """Append the rows of an array; return the number of its accessor."""
        self.gltf.bufferViews.append(
            gl.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=array.nbytes, target=target)
        )
        self.blob += array.tobytes()
        self.blob += b"\0" * (-len(self.blob) % 4)
        width = int(np.prod(array.shape[1:]))
        rows = array.reshape(len(array), width)
        accessor = gl.Accessor(
            bufferView=len(self.gltf.bufferViews) - 1,
            componentType=_TYPES[array.dtype.char],
            count=len(array),
            type=_KINDS[width],
        )
        if bounds:
            accessor.min, accessor.max = rows.min(axis=0).tolist(), rows.max(axis=0).tolist()
        self.gltf.accessors.append(accessor)
        return len(self.gltf.accessors) - 1


def write_gltf(path: Path, motion: Motion, skeleton: Skeleton, up: Up) -> tuple[int, ...]:
    """Write a motion, rig frame, as .glb or .gltf with all data, by the file's name.

    `up`: see `bvh.Axes`; y is what glTF means.

    Returns:
        The joints, without the wrist, that have keys of their place because their bone is not rigid.

    Raises:
        OSError: It cannot be written; nothing half written is left.
    """
    about = {
        "hand": skeleton.hand,
        "side": skeleton.side,
        "up": up,
        "first_t_ns": str(int(motion.t_ns[0])),  # more digits than a number of JSON has everywhere
        "held_keys": motion.held_frames,
    }
    data = _Data(gl.GLTF2(asset=gl.Asset(version="2.0", generator="Phalanx", extras=about)))
    _nodes(data, skeleton)
    _skin(data, skeleton, skin_of(skeleton))
    free = _animation(data, local(with_holds(upright(motion, up))), skeleton)
    data.gltf.buffers.append(gl.Buffer(byteLength=len(data.blob)))
    data.gltf.set_binary_blob(bytes(data.blob))
    with replacing(path) as file:
        if path.suffix == ".gltf":
            data.gltf.convert_buffers(gl.BufferFormat.DATAURI)
            file.write(data.gltf.gltf_to_json().encode())
        else:
            file.writelines(cast(list[bytes], data.gltf.save_to_bytes()))
    return free


def with_holds(motion: Motion) -> Motion:
    """Add a key just before the end of every gap: the hand as at its beginning."""
    gaps = np.flatnonzero(np.diff(motion.t_ns) > motion.gap_ns)
    rows = np.sort(np.concatenate([np.arange(len(motion)), gaps]))
    t_ns = motion.t_ns[rows].copy()
    second = np.append(False, rows[1:] == rows[:-1])
    after = motion.t_ns[np.minimum(rows + 1, len(motion) - 1)]
    hold_s = 1e-3  # before the end of a gap the hand still stands where it was
    t_ns[second] = after[second] - round(hold_s * 1e9)
    return replace(
        motion,
        t_ns=t_ns,
        position_m=motion.position_m[rows],
        orientation_wxyz=motion.orientation_wxyz[rows],
        held=motion.held[rows],
    )


def _nodes(data: _Data, skeleton: Skeleton) -> None:
    """Nodes 0 ... 25 are the joints, 26 is the mesh, 27 holds the joints."""
    at, q = skeleton.local()
    for joint in range(len(JOINTS)):
        data.gltf.nodes.append(
            gl.Node(
                name=JOINTS[joint],
                translation=at[joint].tolist(),
                rotation=_xyzw(q[joint]).tolist(),
                children=list(CHILDREN[joint]),
            )
        )
    mesh, whole = len(JOINTS), len(JOINTS) + 1
    data.gltf.nodes.append(gl.Node(name=f"{skeleton.hand} skin", mesh=0, skin=0))
    data.gltf.nodes.append(gl.Node(name=skeleton.hand, children=[WRIST]))
    # a skinned mesh goes by its joints, not by a parent
    data.gltf.scenes.append(gl.Scene(nodes=[whole, mesh]))
    data.gltf.scene = 0


def _xyzw(q_wxyz: Float) -> Float:
    return np.roll(q_wxyz, -1, axis=-1)


def _skin(data: _Data, skeleton: Skeleton, skin: Skin) -> None:
    """The mesh, and which vertex moves with which joint."""
    joints = np.zeros((len(skin.joint), 4), np.uint8)
    joints[:, 0] = skin.joint
    weights = np.zeros((len(skin.joint), 4), "<f4")
    weights[:, 0] = 1.0
    attributes = gl.Attributes(
        POSITION=data.add(skin.vertex_m.astype("<f4"), gl.ARRAY_BUFFER, bounds=True),
        NORMAL=data.add(skin.normal.astype("<f4"), gl.ARRAY_BUFFER),
        JOINTS_0=data.add(joints, gl.ARRAY_BUFFER),
        WEIGHTS_0=data.add(weights, gl.ARRAY_BUFFER),
    )
    triangles = data.add(skin.triangle.astype("<u4").reshape(-1, 1), gl.ELEMENT_ARRAY_BUFFER)
    look = gl.PbrMetallicRoughness(baseColorFactor=_COLOUR, metallicFactor=0.0, roughnessFactor=0.65)
    data.gltf.materials.append(gl.Material(name="skin", pbrMetallicRoughness=look))
    data.gltf.meshes.append(
        gl.Mesh(
            name=skeleton.hand,
            primitives=[gl.Primitive(attributes=attributes, indices=triangles, material=0)],
        )
    )
    bind = np.zeros((len(JOINTS), 4, 4))
    rotation = quaternion_to_matrix(skeleton.orientation_wxyz).swapaxes(1, 2)
    bind[:, :3, :3], bind[:, 3, 3] = rotation, 1.0
    bind[:, :3, 3] = -(rotation @ skeleton.position_m[..., None])[..., 0]
    by_columns = np.ascontiguousarray(bind.swapaxes(1, 2)).astype("<f4").reshape(-1, 16)
    data.gltf.skins.append(
        gl.Skin(
            name=skeleton.hand,
            skeleton=WRIST,
            joints=list(range(len(JOINTS))),
            inverseBindMatrices=data.add(by_columns),
        )
    )


def _animation(data: _Data, own: Motion, skeleton: Skeleton) -> tuple[int, ...]:
    """Keys of all that moves; what stands still is set in its node."""
    at, q = skeleton.local()
    times_s = ((own.t_ns - own.t_ns[0]) * 1e-9).astype("<f4")
    clip = gl.Animation(name=skeleton.hand)
    keys = data.add(times_s.reshape(-1, 1), bounds=True)
    free: list[int] = []
    for joint in range(len(JOINTS)):
        moves = float(np.abs(own.position_m[:, joint] - at[joint]).max()) > RIGID_M
        if moves:
            _channel(data, clip, keys, joint, "translation", own.position_m[:, joint])
            if joint != WRIST:
                free.append(joint)
        from_rest = 1.0 - np.abs(own.orientation_wxyz[:, joint] @ q[joint])
        still = 1e-6  # of a quaternion
        if joint == WRIST or float(from_rest.max()) > still**2:
            _channel(data, clip, keys, joint, "rotation", _xyzw(own.orientation_wxyz[:, joint]))
    data.gltf.animations.append(clip)
    return tuple(free)


def _channel(data: _Data, clip: gl.Animation, keys: int, joint: int, path: str, values: Float) -> None:
    clip.samplers.append(gl.AnimationSampler(input=keys, output=data.add(values.astype("<f4"))))
    target = gl.AnimationChannelTarget(node=joint, path=path)
    clip.channels.append(gl.AnimationChannel(sampler=len(clip.samplers) - 1, target=target))
