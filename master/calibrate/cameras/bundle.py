"""A bundle adjustment fits lenses, camera poses, board poses and board shape.

Corner i of an image is seen at pixel = lens(T_camera_rig T_rig_board (c_i + s_i)), where c_i is the drawn
corner and s_i its offset on the real, never quite flat board. The board's pose is a view's own unknown
(`master.calibrate.adjust`), and so is how late each of its frames is in truth: a stamp that a program
gives is early or late by some milliseconds, which at 100 px/s moves all corners of an image together. All
else is shared. A prior of the shape about the drawn one also fixes the
board's frame and size: few views leave it as drawn. Lenses have a weak prior: what corners in a small part of
the image hardly determine stays near that of an ordinary lens, and its standard deviation says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import rigid, skew, transform
from master.calibrate.adjust import Minimum, Normal, cauchy, minimise, stepped_poses, weigh

LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Corners of one image."""

    camera: int  # this and view: indices into the bundle
    view: int
    corners: Int  # numbers (n,) of the corners seen
    uv: Float  # their places (n, 2) [px]
    speed: Float | None = None  # of these places (n, 2) [px/s]; None: not known, or still


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """What is estimated."""

    lenses: Float  # (C, 9) in the order `LENS`
    centre_px: Float  # (C, 2) middle of the images
    T_camera_rig: Float  # (C, 4, 4) [m]
    T_rig_board: Float  # (V, 4, 4) [m]
    # this and shape_m: (N, 3) [m] corners of the board as drawn, and the offsets of the real ones
    drawn_m: Float
    shape_m: Float
    delay_s: Float  # (C,) by which frames were taken later than their times state
    late_s: Float | None = None  # (V, C) by which one frame was later than that; None: not estimated
    late_sd_s: float = 0.0  # standard deviation of that; 0: it is not estimated


@dataclass(frozen=True, slots=True, eq=False)
class Free:
    """What is estimated of lenses (C, 9), cameras (C,) and the board's shape.

    Poses of the board always are.
    """

    lenses: Bool
    cameras: Bool
    shape: bool
    delays: Bool | None = None

    @classmethod
    def only_boards(cls, bundle: Bundle) -> "Free":
        """Neither lenses, camera poses nor shape."""
        lenses = np.zeros_like(bundle.lenses, dtype=np.bool_)
        return cls(lenses, np.zeros(len(lenses), dtype=np.bool_), shape=False)

    def mask(self, corners: int) -> Bool:
        """The shared parameters in a row: lenses, camera poses, delays, shape."""
        delays = np.zeros_like(self.cameras) if self.delays is None else self.delays
        shape = np.full(3 * corners, self.shape)
        return np.concatenate([self.lenses.ravel(), np.repeat(self.cameras, 6), delays, shape])


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

    def delay_sd(self, camera: int) -> float:
        """Standard deviation [s] of a camera's delay; 0: held."""
        return float(np.sqrt(np.diag(self.covariance)[15 * len(self.bundle.lenses) + camera]))


def solve(
    observations: Sequence[Observation],
    start: Bundle,
    free: Free,
    cauchy_px: float | None = None,
    sigma_px: float = 0.2,
) -> Solution:
    """Minimise the sum of squared residuals, or of Cauchy losses per corner.

    Every view of `start` is in an observation. With `cauchy_px` a corner begins to lose its weight at that
    residual. `sigma_px` is a corner's standard deviation, against which the priors are weighed; 0: none.
    What the observations do not determine has an enormous standard deviation in the result.
    """
    mask = free.mask(len(start.drawn_m))
    shape_sd_m = 3e-4  # a print glued on a plate by hand: some tenths of a millimetre
    prior_px_m = sigma_px / shape_sd_m if free.shape else 0.0

    images = _stacked(observations, len(start.drawn_m))

    def equations(bundle: Bundle) -> Normal:
        normal = _equations(images, bundle, mask, prior_px_m, cauchy_px)
        if bundle.late_s is not None:
            _add_late(normal, bundle.late_s, sigma_px / bundle.late_sd_s)
        if sigma_px == 0.0:
            return normal
        away, sd = lens_prior(bundle)
        known, cameras = np.zeros(len(mask)), len(away)
        known[: away.size], known[15 * cameras : 16 * cameras] = away.ravel(), bundle.delay_s
        sigma = np.full(len(mask), np.inf)
        usual_s = 0.1  # a few frames in the buffers of a driver
        sigma[: away.size], sigma[15 * cameras : 16 * cameras] = sd.ravel() / sigma_px, usual_s / sigma_px
        normal.add_prior(known[mask], sigma[mask])
        _add_unfolded(normal, bundle, free.lenses, sigma_px)
        return normal

    def stepped(bundle: Bundle, step: Float, own: Float) -> Bundle:
        shared = np.zeros(len(mask))
        shared[mask] = step
        return _retracted(bundle, shared, own)

    # robust fits only judge
    if start.late_s is None and start.late_sd_s > 0.0:
        start = replace(start, late_s=np.zeros((len(start.T_rig_board), len(start.lenses))))
    found = minimise(equations, stepped, start, gain_share=1e-8 if cauchy_px is None else 1e-6)
    return _solution(observations, found, mask, free)


def lens_prior(bundle: Bundle) -> tuple[Float, Float]:
    """How far lenses (C, 9) are from ordinary ones, and the widths (C, 9) of these.

    Standard deviations; inf: no prior. The principal point lies in the middle of the image, to a twentieth of its
    width; there is no distortion, to what lenses of 50 to 90 degrees have.
    """
    away = bundle.lenses.copy()
    away[:, :2], away[:, 2:4] = 0.0, bundle.lenses[:, 2:4] - bundle.centre_px
    sd = np.empty_like(away)
    sd[:] = [np.inf, np.inf, 0.0, 0.0, 0.3, 0.3, 0.005, 0.005, 0.3]
    sd[:, 2:4] = 0.1 * bundle.centre_px[:, :1]
    return away, sd


def _add_unfolded(normal: Normal, bundle: Bundle, free: Bool, sigma_px: float) -> None:
    """Add the prior that a lens does not fold in its image.

    At the corner of the image the derivative 1 + 3 k1 r^2 + 5 k2 r^4 + 7 k3 r^6 of its distortion is 1 +- 0.3.
    """
    first = np.cumsum(free.ravel()).reshape(free.shape) - 1
    for lens, centre, kept, column in zip(bundle.lenses, bundle.centre_px, free, first, strict=True):
        if kept[:4].all():
            terms = kept & np.isin(np.arange(9), (4, 5, 8))
            r2 = float(((centre / lens[:2]) ** 2).sum())
            by = np.array([0, 0, 0, 0, 3 * r2, 5 * r2**2, 0, 0, 7 * r2**3]) * sigma_px / 0.3
            normal.add(np.array([[by @ lens]]), by[None, None, terms], columns=column[terms])


def lateness(observations: Sequence[Observation], bundle: Bundle) -> Bundle:
    """Measure how far single frames are from their times, for the next step.

    Frames of a fast board count more: of a slow one all kinds of errors look like much time.
    """
    if bundle.late_s is None or len(bundle.lenses) < 2:
        return bundle
    late_s = np.array([bundle.late_s[seen.view, seen.camera] for seen in observations])
    weight = np.array([0.0 if seen.speed is None else float((seen.speed**2).mean()) for seen in observations])
    # What all frames of a view share is a place of the board.
    share = 1.0 - 1.0 / len(bundle.lenses)
    sd_s = float(np.sqrt((weight * late_s**2).sum() / max(float(weight.sum()), 1e-12) / share))
    return replace(bundle, late_sd_s=min(max(sd_s, 1e-3), 0.03))


def _add_late(normal: Normal, late_s: Float, weight: float) -> None:
    """Add the prior of late frames: `weight` [1/s] is 1 over its deviation."""
    normal.cost += weight**2 * float((late_s**2).sum())
    np.einsum("vii->vi", normal.own[0])[:, 6:] += weight**2
    normal.own_gradient[:, 6:] += weight**2 * late_s


def predict(bundle: Bundle, seen: Observation) -> Float:
    """Pixels (n, 2) where the corners of an observation should be, as of its time."""
    on_board = bundle.drawn_m[seen.corners] + bundle.shape_m[seen.corners]
    points = transform(bundle.T_camera_rig[seen.camera] @ bundle.T_rig_board[seen.view], on_board)
    found = project(points, bundle.lenses[seen.camera])
    if seen.speed is None:
        return found
    late_s = 0.0 if bundle.late_s is None else bundle.late_s[seen.view, seen.camera]
    return found - seen.speed * (bundle.delay_s[seen.camera] + late_s)


def project(points_m: Float, lens: Float) -> Float:
    """Pixels (n, 2) of points (n, 3) [m] before a lens (9,)."""
    uv, _ = cv2.projectPoints(points_m, _ZERO, _ZERO, _matrix(lens), lens[4:])
    return np.asarray(uv, dtype=np.float64).reshape(-1, 2)


def rms(residuals: Sequence[Float]) -> float:
    """Root mean square distance [px] of corners, both coordinates under one root.

    As OpenCV has it.
    """
    return float(np.sqrt(np.mean(np.concatenate([(r**2).sum(axis=1) for r in residuals]))))


_ZERO = np.zeros(3)


def _matrix(lens: Float) -> Float:
    return np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """All images of one camera in arrays, so that a step needs no loop over images."""

    camera: int
    views: Int  # (E,) indices into the bundle
    uv: Float  # (E, N, 2) [px] of all corners; NaN: not seen
    speed: Float  # (E, N, 2) [px/s]


def _stacked(observations: Sequence[Observation], corners: int) -> list[_Images]:
    found: list[_Images] = []
    for camera in sorted({seen.camera for seen in observations}):
        own = [seen for seen in observations if seen.camera == camera]
        uv, speed = np.full((len(own), corners, 2), np.nan), np.zeros((len(own), corners, 2))
        for i, seen in enumerate(own):
            uv[i, seen.corners] = seen.uv
            if seen.speed is not None:
                speed[i, seen.corners] = seen.speed
        found.append(_Images(camera, np.array([seen.view for seen in own], np.int64), uv, speed))
    return found


def _jacobian(images: _Images, bundle: Bundle) -> tuple[Float, Float, Float, Float, Float]:
    """Predicted minus seen corners (E, N, 2), and their derivatives.

    By lens (E, N, 2, 9), pose of camera (E, N, 2, 6), own unknowns of the view (E, N, 2, 6 or 6 + C), shape
    (E, N, 2, 3). A pose rotates by exp(w) on its left and moves by t.
    """
    T_rig_board, T_camera_rig = bundle.T_rig_board[images.views], bundle.T_camera_rig[images.camera]
    rotation_v, rotation_c = T_rig_board[:, :3, :3], T_camera_rig[:3, :3]
    turned = (bundle.drawn_m + bundle.shape_m) @ np.swapaxes(rotation_v, 1, 2)
    in_rig = turned + T_rig_board[:, None, :3, 3]
    points, lens = transform(T_camera_rig, in_rig).reshape(-1, 3), bundle.lenses[images.camera]
    projected, derivatives = cv2.projectPoints(points, _ZERO, _ZERO, _matrix(lens), lens[4:])
    late_s = np.zeros((1, 0)) if bundle.late_s is None else bundle.late_s[images.views]
    delay_s = bundle.delay_s[images.camera] + late_s[:, images.camera : images.camera + 1].sum(axis=1)
    seen = images.uv + images.speed * delay_s[:, None, None]
    off = np.asarray(projected, dtype=np.float64).reshape(seen.shape) - seen
    by_all = np.asarray(derivatives, dtype=np.float64).reshape(*off.shape, -1)
    by_point, by_lens = by_all[..., 3:6], by_all[..., 6:15]
    by_camera = np.concatenate([-by_point @ skew(in_rig @ rotation_c.T), by_point], axis=-1)
    by_rig = by_point @ rotation_c
    by_late = np.zeros((*off.shape, late_s.shape[1]))
    by_late[..., images.camera : images.camera + 1] = -images.speed[..., None]
    by_view = np.concatenate([-by_rig @ skew(turned), by_rig, by_late], axis=-1)
    return off, by_lens, by_camera, by_view, by_rig @ rotation_v[:, None]


def _equations(
    images: Sequence[_Images], bundle: Bundle, mask: Bool, prior_px_m: float, cauchy_px: float | None
) -> Normal:
    """Normal equations [px] of the free unknowns, with the prior of the shape."""
    cameras, shape_at = len(bundle.lenses), 16 * len(bundle.lenses)
    late = 0 if bundle.late_s is None else cameras
    normal = Normal(len(mask), len(bundle.T_rig_board), 6 + late)
    loss = None if cauchy_px is None else cauchy(cauchy_px)
    for own in images:
        off, by_lens, by_camera, by_view, by_shape = _jacobian(own, bundle)
        if not np.isfinite(off[np.isfinite(own.uv)]).all():
            normal.cost = np.inf  # a board went through a camera: no such step
        c, (count, corners, _) = own.camera, off.shape
        at = np.r_[9 * c : 9 * c + 9, 9 * cameras + 6 * c : 9 * cameras + 6 * c + 6, 15 * cameras + c]
        by = np.concatenate([by_lens, by_camera, -own.speed[..., None]], axis=-1)
        rows = (count, 2 * corners, -1)
        flat = off.reshape(count, -1)
        normal.add(
            flat, by.reshape(rows), by_view.reshape(rows), epochs=own.views, columns=at, loss=loss, group=2
        )
        if prior_px_m > 0.0:  # a corner's offset moves that corner alone: its rows are blocks
            weight = weigh(flat, loss, 2)[1].reshape(off.shape)[..., None] ** 2
            heavy = np.where(weight > 0.0, by_shape * weight, 0.0)
            places: Int = shape_at + np.arange(3 * corners, dtype=np.int64).reshape(corners, 3)
            blocks = _einsum("enri,enrj->nij", heavy, by_shape)
            cross = _einsum("enra,enrj->anj", by, heavy).reshape(len(at), -1)
            normal.shared[places[:, :, None], places[:, None, :]] += blocks
            normal.shared[at, shape_at:] += cross
            normal.shared[shape_at:, at] += cross.T
            normal.gradient[shape_at:] += _einsum("enri,enr->ni", heavy, off).ravel()
            mixed = _einsum("enrb,enrj->ebnj", by_view, heavy)
            normal.mixed[own.views, :, shape_at:] += mixed.reshape(count, 6 + late, -1)
    if prior_px_m > 0.0:
        away, sigma = np.zeros(len(mask)), np.full(len(mask), np.inf)
        away[shape_at:], sigma[shape_at:] = bundle.shape_m.ravel(), 1.0 / prior_px_m
        normal.add_prior(away, sigma)
    normal.shared, normal.gradient = normal.shared[np.ix_(mask, mask)], normal.gradient[mask]
    normal.mixed = normal.mixed[..., mask]
    return normal


def _einsum(sums: str, a: Float, b: Float) -> Float:
    """Sums of products where both are known: of corners not seen there are none."""
    return np.asarray(np.einsum(sums, np.nan_to_num(a), np.nan_to_num(b)), np.float64)


def _retracted(bundle: Bundle, shared: Float, own: Float) -> Bundle:
    cameras = len(bundle.lenses)
    places = shared[9 * cameras : 15 * cameras].reshape(cameras, 6)
    return replace(
        bundle,
        lenses=bundle.lenses + shared[: 9 * cameras].reshape(cameras, 9),
        T_camera_rig=stepped_poses(bundle.T_camera_rig, places),
        T_rig_board=stepped_poses(bundle.T_rig_board, own[:, :6]),
        late_s=None if bundle.late_s is None else bundle.late_s + own[:, 6:],
        delay_s=bundle.delay_s + shared[15 * cameras : 16 * cameras],
        shape_m=bundle.shape_m + shared[16 * cameras :].reshape(-1, 3),
    )


def _solution(
    observations: Sequence[Observation], found: Minimum[Bundle], mask: Bool, free: Free
) -> Solution:
    bundle = found.x
    residuals = tuple(seen.uv - predict(bundle, seen) for seen in observations)
    numbers = 2 * sum(len(r) for r in residuals)
    # The prior takes the place of measurements for what the shape cannot learn: seven numbers of its frame and size.
    spent = int(mask[: 16 * len(bundle.lenses)].sum()) + 6 * len(bundle.T_rig_board)
    spent += 3 * len(bundle.drawn_m) - 7 if free.shape else 0
    spent += 0 if bundle.late_s is None else len(observations)
    sigma = float(np.sqrt(sum(float((r**2).sum()) for r in residuals) / max(numbers - spent, 1)))
    covariance = np.zeros((len(mask), len(mask)))
    if mask.any():
        covariance[np.ix_(mask, mask)] = sigma**2 * found.normal.covariance()
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
