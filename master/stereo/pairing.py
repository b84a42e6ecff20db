"""All cameras brought to one instant: which frames belong together, and where each marker was then.

An instant is the centre row of a frame of the leading camera: the first of the rig that is not silent (silent: others
delivered a dozen frames since its last), nor slow (it delivers less than half of its frames, by what others deliver),
nor behind (its last frame was a dozen periods older than the newest when it came). It is *complete* when every other
camera has delivered a frame at or after it, so that tracks can be interpolated; `predict` waits only for those whose
next frame is nearer to the instant than their last, and carries the others forward, half a period at most. An instant
is emitted when it is complete, or when the message time has passed its deadline, with whatever there is. Message time
is the newest capture time seen: no clock is read here, so a replay pairs exactly as the live run did. An instant that
still waited for a partner when all cameras fell silent, for as long as makes one silent, is *outdated* and left out:
nobody asks any more where the hand was then.

Each marker has its own capture time, t_row0 + row_time v: a rolling shutter sees the finger tips earlier
than the back of the hand. `master.stereo.tracks` carries each to the instant; a sideways error Dt v would turn into a
depth error D v Dt / B, the largest of an unsynchronised rig.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from common.arrays import Bool, Float
from common.camera_model import CameraModel
from common.messages import MarkerDetections
from master.stereo.tracks import SIGHTINGS, Sighting, carry

HISTORY = 8
SILENT_FRAMES = 12
_SLOW, _SLOW_FRAMES = 2.2, 4  # times as many frames of others as the files say, between so many of its own
_REACH_M = 0.5  # where hands are, for what a camera makes of their motion


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """Every marker in every camera at one moment.

    Attributes:
        t_ns: The moment, master's clock.
        uv: (C, M, 2) [px], distorted image; NaN: that camera does not see that marker then.
        sigma_px: (C, M) standard deviation per axis, time error included.
        area: (C, M) [px^2] of the nearest sighting.
        ready_t_ns: When the last contributing frame was handed to its slave.
        missing: (C,) cameras that had no frame in time.
        rival_uv, rival_sigma_px: As `uv` and `sigma_px` of the second places that slaves named; None: none at all.
    """

    t_ns: int
    uv: Float
    sigma_px: Float
    area: Float
    ready_t_ns: int
    missing: Bool
    rival_uv: Float | None = None
    rival_sigma_px: Float | None = None


class Pairing:
    """Push machine. Holds the last few sightings of each camera and the instants not yet emitted.

    Attributes:
        outdated: Instants that were left out because they waited for as long as nothing came at all.
    """

    def __init__(
        self,
        cameras: dict[str, CameraModel],
        frame_rate_hz: dict[str, float],
        *,
        policy: Literal["interpolate", "predict"] = "interpolate",
        continuous: bool = True,
    ) -> None:
        """Take the cameras in the rig's order; the first that speaks leads.

        Args:
            cameras: Camera name -> model.
            frame_rate_hz: Nominal rates; the slowest sets deadline and largest bridgeable gap.
            policy: Wait for the other cameras' next frames and interpolate, or for those alone that are nearer to the
                instant than the last ones, and predict.
            continuous: False: frames are unrelated poses, nothing is carried from one to another.
        """
        self._names = tuple(cameras)
        self._index = {name: c for c, name in enumerate(cameras)}
        self._cameras = tuple(cameras.values())
        period_ns = int(1e9 / min(frame_rate_hz[name] for name in self._names))
        self._deadline_ns = int(1.25 * period_ns)
        self._gap_ns = int((SIGHTINGS + 0.25) * period_ns)
        self._outdated_ns = SILENT_FRAMES * period_ns
        self._half_ns = [int(0.5e9 / frame_rate_hz[name]) for name in self._names]
        self._scale_px_m = np.array([camera.matrix[0, 0] / _REACH_M for camera in self._cameras])
        self._patience = SILENT_FRAMES * len(cameras)
        self._policy, self._continuous = policy, continuous
        self.outdated = 0
        self._seen: tuple[deque[Sighting], ...] = tuple(deque(maxlen=HISTORY) for _ in self._names)
        self._frames = 0  # of all cameras
        # How many those were at the last ones of each.
        self._came: tuple[deque[int], ...] = tuple(deque(maxlen=HISTORY) for _ in self._names)
        together_hz = sum(frame_rate_hz[name] for name in self._names)
        self._slow_frames = [_SLOW * together_hz / frame_rate_hz[name] for name in self._names]
        self._behind = [False] * len(self._names)
        self._awaited = 0  # the camera that was waited for when somebody asked last
        self._pending: deque[int] = deque()
        self._origin_ns: int | None = None
        self._newest_ns = -(2**63)
        self._emitted_ns = -(2**63)

    def push(self, message: MarkerDetections) -> list[Instant]:
        """Take one camera's detections; return the instants that became complete or due, oldest first.

        Raises:
            ValueError: The camera is not of this rig (ingest lets no such message pass).
        """
        index = self._index.get(message.camera)
        if index is None:
            raise ValueError(
                f"camera {message.camera!r} is not of this rig, which has {', '.join(self._names)}"
            )
        camera = self._cameras[index]
        if self._origin_ns is None:
            self._origin_ns = message.t_ns
        half = 0.5 * (camera.height_px - 1) * camera.row_time_ns
        centre_ns = message.t_ns + round(half)
        if self._seen[index] and centre_ns <= self._seen[index][-1].centre_ns:
            return []  # a restarted slave's first clock estimate may step back: wait until time goes on
        rivals = message.rival_uv if message.has_rivals else None
        self._seen[index].append(
            Sighting(
                centre_ns=centre_ns,
                marks=self._marks(message, camera, message.uv),
                area=message.area,
                ready_t_ns=message.ready_t_ns,
                rivals=None if rivals is None else self._marks(message, camera, rivals),
                t_sigma_ns=message.t_sigma_ns,
            )
        )
        self._behind[index] = self._newest_ns - centre_ns > self._outdated_ns
        self._newest_ns = max(self._newest_ns, centre_ns)
        if self._silent(index):
            self._came[index].clear()  # it begins anew
        self._frames += 1
        self._came[index].append(self._frames)
        newest_instant = self._pending[-1] if self._pending else self._emitted_ns
        if index == self._leader() and centre_ns > newest_instant:
            self._pending.append(centre_ns)
        return self._emit(flush=False)

    def flush(self) -> list[Instant]:
        """At the end of a recording: emit what is still waiting."""
        return self._emit(flush=True)

    def _marks(self, message: MarkerDetections, camera: CameraModel, uv: Float) -> Float:
        """Places (M, 2) with the times of their rows and their sigmas, as `Sighting.marks`."""
        assert self._origin_ns is not None
        marks = np.empty((len(uv), 4))
        marks[:, :2], marks[:, 3] = uv, message.sigma_px
        marks[:, 2] = (message.t_ns - self._origin_ns) + camera.row_time_ns * uv[:, 1]
        return marks

    def _leader(self) -> int:
        first: int | None = None
        for camera, came in enumerate(self._came):
            if not came or self._silent(camera):
                continue
            if not (self._continuous and (self._behind[camera] or self._slow(camera))):
                return camera
            first = camera if first is None else first
        return first or 0

    def _silent(self, camera: int) -> bool:
        """Whether others delivered so many frames since its last."""
        came = self._came[camera]
        return self._frames - (came[-1] if came else 0) >= self._patience

    def _slow(self, camera: int) -> bool:
        """Whether a camera delivers too little to lead.

        By what others deliver and the rates of the files.
        """
        at = self._came[camera]
        return len(at) >= _SLOW_FRAMES and at[-1] - at[0] > self._slow_frames[camera] * (len(at) - 1)

    def _emit(self, *, flush: bool) -> list[Instant]:
        out: list[Instant] = []
        while self._pending:
            t_ns = self._pending[0]
            waited_ns = self._newest_ns - t_ns
            if not (flush or waited_ns > self._deadline_ns or self._complete(t_ns)):
                break
            self._pending.popleft()
            self._emitted_ns = t_ns
            if self._continuous and waited_ns > self._outdated_ns and self._lonely(t_ns):
                self.outdated += 1
                continue
            out.append(self._at(t_ns))
        return out

    def _complete(self, t_ns: int) -> bool:
        # Asked with every message: the camera that was missing mostly still is.
        if self._awaits(self._awaited, t_ns):
            return False
        for camera in range(len(self._seen)):
            if self._awaits(camera, t_ns):
                self._awaited = camera
                return False
        return True

    def _awaits(self, camera: int, t_ns: int) -> bool:
        """Whether an instant waits for the next frame of a camera."""
        if self._silent(camera):
            return False
        seen = self._seen[camera]
        if not seen:
            return True
        newest = seen[-1].centre_ns
        if newest >= t_ns:
            # At the very start one sighting is not yet a track.
            return self._continuous and len(seen) <= 1
        return self._policy == "interpolate" or t_ns - newest > self._half_ns[camera]

    def _lonely(self, t_ns: int) -> bool:
        """Whether a camera that is not silent had no frame for an instant: half a period before, or a while after."""
        return any(
            not self._silent(c)
            and not any(-self._half_ns[c] <= s.centre_ns - t_ns <= self._outdated_ns for s in seen)
            for c, seen in enumerate(self._seen)
        )

    def _at(self, t_ns: int) -> Instant:
        assert self._origin_ns is not None
        views = [self._neighbours(c, t_ns) for c in range(len(self._names))]
        carried = carry(views, float(t_ns - self._origin_ns), self._scale_px_m)
        return Instant(
            t_ns,
            carried.uv,
            carried.sigma_px,
            # The sigma of a camera that sees nothing is NaN, and so is the area.
            area=np.array([v[0].area if v else s for v, s in zip(views, carried.sigma_px, strict=True)]),
            ready_t_ns=max([sighting.ready_t_ns for view in views for sighting in view]),
            missing=np.array([not view for view in views]),
            rival_uv=carried.rival_uv,
            rival_sigma_px=carried.rival_sigma_px,
        )

    def _neighbours(self, camera: int, t_ns: int) -> list[Sighting]:
        """Up to four sightings around the instant, nearest first, none farther away than a gap.

        None at all where even the nearest is farther than the deadline: a track carried over two frames into
        the unknown is a guess of decimetres in depth, and the ray of the camera that does see is worth more.
        Of those after the instant only the first counts (two where there are none before), as if the others had
        not yet come: what is emitted does not depend on how far a camera's messages ran ahead of another's.
        """
        known = self._seen[camera]
        before = len(known)
        while before and known[before - 1].centre_ns >= t_ns:
            before -= 1
        if not before:
            near = [known[k] for k in range(min(len(known), 2))]
        else:
            near = [known[k] for k in range(before - 1, max(before - SIGHTINGS, 0) - 1, -1)]
            if before < len(known):
                away_ns = known[before].centre_ns - t_ns
                near.insert(sum(t_ns - s.centre_ns <= away_ns for s in near), known[before])
                del near[SIGHTINGS:]
        if not near or abs(near[0].centre_ns - t_ns) > self._deadline_ns:
            return []
        reach = self._gap_ns if self._continuous else self._deadline_ns // 2
        near = [s for s in near if abs(s.centre_ns - t_ns) <= reach]
        return near if self._continuous else near[:1]
