"""Decision whether the board is flat or bent, by cross validation.

A shape of its own always lowers the residuals of the views that it is fitted to, by three numbers a corner.
So the views are dealt into folds. Lenses, camera poses and shape are fitted to all folds but one; in the
views of that one only the board may move. It is placed by one half of its corners and the other half is
scored, then the other way round. Both boards are scored on the same corners, view by view, and the simpler
one is taken unless the other is better by more than the views scatter (the rule of one standard error:
Breiman et al., Classification and Regression Trees, 1984, section 3.4; Hastie et al., The Elements of
Statistical Learning, 2009, section 7.10; here paired, and with the quantile of Student's t in place of one).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from common.arrays import Bool, Float
from master.calibrate.cameras.boards import Board, grid_shape
from master.calibrate.cameras.bundle import Bundle, Free, Observation, predict, solve
from master.calibrate.cameras.outliers import Seen, Shot, place_boards

# Dealt into five folds they leave six to fit: fewer cannot distinguish a bent board from a bent lens.
MIN_VIEWS = 8


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
    if views < MIN_VIEWS:
        return BoardChoice(
            bent=False, reason=f"{views} views are too few to compare, at least {MIN_VIEWS} are needed"
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
        for view, square in _predicted(found, fitted, _odd(seen.views.board), odd=odd):
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


def _odd(board: Board) -> Bool:
    """Mask (N,) of every second corner, so that either half spans the board."""
    row, column = np.indices(grid_shape(board))
    return np.asarray((row + column) % 2 == 1, dtype=np.bool_).ravel()
