"""Joints move on arcs: what their linear covariances leave out.

A palm that is turned by 30 degrees about the one marker on its back has its wrist 8 mm off the tangent, across all that
the linear covariance allows for. A bone b that is turned by w moves by w x b + w x (w x b) / 2 to second order. With
w = sum_k c_k w_k along the principal directions of the turns' covariance, c_k independent of variance one,

    h_kl = (w_k x (w_l x b) + w_l x (w_k x b)) / 2
    E[(sum_kl c_k c_l h_kl / 2)(sum_kl c_k c_l h_kl / 2)'] = (sum_k h_kk)(sum_k h_kk)' / 4 + sum_kl h_kl h_kl' / 2

(Isserlis 1918), h summed over the bones from the palm's origin to the joint.

A marker that is seen does not leave its place by any turn: its arc h^m is taken back by the answer of the fit to a
marker that moved so far,

    h - J K h^m,   K = cov Jm' (Jm cov Jm' v R)^-1

R is the covariance of the markers, and v takes the larger in each direction, with R as the unit matrix. So K is the
gain cov Jm' R^-1 of the fit whose covariance this is. Where that is wider than its markers, because their misfit or two
hypotheses made it so, they still are not taken back by more than they moved. So tips that are seen stay where they are,
and the palm turns about the marker on its back.
"""

import numpy as np

from common.arrays import Bool, Float
from common.geometry import skew
from common.hand_model import CHAINS, HandModel
from master.ik.attached import Attached
from master.ik.hand import HandSolution
from master.ik.parameters import HandParameters

_STRAIGHT_RAD = np.radians(3.0)  # a turn by less is straight: 0.2 mm off the tangent at the far end of a hand
_ANYWHERE_RAD = 1.0  # a turn that is less sure than this leads nowhere farther
_PALM_POINTS = np.setdiff1d(np.arange(26), CHAINS)
_CHAIN_BONES = CHAINS.size


class Arcs:
    """Second order of the joints of one hand with its markers. Holds tables of how bones add up to points."""

    def __init__(self, model: HandModel, parameters: HandParameters, markers: tuple[str, ...]) -> None:
        """Bones: four of each chain, the first from the palm's origin; one to each point of the palm; each marker."""
        self._parameters = parameters
        self._marker = Attached.markers(model, parameters, markers)
        self._joint_of = CHAINS[self._marker.finger, self._marker.level]
        self._turns = parameters.complete.reshape(5, 4, 1, -1)
        bones = _CHAIN_BONES + len(_PALM_POINTS) + len(markers)
        self._sums = np.zeros((26 + len(markers), bones))
        self._sums[CHAINS, :_CHAIN_BONES] = (
            np.eye(5)[:, None, :, None] * np.tri(4)[None, :, None, :]
        ).reshape(5, 4, -1)
        self._sums[_PALM_POINTS, _CHAIN_BONES + np.arange(len(_PALM_POINTS))] = 1.0
        on_finger = self._marker.on_finger
        self._sums[26:] = np.where(on_finger, self._sums[self._joint_of], 0.0)
        self._sums[26:, bones - len(markers) :] += np.eye(len(markers))

    def covariance(self, found: HandSolution, cov: Float, markers_cov_m2: Float, seen: Bool) -> Float:
        """(26, 3, 3) [m^2] that the linear covariances of the joints leave out.

        Args:
            found: The hand.
            cov: (6 + n, 6 + n) of the palm's turn and shift and of the free angles.
            markers_cov_m2: (M, 3, 3) [m^2] of the markers, with the model's own error.
            seen: (M,) which of them are seen.
        """
        turning = np.concatenate([np.arange(3), np.arange(6, len(cov))])
        variance, axes = np.linalg.eigh(cov[np.ix_(turning, turning)])
        bent = variance > _STRAIGHT_RAD**2
        if not bent.any():
            return np.zeros((26, 3, 3))
        bone, turned = self._bones(found)
        size = np.minimum(np.sqrt(variance[bent]), _ANYWHERE_RAD)
        w = np.moveaxis(turned @ (axes[:, bent] * size), -1, 0)  # (K, S, 3)
        h = self._second_order(bone, w)
        joints = h[:, :26].reshape(len(h), 78)
        if seen.any():
            use = 26 + np.flatnonzero(seen)
            Jm = np.zeros((len(use), 3, len(cov)))
            Jm[..., turning] = np.einsum("ps,sin->pin", self._sums[use], skew(-bone) @ turned)
            Jm[..., 3:6] = np.eye(3)
            whiten = np.linalg.inv(np.linalg.cholesky(markers_cov_m2[seen]))
            Jm = (whiten @ Jm).reshape(-1, len(cov))
            told = cov @ Jm.T
            wide, ways = np.linalg.eigh(Jm @ told)
            gain = told @ (ways / np.maximum(wide, 1.0)) @ ways.T
            back = found.moved.reshape(78, -1) @ gain
            marker = (whiten @ h[:, use, :, None]).reshape(len(h), -1)
            joints = joints - marker @ back.T
        at = np.moveaxis(joints.reshape(-1, 26, 3), 0, -1)  # (26, 3, pairs)
        mean = at[..., : len(w)].sum(axis=-1)
        at[..., len(w) :] *= np.sqrt(2.0)  # they count twice, k and l exchanged
        return 0.25 * mean[:, :, None] * mean[:, None, :] + 0.5 * at @ np.swapaxes(at, 1, 2)

    def _bones(self, found: HandSolution) -> tuple[Float, Float]:
        """Bones (S, 3) [m], and how turn of the palm and free angles turn them (S, 3, 3 + n), rig frame."""
        T, place, rotation = found.T_rig_palm, found.joints.position_m, found.joints.rotation
        chain = np.diff(place[CHAINS], axis=1, prepend=np.broadcast_to(T[:3, 3], (5, 1, 3)))
        marker = np.where(self._marker.on_finger[..., None], rotation[self._joint_of], T[:3, :3])
        offset = (marker @ self._marker.offset_m[..., None])[..., 0]
        bone = np.concatenate([chain.reshape(-1, 3), place[_PALM_POINTS] - T[:3, 3], offset])
        axes = np.empty((5, 4, 3))
        axes[:, 0] = self._marker.abduction_axis[:, 0] @ T[:3, :3].T
        axes[:, 1:] = -rotation[CHAINS[:, :3], :, 0]
        by_angles = np.cumsum(axes[..., None] * self._turns, axis=1)  # (5, 4, 3, n)
        turned = np.zeros((len(bone), 3, 3 + by_angles.shape[-1]))
        turned[:, :, :3] = np.eye(3)
        chains = turned[:_CHAIN_BONES].reshape(5, 4, 3, -1)  # a view
        chains[:, 1:, :, 3:] = by_angles[:, 1:]
        level = np.minimum(self._marker.level, 2) + 1
        turned[len(bone) - len(offset) :, :, 3:] = np.where(
            self._marker.on_finger[..., None], by_angles[self._marker.finger, level], 0.0
        )
        x = self._parameters.of_angles(found.angles_rad)
        self._parameters.by_parameters(turned[:, :, 3:], x)
        return bone, turned

    def _second_order(self, bone: Float, w: Float) -> Float:
        """h of all points (pairs, 26 + M, 3) [m] for bones (S, 3) turned by w (K, S, 3); pairs k = m, then k < m."""
        k, m = (np.concatenate([np.arange(len(w)), one]) for one in np.triu_indices(len(w), 1))
        along = np.vecdot(w, bone)[..., None]
        h = 0.5 * (w[k] * along[m] + w[m] * along[k]) - np.vecdot(w[k], w[m])[..., None] * bone
        return self._sums @ h
