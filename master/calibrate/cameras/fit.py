"""A fit finds all cameras that saw a board in one bundle.

every camera alone -> links between them -> robust bundle <-> judge images and views -> plain least squares,
with the board as drawn and with a shape of its own -> the one that predicts held-out views better
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import cast

import numpy as np

from common.arrays import Bool, Float, Int
from common.errors import FitError
from common.geometry.lens import Fold, Lens, fold_of
from common.geometry.transforms import fit_rigid, invert, transform
from master.calibrate.cameras.boards import Board, board_corners, orderings
from master.calibrate.cameras.bundle import (
    Bundle,
    Free,
    Observation,
    Solution,
    lateness,
    predict,
    project,
    rms,
    solve,
)
from master.calibrate.cameras.outliers import (
    MIN_SHAPE_VIEWS,
    MIN_VIEWS,
    Alone,
    BoardChoice,
    Model,
    Rejection,
    Seen,
    Shot,
    centre_of,
    choose,
    corners_seen,
    fit_alone,
    judge,
    place_boards,
)
from master.calibrate.cameras.tracks import Tracks
from master.calibrate.cameras.views import BoardViews

Places = Mapping[str, Mapping[str, Float]]
"""Camera -> view -> T_camera_board (4, 4) [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """First estimate of a rig."""

    T_camera_rig: Mapping[str, Float]  # camera -> (4, 4) [m]; the rig's frame is that of the first camera
    # view -> camera -> order (N,): what the camera calls corner i is corner order[i] of the view
    corner_order: Mapping[str, Mapping[str, Int]]


def link(board: Board, cameras: Sequence[str], places: Places) -> Links:
    """Chain the cameras by the pairs that share most views.

    Raises:
        FitError: The cameras fall into groups that share no view; the text names them.
    """
    drawn = board_corners(board)
    # Corner i of a turned board is corner order[i] of the upright one.
    turns = [(order, fit_rigid(drawn, drawn[order])) for order in orderings(board)]
    known: dict[str, Float] = {cameras[0]: np.eye(4)}
    while len(known) < len(cameras):
        shared = {
            (a, b): sorted(places[a].keys() & places[b].keys())
            for a in known
            for b in cameras
            if b not in known
        }
        a, b = max(shared, key=lambda pair: len(shared[pair]))
        if not shared[a, b]:
            raise FitError(_islands(cameras, places))
        known[b] = _relative(drawn, turns, places[b], places[a], shared[a, b]) @ known[a]
    return Links(known, _corner_orders(drawn, turns, known, places))


def _relative(
    drawn: Float,
    turns: list[tuple[Int, Float]],
    to: Mapping[str, Float],
    of: Mapping[str, Float],
    views: list[str],
) -> Float:
    """T_to_of (4, 4) [m]: the view's estimate with the least median distance."""
    candidates = [
        np.stack([to[view] @ rotation @ invert(of[view]) for _, rotation in turns]) for view in views
    ]
    points = [transform(of[view], drawn) for view in views]

    def distance(T: Float) -> float:
        """Median over views [m] of the board's distance, in the ordering that suits."""
        off = [
            min(float(np.linalg.norm(transform(T, p) - transform(other, p), axis=1).mean()) for other in own)
            for own, p in zip(candidates, points, strict=True)
        ]
        return float(np.median(off))

    return min((T for own in candidates for T in own), key=distance)


def _corner_orders(
    drawn: Float, turns: list[tuple[Int, Float]], known: Mapping[str, Float], places: Places
) -> dict[str, dict[str, Int]]:
    """Order of each camera's corners that agrees best with the view's first camera."""
    corner_order: dict[str, dict[str, Int]] = {}
    for view in sorted(set[str]().union(*places.values())):
        first: Float | None = None
        corner_order[view] = {}
        for camera in known:
            if view not in places[camera]:
                continue
            in_rig = [invert(known[camera]) @ places[camera][view] @ rotation for _, rotation in turns]
            best = 0
            if first is None:
                first = in_rig[0]
            else:
                there = transform(first, drawn)
                best = int(np.argmin([np.linalg.norm(transform(T, drawn) - there) for T in in_rig]))
            corner_order[view][camera] = turns[best][0]
    return corner_order


def _islands(cameras: Sequence[str], places: Places) -> str:
    groups: list[list[str]] = []
    for camera in cameras:
        touching = [g for g in groups if any(places[camera].keys() & places[other].keys() for other in g)]
        joined = [*(name for g in touching for name in g), camera]
        groups = [*(g for g in groups if g not in touching), joined]
    named = " and ".join("{" + ", ".join(group) + "}" for group in groups)
    return f"the cameras {named} share no view of the board: show it to both groups at once"


_ROUNDS = 6
_TANGENTIAL = (6, 7)
_RADIAL = ((5,), (4,))
_TERMS = ((8,), _TANGENTIAL, *_RADIAL)  # k3, p1 and p2, k2, k1: in this order they are given up


@dataclass(frozen=True, slots=True, eq=False)
class CamerasFit:
    """The result."""

    views: BoardViews
    shots: tuple[Shot, ...]  # the accepted images
    observations: tuple[Observation, ...]  # their corners, in the order of `shots`
    solution: Solution  # plain least squares over them; the rig's frame is that of the first camera
    free: Free  # what was estimated
    rejected: tuple[Rejection, ...]  # images that are not used, and views whose cameras do not agree
    board: BoardChoice  # whether the board's shape was estimated, and why
    # camera -> by how much its times lag its exposures [s], against the first camera; empty: frames have no times
    delay_s: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def rms_px(self) -> float:
        """Reprojection rms over all accepted images."""
        return rms(self.solution.residuals)

    def of(self, camera: str) -> tuple[int, ...]:
        """Indices of the accepted images of a camera."""
        return tuple(i for i, shot in enumerate(self.shots) if shot.camera == camera)

    def shared(self) -> tuple[int, ...]:
        """Indices of accepted images whose board pose another camera shares."""
        places = [shot.place for shot in self.shots]
        return tuple(i for i, place in enumerate(places) if places.count(place) > 1)


def fit_cameras(
    views: BoardViews,
    held: Mapping[str, Float] | None = None,
    *,
    bent: bool | None = None,
    near: Mapping[str, Float] | None = None,
    late_sd_s: float = 0.0,
) -> CamerasFit:
    """Lenses and poses of all cameras of `views`.

    Args:
        held: Camera -> known lens (9,), in the order of `bundle.LENS`; those of the others are estimated.
        bent: Estimate the board's shape too; False: it is exactly as drawn (a print on glass, a screen);
            None: the one that predicts held-out views better, flat where that is not certain or it was moving.
        near: Camera -> lens (9,) of an earlier fit, to begin with.
        late_sd_s: Standard deviation of single frames' times [s], to begin with; 0: they are exact.

    Raises:
        FitError: The views do not determine what is asked for; the message states what is missing.
    """
    held = held or {}
    near = near or {}
    alone = {camera: fit_alone(views, camera, held.get(camera), near.get(camera)) for camera in views.cameras}
    links = link(views.board, views.cameras, {camera: fit.T_camera_board for camera, fit in alone.items()})
    known = (seen.speed_px_s for view in views.views for seen in view.observations.values())
    speeds = [np.nanmedian(np.linalg.norm(speed, axis=1)) for speed in known if speed is not None]
    if late_sd_s > 0.0 or not speeds:  # until its lag is known, a waved board is off as if cameras moved
        _refuse_moved(views, alone, links)
    seen = Seen(views, links.corner_order)
    drawn = board_corners(views.board)
    start = Bundle(
        lenses=np.stack([alone[camera].lens for camera in views.cameras]),
        centre_px=np.array([centre_of(views.sizes_px[camera]) for camera in views.cameras]),
        T_camera_rig=np.stack([links.T_camera_rig[camera] for camera in views.cameras]),
        T_rig_board=np.zeros((0, 4, 4)),
        drawn_m=drawn,
        shape_m=np.zeros_like(drawn),
        delay_s=np.zeros(len(views.cameras)),
        late_sd_s=late_sd_s,
    )
    if bent is not None:
        return _fit(seen, alone, start, held, BoardChoice(bent, reason="as asked for"))
    if speeds and float(np.median(speeds)) > 10.0:  # px/s
        reason = "it was moving, and cameras that expose row by row bend its image (--bent-board estimates its shape)"
        return _fit(seen, alone, start, held, BoardChoice(bent=False, reason=reason))
    flat = _fit(seen, alone, start, held, BoardChoice(bent=False))
    count = len({shot.place for shot in flat.shots})
    if count < MIN_SHAPE_VIEWS:
        reason = f"{count} views are too few to determine its shape, at least {MIN_SHAPE_VIEWS} are needed"
        return replace(flat, board=BoardChoice(bent=False, reason=reason))
    try:
        shaped = _fit(seen, alone, start, held, BoardChoice(bent=True))
    except FitError as error:
        return replace(flat, board=BoardChoice(bent=False, reason=f"with a shape of its own {error}"))
    both = [shot for shot in flat.shots if shot in shaped.shots]
    choice = choose(seen, both, _model(flat), _model(shaped))
    return replace(shaped if choice.bent else flat, board=choice)


def fit_tracks(
    tracks: Tracks, held: Mapping[str, Float] | None = None, *, bent: bool | None = None
) -> CamerasFit:
    """`fit_cameras` of cameras with times of their own, and the lag of these.

    Corners are carried to common instants anew until the lags change no more.

    Raises:
        FitError: As `fit_cameras`.
    """
    delay_s, near = dict.fromkeys(tracks.cameras, 0.0), dict[str, Float]()
    rounds, settled_s = 8, 1e-3
    late_sd_s = 0.0  # of single frames, once the lags are found
    while True:
        views, final = tracks.views(delay_s), late_sd_s > 0.0
        fit = fit_cameras(views, held, bent=bent if final else False, near=near, late_sd_s=late_sd_s)
        bundle = fit.solution.bundle
        near = dict(zip(views.cameras, bundle.lenses, strict=True))
        steps = dict(zip(views.cameras, bundle.delay_s.tolist(), strict=True))
        delay_s = {name: delay_s[name] + step for name, step in steps.items()}
        if final:
            return replace(fit, delay_s=delay_s)
        rounds -= 1
        if not rounds or float(np.abs(bundle.delay_s).max()) < settled_s:
            late_sd_s = 0.01  # a program that asks a camera of 30 Hz gets a frame that is up to 33 ms old


def _refuse_moved(views: BoardViews, alone: Mapping[str, Alone], links: Links) -> None:
    """Refuse views before and after a camera was moved.

    Where one camera has the board, by itself, another should see it. It sees it off there by much the same before a
    move, and after it by another offset, farther off than the views of one time scatter.
    """
    drawn, jumps = board_corners(views.board), dict[tuple[str, str], tuple[float, str, str]]()
    for a, b in permutations(views.cameras, 2):
        shared = [
            v for v in views.views if v.name in alone[a].T_camera_board and v.name in alone[b].T_camera_board
        ]
        off = np.zeros((len(shared), 2))  # [px]
        T = links.T_camera_rig[b] @ invert(links.T_camera_rig[a])
        for k, view in enumerate(shared):
            order, points = links.corner_order[view.name], np.empty_like(drawn)
            points[order[a]] = transform(T @ alone[a].T_camera_board[view.name], drawn)
            corners, uv = corners_seen(view.observations[b])
            off[k] = (uv - project(points[order[b][corners]], alone[b].lens)).mean(axis=0)
            if (speed := view.observations[b].speed_px_s) is not None:  # along it frames are off by their lag
                way, usual_s = speed[corners].mean(axis=0), 0.1
                off[k] -= way * float(way @ off[k]) / (float(way @ way) + usual_s**-2)
        moving = any(view.observations[name].speed_px_s is not None for view in shared for name in (a, b))
        if (jump := _jump(off, 3.0 if moving else 1.0))[0] > 0.0:
            jumps[a, b] = jump[0], shared[jump[1] - 1].name, shared[jump[1]].name
    if not jumps:
        return
    in_jumps = {name: sum(name in pair for pair in jumps) for name in views.cameras}
    moved = " or ".join(repr(name) for name, count in in_jumps.items() if count == max(in_jumps.values()))
    size, before, after = max(jumps.values())
    raise FitError(
        f"camera {moved} moved between the views {before} and {after}: corners jump by {size:.1f} px there; take the"
        " views before or after it alone, and fasten the cameras"
    )


def _jump(off: Float, least_px: float) -> tuple[float, int]:
    """The jump [px] of offsets (V, 2), and the view after it; 0: they scatter only."""
    least, sure = 3, 6.0  # views of either place; standard deviations
    best, found = np.inf, (0.0, 0)
    for k in range(least, len(off) - least + 1):
        middles = [np.median(part, axis=0) for part in (off[:k], off[k:])]
        rest = np.linalg.norm(np.concatenate([off[:k] - middles[0], off[k:] - middles[1]]), axis=1)
        if rest.sum() < best:
            size, scatter = float(np.linalg.norm(middles[1] - middles[0])), 1.4826 * float(np.median(rest))
            best, found = float(rest.sum()), (size if size > max(sure * scatter, least_px) else 0.0, k)
    return found


def _model(fit: CamerasFit) -> Model:
    return Model(fit.solution.bundle, fit.free, fit.solution.sigma_px)


def _fit(
    seen: Seen, alone: Mapping[str, Alone], start: Bundle, held: Mapping[str, Float], board: BoardChoice
) -> CamerasFit:
    """The fit with one kind of board."""
    views, bundle = seen.views, start
    candidates = tuple(
        Shot(view.name, camera, view.name)
        for view in views.views
        for camera in views.cameras
        if view.name in alone[camera].T_camera_board
    )
    sigma = max(fit.sigma_px for fit in alone.values())
    free = _free(views, held)
    shots, notes = candidates, tuple[Rejection, ...]()
    # At first the lenses stay as each camera by itself found them: they would bend to suit a board that moved.
    stages = [replace(free, lenses=np.zeros_like(free.lenses))] + [free] * _ROUNDS
    for stage in stages:
        _check_enough(views, shots, held, board)
        bundle, sigma = _robust(seen, shots, bundle, stage, sigma, bent=board.bent)
        judged, notes = judge(seen, candidates, bundle)
        if judged == shots and stage is free:
            break
        shots = judged
    _check_enough(views, shots, held, board)
    first = tuple(no for fit in alone.values() for no in fit.rejected)
    return _final(seen, shots, bundle, replace(free, shape=board.bent), sigma, first + notes, board)


def _free(views: BoardViews, held: Mapping[str, Float]) -> Free:
    """All but what is held, the first camera's pose, and k3."""
    lenses = np.array([[camera not in held and term < 8 for term in range(9)] for camera in views.cameras])
    moving = [any(seen.speed_px_s is not None for _, seen in views.of(camera)) for camera in views.cameras]
    others = np.arange(len(views.cameras)) > 0
    return Free(lenses, others, shape=False, delays=others & np.array(moving))


def _robust(
    seen: Seen, shots: Sequence[Shot], bundle: Bundle, free: Free, sigma: float, *, bent: bool
) -> tuple[Bundle, float]:
    """Fit with Cauchy's loss at three robust deviations, first flat, then shaped."""
    observations = seen.observations(shots)
    bundle = place_boards(observations, bundle)
    for shape in (False, True) if bent else (False,):
        robust = solve(observations, bundle, replace(free, shape=shape), 3 * sigma, sigma).bundle
        bundle = lateness(observations, robust)
        distances = [np.linalg.norm(o.uv - predict(bundle, o), axis=1) for o in observations]
        sigma = max(float(np.median(np.concatenate(distances))) / 1.1774, 1e-3)
    return bundle, sigma


def _final(
    seen: Seen,
    shots: tuple[Shot, ...],
    start: Bundle,
    free: Free,
    sigma: float,
    rejected: tuple[Rejection, ...],
    board: BoardChoice,
) -> CamerasFit:
    observations = seen.observations(shots)
    start = place_boards(observations, start)
    estimated: Bool = np.any(free.lenses, axis=1, keepdims=True)
    lenses: Bool = np.repeat(estimated, 9, axis=1)
    while True:
        # From the start anew each time: what a term that is not determined did to the others must not stay.
        bare = np.where(np.arange(9) < 4, start.lenses, 0.0)  # without distortion
        begin = replace(start, lenses=np.where(lenses | ~estimated, start.lenses, bare))
        solution = solve(observations, begin, replace(free, lenses=lenses), None, sigma)
        fewer = _determined(solution, lenses)
        if np.array_equal(fewer, lenses):
            break
        lenses = fewer
    return CamerasFit(
        seen.views, shots, observations, solution, replace(free, lenses=lenses), rejected, board
    )


def _determined(solution: Solution, lenses: Bool) -> Bool:
    """The free terms (C, 9) without the next insignificant one of each camera."""
    kept = lenses.copy()
    for camera, lens in enumerate(solution.bundle.lenses):
        higher = [term for term in (8, 5) if kept[camera, term]]
        if higher and _fold(lens, solution.bundle.centre_px[camera]) is not None:
            kept[camera, higher[0]] = False  # what folds the lens inside the image is not known there
            continue
        for term in _TERMS:
            index = list(term)
            if not kept[camera, index].any():
                continue
            at = 9 * camera + np.array(index)
            covariance = solution.covariance[np.ix_(at, at)]
            square = float(lens[index] @ cast(Float, np.linalg.solve(covariance, lens[index])))
            sure = 3.0  # standard deviations that a term of the distortion must be away from zero
            known = 0.1  # of k1, k2: corners that cover little leave them with their prior, as unsure as that
            if square < len(index) * sure**2 and (term not in _RADIAL or covariance[0, 0] < known**2):
                kept[camera, index] = False
                break
            if term != _TANGENTIAL and not kept[camera, _TANGENTIAL[0]]:
                break  # a radial term that is needed needs those before it
    return kept


def _fold(values: Float, centre_px: Float) -> Fold | None:
    """Where a lens (9,) turns back inside the image, whose middle is at `centre_px`."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values.tolist()
    width, height = np.rint(2.0 * centre_px + 1.0).astype(int).tolist()
    return fold_of(Lens((width, height), (fx, fy), (cx, cy), (k1, k2, p1, p2, k3)))


def _check_enough(
    views: BoardViews, shots: Sequence[Shot], held: Mapping[str, Float], board: BoardChoice
) -> None:
    """Refuse too few images, shared views, or views for the board's shape."""
    places = [shot.place for shot in shots]
    if board.bent and len(set(places)) < MIN_SHAPE_VIEWS:
        raise FitError(
            f"{len(set(places))} good views are too few for the board's own shape, at least {MIN_SHAPE_VIEWS} are"
            " needed: take more, or take the board as flat (--flat-board)"
        )
    for camera in views.cameras:
        own = [shot for shot in shots if shot.camera == camera]
        if camera not in held and len(own) < max(MIN_VIEWS, len(views.of(camera)) / 2):
            raise FitError(
                f"camera {camera!r}: only {len(own)} of {len(views.of(camera))} images agree with each other"
            )
        shared = sum(places.count(shot.place) > 1 for shot in own)
        # views that a camera must share with the others: one can be wrong, two cannot outvote it
        min_shared = 3
        if len(views.cameras) > 1 and shared < min_shared:
            raise FitError(
                f"camera {camera!r} shares {shared} good views of the board with the other cameras, at least"
                f" {min_shared} are needed (better 15)"
            )
