"""Frames of all cameras are brought to one epoch.

An epoch is the centre row of a frame of the leading camera: the first of the rig that is not silent (others
delivered a dozen frames since its last), nor slow (it delivers less than half of its frames, by what others
deliver), nor behind (its last frame was a dozen periods older than the newest when it came). It is *complete*
when every other camera has delivered a frame at or after it; `predict` waits only for those whose next frame
is nearer to the epoch than their last, and carries the others forward, half a period at most. It is emitted
when it is complete, or when the message time has passed its deadline. Message time is the newest capture time
seen: no clock is read, so a replay synchronises exactly as the live run did. An epoch that still waited when
all fell silent is *stale* and dropped.

Each marker has its own capture time, t_row0 + row_time v, and is carried from there to the epoch; a sideways
error Dt v would turn into a depth error D v Dt / B, the largest of an unsynchronised rig. A hand's way is a
Taylor series whose speed, acceleration, jerk and snap are random, with the sizes of real hands. Given up to
four frames, the best linear estimate of the place and its variance follow (Gaussian process regression with
an unknown constant: Rasmussen, Williams 2006, 2.7; "universal kriging"):

    S_ij = V^2 tt + A^2 (tt^2 / 2!^2 + w^2 tt^3 / 3!^2 + w^4 tt^4 / 4!^2) + sigma_i^2 [i = j],    tt = t_i t_j
    x = 1' S^-1 y / c,    var = 1 / c,    c = 1' S^-1 1                     (t: times from the epoch)

A is not known, so every degree of vigour is tried; each counts by its marginal likelihood, and where they
disagree the variance grows. An error of the time adds in proportion to the marker's speed in the image. Of a
marker and its *alternative*, which may be swapped from one frame to the next, the places are first sorted
into two tracks by nearness; which is the marker is decided with the other cameras
(`master.fabrik.intersection`).
"""

from collections import deque
from dataclasses import dataclass
from math import exp, hypot, inf, isfinite, isnan, log, nan, sqrt
from typing import Literal, NamedTuple

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.camera_model import CameraModel
from common.kernels import inner, kernel
from common.messages import MarkerDetections
from master.fabrik.settings import NEVER_NS, SYNC

Reach = tuple[int, int, int, int]


class TrackHistory(NamedTuple):
    """The last frames of C cameras; frame k is in slot k modulo HISTORY.

    `times_ns` (C, HISTORY, 3): when the centre row and row 0 were exposed, when the frame was handed to its
    slave. `marks` (C, HISTORY, 6, M): u, v, u and v of the alternative, sigma [px], area [px^2]; NaN: not
    seen.
    """

    total: Int  # (C,) frames of each camera so far
    times_ns: Int
    t_sigma_ns: Float  # (C, HISTORY) of the times, one error for all frames of a camera
    marks: Float
    row_time_ns: Float  # (C,) from one row to the next
    scale_px_m: Float  # (C,) pixels of a metre across the line of sight where hands are


@kernel
def propagate(
    history: TrackHistory, t_ns: int, reach_ns: Reach, uv: Float, sigma: Float, area: Float, missing: Bool
) -> tuple[int, bool]:
    """Write the markers and their alternatives in C cameras at an epoch.

    What the nearest frame does not show is not seen.

    Args:
        reach_ns: How far away each of the frames that are used may be, the nearest first; negative: not used.
        uv, sigma: (2, C, M, 2), (2, C, M) [px], markers and alternatives, time error included; NaN: not seen.
        area, missing: (C, M) [px^2] of the nearest frame; (C,) the camera has no frame there.

    Returns:
        When the last frame that was used was handed to its slave [ns] (none: the epoch), and whether there are
        alternatives.
    """
    used, track = np.empty(SYNC.observations, np.int64), np.empty((SYNC.observations, 2, 4))
    most = SYNC.observations
    known, L, z = np.empty((most, 5)), np.empty((most, most)), np.empty((most, 4))
    fit, mixed = np.empty(6 + most), np.empty(6 + most)
    ready_ns, alternatives = NEVER_NS, False
    for c in range(len(history.total)):
        n = _around(history, c, t_ns, reach_ns, used)
        missing[c] = n == 0
        for k in range(n):
            ready_ns = max(ready_ns, history.times_ns[c, used[k], 2])
        scale, t_sigma_s = history.scale_px_m[c], 1e-9 * history.t_sigma_ns[c, used[0]] if n > 0 else 0.0
        for m in range(area.shape[1]):
            area[c, m] = history.marks[c, used[0], 5, m] if n > 0 else nan
            alternative = _read(history, c, m, t_ns, used, n, track)
            alternatives |= alternative
            if alternative:
                _sort(track, n, SYNC.leap_m_s * scale)
            for i in range(2):
                uv[i, c, m, 0] = uv[i, c, m, 1] = sigma[i, c, m] = nan
                count = _select(track, n, i, scale, known) if alternative or i == 0 else 0
                if count > 0:
                    gain = _mix(known, count, scale, L, z, fit, mixed)
                    uv[i, c, m, 0], uv[i, c, m, 1] = track[0, i, 0] + mixed[1], track[0, i, 1] + mixed[2]
                    # Where independent noise would be amplified, so is that which is not new in each frame.
                    vary = mixed[3] + (_variance(track[0, i, 3]) - known[0, 4]) * max(gain, 1.0)
                    moved = t_sigma_s * t_sigma_s * (mixed[4] * mixed[4] + mixed[5] * mixed[5])
                    sigma[i, c, m] = sqrt(vary + SYNC.along * moved)
    return t_ns if ready_ns == NEVER_NS else ready_ns, alternatives


@inner
def _around(history: TrackHistory, c: int, t_ns: int, reach_ns: Reach, used: Int) -> int:
    """Write the slots of frames around an epoch, nearest first; return how many.

    None where even the nearest is too far: a track carried over two frames into the unknown is off by
    decimetres in depth. Of the frames after the epoch the first alone counts (two where there is none
    before), as if the others had not yet come: what comes out does not depend on how far a camera's messages
    ran ahead of another's.
    """
    newest, oldest = history.total[c], max(history.total[c] - SYNC.history, 0)
    after = newest
    while after > oldest and history.times_ns[c, (after - 1) % SYNC.history, 0] >= t_ns:
        after -= 1
    before, end, n = after - 1, min(after + (1 if after > oldest else 2), newest), 0
    while n < SYNC.observations and (before >= oldest or after < end):
        far_ns = -2 * NEVER_NS
        back_ns = t_ns - history.times_ns[c, before % SYNC.history, 0] if before >= oldest else far_ns
        ahead_ns = history.times_ns[c, after % SYNC.history, 0] - t_ns if after < end else far_ns
        if min(back_ns, ahead_ns) > reach_ns[n]:
            break
        if back_ns <= ahead_ns:
            used[n] = before % SYNC.history
            before -= 1
        else:
            used[n] = after % SYNC.history
            after += 1
        n += 1
    return n


@inner
def _read(history: TrackHistory, c: int, m: int, t_ns: int, used: Int, n: int, track: Float) -> bool:
    """Write the tracks of a marker and its alternative; return whether it has one.

    `track` (OBSERVATIONS, 2, 4): u, v [px], time of the row from the epoch [s], sigma [px].
    """
    alternative = False
    for k in range(n):
        slot = used[k]
        for i in range(2):
            v = history.marks[c, slot, 2 * i + 1, m]
            track[k, i, 0], track[k, i, 1] = history.marks[c, slot, 2 * i, m], v
            track[k, i, 2] = 1e-9 * (history.times_ns[c, slot, 1] - t_ns + history.row_time_ns[c] * v)
            track[k, i, 3] = history.marks[c, slot, 4, m]
        alternative |= isfinite(track[k, 1, 0])
    return alternative


@inner
def _sort(track: Float, n: int, leap_px_s: float) -> None:
    """Give every place to the track that it continues; leaps are cut.

    The slave's names are contradicted only by places much nearer to the other track, which must exist.
    """
    for k in range(1, n):
        straight = crossed = 0.0
        other = False
        for i in range(2):
            there, across = _distance(track, k, i, i, leap_px_s), _distance(track, k, i, 1 - i, leap_px_s)
            straight += 0.0 if isnan(there) else there
            crossed += 0.0 if isnan(across) else across
            other |= not isnan(across)
        if other and SYNC.swapped * crossed < straight:
            for j in range(4):
                track[k, 0, j], track[k, 1, j] = track[k, 1, j], track[k, 0, j]
        for i in range(2):
            if _distance(track, k, i, i, leap_px_s) == inf:
                track[k, i, 0] = track[k, i, 1] = nan


@inner
def _distance(track: Float, k: int, i: int, which: int, leap_px_s: float) -> float:
    """Distance [px] of place `which` of frame k from the place before in track i.

    Infinite: that is a leap; NaN: there are no two places.
    """
    nearest, gap_s = -1, inf
    for j in range(k):
        if isfinite(track[j, i, 0]) and abs(track[j, i, 2] - track[k, which, 2]) < gap_s:
            nearest, gap_s = j, abs(track[j, i, 2] - track[k, which, 2])
    if nearest < 0:  # also where the place itself is NaN
        return nan
    distance = hypot(track[nearest, i, 0] - track[k, which, 0], track[nearest, i, 1] - track[k, which, 1])
    return distance if distance <= SYNC.leap_px + leap_px_s * gap_s else inf


@inner
def _variance(sigma_px: float) -> float:
    return max(sigma_px, SYNC.least_px) ** 2


@inner
def _select(track: Float, n: int, i: int, scale: float, known: Float) -> int:
    """Write the places of track i that are no leap from the nearest; return how many.

    `known` (OBSERVATIONS, 5): 1, u, v [px] from the nearest, time [s], variance of its new noise [px^2].
    """
    count = 0
    for k in range(n):
        u, v = track[k, i, 0] - track[0, i, 0], track[k, i, 1] - track[0, i, 1]
        leap = SYNC.leap_px + SYNC.leap_m_s * scale * abs(track[k, i, 2] - track[0, i, 2])
        if u * u + v * v <= leap * leap:  # false for NaN
            known[count, 0], known[count, 1], known[count, 2], known[count, 3] = 1.0, u, v, track[k, i, 2]
            known[count, 4] = min(
                SYNC.independent_share * _variance(track[k, i, 3]),
                SYNC.independent_px * SYNC.independent_px,
            )
            count += 1
    return count


@inner
def _mix(known: Float, n: int, scale: float, L: Float, z: Float, fit: Float, mixed: Float) -> float:
    """Write the mean of all degrees of vigour by their evidence, as of `_fit`.

    With the spread of their places in the variance. Returns by how much independent noise is multiplied.
    """
    mixed[:] = 0.0
    best = -inf
    for k in range(len(SYNC.speed_m_s)):
        speed, acceleration = SYNC.speed_m_s[k] * scale, SYNC.acceleration_m_s2[k] * scale
        evidence = _fit(known, n, speed * speed, acceleration * acceleration, L, z, fit)
        fit[3] += 0.5 * (fit[1] * fit[1] + fit[2] * fit[2])
        keep, add = exp(min(best - evidence, 0.0)), exp(min(evidence - best, 0.0))
        best = max(best, evidence)
        for j in range(6 + n):
            mixed[j] = keep * mixed[j] + add * fit[j]
    for j in range(5 + n, -1, -1):
        mixed[j] /= mixed[0]
    mixed[3] -= 0.5 * (mixed[1] * mixed[1] + mixed[2] * mixed[2])
    gain = 0.0
    for j in range(6, 6 + n):
        gain += mixed[j] * mixed[j]
    return gain


@inner
def _fit(known: Float, n: int, speed2: float, acceleration2: float, L: Float, z: Float, fit: Float) -> float:
    """Fit one degree of vigour to n places; return its log marginal likelihood.

    `known` as of `_select`; V^2 [px^2/s^2], A^2 [px^2/s^4]; L, z: scratch, Cholesky factor of S with the
    diagonal inverted, and L^-1 (1, u, v, t); fit: written: 1, u, v, their variance, speed of u and of v,
    weights of the places.
    """
    det, c, u, v = 1.0, 0.0, 0.0, 0.0
    for i in range(n):
        for j in range(i + 1):
            tt = known[i, 3] * known[j, 3]
            w2tt = SYNC.jerk_1_s**2 * tt
            s = tt * (speed2 + acceleration2 * tt * (1.0 / 4.0 + w2tt * (1.0 / 36.0 + w2tt / 576.0)))
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                s = max(s, 0.0) + known[i, 4]  # less is rounding
                det *= s
                L[i, i] = 1.0 / sqrt(s)
            else:
                L[i, j] = s * L[j, j]
        for r in range(4):
            s = known[i, r]
            for k in range(i):
                s -= L[i, k] * z[k, r]
            z[i, r] = s * L[i, i]
        c += z[i, 0] * z[i, 0]
        u += z[i, 0] * z[i, 1]
        v += z[i, 0] * z[i, 2]
    u, v = u / c, v / c
    fit[0], fit[1], fit[2], fit[3], fit[4], fit[5] = 1.0, u, v, 1.0 / c, 0.0, 0.0
    residual2 = 0.0
    for i in range(n):
        off_u, off_v = z[i, 1] - u * z[i, 0], z[i, 2] - v * z[i, 0]
        residual2 += off_u * off_u + off_v * off_v
        fit[4] += speed2 * z[i, 3] * off_u
        fit[5] += speed2 * z[i, 3] * off_v
    for i in range(n - 1, -1, -1):
        s = z[i, 0] / c
        for k in range(i + 1, n):
            s -= L[k, i] * fit[6 + k]
        fit[6 + i] = s * L[i, i]
    # two axes: twice the logarithm of the determinant's root
    return -SYNC.evidence * (log(det * c) + 0.5 * residual2)


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Every marker in every camera at one epoch."""

    t_ns: int  # the epoch, master's clock
    uv: Float  # (C, M, 2) [px], distorted image; NaN: that camera does not see that marker then
    sigma_px: Float  # (C, M) standard deviation per axis, time error included
    area: Float  # (C, M) [px^2] of the nearest frame
    ready_t_ns: int  # when the last contributing frame was handed to its slave
    missing: Bool  # (C,) cameras that had no frame in time
    alt_uv: Float | None = None  # as `uv`, of the second places that slaves named; None: none at all
    alt_sigma_px: Float | None = None


class FrameSync:
    """Push machine: frames to epochs; `stale`: dropped, they waited while none came."""

    def __init__(
        self,
        cameras: dict[str, CameraModel],
        frame_rate_hz: dict[str, float],
        markers: int,
        *,
        policy: Literal["interpolate", "predict"] = "interpolate",
        continuous: bool = True,
    ) -> None:
        """Take the cameras in the rig's order; the first that delivers leads.

        Args:
            frame_rate_hz: Nominal rates; the slowest sets deadline and largest bridgeable gap.
            markers: How many each message has.
            policy: Wait for the other cameras' next frames and interpolate, or for those alone that are nearer to the
                epoch than the last ones, and predict.
            continuous: False: frames are unrelated poses, nothing is carried from one to another.
        """
        self._index = {name: c for c, name in enumerate(cameras)}
        models, rates = tuple(cameras.values()), [frame_rate_hz[name] for name in cameras]
        count, period_ns = len(models), int(1e9 / min(rates))
        self._markers, self._continuous = markers, continuous
        self._centre_row_ns = [round(0.5 * (model.height_px - 1) * model.row_time_ns) for model in models]
        self._deadline_ns, self._stale_ns = int(SYNC.deadline * period_ns), SYNC.silent_frames * period_ns
        self._half_ns = [int(0.5 * 1e9 / rate) for rate in rates]
        self._slack_ns = self._half_ns if policy == "predict" else [0] * count
        far_ns = int((SYNC.observations + SYNC.carried) * period_ns) if continuous else -1
        near_ns = self._deadline_ns if continuous else self._deadline_ns // 2
        self._reach_ns = near_ns, far_ns, far_ns, far_ns
        self._patience = SYNC.silent_frames * count
        self._slow_frames = [SYNC.slow * sum(rates) / rate for rate in rates]
        self._history = TrackHistory(
            np.zeros(count, np.int64),
            np.full((count, SYNC.history, 3), NEVER_NS),
            np.zeros((count, SYNC.history)),
            np.full((count, SYNC.history, 6, markers), np.nan),
            np.array([model.row_time_ns for model in models], np.float64),
            np.array([model.matrix[0, 0] / SYNC.away_m for model in models]),
        )
        self._newest_of = [NEVER_NS] * count  # centre rows
        self._behind = [False] * count
        self._frames = 0  # of all cameras
        # How many those were at the last ones of each.
        self._came: tuple[deque[int], ...] = tuple(deque(maxlen=SYNC.history) for _ in models)
        self._awaited = 0  # the camera that was waited for when an epoch was last asked for
        self._pending: deque[int] = deque()
        self._newest_ns = self._last_ns = NEVER_NS  # of all frames, of all epochs
        self.stale = 0

    def push(self, message: MarkerDetections) -> list[FrameSet]:
        """Take one camera's detections; return epochs complete or due, oldest first.

        Raises:
            ValueError: The camera or the number of markers is not of this rig (ingest lets no such message pass).
        """
        c = self._index.get(message.camera)
        if c is None:
            raise ValueError(
                f"camera {message.camera!r} is not of this rig, which has {', '.join(self._index)}"
            )
        if len(message.area) != self._markers:
            raise ValueError(f"camera {message.camera!r}: {len(message.area)} markers, not {self._markers}")
        centre_ns = message.t_ns + self._centre_row_ns[c]
        if centre_ns <= self._newest_of[c]:
            return []  # a restarted slave's first clock estimate may step back: wait until time goes on
        self._hold(c, centre_ns, message)
        self._behind[c] = self._newest_ns - centre_ns > self._stale_ns
        self._newest_of[c] = centre_ns
        self._newest_ns = max(self._newest_ns, centre_ns)
        if self._silent(c):
            self._came[c].clear()  # it begins anew
        self._frames += 1
        self._came[c].append(self._frames)
        if centre_ns > self._last_ns and c == self._leader():
            self._pending.append(centre_ns)
            self._last_ns = centre_ns
        return self._emit(flush=False) if self._pending else []

    def flush(self) -> list[FrameSet]:
        """At the end of a recording: emit what is still waiting."""
        return self._emit(flush=True)

    def at(self, t_ns: int) -> FrameSet:
        """Carry the held frames to an epoch."""
        shape = len(self._came), self._markers
        uv, sigma = np.empty((2, *shape, 2)), np.empty((2, *shape))
        area, missing = np.empty(shape), np.empty(shape[0], np.bool_)
        ready_t_ns, alternatives = propagate(self._history, t_ns, self._reach_ns, uv, sigma, area, missing)
        second = (uv[1], sigma[1]) if alternatives else (None, None)
        return FrameSet(t_ns, uv[0], sigma[0], area, ready_t_ns, missing, *second)

    def _hold(self, c: int, centre_ns: int, message: MarkerDetections) -> None:
        """Copy a frame into its camera's ring."""
        total, times_ns, t_sigma_ns, all_marks, _, _ = self._history
        slot = int(total[c]) % SYNC.history
        total[c] += 1
        times_ns[c, slot, 0], times_ns[c, slot, 1] = centre_ns, message.t_ns
        times_ns[c, slot, 2], t_sigma_ns[c, slot] = message.ready_t_ns, message.t_sigma_ns
        marks = all_marks[c, slot]
        marks[:2], marks[2:4] = message.uv.T, message.alt_uv.T
        marks[4], marks[5] = message.sigma_px, message.area

    def _leader(self) -> int:
        first: int | None = None
        for c, came in enumerate(self._came):
            if not came or self._silent(c):
                continue
            if not (self._continuous and (self._behind[c] or self._slow(c))):
                return c
            first = c if first is None else first
        return first or 0

    def _silent(self, c: int) -> bool:
        """Whether others delivered so many frames since its last."""
        came = self._came[c]
        return self._frames - (came[-1] if came else 0) >= self._patience

    def _slow(self, c: int) -> bool:
        """Whether a camera delivers too little to lead, by others and the files' rates."""
        at = self._came[c]
        return len(at) >= SYNC.slow_frames and at[-1] - at[0] > self._slow_frames[c] * (len(at) - 1)

    def _emit(self, *, flush: bool) -> list[FrameSet]:
        out: list[FrameSet] = []
        while self._pending:
            t_ns = self._pending[0]
            waited_ns = self._newest_ns - t_ns
            if not (flush or waited_ns > self._deadline_ns or self._complete(t_ns)):
                break
            self._pending.popleft()
            if self._continuous and waited_ns > self._stale_ns and self._lonely(t_ns):
                self.stale += 1
            else:
                out.append(self.at(t_ns))
        return out

    def _complete(self, t_ns: int) -> bool:
        """Whether no camera is waited for; the one last waited for is asked first."""
        for _ in self._came:
            if self._awaits(self._awaited, t_ns):
                return False
            self._awaited = (self._awaited + 1) % len(self._came)
        return True

    def _awaits(self, c: int, t_ns: int) -> bool:
        """Check whether an epoch waits for the next frame of a camera."""
        newest = self._newest_of[c]
        if newest >= t_ns:
            # At the very start one frame is not yet a track.
            return self._continuous and self._history.total[c] == 1 and not self._silent(c)
        return newest + self._slack_ns[c] < t_ns and not self._silent(c)

    def _lonely(self, t_ns: int) -> bool:
        """Whether a camera, not silent, had no frame from half a period before an epoch."""
        return any(
            not self._silent(c) and not any(-self._half_ns[c] <= s - t_ns <= self._stale_ns for s in centres)
            for c, centres in enumerate(self._history.times_ns[:, :, 0].tolist())
        )
