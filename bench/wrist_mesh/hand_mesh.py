"""The skinned mesh of the WebXR hand: linear blend skinning, then two steps of subdivision and an even thickening.

What the rendered recordings show is rounder than the mesh, and thicker than its subdivision: the points of their laser
lines lie 0.68 mm (standard deviation 0.07 mm) outside of the subdivided, posed mesh, for hands of both sizes.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.wrist_mesh.hinges import Hinges
from bench.wrist_mesh.subdivision import Subdivision
from common.arrays import Float, Int
from common.hand.model import WEBXR_JOINTS, HandModel

SEGMENT = np.array(
    [0, 10, 11, 13, 13, *(f + s for f in (20, 30, 40, 50) for s in (0, 1, 2, 3, 3))]
)  # of 25 joints
SEGMENT[[5, 10, 15, 20]] = 0  # metacarpals of the fingers are palm


LEVELS = 2
THICKER_M = 0.00068
MOTTLE, MOTTLE_SEED = 0.03, 7  # standard deviation of the skin's brightness at each level, relative


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """The hand in one pose, camera frame.

    Attributes:
        verts: (V, 3) [m].
        normals: Of the vertices, unit (V, 3).
        joints: (25, 3) [m].
    """

    verts: Float
    normals: Float
    joints: Float


@dataclass(frozen=True, slots=True, eq=False)
class HandMesh:
    """A mesh, bound to the joints of a hand.

    Attributes:
        hinges: The hand's kinematics.
        bound: (C, 4, 3) [m] each vertex of the coarse mesh in the frame of each of its four joints.
        joints: (C, 4) which those are, of 25.
        weights: (C, 4).
        finer: The steps of subdivision.
        faces: (F, 3) triangles of the fine mesh.
        label: (F,) finger * 10 + segment, by the joints that move it most.
        albedo: (V,) how bright the fine vertices are, about 1: mottled skin.
    """

    hinges: Hinges
    bound: Float
    joints: Int
    weights: Float
    finer: tuple[Subdivision, ...]
    faces: Int
    label: Int
    albedo: Float

    @classmethod
    def of(cls, model: HandModel, datasets: Path) -> "HandMesh":
        """The mesh of the hand's side, as large as the hand."""
        hinges = Hinges.of(model)
        mesh = np.load(datasets / "webxr_hand" / f"{model.profile.side}_rest.npz")
        order = [mesh["names"].tolist().index(name) for name in WEBXR_JOINTS]
        inverse: Float = mesh["inv_bind"].astype(np.float64)[order]
        bind = np.linalg.inv(inverse)[:, :3, 3].astype(np.float64)
        scale = np.linalg.norm(hinges.rest_m[10] - hinges.rest_m[11]) / np.linalg.norm(bind[10] - bind[11])
        every: Float = mesh["verts"].astype(np.float64)
        # Vertices of one place are one: they differ in what a picture would be wrapped by.
        _, kept, welded = np.unique(np.round(every, 6), axis=0, return_index=True, return_inverse=True)
        faces = welded.ravel()[mesh["faces"].astype(np.int64)]
        joints = np.argsort(order)[mesh["joints"][kept].astype(np.int64)]
        ahead = np.concatenate([every[kept], np.ones((len(kept), 1))], axis=1)
        bound = scale * np.einsum("vkij,vj->vki", inverse[joints], ahead)[..., :3]
        weights = mesh["weights"][kept].astype(np.float64)
        share = np.zeros((len(kept), 25))
        np.add.at(share, (np.arange(len(kept))[:, None], joints), weights)
        finer: list[Subdivision] = []
        rng = np.random.default_rng(MOTTLE_SEED)
        mottle = MOTTLE * rng.standard_normal((len(kept), 1))
        for _ in range(LEVELS):
            finer.append(Subdivision.of(faces, len(share)))
            faces, share = finer[-1].faces, finer[-1](share)
            mottle = finer[-1](mottle)
            mottle += MOTTLE * rng.standard_normal(mottle.shape)
        label = SEGMENT[share[faces].sum(axis=1).argmax(axis=1)]
        return cls(hinges, bound, joints, weights, tuple(finer), faces, label, np.exp(mottle[:, 0]))

    def pose(self, angles_rad: Float, T_camera_palm: Float) -> Posed:
        """The hand with named angles (21,), its palm at `T_camera_palm` (4, 4)."""
        at, rotated = self.hinges.pose(angles_rad)
        R = T_camera_palm[:3, :3] @ rotated @ self.hinges.rest_rotation
        at = at @ T_camera_palm[:3, :3].T + T_camera_palm[:3, 3]
        each = np.einsum("vkij,vkj->vki", R[self.joints], self.bound) + at[self.joints]
        verts = np.einsum("vk,vki->vi", self.weights, each)
        for step in self.finer:
            verts = step(verts)
        normals = self._normals(verts)
        return Posed(verts + THICKER_M * normals, normals, at)

    def _normals(self, verts: Float) -> Float:
        """Means of the triangles' normals by area, unit (V, 3)."""
        a, b, c = verts[self.faces].transpose(1, 0, 2)
        across = np.cross(b - a, c - a)
        corner = self.faces.ravel()
        out = np.stack([np.bincount(corner, np.repeat(n, 3), len(verts)) for n in across.T], axis=1)
        return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30)
