"""A robust fit calibrates one camera, and rejects wrong images and views.

An image is judged by its own camera, whatever the others saw: one that fails is not used at all. A view is
judged by whether its cameras agree on where the board is: where they do not, the board moved between the
exposures or images of two epochs were put together. Such images are good in themselves, so each still helps
the lens of its own camera.

Whether the board is flat or bent is decided by cross validation.
A shape of its own always lowers the residuals of the views that it is fitted to, by three numbers a corner.
So the views are dealt into folds. Lenses, camera poses and shape are fitted to all folds but one; in the
views of that one only the board may move. It is placed by one half of its corners and the other half is
scored, then the other way round. Both boards are scored on the same corners, view by view, and the simpler
one is taken unless the other is better by more than the views scatter (the rule of one standard error:
Breiman et al., Classification and Regression Trees, 1984, section 3.4; Hastie et al., The Elements of
Statistical Learning, 2009, section 7.10; here paired, and with the quantile of Student's t in place of one).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from common.arrays import Bool, Float, Int
from common.errors import FitError
from common.geometry.transforms import invert
from master.calibrate.cameras.boards import Board, ImageObservation, board_corners, grid_shape
from master.calibrate.cameras.bundle import (
    Bundle,
    Free,
    Observation,
    guess_lens,
    place_board,
    predict,
    rms,
    solve,
)
from master.calibrate.cameras.views import BoardViews

FALSE_ALARM = 0.05  # chance that a set of good views loses one; one view less costs little, a wrong one much
GOOD_PX = 0.12  # as well as corners can be found: such a view is right, however good the others are


def limit(errors: Float, dof: Float) -> float:
    """Error [px] above which a view is an outlier; infinite below four views.

    The logarithms of good views' rms errors (V,) scatter about a common middle, more than chi-square alone
    would have it (light, blur and tilt differ). Middle and spread are median and median absolute deviation,
    so up to half of the views may be wrong; the quantile is Student's for as many views, at the level
    `FALSE_ALARM` for the whole set. `dof` (V,) are the degrees of freedom of each error.
    """
    if len(errors) < 4:
        return float("inf")
    logs = np.log(np.maximum(errors, 1e-6))
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    least_spread = 0.1  # of log rms: below it, views of one camera hardly ever agree
    # The logarithm of an rms of n normal numbers has the standard deviation 1 / sqrt(2 n).
    spread = max(spread, least_spread, 1.0 / np.sqrt(2.0 * max(float(np.median(dof)), 1.0)))
    quantile = float(stdtrit(len(errors) - 1, 1.0 - FALSE_ALARM / len(errors)))
    return max(float(np.exp(middle + quantile * spread)), GOOD_PX)


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
    """A camera's own fit."""

    lens: Float  # (9,) in the order of `bundle.LENS`
    T_camera_board: Mapping[str, Float]  # view -> board pose (4, 4) [m], accepted images only
    rejected: tuple[Rejection, ...]
    sigma_px: float  # robust standard deviation of a coordinate


def centre_of(size_px: tuple[int, int]) -> Float:
    """The middle (2,) [px] of an image."""
    return (np.array(size_px, np.float64) - 1.0) / 2.0


def corners_seen(observation: ImageObservation) -> tuple[Int, Float]:
    """Numbers (n,) and places (n, 2) [px] of the corners seen."""
    seen = np.flatnonzero(np.isfinite(observation.corners_px[:, 0])).astype(np.int64)
    return seen, observation.corners_px[seen]


def fit_alone(views: BoardViews, camera: str, held: Float | None = None, near: Float | None = None) -> Alone:
    """Lens and board poses from one camera's images, without the wrong ones.

    Images are judged by a robust fit to all: blurred ones are out, and those with errors beyond `limit`. Then
    the lens is fitted to the good ones and all are judged again until nothing changes, so an image may come
    back. With a known lens `held` (9,) the images are judged only; `near` (9,) is one to begin with.

    Raises:
        FitError: Too few images, or too few that agree with each other.
    """
    drawn = board_corners(views.board)
    observations = views.of(camera)
    if held is None and len(observations) < MIN_VIEWS:
        without = " ".join(f"--camera {name}" for name in views.cameras if name != camera)
        raise FitError(
            f"camera {camera!r}: the board is seen in {len(observations)} images, at least {MIN_VIEWS} are needed"
            " (better 15), each with the board in another place and tilt"
            + (f"; or leave it out: {without}" if without else "")
        )
    names = [name for name, _ in observations]
    seen = [corners_seen(observation) for _, observation in observations]
    blurred = _blurred(np.array([observation.blur_px for _, observation in observations]))
    sharp = [seen[i] for i in range(len(seen)) if i not in blurred]
    begin = near if held is None else held
    lens = guess_lens(sharp, drawn, views.sizes_px[camera]) if begin is None else begin
    good = [i for i in range(len(seen)) if i not in blurred]
    errors, bound, sigma = np.zeros(len(seen)), np.inf, 1.0
    dof = np.array([2.0 * len(uv) - 6.0 for _, uv in seen])
    for round_ in range(_ROUNDS):
        if held is None:
            lens, sigma = _robust(
                good, seen, drawn, lens, views.sizes_px[camera], first=round_ == 0 and near is None
            )
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
        Rejection(names[i], camera, blurred.get(i) or _off(errors[i], typical, bound))
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
    good: list[int],
    seen: list[tuple[Int, Float]],
    drawn: Float,
    lens: Float,
    size_px: tuple[int, int],
    *,
    first: bool,
) -> tuple[Float, float]:
    """Fit a lens with Cauchy's loss at three robust deviations of the residuals."""
    observations = [Observation(0, view, *seen[i]) for view, i in enumerate(good)]
    places = np.stack([place_board(drawn[seen[i][0]], seen[i][1], lens)[0] for i in good])
    bundle = Bundle(
        lens[None],
        centre_of(size_px)[None],
        np.eye(4)[None],
        places,
        drawn,
        np.zeros_like(drawn),
        np.zeros(1),
    )
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
        i: f"blurred: edges spread over {blur_px[i]:.1f} px (standard deviation), usually {typical:.1f} px"
        for i in np.flatnonzero(blur_px > max(blurred * typical, blurred_px)).tolist()
    }


def _off(error: float, typical: float, bound: float) -> str:
    return f"corners are off by {error:.2f} px rms, usually {typical:.2f} px (limit {bound:.2f} px)"


@dataclass(frozen=True, slots=True)
class Shot:
    """One image, and the place of the board that it shows.

    Cameras that agree on a view share a `place`, named as the view; one parted from the others has its own.
    """

    view: str
    camera: str
    place: str


@dataclass(frozen=True, slots=True)
class Seen:
    """What was seen, with the turned boards put right."""

    views: BoardViews
    # view -> camera -> order of the corner numbers, as of `fit.Links`
    corner_order: Mapping[str, Mapping[str, Int]]

    def observations(self, shots: Sequence[Shot]) -> tuple[Observation, ...]:
        """Corners of the shots; views are numbered by the shots' places, in order."""
        cameras = self.views.cameras
        number = {place: i for i, place in enumerate(dict.fromkeys(shot.place for shot in shots))}
        by_name = {view.name: view for view in self.views.views}
        found: list[Observation] = []
        for shot in shots:
            image = by_name[shot.view].observations[shot.camera]
            corners, uv = corners_seen(image)
            true = self.corner_order[shot.view][shot.camera][corners]
            speed = None if image.speed_px_s is None else image.speed_px_s[corners]
            found.append(Observation(cameras.index(shot.camera), number[shot.place], true, uv, speed))
        return tuple(found)


def place_boards(observations: Sequence[Observation], bundle: Bundle) -> Bundle:
    """The bundle with each board where the median camera of its view fits it best."""
    views: dict[int, list[Observation]] = {}
    for seen in observations:
        views.setdefault(seen.view, []).append(seen)
    places: list[Float] = []
    for _, own in sorted(views.items()):
        tried: list[tuple[float, Float]] = []
        for seen in own:
            T_camera_board, _ = place_board(bundle.drawn_m[seen.corners], seen.uv, bundle.lenses[seen.camera])
            T = invert(bundle.T_camera_rig[seen.camera]) @ T_camera_board
            alone = replace(bundle, T_rig_board=T[None], late_s=None)
            off = [rms([other.uv - predict(alone, replace(other, view=0))]) for other in own]
            tried.append((float(np.nan_to_num(np.median(off), nan=np.inf)), T))
        places.append(min(tried, key=lambda pair: pair[0])[1])
    return replace(bundle, T_rig_board=np.stack(places), late_s=None)


def judge(
    seen: Seen, shots: Sequence[Shot], bundle: Bundle
) -> tuple[tuple[Shot, ...], tuple[Rejection, ...]]:
    """The good shots, each at its place, and why the others are rejected.

    `shots` are all that may be good, every view at one place; the board poses of `bundle` are not used.
    """
    good, rejected, sigma = _judge_images(seen, shots, bundle)
    views: dict[str, list[Shot]] = {}
    for shot in good:
        views.setdefault(shot.view, []).append(shot)
    linked = {view: own for view, own in views.items() if len(own) > 1}
    if not linked:
        return good, rejected
    errors = _view_errors(seen, list(linked.values()), bundle, sigma)
    corners = [2.0 * sum(len(o.uv) for o in seen.observations(own)) - 6.0 for own in linked.values()]
    bound, typical = limit(errors, np.array(corners)), float(np.median(errors))
    parted: dict[str, set[str]] = {}
    notes = list(rejected)
    for (view, own), error in zip(linked.items(), errors, strict=True):
        if error > bound:
            parted[view] = _to_part(seen, own, bundle, sigma, bound)
            cameras = "" if len(parted[view]) == len(own) else "".join(parted[view])
            notes.append(Rejection(view, cameras, _disagreement(own, parted[view], error / typical)))
    placed = (_at_own_place(shot) if shot.camera in parted.get(shot.view, ()) else shot for shot in good)
    return tuple(placed), tuple(notes)


def _at_own_place(shot: Shot) -> Shot:
    return replace(shot, place=f"{shot.view} {shot.camera}")


def _judge_images(
    seen: Seen, shots: Sequence[Shot], bundle: Bundle
) -> tuple[tuple[Shot, ...], tuple[Rejection, ...], Float]:
    """Good shots, rejections, and each camera's robust standard deviation (C,) [px]."""
    residuals = _settled(seen, [_at_own_place(shot) for shot in shots], bundle)
    errors = np.array([rms([r]) for r in residuals])
    dof = np.array([2.0 * len(r) - 6.0 for r in residuals])
    good = np.ones(len(shots), dtype=np.bool_)
    sigma = np.ones(len(bundle.lenses))
    reasons: dict[int, Rejection] = {}
    for c, camera in enumerate(seen.views.cameras):
        own = [i for i, shot in enumerate(shots) if shot.camera == camera]
        if not own:
            continue
        bound, typical = limit(errors[own], dof[own]), float(np.median(errors[own]))
        distances = np.concatenate([np.linalg.norm(residuals[i], axis=1) for i in own])
        sigma[c] = max(float(np.median(distances)) / 1.1774, 1e-3)
        for i in (i for i in own if errors[i] > bound):
            reasons[i] = Rejection(shots[i].view, camera, _off(errors[i], typical, bound))
            good[i] = False
    kept = tuple(shot for shot, yes in zip(shots, good, strict=True) if yes)
    return kept, tuple(reasons.values()), sigma


def _settled(seen: Seen, shots: Sequence[Shot], bundle: Bundle) -> tuple[Float, ...]:
    """Residuals (n, 2) [px] of each shot when only the boards may move."""
    observations = seen.observations(shots)
    return solve(observations, place_boards(observations, bundle), Free.only_boards(bundle)).residuals


def _view_errors(seen: Seen, views: Sequence[Sequence[Shot]], bundle: Bundle, sigma: Float) -> Float:
    """Rms residual (V,) [px] of each view, scaled to the median camera's noise."""
    shots = [shot for own in views for shot in own]
    residuals = iter(_settled(seen, shots, bundle))
    cameras = seen.views.cameras
    return float(np.median(sigma)) * np.array(
        [rms([next(residuals) / sigma[cameras.index(shot.camera)] for shot in own]) for own in views]
    )


def _to_part(seen: Seen, own: Sequence[Shot], bundle: Bundle, sigma: Float, bound: float) -> set[str]:
    """Cameras to separate: the one without which the others agree, or else all."""
    if len(own) < 3:
        return {shot.camera for shot in own}
    without = [[shot for shot in own if shot != rejected] for rejected in own]
    errors = [float(_view_errors(seen, [rest], bundle, sigma)[0]) for rest in without]
    best = int(np.argmin(errors))
    return {own[best].camera} if errors[best] <= bound else {shot.camera for shot in own}


def _disagreement(own: Sequence[Shot], parted: set[str], times: float) -> str:
    names = [shot.camera for shot in own]
    who = " and ".join(names) if len(parted) == len(own) else "this camera and the others"
    return (
        f"{who} disagree on where the board is, {times:.1f} times the usual error: it moved between the exposures,"
        " or these are images of two different times; used for the lens only"
    )


# Dealt into five folds they leave six to fit: fewer cannot distinguish a bent board from a bent lens.
MIN_SHAPE_VIEWS = 8


@dataclass(frozen=True, slots=True)
class BoardChoice:
    """Which board was taken, and why."""

    bent: bool  # the board's own shape was estimated; False: the board is as drawn
    # this and bent_px: error at the corners of held-out views (rms over a view's corners, geometric mean over
    # the views) with either board; NaN: not compared
    flat_px: float = float("nan")
    bent_px: float = float("nan")
    views: int = 0  # number of views that were held out, each once
    reason: str = ""  # why nothing was compared; empty: it was


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """One of the fits that are compared."""

    bundle: Bundle  # its optimum over all views, where the fits to fewer views begin
    free: Free
    sigma_px: float  # standard deviation of a corner [px] in it


def choose(seen: Seen, shots: Sequence[Shot], flat: Model, bent: Model) -> BoardChoice:
    """Choose the board that predicts held-out corners better; flat where not certain.

    `shots` are the images that both fits accept.
    """
    errors: list[Float] = []
    for training, held_out in _folds(shots):
        if camera := _lacking(seen, training, flat.free):
            return BoardChoice(bent=False, reason=f"camera {camera!r} has too few views to hold some out")
        errors.append(np.stack([_errors(seen, training, held_out, model) for model in (flat, bent)]))
    flat_px, bent_px = np.concatenate(errors, axis=1) if errors else np.empty((2, 0))
    scored = np.isfinite(flat_px) & np.isfinite(bent_px)
    views = int(scored.sum())
    if views < MIN_SHAPE_VIEWS:
        return BoardChoice(
            bent=False, reason=f"{views} views are too few to compare, at least {MIN_SHAPE_VIEWS} are needed"
        )
    flat_log, bent_log = np.log(flat_px[scored]), np.log(bent_px[scored])
    gain = flat_log - bent_log
    chance = 0.01  # that a flat board is taken for a bent one
    bound = float(stdtrit(views - 1, 1.0 - chance)) * float(gain.std(ddof=1)) / np.sqrt(views)
    return BoardChoice(
        bent=bool(gain.mean() > bound),
        flat_px=float(np.exp(flat_log.mean())),
        bent_px=float(np.exp(bent_log.mean())),
        views=views,
    )


def _folds(shots: Sequence[Shot]) -> Iterator[tuple[list[Shot], list[Shot]]]:
    """Yield images to fit and to hold out; equal sets of cameras are dealt evenly."""
    cameras: dict[str, tuple[str, ...]] = {}
    for shot in shots:
        cameras[shot.place] = (*cameras.get(shot.place, ()), shot.camera)
    places = sorted(cameras, key=lambda place: cameras[place])  # stable: in the order of the views
    folds = 5  # Hastie et al., section 7.10: five or ten
    fold = {place: i % folds for i, place in enumerate(places)}
    for k in range(min(folds, len(places))):
        yield [s for s in shots if fold[s.place] != k], [s for s in shots if fold[s.place] == k]


def _lacking(seen: Seen, training: Sequence[Shot], free: Free) -> str:
    """The first camera that the images do not determine; empty: none."""
    places = [shot.place for shot in training]
    for c, camera in enumerate(seen.views.cameras):
        own = [shot for shot in training if shot.camera == camera]
        shared = sum(places.count(shot.place) > 1 for shot in own)
        min_images = 3  # of each camera in every fit: three views determine a lens
        if (free.lenses[c].any() and len(own) < min_images) or (free.cameras[c] and shared < min_images):
            return camera
    return ""


def _errors(seen: Seen, training: Sequence[Shot], held_out: Sequence[Shot], model: Model) -> Float:
    """Rms corner distance (V,) [px] of held-out views; NaN: too few corners."""
    observations = seen.observations(training)
    start = place_boards(observations, model.bundle)
    fitted = solve(observations, start, model.free, sigma_px=model.sigma_px).bundle
    found = seen.observations(held_out)
    squares = np.zeros(1 + max(o.view for o in found))
    count = np.zeros_like(squares)
    for odd in (False, True):
        for view, square in _predicted(found, fitted, _every_second(seen.views.board), odd=odd):
            squares[view] += square.sum()
            count[view] += len(square)
    with np.errstate(invalid="ignore"):
        return np.sqrt(squares / count)


def _predicted(
    observations: Sequence[Observation], fitted: Bundle, is_odd: Bool, *, odd: bool
) -> Iterator[tuple[int, Float]]:
    """Views and squared distances (n,) of the corners that did not place the boards.

    The odd corners place the boards, or the even ones.
    """
    halves: dict[int, list[Observation]] = {}
    for o in observations:
        half = _only(o, is_odd[o.corners] == odd)
        if len(half.corners) >= 4:  # corners that place a board
            halves.setdefault(o.view, []).append(half)
    if not halves:
        return
    number = {view: i for i, view in enumerate(sorted(halves))}
    placing = [replace(half, view=number[view]) for view, own in halves.items() for half in own]
    placed = solve(placing, place_boards(placing, fitted), Free.only_boards(fitted)).bundle
    for o in observations:
        rest = _only(o, is_odd[o.corners] != odd)
        if o.view in number and len(rest.corners):
            off = rest.uv - predict(placed, replace(rest, view=number[o.view]))
            yield o.view, (off**2).sum(axis=1)


def _only(seen: Observation, which: Bool) -> Observation:
    speed = None if seen.speed is None else seen.speed[which]
    return replace(seen, corners=seen.corners[which], uv=seen.uv[which], speed=speed)


def _every_second(board: Board) -> Bool:
    """Mask (N,) of every second corner, so that either half spans the board."""
    row, column = np.indices(grid_shape(board))
    return np.asarray((row + column) % 2 == 1, dtype=np.bool_).ravel()
