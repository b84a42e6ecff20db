"""Cameras that take frames at their own times see a moving board: corners are carried to common instants.

A view is an instant at which the slowest camera took a frame. The corners of the others are interpolated between
their own frames, by the parabola through three where there are three. What remains unknown is by how much a
camera's times lag its exposures (buffers of a driver hold a frame or more): that is an unknown of the bundle, which
the corners' speeds determine (`bundle.Bundle.delay_s`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Float, Image
from common.errors import FitError, PictureError
from master.calibrate.cameras.boards import Board, ImageObservation
from master.calibrate.cameras.views import MOST_VIEWS, BoardViews, Finder, View, moved_px


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The frames of one camera, read one after the other."""

    numbers: tuple[int, ...]  # how they are called in reports
    t_s: Float  # (T,) rising
    read: Callable[[int], Image]  # number -> frame; PictureError: it cannot be decoded
    source: str  # file or folder, for messages


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The board in frames of one camera."""

    numbers: tuple[int, ...]
    t_s: Float  # (T,) rising
    found: tuple[ImageObservation | None, ...]

    def at(self, t_s: float) -> ImageObservation | None:
        """The board at an instant by this camera's clock; None: not seen about then."""
        k = int(np.abs(self.t_s - t_s).argmin())
        here, away_s = self.found[k], t_s - float(self.t_s[k])
        slopes: list[tuple[float, Float]] = []
        for j in (k - 1, k + 1):
            beside = self.found[j] if 0 <= j < len(self.found) else None
            gap_s = float(self.t_s[j] - self.t_s[k]) if beside is not None else np.inf
            if here is not None and beside is not None and abs(gap_s) < _LONGEST_GAP_S:
                slopes.append((gap_s, (beside.corners_px - here.corners_px) / gap_s))
        if here is None:
            return None
        if not slopes and away_s == 0.0:  # alone, but its own
            return here
        if not any(abs(away_s) <= 0.51 * abs(gap) and away_s * gap >= 0.0 for gap, _ in slopes):
            return None
        uv, (gap_s, speed) = here.corners_px, slopes[-1]
        bend: Float = np.zeros_like(uv)  # half the acceleration
        if len(slopes) == 2:
            bend = (speed - slopes[0][1]) / (gap_s - slopes[0][0])
            speed = speed - bend * gap_s
            one = np.isnan(speed)  # corners seen in one of the neighbours alone
            bend = np.where(one, 0.0, bend)
            speed = np.where(one, np.where(np.isnan(slopes[0][1]), slopes[1][1], slopes[0][1]), speed)
        carried = uv + (speed + bend * away_s) * away_s
        if np.isfinite(carried[:, 0]).sum() < 8:
            return None
        return ImageObservation(carried, here.blur_px, speed + 2.0 * bend * away_s)


_LONGEST_GAP_S = 0.35  # between frames: a hand moves a board to and fro in a second or two


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """What all cameras saw of one board, each at its own times."""

    board: Board
    sizes_px: Mapping[str, tuple[int, int]]
    tracks: Mapping[str, Track]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(self.sizes_px)

    def views(self, delay_s: Mapping[str, float]) -> BoardViews:
        """Views of instants spread over all places where the board was, the stillest of each.

        `delay_s`: by how much each camera's times lag its exposures.
        """
        slowest = max(self.tracks, key=lambda name: float(np.median(np.diff(self.tracks[name].t_s))))
        reference = self.tracks[slowest]
        views: list[tuple[float, View]] = []
        for number, t_s in zip(reference.numbers, reference.t_s - delay_s[slowest], strict=True):
            seen = {name: track.at(float(t_s) + delay_s[name]) for name, track in self.tracks.items()}
            observations = {name: found for name, found in seen.items() if found is not None}
            if observations:
                speeds = [s.speed_px_s for s in observations.values() if s.speed_px_s is not None]
                fastest = max(
                    (float(np.nanmedian(np.linalg.norm(s, axis=1))) for s in speeds), default=np.inf
                )
                views.append((fastest, View(str(number), observations)))
        chosen: list[View] = []
        for _, view in sorted(views, key=lambda pair: pair[0]):
            if len(chosen) < MOST_VIEWS and is_new(view.observations, chosen, self.sizes_px, _NEW):
                chosen.append(view)
        return BoardViews(self.board, self.sizes_px, tuple(sorted(chosen, key=lambda v: int(v.name))))


_NEW = 0.01  # of the image's width: how far corners must be from where another view has them


def is_new(
    seen: Mapping[str, ImageObservation],
    views: list[View],
    sizes_px: Mapping[str, tuple[int, int]],
    share: float,
) -> bool:
    """Whether some camera sees the board as in no view, or this set of cameras is new.

    `share` of the image's width is how far corners must be from where a view has them.
    """
    for view in views:
        if set(seen) <= set(view.observations):
            moved = (moved_px(now, view.observations[name]) / sizes_px[name][0] for name, now in seen.items())
            if max(moved) < share:
                return False
    return True


def track(board: Board, streams: Mapping[str, Stream], progress: Callable[[str], None]) -> Tracks:
    """Find the board in frames of all cameras, of long streams in bursts spread over all.

    Raises:
        FitError: The board is in none of the frames, or no frame of a camera can be decoded.
    """
    finder, tracks, sizes = Finder(board), dict[str, Track](), dict[str, tuple[int, int]]()
    for name, stream in streams.items():
        wanted = _wanted(stream.t_s)
        found, broken = list[ImageObservation | None](), ""
        for done, i in enumerate(wanted.tolist(), 1):
            try:
                image = stream.read(stream.numbers[i])
                sizes[name] = (image.shape[1], image.shape[0])
                found.append(finder.find(image))
            except PictureError as error:
                found.append(None)
                broken = str(error)
            if done % 50 == 0 or done == len(wanted):
                seen = sum(one is not None for one in found)
                progress(f"{name}: {done} of {len(wanted)} frames, the board in {seen}")
        if name not in sizes:
            raise FitError(f"{stream.source}: {broken}")
        tracks[name] = Track(tuple(stream.numbers[i] for i in wanted), stream.t_s[wanted], tuple(found))
    if not any(one for own in tracks.values() for one in own.found):
        raise FitError(
            f"no {board} in any of {sum(len(t.found) for t in tracks.values())} frames: {finder.advice()}"
        )
    return Tracks(finder.board, sizes, tracks)


def _wanted(t_s: Float) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    """Indices of at most 600 frames: thinned to 15 a second, then in bursts of a second."""
    fastest_hz, most, burst = 15.0, 600, 15
    step = max(int(1.0 / fastest_hz / max(float(np.median(np.diff(t_s))), 1e-6) + 0.01), 1)
    thinned = np.arange(0, len(t_s), step)
    if len(thinned) <= most:
        return thinned
    begins = np.linspace(0, len(thinned) - burst, most // burst).astype(np.int64)
    return thinned[np.unique(begins[:, None] + np.arange(burst))]
