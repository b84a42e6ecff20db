"""A bundle adjustment fits lenses, camera poses, board poses and board shape.

Corner i of an image is seen at pixel = lens(T_camera_rig T_rig_board (c_i + s_i)), where c_i is the drawn
corner and s_i its offset on the real, never quite flat board. A board pose touches only its own view, so the
poses are eliminated view by view (Schur complement; Triggs et al., Bundle adjustment - a modern synthesis,
2000, section 6), and the step is solved in what all views share. Damping by Marquardt. A prior of the shape
about the drawn one also fixes the board's frame and size: few views leave it as drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import rigid, rotation_vector_to_matrix, transform

LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Corners of one image."""

    camera: int  # this and view: indices into the bundle
    view: int
    corners: Int  # numbers (n,) of the corners seen
    uv: Float  # their places (n, 2) [px]


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """What is estimated."""

    lenses: Float  # (C, 9) in the order `LENS`
    T_camera_rig: Float  # (C, 4, 4) [m]
    T_rig_board: Float  # (V, 4, 4) [m]
    # this and shape_m: (N, 3) [m] corners of the board as drawn, and the offsets of the real ones
    drawn_m: Float
    shape_m: Float


@dataclass(frozen=True, slots=True, eq=False)
class Free:
    """What is estimated of lenses (C, 9), camera poses (C,) and the board's shape.

    Poses of the board always are.
    """

    lenses: Bool
    cameras: Bool
    shape: bool

    @classmethod
    def only_boards(cls, bundle: Bundle) -> "Free":
        """Neither lenses, camera poses nor shape."""
        lenses = np.zeros_like(bundle.lenses, dtype=np.bool_)
        return cls(lenses, np.zeros(len(lenses), dtype=np.bool_), shape=False)

    def mask(self, corners: int) -> Bool:
        """The shared parameters in a row: lenses, camera poses, shape."""
        return np.concatenate(
            [self.lenses.ravel(), np.repeat(self.cameras, 6), np.full(3 * corners, self.shape)]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A bundle at its optimum."""

    bundle: Bundle
    residuals: tuple[Float, ...]  # measured minus predicted corners (n, 2) [px] of each observation
    sigma_px: float  # standard deviation of one coordinate, from the residuals and the degrees of freedom
    covariance: Float  # (S, S) of the shared parameters, zero where not free

    def lens_sd(self, camera: int) -> Float:
        """Standard deviations (9,) of a lens; 0: held."""
        return np.sqrt(np.diag(self.covariance)[9 * camera : 9 * camera + 9])

    def place_sd(self, camera: int) -> Float:
        """Standard deviations (6,) of a camera's rotation [rad] and shift [m]; 0: held."""
        at = 9 * len(self.bundle.lenses) + 6 * camera
        return np.sqrt(np.diag(self.covariance)[at : at + 6])


def solve(
    observations: Sequence[Observation],
    start: Bundle,
    free: Free,
    cauchy_px: float | None = None,
    sigma_px: float = 0.2,
) -> Solution:
    """Minimise the sum of squared residuals, or of Cauchy losses per corner.

    Every view of `start` is in an observation. With `cauchy_px` a corner begins to lose its weight at that
    residual. `sigma_px` is a corner's standard deviation, against which the prior of the shape is weighed.
    What the observations do not determine has an enormous standard deviation in the result.
    """
    mask = free.mask(len(start.drawn_m))
    shape_sd_m = 3e-4  # a print glued on a plate by hand: some tenths of a millimetre
    prior = (sigma_px / shape_sd_m) ** 2 if free.shape else 0.0
    now, damping = start, 1e-3
    cost, normal = _normal_equations(observations, now, prior, cauchy_px)
    for _ in range(100):
        step = _step(normal, mask, damping)
        tried = now if step is None else _retracted(now, *step)
        new_cost, new_normal = _normal_equations(observations, tried, prior, cauchy_px)
        if step is not None and new_cost <= cost:  # False where it is NaN: a board went through a camera
            gain = cost - new_cost
            now, cost, normal = tried, new_cost, new_normal
            damping = max(damping / 10, 1e-10)
            if gain <= (1e-9 if cauchy_px is None else 1e-6) * cost:  # robust fits only judge
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    residuals = tuple(seen.uv - predict(now, seen) for seen in observations)
    return _solution(now, residuals, normal, mask, free)


def predict(bundle: Bundle, seen: Observation) -> Float:
    """Pixels (n, 2) where the corners of an observation should be."""
    points = _camera_points(bundle, seen)[2]
    lens = bundle.lenses[seen.camera]
    uv, _ = cv2.projectPoints(points, _ZERO, _ZERO, _matrix(lens), lens[4:])
    return np.asarray(uv, dtype=np.float64).reshape(-1, 2)


def rms(residuals: Sequence[Float]) -> float:
    """Root mean square distance [px] of corners, both coordinates under one root.

    As OpenCV has it.
    """
    return float(np.sqrt(np.mean(np.concatenate([(r**2).sum(axis=1) for r in residuals]))))


_ZERO = np.zeros(3)
Normal = tuple[Float, Float, Float, Float, Float]
"""Shared (S, S), shared x view (V, S, 6), view (V, 6, 6), right sides (S,) and (V, 6)."""


def _matrix(lens: Float) -> Float:
    return np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])


def _camera_points(bundle: Bundle, seen: Observation) -> tuple[Float, Float, Float]:
    """Corners (n, 3) on the board, in the rig's frame, and in the camera's."""
    on_board = bundle.drawn_m[seen.corners] + bundle.shape_m[seen.corners]
    in_rig = transform(bundle.T_rig_board[seen.view], on_board)
    return on_board, in_rig, transform(bundle.T_camera_rig[seen.camera], in_rig)


def _skews(vectors: Float) -> Float:
    """Matrices (n, 3, 3) with `_skews(a)[i] @ b == cross(a[i], b)`."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    return out - out.transpose(0, 2, 1)


def _jacobian(seen: Observation, bundle: Bundle) -> tuple[Float, Float, Float, Float, Float]:
    """Residuals (n, 2), and derivatives of the prediction.

    By lens (n, 2, 9), pose of camera and of board (n, 2, 6) each, shape (n, 2, 3). A pose rotates by exp(w)
    on its left and moves by t.
    """
    on_board, in_rig, points = _camera_points(bundle, seen)
    lens = bundle.lenses[seen.camera]
    projected, derivatives = cv2.projectPoints(points, _ZERO, _ZERO, _matrix(lens), lens[4:])
    uv = np.asarray(projected, dtype=np.float64).reshape(-1, 2)
    by_all = np.asarray(derivatives, dtype=np.float64).reshape(len(points), 2, -1)
    by_point, by_lens = by_all[:, :, 3:6], by_all[:, :, 6:15]
    rotation_c = bundle.T_camera_rig[seen.camera][:3, :3]
    rotation_v = bundle.T_rig_board[seen.view][:3, :3]
    by_camera = np.concatenate([-by_point @ _skews(in_rig @ rotation_c.T), by_point], axis=2)
    by_rig = by_point @ rotation_c
    by_view = np.concatenate([-by_rig @ _skews(on_board @ rotation_v.T), by_rig], axis=2)
    return seen.uv - uv, by_lens, by_camera, by_view, by_rig @ rotation_v


def _normal_equations(
    observations: Sequence[Observation], bundle: Bundle, prior: float, cauchy_px: float | None
) -> tuple[float, Normal]:
    """Cost and Gauss-Newton equations at a bundle."""
    cameras, views, corners = len(bundle.lenses), len(bundle.T_rig_board), len(bundle.drawn_m)
    size, shape_at = 15 * cameras + 3 * corners, 15 * cameras
    shared, right = np.zeros((size, size)), np.zeros(size)
    mixed, own, right_own = np.zeros((views, size, 6)), np.zeros((views, 6, 6)), np.zeros((views, 6))
    cost = 0.0
    for seen in observations:
        residual, by_lens, by_camera, by_view, by_shape = _jacobian(seen, bundle)
        square = (residual**2).sum(axis=1)
        if cauchy_px is None:
            weight = np.ones(len(square))
            cost += float(square.sum())
        else:
            weight = 1.0 / (1.0 + square / cauchy_px**2)
            cost += float(cauchy_px**2 * np.log1p(square / cauchy_px**2).sum())
        c, v = seen.camera, seen.view
        at = np.r_[9 * c : 9 * c + 9, 9 * cameras + 6 * c : 9 * cameras + 6 * c + 6]
        by_both = np.concatenate([by_lens, by_camera], axis=2)
        heavy = by_both * weight[:, None, None]
        shared[np.ix_(at, at)] += np.einsum("nij,nik->jk", heavy, by_both)
        right[at] += np.einsum("nij,ni->j", heavy, residual)
        mixed[v, at] += np.einsum("nij,nik->jk", heavy, by_view)
        heavy_view = by_view * weight[:, None, None]
        own[v] += np.einsum("nij,nik->jk", heavy_view, by_view)
        right_own[v] += np.einsum("nij,ni->j", heavy_view, residual)
        if prior > 0.0:
            to = shape_at + 3 * seen.corners[:, None] + np.arange(3)
            heavy_shape = by_shape * weight[:, None, None]
            shared[to[:, :, None], to[:, None, :]] += np.einsum("nij,nik->njk", heavy_shape, by_shape)
            cross = np.einsum("nij,nik->njk", heavy_shape, by_both)
            shared[to[:, :, None], at] += cross
            shared[at[:, None], to.ravel()] += cross.reshape(-1, len(at)).T
            right[to] += np.einsum("nij,ni->nj", heavy_shape, residual)
            mixed[v, to] += np.einsum("nij,nik->njk", heavy_shape, by_view)
    if prior > 0.0:
        shape = bundle.shape_m.ravel()
        cost += prior * float(shape @ shape)
        shared[np.arange(shape_at, size), np.arange(shape_at, size)] += prior
        right[shape_at:] -= prior * shape
    return cost, (shared, mixed, own, right, right_own)


def _reduced(normal: Normal, mask: Bool, damping: float) -> tuple[Float, Float, Float, Float]:
    """Schur's equations of the free shared parameters, and what leads back to views."""
    shared, mixed, own, right, right_own = normal
    shared, mixed, right = shared[np.ix_(mask, mask)], mixed[:, mask], right[mask]
    almost_nothing = 1e-3  # px^2 per rad^2 or m^2, where one view has 10^7 and more
    # A board that wrong corners drove far away no longer moves any pixel; its equations must stay solvable.
    damped: Float = own * (1.0 + damping * np.eye(6)) + almost_nothing * np.eye(6)
    sides: Float = np.concatenate([mixed.transpose(0, 2, 1), right_own[:, :, None]], axis=2)
    back = cast(Float, np.linalg.solve(damped, sides))
    by_shared, by_right = back[:, :, :-1], back[:, :, -1]
    schur = shared + damping * np.diag(np.diag(shared)) - np.tensordot(mixed, by_shared, ((0, 2), (0, 1)))
    return schur, right - np.einsum("vsi,vi->s", mixed, by_right), by_shared, by_right


def _step(normal: Normal, mask: Bool, damping: float) -> tuple[Float, Float] | None:
    """Marquardt's step, shared (S,) and per view (V, 6); None: needs more damping."""
    schur, right, by_shared, by_right = _reduced(normal, mask, damping)
    step = np.zeros(len(mask))
    if mask.any():
        # Scaled to a unit diagonal: pixels, radians and metres differ by orders of magnitude.
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal[0])[mask], 1e-300))
        try:
            step[mask] = scale * np.linalg.solve(schur * scale[:, None] * scale, right * scale)
        except np.linalg.LinAlgError:
            return None
    return step, by_right - by_shared @ step[mask]


def _retracted(bundle: Bundle, shared: Float, own: Float) -> Bundle:
    cameras = len(bundle.lenses)
    places = shared[9 * cameras : 15 * cameras].reshape(cameras, 6)
    return replace(
        bundle,
        lenses=bundle.lenses + shared[: 9 * cameras].reshape(cameras, 9),
        T_camera_rig=np.stack([_rotated(T, s) for T, s in zip(bundle.T_camera_rig, places, strict=True)]),
        T_rig_board=np.stack([_rotated(T, s) for T, s in zip(bundle.T_rig_board, own, strict=True)]),
        shape_m=bundle.shape_m + shared[15 * cameras :].reshape(-1, 3),
    )


def _rotated(T: Float, step: Float) -> Float:
    return rigid(rotation_vector_to_matrix(step[:3]) @ T[:3, :3], T[:3, 3] + step[3:])


def _solution(
    bundle: Bundle, residuals: tuple[Float, ...], normal: Normal, mask: Bool, free: Free
) -> Solution:
    schur, *_ = _reduced(normal, mask, 0.0)
    numbers = 2 * sum(len(r) for r in residuals)
    # The prior takes the place of measurements for what the shape cannot learn: seven numbers of its frame and size.
    spent = int(mask[: 15 * len(bundle.lenses)].sum()) + 6 * len(bundle.T_rig_board)
    spent += 3 * len(bundle.drawn_m) - 7 if free.shape else 0
    sigma = float(np.sqrt(sum(float((r**2).sum()) for r in residuals) / max(numbers - spent, 1)))
    covariance = np.zeros((len(mask), len(mask)))
    if mask.any():
        scale = 1.0 / np.sqrt(np.maximum(np.diag(schur), 1e-300))
        values, vectors = np.linalg.eigh(schur * scale[:, None] * scale)
        # A direction that nothing determines has a variance without bound; this one is large enough to be refused.
        inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
        covariance[np.ix_(mask, mask)] = sigma**2 * inverse * scale[:, None] * scale
    return Solution(bundle, residuals, sigma, covariance)


_FOCAL = np.geomspace(0.35, 6.0, 24)  # of the image's width: 110 to 10 degrees of view


def guess_lens(observations: Sequence[tuple[Int, Float]], drawn_m: Float, size_px: tuple[int, int]) -> Float:
    """Initial lens (9,) without distortion: that which fits the middle image best.

    The middle one, since up to half of the images may be wrong altogether. Observations are the numbers (n,)
    and places (n, 2) [px] of the corners (N, 3) [m] in each image.
    """
    width, height = size_px
    lenses = [
        np.array([f * width, f * width, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0]) for f in _FOCAL
    ]
    errors = [
        np.median([place_board(drawn_m[corners], uv, lens)[1] for corners, uv in observations])
        for lens in lenses
    ]
    return lenses[int(np.argmin(errors))]


def place_board(corners_m: Float, uv: Float, lens: Float) -> tuple[Float, float]:
    """T_camera_board (4, 4) [m] and rms [px] of one image of a flat board.

    From corners (n, 3) [m], z = 0, at least four, seen at (n, 2) [px] by a lens (9,). A plane seen from afar
    has two poses that look alike (Schweighofer and Pinz, 2006): both are refined.
    """
    matrix, best = _matrix(lens), (np.eye(4), np.inf)
    _, rotation_vectors, moves, _ = cv2.solvePnPGeneric(
        corners_m, uv, matrix, lens[4:], flags=cv2.SOLVEPNP_IPPE
    )
    for rotation_vector, move in zip(rotation_vectors, moves, strict=True):
        rotation_vector, move = cv2.solvePnPRefineLM(corners_m, uv, matrix, lens[4:], rotation_vector, move)
        again, _ = cv2.projectPoints(corners_m, rotation_vector, move, matrix, lens[4:])
        off = np.asarray(again, dtype=np.float64).reshape(-1, 2) - uv
        error = float(np.sqrt((off**2).sum(axis=1).mean()))
        if error < best[1] and float(np.asarray(move).ravel()[2]) > 0:
            rotation = np.asarray(cv2.Rodrigues(rotation_vector)[0], dtype=np.float64)
            best = rigid(rotation, np.asarray(move, dtype=np.float64).ravel()), error
    return best
