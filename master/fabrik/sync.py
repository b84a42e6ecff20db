"""Synchronisation of the cameras.

It determines which frames belong together, and the markers at one epoch.

An epoch is the centre row of a frame of the leading camera: the first of the rig that is not silent (silent: others
delivered a dozen frames since its last), nor slow (it delivers less than half of its frames, by what others deliver),
nor behind (its last frame was a dozen periods older than the newest when it came). It is *complete* when every other
camera has delivered a frame at or after it, so that tracks can be interpolated; `predict` waits only for those whose
next frame is nearer to the epoch than their last, and carries the others forward, half a period at most. An epoch
is emitted when it is complete, or when the message time has passed its deadline, with whatever there is. Message time
is the newest capture time seen: no clock is read here, so a replay synchronises exactly as the live run did. An epoch
that still waited for a camera when all fell silent, for as long as makes one silent, is *outdated* and dropped.

Each marker has its own capture time, t_row0 + row_time v: a rolling shutter sees the finger tips earlier than the back
of the hand. `master.fabrik.propagate` carries each to the epoch; a sideways error Dt v would turn into a depth error
D v Dt / B, the largest of an unsynchronised rig.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from common.arrays import Bool, Float
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections
from master.fabrik.propagate import SETTINGS, TrackHistory, propagate

SILENT_FRAMES = 12


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Every marker in every camera at one epoch.

    Attributes:
        t_ns: The epoch, master's clock.
        uv: (C, M, 2) [px], distorted image; NaN: that camera does not see that marker then.
        sigma_px: (C, M) standard deviation per axis, time error included.
        area: (C, M) [px^2] of the nearest frame.
        ready_t_ns: When the last contributing frame was handed to its slave.
        missing: (C,) cameras that had no frame in time.
        alt_uv, alt_sigma_px: As `uv` and `sigma_px` of the second places that slaves named; None: none at all.
    """

    t_ns: int
    uv: Float
    sigma_px: Float
    area: Float
    ready_t_ns: int
    missing: Bool
    alt_uv: Float | None = None
    alt_sigma_px: Float | None = None


class FrameSync:
    """Synchroniser of camera frames into epochs.

    Push machine. Holds the last few frames of each camera and the epochs not yet emitted.

    Attributes:
        outdated: Epochs that were dropped because they waited for as long as nothing came at all.
    """

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
            cameras: Camera name -> model.
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
        self._deadline_ns, self._stale_ns = int(1.25 * period_ns), SILENT_FRAMES * period_ns
        self._half_ns = [int(0.5e9 / rate) for rate in rates]
        self._slack_ns = self._half_ns if policy == "predict" else [0] * count
        far_ns = int((SETTINGS.observations + 0.25) * period_ns) if continuous else -1
        near_ns = self._deadline_ns if continuous else self._deadline_ns // 2
        self._reach_ns = near_ns, far_ns, far_ns, far_ns
        self._patience = SILENT_FRAMES * count
        slow = 2.2  # times as many frames of others as the files state, between so many of its own
        self._slow_frames = [slow * sum(rates) / rate for rate in rates]
        reach_m = 0.5  # where hands are, for what a camera makes of their motion
        self._history = TrackHistory(
            np.zeros(count, np.int64),
            np.full((count, SETTINGS.history, 3), SETTINGS.never),
            np.zeros((count, SETTINGS.history)),
            np.full((count, SETTINGS.history, 6, markers), np.nan),
            np.array([model.row_time_ns for model in models], np.float64),
            np.array([model.matrix[0, 0] / reach_m for model in models]),
        )
        self._newest_of = [SETTINGS.never] * count  # centre rows
        self._behind = [False] * count
        self._frames = 0  # of all cameras
        # How many those were at the last ones of each.
        self._came: tuple[deque[int], ...] = tuple(deque(maxlen=SETTINGS.history) for _ in models)
        self._awaited = 0  # the camera that was waited for when an epoch was last asked for
        self._pending: deque[int] = deque()
        self._newest_ns = self._last_ns = SETTINGS.never  # of all frames, of all epochs
        self.stale = 0

    def push(self, message: MarkerDetections) -> list[FrameSet]:
        """Take one camera's detections and return the finished epochs.

        These are the epochs that became complete or due, oldest first.

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
        slot = int(total[c]) % SETTINGS.history
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
        """Whether a camera delivers too little to lead.

        By what others deliver and the rates of the files.
        """
        at = self._came[c]
        slow_frames = 4  # times as many frames of others as the files state, between so many of its own
        return len(at) >= slow_frames and at[-1] - at[0] > self._slow_frames[c] * (len(at) - 1)

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
        """Whether no camera is waited for.

        One that was when last asked mostly still is, and is asked first.
        """
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
        """Check whether a camera that is not silent had no frame for an epoch.

        From half a period before it to a while after.
        """
        return any(
            not self._silent(c) and not any(-self._half_ns[c] <= s - t_ns <= self._stale_ns for s in centres)
            for c, centres in enumerate(self._history.times_ns[:, :, 0].tolist())
        )
