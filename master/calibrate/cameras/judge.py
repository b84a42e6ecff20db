"""Which images and views are wrong, given lenses and places of the cameras.

An image is judged by its own camera, whatever the others saw: one that fails is not used at all. A view is judged by
whether its cameras agree on where the board is: where they do not, the board moved between the exposures or images of
two epochs were put together. Such images are good in themselves, so each still helps the lens of its own camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.transforms import invert
from master.calibrate.cameras.alone import Rejection, corners_seen
from master.calibrate.cameras.bundle import Bundle, Free, Observation, predict, rms, solve
from master.calibrate.cameras.first_guess import place_board
from master.calibrate.cameras.outliers import limit
from master.calibrate.cameras.views import BoardViews


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
    """What was seen, with the turned boards put right.

    Attributes:
        views: As found in the images.
        corner_order: View -> camera -> order of the corner numbers, as of `links.Links`.
    """

    views: BoardViews
    corner_order: Mapping[str, Mapping[str, Int]]

    def observations(self, shots: Sequence[Shot]) -> tuple[Observation, ...]:
        """Return the corners of the shots.

        Views are numbered by the shots' places, in order of appearance.
        """
        cameras = self.views.cameras
        number = {place: i for i, place in enumerate(dict.fromkeys(shot.place for shot in shots))}
        by_name = {view.name: view for view in self.views.views}
        found: list[Observation] = []
        for shot in shots:
            corners, uv = corners_seen(by_name[shot.view].observations[shot.camera])
            true = self.corner_order[shot.view][shot.camera][corners]
            found.append(Observation(cameras.index(shot.camera), number[shot.place], true, uv))
        return tuple(found)


def place_boards(observations: Sequence[Observation], bundle: Bundle) -> Bundle:
    """The bundle with each board where the middle camera of its view likes it best."""
    views: dict[int, list[Observation]] = {}
    for seen in observations:
        views.setdefault(seen.view, []).append(seen)
    places: list[Float] = []
    for _, own in sorted(views.items()):
        tried: list[tuple[float, Float]] = []
        for seen in own:
            T_camera_board, _ = place_board(bundle.drawn_m[seen.corners], seen.uv, bundle.lenses[seen.camera])
            T = invert(bundle.T_camera_rig[seen.camera]) @ T_camera_board
            alone = replace(bundle, T_rig_board=T[None])
            off = [rms([other.uv - predict(alone, replace(other, view=0))]) for other in own]
            tried.append((float(np.nan_to_num(np.median(off), nan=np.inf)), T))
        places.append(min(tried, key=lambda pair: pair[0])[1])
    return replace(bundle, T_rig_board=np.stack(places))


def judge(
    seen: Seen, shots: Sequence[Shot], bundle: Bundle
) -> tuple[tuple[Shot, ...], tuple[Rejection, ...]]:
    """The shots that are good, each at its place, and what is wrong with the others.

    Args:
        seen: What was seen.
        shots: All that may be good, every view at one place.
        bundle: Lenses, places of the cameras and shape of the board; its places of the board are not used.
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
    placed = tuple(
        replace(shot, place=f"{shot.view} {shot.camera}")
        if shot.camera in parted.get(shot.view, ())
        else shot
        for shot in good
    )
    return placed, tuple(notes)


def _judge_images(
    seen: Seen, shots: Sequence[Shot], bundle: Bundle
) -> tuple[tuple[Shot, ...], tuple[Rejection, ...], Float]:
    """Return good shots, rejections, and each camera's robust standard deviation.

    Reasons are given for the rejections; the standard deviation is (C,) [px].
    """
    residuals = _settled(seen, [replace(shot, place=f"{shot.view} {shot.camera}") for shot in shots], bundle)
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
            text = (
                f"corners are off by {errors[i]:.2f} px rms, usually {typical:.2f} px (limit {bound:.2f} px)"
            )
            reasons[i] = Rejection(shots[i].view, camera, text)
            good[i] = False
    kept = tuple(shot for shot, yes in zip(shots, good, strict=True) if yes)
    return kept, tuple(reasons.values()), sigma


def _settled(seen: Seen, shots: Sequence[Shot], bundle: Bundle) -> tuple[Float, ...]:
    """Residuals (n, 2) [px] of each shot when only the boards may move."""
    observations = seen.observations(shots)
    nothing = Free(np.zeros_like(bundle.lenses, dtype=np.bool_), _none(bundle), shape=False)
    return solve(observations, place_boards(observations, bundle), nothing).residuals


def _none(bundle: Bundle) -> Bool:
    return np.zeros(len(bundle.lenses), dtype=np.bool_)


def _view_errors(seen: Seen, views: Sequence[Sequence[Shot]], bundle: Bundle, sigma: Float) -> Float:
    """Return the rms residual of each view.

    Shape (V,) [px], as if all cameras were as good as the middle one.
    """
    shots = [shot for own in views for shot in own]
    residuals = iter(_settled(seen, shots, bundle))
    cameras = seen.views.cameras
    return float(np.median(sigma)) * np.array(
        [rms([next(residuals) / sigma[cameras.index(shot.camera)] for shot in own]) for own in views]
    )


def _to_part(seen: Seen, own: Sequence[Shot], bundle: Bundle, sigma: Float, bound: float) -> set[str]:
    """Return the cameras to separate from a view.

    The one without which the others agree, or else all.
    """
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
