"""Calibration of one camera by itself, the start of every fit.

Its lens, where the board was, and which of its images are wrong.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Int
from common.errors import FitError
from master.calibrate.cameras.boards import board_corners
from master.calibrate.cameras.bundle import Bundle, Free, Observation, predict, solve
from master.calibrate.cameras.detect import ImageObservation
from master.calibrate.cameras.first_guess import guess_lens, place_board
from master.calibrate.cameras.outliers import limit
from master.calibrate.cameras.views import BoardViews

MIN_VIEWS = 4  # three determine a lens in principle; a fourth can contradict it
_ROUNDS = 8


@dataclass(frozen=True, slots=True)
class Rejection:
    """An image, or a whole view (no camera), that is not used, and why."""

    view: str
    camera: str
    reason: str

    def __str__(self) -> str:
        return f"view {self.view}{' ' * bool(self.camera)}{self.camera}: {self.reason}"


@dataclass(frozen=True, slots=True, eq=False)
class Alone:
    """A camera's own fit.

    Attributes:
        lens: (9,) in the order of `bundle.LENS`.
        T_camera_board: View -> place of the board (4, 4) [m], accepted images only.
        rejected: The other images.
        sigma_px: Robust standard deviation of a coordinate.
    """

    lens: Float
    T_camera_board: Mapping[str, Float]
    rejected: tuple[Rejection, ...]
    sigma_px: float


def corners_seen(observation: ImageObservation) -> tuple[Int, Float]:
    """Numbers (n,) and places (n, 2) [px] of the corners seen."""
    seen = np.flatnonzero(np.isfinite(observation.corners_px[:, 0])).astype(np.int64)
    return seen, observation.corners_px[seen]


def fit_alone(views: BoardViews, camera: str, held: Float | None = None) -> Alone:
    """Lens and places of the board from one camera's images, without the wrong ones.

    Images are judged by a robust fit to all of them: blurred ones and those whose corners lie off further than the
    other images' do (`outliers.limit`). Then it is fitted to the good ones, and all are judged anew, until nothing
    changes; so an image may come back.

    Args:
        views: What was seen.
        camera: One of its cameras.
        held: A known lens (9,), then only the images are judged.

    Raises:
        FitError: Too few images, or too few that agree with each other.
    """
    drawn = board_corners(views.board)
    observations = views.of(camera)
    if held is None and len(observations) < MIN_VIEWS:
        raise FitError(
            f"camera {camera!r}: the board is seen in {len(observations)} images, at least {MIN_VIEWS} are needed"
            " (better 15), each with the board in another place and tilt"
        )
    names = [name for name, _ in observations]
    seen = [corners_seen(observation) for _, observation in observations]
    blurred = _blurred(np.array([observation.blur_px for _, observation in observations]))
    sharp = [seen[i] for i in range(len(seen)) if i not in blurred]
    lens = guess_lens(sharp, drawn, views.sizes_px[camera]) if held is None else held
    good = [i for i in range(len(seen)) if i not in blurred]
    errors, bound, sigma = np.zeros(len(seen)), np.inf, 1.0
    dof = np.array([2.0 * len(uv) - 6.0 for _, uv in seen])
    for round_ in range(_ROUNDS):
        if held is None:
            lens, sigma = _robust(good, seen, drawn, lens, first=round_ == 0)
        placed = [place_board(drawn[corners], uv, lens) for corners, uv in seen]
        errors = np.array([error for _, error in placed])
        bound = limit(errors, dof)
        kept = [i for i in range(len(seen)) if i not in blurred and errors[i] <= bound]
        if kept == good and round_ > 0:
            break
        good = kept
        if held is None and len(good) < MIN_VIEWS:
            break
    typical = float(np.median(errors))
    rejected = tuple(
        Rejection(names[i], camera, _reason(blurred.get(i), errors[i], typical, bound))
        for i in range(len(seen))
        if i not in good
    )
    if held is None and len(good) < max(MIN_VIEWS, len(seen) / 2):
        raise FitError(
            f"camera {camera!r}: only {len(good)} of {len(seen)} images agree with each other, at least"
            f" {max(MIN_VIEWS, (len(seen) + 1) // 2)} must: " + "; ".join(str(no) for no in rejected)
        )
    placed = [place_board(drawn[corners], uv, lens)[0] for corners, uv in seen]
    return Alone(lens, {names[i]: placed[i] for i in good}, rejected, sigma)


def _robust(
    good: list[int], seen: list[tuple[Int, Float]], drawn: Float, lens: Float, *, first: bool
) -> tuple[Float, float]:
    """Fit a lens with Cauchy's loss.

    The scale of the loss is three times the robust standard deviation of the residuals.
    """
    observations = [Observation(0, view, *seen[i]) for view, i in enumerate(good)]
    places = np.stack([place_board(drawn[seen[i][0]], seen[i][1], lens)[0] for i in good])
    bundle = Bundle(lens[None], np.eye(4)[None], places, drawn, np.zeros_like(drawn))
    free = np.ones((1, 9), dtype=np.bool_)
    free[0, 8] = False
    # From a lens without distortion everything is wrong a little: k1 must be found before outliers can be detected.
    for _ in range(3 if first else 1):
        residuals = [seen_.uv - predict(bundle, seen_) for seen_ in observations]
        # The median of a two-dimensional normal distance is 1.1774 standard deviations.
        sigma = max(float(np.median(np.linalg.norm(np.concatenate(residuals), axis=1))) / 1.1774, 1e-3)
        bundle = solve(observations, bundle, Free(free, np.zeros(1, np.bool_), shape=False), 3 * sigma).bundle
    residuals = [seen_.uv - predict(bundle, seen_) for seen_ in observations]
    sigma = max(float(np.median(np.linalg.norm(np.concatenate(residuals), axis=1))) / 1.1774, 1e-3)
    return bundle.lenses[0], sigma


def _blurred(blur_px: Float) -> dict[int, str]:
    """Images that are blurred where the others are not: index -> reason."""
    typical = float(np.median(blur_px))
    blurred = 2.5  # times the blur of the camera's other images: more of the edge than a window holds
    blurred_px = 1.5  # less is no harm, however sharp the others are
    return {
        int(
            i
        ): f"blurred: edges spread over {blur_px[i]:.1f} px (standard deviation), usually {typical:.1f} px"
        for i in np.flatnonzero(blur_px > max(blurred * typical, blurred_px))
    }


def _reason(blurred: str | None, error: float, typical: float, bound: float) -> str:
    if blurred is not None:
        return blurred
    return f"corners are off by {error:.2f} px rms, usually {typical:.2f} px (limit {bound:.2f} px)"
