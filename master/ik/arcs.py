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

from common.arrays import Bool, Float, Int
from common.geometry import skew
from common.hand_model import CHAINS, HandModel
from master.estimator.attached import Attached
from master.estimator.parameters import HandParameters
from master.ik.hand import HandSolution

_STRAIGHT_RAD = np.radians(3.0)  # a turn by less is straight: 0.2 mm off the tangent at the far end of a hand
_ANYWHERE_RAD = 1.0  # a turn that is less sure than this leads nowhere farther
_PALM_POINTS = np.setdiff1d(np.arange(26), CHAINS)
_CHAIN_BONES = CHAINS.size
_EYE, _ROOT_2 = np.eye(3), float(np.sqrt(2.0))


class Arcs:
    """Second order of the joints of one hand with its markers. Holds tables: how bones turn and add up to points."""

    def __init__(self, model: HandModel, parameters: HandParameters, markers: tuple[str, ...]) -> None:
        """Bones: four of each chain, the first from the palm's origin; one to each point of the palm; each marker."""
        self._parameters = parameters
        self._marker = marker = Attached.markers(model, parameters, markers)
        palm = len(_PALM_POINTS)
        bones = _CHAIN_BONES + palm + len(markers)
        self._sums = np.zeros((26 + len(markers), bones))
        self._sums[CHAINS, :_CHAIN_BONES] = (
            np.eye(5)[:, None, :, None] * np.tri(4)[None, :, None, :]
        ).reshape(5, 4, -1)
        self._sums[_PALM_POINTS, _CHAIN_BONES + np.arange(palm)] = 1.0
        self._sums[26:] = np.where(marker.on_finger, self._sums[CHAINS[marker.finger, marker.level]], 0.0)
        self._sums[26:, bones - len(markers) :] += np.eye(len(markers))
        # The bone to a joint is turned by the axes of the joints before it; that to a knuckle, and the palm's, by none.
        self._finger = np.concatenate([np.repeat(np.arange(5), 4), np.zeros(palm, np.int64), marker.finger])
        self._moves = np.zeros((bones, 4, len(parameters.free)))
        for f in range(5):
            for k in range(1, 4):
                self._moves[4 * f + k, : k + 1] = parameters.complete[4 * f : 4 * f + k + 1]
        self._moves[_CHAIN_BONES + palm :] = marker.moves
        self._turning = np.concatenate([np.arange(3), np.arange(6, 6 + len(parameters.free))])
        self._pairs = [_pairs(count) for count in range(len(self._turning) + 1)]

    def covariance(self, found: HandSolution, cov: Float, markers_cov_m2: Float, seen: Bool) -> Float:
        """(26, 3, 3) [m^2] that the linear covariances of the joints leave out.

        Args:
            found: The hand.
            cov: (6 + n, 6 + n) of the palm's turn and shift and of the free angles.
            markers_cov_m2: (N, 3, 3) [m^2] of the markers that are seen, with the model's own error.
            seen: (M,) which these are.
        """
        variance, axes = np.linalg.eigh(cov[self._turning[:, None], self._turning])
        bent = variance > _STRAIGHT_RAD**2
        if not bent.any():
            return np.zeros((26, 3, 3))
        bone, turned = self._bones(found)
        size = np.minimum(np.sqrt(variance[bent]), _ANYWHERE_RAD)
        h = self._second_order(bone, turned @ (axes[:, bent] * size))
        joints = h[:26].reshape(78, -1)
        if seen.any():
            use = 26 + np.flatnonzero(seen)
            whiten = np.linalg.inv(np.linalg.cholesky(markers_cov_m2))
            by_turns = (self._sums[use] @ (skew(-bone) @ turned).reshape(len(bone), -1)).reshape(
                len(use), 3, -1
            )
            Jm = np.empty((len(use), 3, len(cov)))
            Jm[..., :3], Jm[..., 3:6], Jm[..., 6:] = by_turns[..., :3], _EYE, by_turns[..., 3:]
            Jm = (whiten @ Jm).reshape(-1, len(cov))
            told = cov @ Jm.T
            wide, ways = np.linalg.eigh(Jm @ told)
            gain = told @ (ways / np.maximum(wide, 1.0)) @ ways.T
            back = found.moved.reshape(78, -1) @ gain
            joints = joints - back @ (whiten @ h[use]).reshape(back.shape[1], -1)
        at, same = joints.reshape(26, 3, -1), len(size)
        mean = at[..., :same].sum(axis=-1)
        at[..., same:] *= _ROOT_2  # they count twice, k and l exchanged
        return 0.25 * mean[:, :, None] * mean[:, None, :] + 0.5 * (at @ at.swapaxes(1, 2))

    def _bones(self, found: HandSolution) -> tuple[Float, Float]:
        """Bones (S, 3) [m], and how turn of the palm and free angles turn them (S, 3, 3 + n), rig frame."""
        T, place, rotation = found.T_rig_palm, found.joints.position_m, found.joints.rotation
        bone = np.empty((len(self._moves), 3))
        chain = bone[:_CHAIN_BONES].reshape(5, 4, 3)  # a view
        chain[...] = ends = place[CHAINS]
        chain[:, 1:] -= ends[:, :-1]
        chain[:, 0] -= T[:3, 3]
        bone[_CHAIN_BONES : len(bone) - len(self._marker.finger)] = place[_PALM_POINTS] - T[:3, 3]
        on_finger, joint = self._marker.on_finger[..., None], CHAINS[self._marker.finger, self._marker.level]
        frame = np.where(on_finger, rotation[joint], T[:3, :3])
        bone[len(bone) - len(joint) :] = (frame @ self._marker.offset_m[..., None])[..., 0]
        axes = np.empty((5, 3, 4))
        axes[..., 0] = self._marker.abduction_axis[:, 0] @ T[:3, :3].T
        np.negative(rotation[CHAINS[:, :3], :, 0].swapaxes(1, 2), out=axes[..., 1:])
        turned = np.empty((len(bone), 3, 3 + self._moves.shape[-1]))
        turned[:, :, :3] = _EYE
        np.matmul(axes[self._finger], self._moves, out=turned[..., 3:])
        x = self._parameters.of_angles(found.angles_rad)
        self._parameters.by_parameters(turned[..., 3:], x)
        return bone, turned

    def _second_order(self, bone: Float, w: Float) -> Float:
        """h of all points (26 + M, 3, pairs) [m] for bones (S, 3) turned by w (S, 3, K); pairs k = m, then k < m."""
        count: int = w.shape[-1]
        k, m = self._pairs[count]
        bone = bone[:, :, None]
        half = 0.5 * (w * bone).sum(axis=1, keepdims=True)
        one, other = w.take(k, axis=2), w.take(m, axis=2)
        h = one * half.take(m, axis=2)
        h += other * half.take(k, axis=2)
        one *= other
        h -= one.sum(axis=1, keepdims=True) * bone
        return (self._sums @ h.reshape(len(h), -1)).reshape(-1, *h.shape[1:])


def _pairs(count: int) -> tuple[Int, Int]:
    """Of so many directions each with itself, then each with each of those behind it."""
    same: Int = np.arange(count)
    above: Int = np.argwhere(np.tri(count, k=-1).T > 0.0)  # row by row
    return np.concatenate([same, above[:, 0]]), np.concatenate([same, above[:, 1]])
