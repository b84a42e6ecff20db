"""A window holds the observations of one object around an epoch.

An epoch is the centre row of a frame of the leading camera: the first of the rig that is not silent, as in
`master.fabrik.sync`. It is complete when every other camera has delivered a frame at or after it, its tags
included where the object has tags: those of a frame have come, or never will, when the markers of the next
are there. It is due when the message time has passed its deadline. Message time is the newest capture time:
no clock is read. Nothing is carried to the epoch here: every point keeps the time of its own row
(`master.objects.fit`).

A feature that a camera should see and does not is hidden, and so is a bead that shows much less of its disc
than it has shown: how much of a ball counts as painted depends on light and colour, so each bead in each
camera is compared with what it shows when it is whole, which is learnt as the larger part of what it has
shown.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import Bool, Float, Int
from common.geometry.camera_model import CameraModel
from common.messages import MarkerDetections, TagDetections
from master.fabrik.caps import LensShift
from master.fabrik.settings import SYNC
from master.objects.surface import Features

_PERIOD_NS = 16_666_667  # until it is measured from frames
_DEADLINE = 1.25  # periods


@dataclass(frozen=True, slots=True, eq=False)
class ImageObservation:
    """One camera's observation of K points in one frame, by markers or by tags."""

    centre_ns: int  # when its centre row was exposed
    ready_t_ns: int  # when the frame was handed to its slave
    point: Int  # (K,) rows of `Features.points`
    uv: Float  # (K, 2) [px] as from a lens that keeps blobs in their place; NaN: not seen
    alt_uv: Float  # (K, 2) [px] second places; NaN: none
    t_ns: Float  # (K,) when the rows were exposed [ns], from the first frame of all
    sigma_px: Float  # (K,)
    t_sigma_s: float  # the same for all
    area_px2: Float  # (K,) of blobs; NaN: a corner


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """All observations around an epoch.

    `views` of each camera: up to four observations by markers and four by tags, each kind the nearest first.
    """

    t_ns: int  # the epoch, master's clock
    origin_ns: int  # the first frame of all, to which the times of observations count
    views: tuple[tuple[tuple[ImageObservation, ...], tuple[ImageObservation, ...]], ...]
    ready_t_ns: int  # when the last contributing frame was handed to its slave
    period_ns: int  # from frame to frame, of the slowest camera

    def near(self, camera: int, kind: int) -> ImageObservation | None:
        """Return a camera's observation at the epoch; None: it did not look."""
        views = self.views[camera][kind]
        if not views or abs(views[0].centre_ns - self.t_ns) > _DEADLINE * self.period_ns:
            return None
        return views[0]


class Windows:
    """Push machine: observations to epochs; holds the last of each camera."""

    def __init__(
        self,
        cameras: Mapping[str, CameraModel],
        features: Features,
        *,
        predict: bool = False,
        late_ns: Mapping[str, int] | None = None,
    ) -> None:
        """Take the cameras in the rig's order; `late_ns`: frames are later than stamps.

        `predict`: do not wait for a camera whose last frame is nearer to the epoch than its next.
        """
        self._names, self._cameras = tuple(cameras), tuple(cameras.values())
        self._features, self._predict, self._late_ns = features, predict, dict(late_ns or {})
        self._shift = [LensShift((camera,)) for camera in self._cameras]
        kept = SYNC.history
        self._seen = [
            (deque[ImageObservation](maxlen=kept), deque[ImageObservation](maxlen=kept)) for _ in self._names
        ]
        self._frames: list[deque[int]] = [deque(maxlen=2) for _ in self._names]  # centres, of markers
        self._newest_of = [-(2**63)] * len(self._names)
        self._period_ns = [_PERIOD_NS] * len(self._names)
        self._waiting = [0] * len(self._names)
        self._pending: deque[int] = deque()
        self._origin_ns: int | None = None
        self._newest_ns = self._emitted_ns = -(2**63)

    def push(self, message: MarkerDetections | TagDetections) -> list[Window]:
        """Take one camera's detections; return epochs complete or due, oldest first.

        Raises:
            ValueError: The camera is not of this rig.
        """
        if message.camera not in self._names:
            raise ValueError(f"camera {message.camera!r} is not of this rig: {', '.join(self._names)}")
        c = self._names.index(message.camera)
        t_ns = message.t_ns + self._late_ns.get(message.camera, 0)
        if self._origin_ns is None:
            self._origin_ns = t_ns
        camera = self._cameras[c]
        centre_ns = t_ns + round(0.5 * (camera.height_px - 1) * camera.row_time_ns)
        tags = isinstance(message, TagDetections)
        line = self._seen[c][tags]
        if line and centre_ns <= line[-1].centre_ns:
            return []  # a restarted slave's first clock estimate may step back
        line.append(self._observation(message, c, t_ns, centre_ns))
        self._frame(c, centre_ns, tags)
        return self._emit(flush=False)

    def flush(self) -> list[Window]:
        """At the end of a recording: what still waits."""
        return self._emit(flush=True)

    def _frame(self, c: int, centre_ns: int, tags: bool) -> None:
        """Record what a camera has delivered, and note a new epoch."""
        self._newest_ns = max(self._newest_ns, centre_ns)
        if not tags:
            self._frames[c].append(centre_ns)
        if centre_ns <= self._newest_of[c]:
            return
        step = centre_ns - self._newest_of[c]
        # The shortest step is a frame, those between are lost frames; it may become longer by and by.
        self._period_ns[c] = max(min(step, round(1.02 * self._period_ns[c])), 1_000_000)
        self._newest_of[c] = centre_ns
        self._waiting = [0 if k == c else count + 1 for k, count in enumerate(self._waiting)]
        if c == self._leader() and centre_ns > max(
            self._emitted_ns, self._pending[-1] if self._pending else -(2**63)
        ):
            self._pending.append(centre_ns)

    def _leader(self) -> int:
        return next(
            (c for c in range(len(self._names)) if self._newest_of[c] > -(2**63) and not self._silent(c)), 0
        )

    def _silent(self, c: int) -> bool:
        return self._waiting[c] >= SYNC.silent_frames * len(self._names)

    def _observation(
        self, message: MarkerDetections | TagDetections, c: int, t_ns: int, centre_ns: int
    ) -> ImageObservation:
        assert self._origin_ns is not None
        if isinstance(message, TagDetections):
            point, uv, sigma = self._corners(message)
            area, alternative = np.full(len(point), np.nan), np.full((len(point), 2), np.nan)
        else:
            rows = self._features.rows
            point, sigma, area = np.arange(len(rows)), message.sigma_px[rows], message.area[rows]
            both = np.stack([message.uv[rows], message.alt_uv[rows]])
            if self._shift[c].any and len(rows):
                # Of an alternative the area is not reported: about that of the marker.
                centres = self._shift[c].centres(both.reshape(1, -1, 2), np.tile(area, 2)[None])
                both = centres[0].reshape(both.shape)
            uv, alternative = both
        return ImageObservation(
            centre_ns=centre_ns,
            ready_t_ns=message.ready_t_ns,
            point=point,
            uv=uv,
            alt_uv=alternative,
            t_ns=(t_ns - self._origin_ns) + self._cameras[c].row_time_ns * uv[:, 1],
            sigma_px=sigma,
            t_sigma_s=message.t_sigma_ns * 1e-9,
            area_px2=area,
        )

    def _corners(self, message: TagDetections) -> tuple[Int, Float, Float]:
        """Return a frame's tag corners: points (4 N), places (4 N, 2), sigmas."""
        features, ids = self._features, self._features.tag_ids
        found = [
            (features.corners_of(ids.index(number)), message.uv[k], message.sigma_px[k])
            for k, number in enumerate(message.ids.tolist())
            if number in ids
        ]
        if not found:
            return np.empty(0, np.int64), np.empty((0, 2)), np.empty(0)
        point, uv, sigma = zip(*found, strict=True)
        return np.concatenate(point), np.concatenate(uv), np.repeat(sigma, 4)

    def _emit(self, *, flush: bool) -> list[Window]:
        out: list[Window] = []
        tagged = bool(self._features.tag_ids)
        while self._pending:
            t_ns = self._pending[0]
            period_ns = max(self._period_ns)
            tag_deadline = 2.25  # periods
            due = self._newest_ns - t_ns > (tag_deadline if tagged else _DEADLINE) * period_ns
            if not (flush or due or all(self._complete(c, t_ns, tagged) for c in range(len(self._names)))):
                break
            self._pending.popleft()
            self._emitted_ns = t_ns
            out.append(self._at(t_ns, period_ns))
        return out

    def _complete(self, c: int, t_ns: int, tagged: bool) -> bool:
        """Check whether a camera has delivered all of an epoch, or is silent."""
        if self._silent(c):
            return True
        slack_ns = self._period_ns[c] // 2 if self._predict else 0
        newest = self._newest_of[c]
        if tagged:
            tags, frames = self._seen[c][1], self._frames[c]
            newest = max(tags[-1].centre_ns if tags else -(2**63), frames[0] if len(frames) > 1 else -(2**63))
        return newest + slack_ns >= t_ns

    def _at(self, t_ns: int, period_ns: int) -> Window:
        assert self._origin_ns is not None
        reach_ns = round((SYNC.observations + 0.25) * period_ns)
        views = tuple(
            (_around(markers, t_ns, reach_ns), _around(tags, t_ns, reach_ns)) for markers, tags in self._seen
        )
        ready = [
            s.ready_t_ns for both in views for line in both for s in line if s.centre_ns - t_ns < period_ns
        ]
        return Window(t_ns, self._origin_ns, views, max(ready, default=t_ns), period_ns)


def _around(line: deque[ImageObservation], t_ns: int, reach_ns: int) -> tuple[ImageObservation, ...]:
    """Return up to four observations around an epoch, the nearest first.

    At most one of them is later than the epoch, or two where none is before it.
    """
    known = list(line)
    before = sum(s.centre_ns < t_ns for s in known)
    associated = known[max(before - SYNC.observations, 0) : max(before + 1, 2)]
    near = [s for s in associated if abs(s.centre_ns - t_ns) <= reach_ns]
    return tuple(sorted(near, key=lambda s: abs(s.centre_ns - t_ns))[: SYNC.observations])


class Hidden:
    """Push machine: occluded features; holds how much of a whole bead cameras see."""

    def __init__(self, features: Features, cameras: tuple[CameraModel, ...]) -> None:
        self._features, self._cameras = features, cameras
        self._whole = np.full((len(cameras), features.beads), np.nan)

    def look(self, window: Window, T_rig_object: Float, used: Bool) -> tuple[int, int, bool]:
        """Return how many features are seen and expected, and if a part is hidden.

        At a pose; `used` (C, F): what it rests on, nearest frames.
        """
        beads = self._features.beads
        expected, occluded = np.zeros(used.shape, np.bool_), False
        for c, camera in enumerate(self._cameras):
            markers, tags = window.near(c, 0), window.near(c, 1)
            if markers is None and tags is None:
                continue
            should = self._features.expected(T_rig_object, camera)
            should[:beads] &= markers is not None
            should[beads:] &= tags is not None
            expected[c] = should
            occluded |= bool((should & ~used[c]).any())
            if markers is not None and beads:
                occluded |= self._partly(c, T_rig_object, markers, should[:beads] & used[c, :beads])
        return int(used.any(axis=0).sum()), int((expected | used).any(axis=0).sum()), occluded

    def centroid_sigma_px(self, c: int, T_rig_object: Float, area_px2: Float) -> Float:
        """Return the centroid error [px] of beads (..., B) in camera `c` by occlusion.

        Whatever part of a disc is cut off, its centroid moves by at most about that part of the radius.
        """
        share, radius_px = self._share(c, T_rig_object, area_px2)
        nearly = 0.93  # of that, a bead may show and be whole
        missing = 1.0 - share / (nearly * self._whole[c])
        return np.where(missing > 0.0, np.minimum(missing, 1.0) * radius_px, 0.0)  # NaN: not known, 0

    def _share(self, c: int, T: Float, area_px2: Float) -> tuple[Float, Float]:
        """Return (..., B) shares of discs that beads of areas [px^2] show; radii (B,)."""
        rows = slice(0, self._features.beads)
        camera = self._cameras[c]
        line_of_sight = self._features.points[rows] @ T[:3, :3].T + (T[:3, 3] - camera.centre)
        distance = np.sqrt(np.vecdot(line_of_sight, line_of_sight))
        radius = self._features.radius_m[rows] * camera.matrix[0, 0] / distance
        return area_px2 / (np.pi * radius * radius), radius

    def _partly(self, c: int, T: Float, markers: ImageObservation, seen: Bool) -> bool:
        """Whether a bead that is seen shows too little; learns what they show."""
        share = np.where(seen, self._share(c, T, markers.area_px2)[0], np.nan)
        whole = self._whole[c]
        part = 0.63  # of what a bead shows when it is whole
        partly = bool((share < part * whole).any())
        known = np.isfinite(share)
        learn, forget = 0.06, 0.004  # towards more, towards less, from frame to frame
        pull = np.where(share > whole, learn, forget)
        self._whole[c] = np.where(
            known, np.where(np.isnan(whole), share, whole + pull * (share - whole)), whole
        )
        return partly
