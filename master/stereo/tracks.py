"""Where the markers of every camera were at an instant, from their sightings around it.

A hand's way is known by what hands can do: about the instant it is a Taylor series whose speed, acceleration, jerk and
snap are drawn at random, with the sizes of real hands. Given up to four sightings with their noise, the best linear
estimate of the place and its variance follow (Gaussian process regression with an unknown constant: Rasmussen,
Williams 2006, 2.7; "universal kriging"):

    S_ij = V^2 tt + A^2 (tt^2 / 2!^2 + w^2 tt^3 / 3!^2 + w^4 tt^4 / 4!^2) + sigma_i^2 [i = j],    tt = t_i t_j
    x = 1' S^-1 y / c,    var = 1 / c,    c = 1' S^-1 1                     (t: times from the instant)

Without noise this is the polynomial through the sightings; a hand at rest is averaged, and a step into the future does
not blow its noise up. How hard the hand moves (A) is not known, so every degree of vigour is tried at once, from a hand
laid down to a brisk wave; each counts by the probability of what was seen, and where they disagree the variance grows.
What time itself is uncertain by adds in proportion to the marker's speed in the image.

Where a slave named two places of a colour, the marker and its *rival*, it may have taken them for each other from
one frame to the next, and a line from one thing to another is nowhere. So the sightings of such a marker are first
sorted into two tracks by nearness in the image, each with its own past. Which of the two is the marker is decided
elsewhere, with the other cameras (`master.stereo.rivals`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from common.arrays import Float

SIGHTINGS = 4  # of one marker that are used: a fifth is too long ago to tell anything
# What hands do, per axis, as measured on recorded hands (docs/sync.md): laid down, gentle, brisk.
_SPEED_M_S: Float = np.array([0.01, 1.0, 1.0])
_ACCELERATION_M_S2: Float = np.array([0.3, 1.5, 15.0])
_W_PER_S = 18.0  # jerk by acceleration, and snap by jerk
_V2, _A2 = (x.reshape(-1, 1, 1, 1, 1) ** 2 for x in (_SPEED_M_S, _ACCELERATION_M_S2))
_LEAP_M_S, _LEAP_PX = 5.0, 5.0  # what is farther away a frame later is another thing
_SWAPPED = 3.0  # times nearer to the other track: a slave's names are contradicted
# Sightings see the same cap in the same light, behind the same finger: most of an error stays from frame to frame, and
# no mean over them removes it. New in each is at most this part of the variance that the slave claims, and this much.
_FRESH, _FRESH_PX = 0.7, 0.1
# So they also tell less of the motion than as many independent ones.
_EVIDENCE = 0.5
# An error in time lies along the motion. One number for both axes cannot say so: all of it covers too much (98-99 %),
# half, which keeps the sum of the axes, too little where the motion is along the baseline (87 %); this 93-97 %.
_ALONG = 0.75
_LEAST_SIGMA_PX = 0.01
_UNSEEN_PX2 = 1e12  # variance of a sighting that is none


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One frame of one camera.

    Attributes:
        centre_ns: When its centre row was exposed.
        marks: (M, 4) of each marker u, v [px], when its row was exposed [ns since the first frame of all: float64 is
            exact to 1 ns] and the standard deviation of u and of v [px]; NaN: not seen.
        area: (M,) [px^2].
        ready_t_ns: When the frame was handed to its slave.
        rivals: As `marks`, of the second places; None where no marker has one.
        t_sigma_ns: Standard deviation of the times, the same error for all sightings of a camera.
    """

    centre_ns: int
    marks: Float
    area: Float
    ready_t_ns: int
    rivals: Float | None = None
    t_sigma_ns: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """The markers of C cameras at one instant.

    Attributes:
        uv: (C, M, 2) [px]; NaN: not seen.
        sigma_px: (C, M) per axis, time error included.
        rival_uv, rival_sigma_px: The same of the second places; None where no marker has one.
    """

    uv: Float
    sigma_px: Float
    rival_uv: Float | None
    rival_sigma_px: Float | None


def carry(views: Sequence[Sequence[Sighting]], t_ns: float, scale_px_m: Float) -> Carried:
    """The markers at `t_ns` [ns since the first frame of all]; one that the nearest sighting does not hold is not seen.

    Args:
        views: Of each camera up to SIGHTINGS, the nearest first; none: the camera sees nothing. One camera has some.
        t_ns: The instant.
        scale_px_m: (C,) pixels that a metre across the sight takes where hands are [px/m].
    """
    nothing = _nothing(len(next(view[0].marks for view in views if view)))
    places: list[Float] = []
    doubtful: list[int] = []
    for c, view in enumerate(views):
        for sighting in view:
            places.append(sighting.marks)
            if sighting.rivals is not None and (not doubtful or doubtful[-1] != c):
                doubtful.append(c)
        places += [nothing] * (SIGHTINGS - len(view))
    marks = np.concatenate(places).reshape(len(views), SIGHTINGS, *nothing.shape)
    t_sigma_s = np.array([view[0].t_sigma_ns if view else 0.0 for view in views]) * 1e-9
    rivals = [_sort(views[c], marks[c], _LEAP_M_S * float(scale_px_m[c])) for c in doubtful]
    uv, sigma = _at(marks, t_ns, scale_px_m, t_sigma_s)
    if not doubtful:
        return Carried(uv, sigma, None, None)
    rival_uv, rival_sigma = np.full_like(uv, np.nan), np.full_like(sigma, np.nan)
    rival_uv[doubtful], rival_sigma[doubtful] = _at(
        np.array(rivals), t_ns, scale_px_m[doubtful], t_sigma_s[doubtful]
    )
    return Carried(uv, sigma, rival_uv, rival_sigma)


@cache
def _nothing(markers: int) -> Float:
    """Marks (M, 4) of a frame in which nothing is seen."""
    return np.full((markers, 4), np.nan)


def _at(marks: Float, t_ns: float, scale: Float, t_sigma_s: Float) -> tuple[Float, Float]:
    """Places (C, M, 2) and sigmas (C, M) at an instant of tracks (C, N, M, 4), the nearest sighting first."""
    marks = marks.swapaxes(1, 2)  # (C, M, N, 4)
    nearest = marks[..., 0, :2]
    y, t = marks[..., :2] - nearest[..., None, :], (marks[..., 2] - t_ns) * 1e-9
    leap = _LEAP_PX + _LEAP_M_S * scale[:, None, None] * np.abs(t - t[..., :1])
    near = (y * y).sum(axis=-1) <= leap * leap  # false for NaN
    t, y = np.where(near, t, 0.0), np.where(near[..., None], y, 0.0)
    variance = np.maximum(marks[..., 3], _LEAST_SIGMA_PX) ** 2
    fresh = np.minimum(_FRESH * variance, _FRESH_PX**2)
    way, vary, speed, gain = _mix(t, y, np.where(near, fresh, _UNSEEN_PX2), scale)
    vary += (variance - fresh)[..., 0] * np.maximum(gain, 1.0)
    if t_sigma_s.any():
        vary += _ALONG * (speed * speed).sum(axis=-1) * (t_sigma_s * t_sigma_s)[:, None]
    return nearest + way, np.where(near[..., 0], np.sqrt(vary), np.nan)


def _mix(t: Float, y: Float, noise: Float, scale: Float) -> tuple[Float, Float, Float, Float]:
    """Mean (C, M, 2), variance (C, M), speed (C, M, 2) and gain (C, M) at time 0, over all degrees of vigour.

    The gain is by how much the variance of independent sightings would be multiplied.

    Args:
        t: (C, M, N) times [s].
        y: (C, M, N, 2) places [px].
        noise: (C, M, N) their variances [px^2].
        scale: (C,) [px/m].
    """
    tt = t[..., :, None] * t[..., None, :]
    w2tt = _W_PER_S**2 * tt
    square = (scale * scale)[:, None, None, None]
    going_px2 = square * tt
    turning_px2 = going_px2 * tt * (1.0 / 4.0 + w2tt * (1.0 / 36.0 + w2tt / 576.0))
    S = _V2 * going_px2 + _A2 * turning_px2  # (L, C, M, N, N)
    S.reshape(*S.shape[:-2], -1)[..., :: t.shape[-1] + 1] += noise
    known = np.empty((*t.shape, 4))
    known[..., 0], known[..., 1:3], known[..., 3] = 1.0, y, t
    # Products x' S^-1 y of all pairs of 1, u, v, t (L, C, M, 4, 4).
    solved = np.linalg.solve(S, known)
    products = known.swapaxes(-1, -2) @ solved
    c = products[..., 0, 0]
    x = products[..., 0, 1:3] / c[..., None]
    misfit = products[..., 1, 1] + products[..., 2, 2] - c * (x * x).sum(axis=-1)
    # Two axes: twice the logarithm of each determinant's root.
    evidence = -_EVIDENCE * (np.linalg.slogdet(S)[1] + np.log(c) + 0.5 * misfit)
    share = np.exp(evidence - evidence.max(axis=0))
    share /= share.sum(axis=0)
    mean = (share[..., None] * x).sum(axis=0)
    off = x - mean
    vary = (share * (1.0 / c + 0.5 * (off * off).sum(axis=-1))).sum(axis=0)
    pull = products[..., 3, 1:3] - products[..., 3, :1] * x
    speed = (share[..., None] * _V2[..., 0] * pull).sum(axis=0) * square[..., 0]
    weights = ((share / c)[..., None] * solved[..., 0]).sum(axis=0)
    return mean, vary, speed, (weights * weights).sum(axis=-1)


def _sort(view: Sequence[Sighting], marks: Float, leap_px_s: float) -> Float:
    """Give every place to the track it continues: `marks` (N, M, 4) is changed, that of the rivals returned."""
    rivals = np.full_like(marks, np.nan)
    for n, sighting in enumerate(view):
        if sighting.rivals is not None:
            rivals[n] = sighting.rivals
    for m in np.flatnonzero(np.isfinite(rivals[..., 0]).any(axis=0)):
        tracks = np.stack([marks[:, m], rivals[:, m]], axis=1)  # (N, 2, 4): sighting, which of the two
        for n in range(1, len(view)):
            if _swapped(tracks[:n], tracks[n], leap_px_s):
                tracks[n] = tracks[n, ::-1]
            for i in range(2):
                if _away(tracks[:n, i], tracks[n, i], leap_px_s) == np.inf:
                    tracks[n, i] = np.nan  # another thing: the track ends
        marks[:, m], rivals[:, m] = tracks[:, 0], tracks[:, 1]
    return rivals


def _swapped(tracks: Float, found: Float, leap_px_s: float) -> bool:
    """Whether the slave called the marker and its rival by each other's name.

    It is contradicted only where the places are so much nearer to the other track: it has a track of its own.

    Args:
        tracks: The marker's track and the rival's (n, 2, 4).
        found: The two places of the next sighting (2, 4); NaN: there is none.
        leap_px_s: What is faster is another thing [px/s].
    """
    away = [[_away(tracks[:, i], found[k], leap_px_s) for k in range(2)] for i in range(2)]
    straight = [x for x in (away[0][0], away[1][1]) if x is not None]
    crossed = [x for x in (away[0][1], away[1][0]) if x is not None]
    return bool(crossed) and _SWAPPED * sum(crossed) < sum(straight)


def _away(track: Float, place: Float, leap_px_s: float) -> float | None:
    """Distance [px] of a place (4,) from the member of a track (n, 4) nearest in time; inf: a leap; None: no two."""
    members = track[np.isfinite(track[:, 0])]
    if not len(members) or not np.isfinite(place[0]):
        return None
    nearest = members[np.argmin(np.abs(members[:, 2] - place[2]))]
    distance = float(np.hypot(*(nearest[:2] - place[:2])))
    leap_px = _LEAP_PX + leap_px_s * 1e-9 * float(abs(nearest[2] - place[2]))
    return distance if distance <= leap_px else np.inf
