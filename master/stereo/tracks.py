"""Where the markers of one camera were at an instant, from its sightings around it.

A track is carried by the polynomial through up to three neighbouring sightings (Lagrange's weights): three are a
parabola, two a line, one is held where it was. The error this leaves is added to the sigma that the slave gave.

Where a slave named two places of a colour, the marker and its *rival*, it may have taken them for each other from
one frame to the next, and a line from one thing to another is nowhere. So the sightings of such a marker are first
sorted into two tracks by nearness in the image, each with its own past. Which of the two is the marker is decided
elsewhere, with the other cameras (`master.stereo.rivals`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from common.arrays import Float

# What a hand can do that a polynomial does not know, at half a metre from a 500 px lens.
_SPEED_PX_S = 500.0
_ACCELERATION_PX_S2 = 1.0e4
_JERK_PX_S3 = 2.0e5
_LEAP_PX_S, _LEAP_PX = 5000.0, 5.0  # 5 m/s there: what is farther away a frame later is another thing
_SWAPPED = 3.0  # times nearer to the other track: a slave's names are contradicted


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One frame of one camera.

    Attributes:
        centre_ns: When its centre row was exposed.
        t_ns: (M,) when each marker's row was, since the first frame of all: float64 is exact to 1 ns.
        uv: (M, 2) [px]; NaN: not seen.
        sigma_px: (M,) standard deviation per axis.
        area: (M,) [px^2].
        ready_t_ns: When the frame was handed to its slave.
        rival_uv, rival_t_ns: As `uv` and `t_ns` of the second place, NaN where there is none; None where no marker
            has one.
    """

    centre_ns: int
    t_ns: Float
    uv: Float
    sigma_px: Float
    area: Float
    ready_t_ns: int
    rival_uv: Float | None = None
    rival_t_ns: Float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """The markers of one camera at one instant.

    Attributes:
        uv: (M, 2) [px]; NaN: not seen.
        sigma_px: (M,) time error included.
        rival_uv, rival_sigma_px: The same of the second places; None where no marker has one.
    """

    uv: Float
    sigma_px: Float
    rival_uv: Float | None
    rival_sigma_px: Float | None


def carry(near: Sequence[Sighting], t_ns: float) -> Carried:
    """The markers at `t_ns` [ns since the first frame of all], from sightings with the nearest first.

    A marker the nearest sighting does not hold is not seen.
    """
    uv, times = np.stack([s.uv for s in near]), np.stack([s.t_ns for s in near])
    sigma = np.stack([s.sigma_px for s in near])
    if all(s.rival_uv is None for s in near):
        return Carried(*_carry(uv, times, sigma, t_ns), None, None)
    rival_uv, rival_times = _sort(near, uv, times)
    rivals = _carry(rival_uv, rival_times, sigma, t_ns)
    return Carried(*_carry(uv, times, sigma, t_ns), *rivals)


def _carry(uv: Float, times: Float, sigma_px: Float, t_ns: float) -> tuple[Float, Float]:
    """Places (M, 2) and sigmas (M,) at `t_ns` of tracks (N, M, 2), (N, M), (N, M), the nearest sighting first."""
    out, sigma = np.full_like(uv[0], np.nan), np.full_like(sigma_px[0], np.nan)
    seen = np.isfinite(uv[..., 0]) & np.isfinite(uv[..., 1])
    order = np.cumprod(seen, axis=0).sum(axis=0)  # sightings in a row, from the nearest on
    for n in range(1, len(uv) + 1):
        use = order == n
        if not use.any():
            continue
        tn = times[:n, use]
        away = np.abs(t_ns - tn) * 1e-9
        weights = np.ones_like(tn)
        for i in range(n):
            for j in range(n):
                if i != j:
                    weights[i] *= (t_ns - tn[j]) / (tn[i] - tn[j])
        out[use] = sum(weights[i][:, None] * uv[i, use] for i in range(n))
        noise = sum((weights[i] * sigma_px[i, use]) ** 2 for i in range(n))
        unknown = (_SPEED_PX_S, _ACCELERATION_PX_S2 / 2, _JERK_PX_S3 / 6)[n - 1] * np.prod(away, axis=0)
        sigma[use] = np.sqrt(noise + unknown**2)
    return out, sigma


def _sort(near: Sequence[Sighting], uv: Float, times: Float) -> tuple[Float, Float]:
    """Give every place to the track it continues: `uv` and `times` are changed, those of the rivals returned."""
    rival_uv, rival_times = np.full_like(uv, np.nan), np.full_like(times, np.nan)
    for n, sighting in enumerate(near):
        if sighting.rival_uv is not None and sighting.rival_t_ns is not None:
            rival_uv[n], rival_times[n] = sighting.rival_uv, sighting.rival_t_ns
    for m in np.flatnonzero(np.isfinite(rival_uv[..., 0]).any(axis=0)):
        places = np.stack([uv[:, m], rival_uv[:, m]], axis=1)  # (N, 2, 2): sighting, which of the two, u v
        moments = np.stack([times[:, m], rival_times[:, m]], axis=1)
        for n in range(1, len(near)):
            order = [1, 0] if _swapped(places[:n], moments[:n], places[n], moments[n]) else [0, 1]
            places[n], moments[n] = places[n, order], moments[n, order]
            for i in range(2):
                if _away(places[:n, i], moments[:n, i], places[n, i], moments[n, i]) == np.inf:
                    places[n, i] = np.nan  # another thing: the track ends
        uv[:, m], rival_uv[:, m] = places[:, 0], places[:, 1]
        times[:, m], rival_times[:, m] = moments[:, 0], moments[:, 1]
    return rival_uv, rival_times


def _swapped(tracks: Float, moments: Float, found: Float, found_ns: Float) -> bool:
    """Whether the slave called the marker and its rival by each other's name.

    It is contradicted only where the places are so much nearer to the other track: it has a track of its own.

    Args:
        tracks, moments: The marker's track and the rival's (n, 2, 2) [px], (n, 2) [ns].
        found, found_ns: The two places of the next sighting (2, 2), (2,); NaN: there is none.
    """
    away = [[_away(tracks[:, i], moments[:, i], found[k], found_ns[k]) for k in range(2)] for i in range(2)]
    straight = [x for x in (away[0][0], away[1][1]) if x is not None]
    crossed = [x for x in (away[0][1], away[1][0]) if x is not None]
    return bool(crossed) and _SWAPPED * sum(crossed) < sum(straight)


def _away(track: Float, moments: Float, place: Float, place_ns: float) -> float | None:
    """Distance [px] of a place from the member of a track that is nearest in time; inf: a leap; None: no such two."""
    members = np.flatnonzero(np.isfinite(track[:, 0]))
    if not len(members) or not np.isfinite(place[0]):
        return None
    j = members[np.argmin(np.abs(moments[members] - place_ns))]
    distance = float(np.hypot(*(track[j] - place)))
    leap_px = _LEAP_PX + _LEAP_PX_S * 1e-9 * float(abs(moments[j] - place_ns))
    return distance if distance <= leap_px else np.inf
