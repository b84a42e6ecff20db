"""Find tags in a frame, and read their codes.

A push machine; it holds where each tag was and how it moved, and which part of the image is next.

    expected   where the tag must be by its motion, its sides are fitted and its code is read
    near       where that fails, and about what was found (the next face of the box): quads
    anywhere   a part of the image each time, the whole in turn; all of it in the first frame

So a frame costs what the tags in it cost and a fixed part of a search. A code is read by the correlation of the light
of its cells with what each tag of the objects would show there, blurred as the tag's edges are: so a tag is read
though its cells are but two or three pixels wide, and what is no tag correlates with none.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import Float, Ids, Image, Int
from common.calibration import CameraCalibration
from common.calibration.object_profile import ObjectProfile, TagFamily
from common.errors import CalibrationError
from common.geometry.camera_model import CameraModel
from common.geometry.tag_family import GRIDS, tag_bits
from common.messages import MAX_TAGS
from slave.tags.corners import LIGHT, Corners, normal_law, quads, refine

# of a cell, where it is looked at
SPOTS = np.array([[0.0, 0.0], [-0.2, -0.2], [0.2, -0.2], [0.2, 0.2], [-0.2, 0.2]])
SURE = {4: 0.97, 5: 0.88, 6: 0.82}  # cells of code -> correlation from which a tag is accepted
EXPECTED = {4: 0.8, 5: 0.7, 6: 0.6}  # and where it is expected


@dataclass(frozen=True, slots=True)
class Read:
    """What N quads are."""

    which: Int  # (N,) index of the tag that fits best
    quarter_turns: Int  # (N,) which of the quad's corners is the first of the print
    fit: Float  # (N,) correlation -1..1; NaN: the border is not black


class Codes:
    """The tags of one family that are sought, and their patterns.

    Attributes:
        ids: (K,) numbers, rising.
        cells: Along a side, the black border included.
        inner: (K, 4, cells) whether the cells behind the border are white, along the four sides, clockwise.
    """

    def __init__(self, family: TagFamily, numbers: Sequence[int]) -> None:
        """Seek `numbers`; ValueError: the family has no such tag."""
        self.ids: Ids = np.array(sorted(numbers), np.uint16)
        code = GRIDS[family].cells
        self.cells = code + 2
        whole = np.array([np.pad(tag_bits(family, int(number)), 1) for number in self.ids], np.float64)
        # A quad that begins with corner t of the print shows the print turned t times anticlockwise.
        self._patterns = np.stack([np.rot90(whole, t, axes=(1, 2)) for t in range(4)], axis=1)
        self.inner = np.stack([whole[:, 1], whole[:, :, -2], whole[:, -2, ::-1], whole[:, ::-1, 1]], axis=1)
        self.sure, self.expected = SURE[code], EXPECTED[code]

    def read(self, grey: Image, corners: Corners) -> Read:
        """Compare quads with all tags in all four turns."""
        n, m = len(corners.uv), self.cells
        seen = self._seen(grey, corners.uv)
        fits = np.empty((n, len(self.ids), 4))
        for k in range(n):
            x = corners.uv[k]
            side = max(1.0, float(np.linalg.norm(x - np.roll(x, 1, axis=0), axis=1).mean()))
            blur = _blur(m, corners.width_px[k] * m / side)
            shown = (blur @ self._patterns @ blur.T)[..., 1:-1, 1:-1].reshape(len(self.ids), 4, -1)
            fits[k] = _correlation(shown, seen[k, 1:-1, 1:-1].ravel())
        best = fits.reshape(n, -1).argmax(axis=1)
        fit = fits.reshape(n, -1)[np.arange(n), best]
        return Read(best // 4, (4 - best % 4) % 4, np.where(self._black(seen), fit, np.nan))

    def _seen(self, grey: Image, uv: Float) -> Float:
        """Linear light (N, cells, cells) of the cells of quads (N, 4, 2)."""
        m = self.cells
        at = (np.stack(np.meshgrid(np.arange(m), np.arange(m)), axis=-1)[:, :, None] + 0.5 + SPOTS).reshape(
            -1, 2
        )
        square = np.array([[0, 0], [m, 0], [m, m], [0, m]], np.float32)
        seen = np.empty((len(uv), m, m))
        for k, corners in enumerate(uv):
            to_image = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
            spots = cv2.perspectiveTransform(at[None], to_image)[0].astype(np.float32)
            bytes_ = cv2.remap(
                grey, spots[:, :1], spots[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            seen[k] = LIGHT[np.asarray(bytes_, np.uint8)].reshape(m, m, len(SPOTS)).mean(axis=-1)
        return seen

    def _black(self, seen: Float) -> Float:
        """Whether the border of each is black all round."""
        low, high = seen.min(axis=(1, 2)), seen.max(axis=(1, 2))
        border = np.concatenate([seen[:, 0], seen[:, -1], seen[:, 1:-1, 0], seen[:, 1:-1, -1]], axis=1)
        dark_border = 0.4  # of the way from black to white that no cell of the border may pass
        return border.max(axis=1) < low + dark_border * (high - low)


def _blur(cells: int, width: float) -> Float:
    """Share (cells, cells) of each cell in the light of each, blurred by `width`."""
    offset = (np.arange(cells)[:, None] - np.arange(cells)).astype(np.float64)
    width = max(width, 0.05)
    weight = normal_law((offset + 0.5) / width) - normal_law((offset - 0.5) / width)
    return weight / weight.sum(axis=1, keepdims=True)


def _correlation(shown: Float, seen: Float) -> Float:
    """Of patterns (..., C) with one that is seen (C,)."""
    a, b = shown - shown.mean(axis=-1, keepdims=True), seen - seen.mean()
    return (a @ b) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b), 1e-12)


HOLD_NS = 500_000_000  # a tag not seen for longer is anywhere
VELOCITY_NS = 50_000_000  # a velocity is trusted no longer than this
PARTS = ((0.0, 0.0), (0.4, 0.4), (0.4, 0.0), (0.0, 0.4))  # left, top of the parts, shares of the image
Box = tuple[int, int, int, int]  # left, top, right, bottom [px]


@dataclass(frozen=True, slots=True)
class FoundTags:
    """Tags of one frame.

    Attributes:
        ids: (N,) rising.
        uv: (N, 4, 2) corners [px], distorted image: of the print top left, top right, bottom right, bottom left.
        sigma_px: (N,) their standard deviation per axis.
    """

    ids: Ids
    uv: Float
    sigma_px: Float


@dataclass(frozen=True, slots=True)
class _Track:
    """Track of a tag."""

    uv: Float  # corners (4, 2) [px]
    speed: Float  # (4, 2) [px/s]
    t_ns: int

    def expected(self, t_ns: int) -> Float:
        return self.uv + self.speed * (min(t_ns - self.t_ns, VELOCITY_NS) * 1e-9)


class TagFinder:
    """Finder of the tags of one camera's objects: a track per tag, the next part."""

    def __init__(self, camera: CameraCalibration, objects: Sequence[ObjectProfile]) -> None:
        """Seek the tags of `objects`; with intrinsics sides are as the lens bends them.

        Raises CalibrationError: two objects have a tag of the same number, or a family has no such tag.
        """
        self._camera, self._objects = camera, tuple(objects)
        self._size = (camera.height_px, camera.width_px)
        self._lens = None if camera.intrinsics is None else CameraModel.of(camera, np.eye(4))
        self._codes = codes_of(objects)
        self._tracks: dict[int, _Track] = {}
        self._cycle = -1  # which part is next; negative before the first frame
        self._idle = 0

    def fresh(self) -> "TagFinder":
        """A finder of the same tags that has seen nothing yet."""
        return TagFinder(self._camera, self._objects)

    def push(self, image: Image, t_ns: int) -> FoundTags:
        """Find the tags of one frame.

        `image`: (H, W, 3) BGR of the camera's size, or (H, W) grey. `t_ns`: Time of the frame [ns], rising;
        only differences matter. Raises ValueError: the image is not of the camera's size, or not 8 bit.
        """
        if image.shape[:2] != self._size or image.dtype != np.uint8:
            raise ValueError(f"image {image.shape} {image.dtype}, the camera file says {self._size} uint8")
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8) if image.ndim == 3 else image
        tracks = {n: track for n, track in self._tracks.items() if 0 <= t_ns - track.t_ns <= HOLD_NS}
        found: dict[int, tuple[Float, float]] = {}
        for codes in self._codes:
            self._expected(grey, codes, tracks, t_ns, found)
        lost = any(number not in found for number in tracks)
        part = self._part(bool(found))
        sought = (self._near(tracks, found, t_ns) if lost or not self._idle else []) + part
        for box in sought:
            self._search(grey[box[1] : box[3], box[0] : box[2]], grey, box, 1, found)
        if self._cycle == len(PARTS) or self._cycle < 0:
            half = np.asarray(cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
            self._search(half, grey, (0, 0, 0, 0), 2, found)
        if self._cycle < 0:
            self._cycle = 0
        self._tracks = {n: _advanced(tracks.get(n), uv, t_ns) for n, (uv, _) in found.items()} | {
            n: track for n, track in tracks.items() if n not in found
        }
        numbers = sorted(found)[:MAX_TAGS]
        digits = 6  # of what is reported: what comes after them differs between processors
        return FoundTags(
            np.array(numbers, np.uint16),
            np.array([found[n][0] for n in numbers]).reshape(-1, 4, 2).round(digits),
            np.array([found[n][1] for n in numbers]).round(digits),
        )

    def _expected(
        self,
        grey: Image,
        codes: Codes,
        tracks: dict[int, _Track],
        t_ns: int,
        found: dict[int, tuple[Float, float]],
    ) -> None:
        """Fit and read the tracked tags of a family where they must be by now."""
        rows = [row for row, number in enumerate(codes.ids.tolist()) if number in tracks]
        if not rows:
            return
        begun = np.array([tracks[int(codes.ids[row])].expected(t_ns) for row in rows])
        corners = refine(grey, begun, codes.cells, self._lens, codes.inner[rows])
        read = codes.read(grey, corners)
        for k, row in enumerate(rows):
            right = read.which[k] == row and read.quarter_turns[k] == 0 and read.fit[k] >= codes.expected
            if right and math.isfinite(corners.sigma_px[k]):
                found[int(codes.ids[row])] = corners.uv[k], float(corners.sigma_px[k])

    def _search(
        self, part: Image, grey: Image, box: Box, scale: int, found: dict[int, tuple[Float, float]]
    ) -> None:
        """Search a part of the image, from left, top of `box`, smaller by `scale`."""
        begun = quads(part)
        begun = (begun + 0.5) * scale - 0.5 + np.array(box[:2], np.float64)
        begun = begun[[not _known(quad, found) for quad in begun]] if len(begun) else begun
        for codes in self._codes if len(begun) else ():
            coarse = refine(grey, begun, codes.cells, self._lens)
            good = np.isfinite(coarse.sigma_px)
            if not good.any():
                continue
            coarse = Corners(
                coarse.uv[good], coarse.sigma_px[good], coarse.contrast[good], coarse.width_px[good]
            )
            read = codes.read(grey, coarse)
            sure = np.flatnonzero(read.fit >= codes.sure)
            if not len(sure):
                continue
            printed = np.array([np.roll(coarse.uv[k], -read.quarter_turns[k], axis=0) for k in sure])
            final = refine(grey, printed, codes.cells, self._lens, codes.inner[read.which[sure]])
            fits = read.fit[sure]
            for k in np.argsort(-fits, kind="stable"):
                number = int(codes.ids[read.which[sure[k]]])
                if number not in found and math.isfinite(final.sigma_px[k]):
                    found[number] = final.uv[k], float(final.sigma_px[k])

    def _near(self, tracks: dict[int, _Track], found: dict[int, tuple[Float, float]], t_ns: int) -> list[Box]:
        """Return the boxes in which lost tags may be, and those beside found ones."""
        boxes: list[Box] = []
        for number, track in tracks.items():
            near = 0.9  # of a tag's size about it, where the next face of its box may be
            margin = near * float(np.ptp(track.uv, axis=0).max())
            if number in found:
                uv = found[number][0]
            else:
                uv = track.expected(t_ns)
                astray = 40.0 / 640.0  # of the image's width, as of markers: how far it may have gone
                margin += astray * self._size[1] * (1.0 + (t_ns - track.t_ns) / VELOCITY_NS / 4)
            ends = np.floor(uv.min(axis=0) - margin), np.ceil(uv.max(axis=0) + margin)
            left, top, right, bottom = np.clip(ends, 0, self._size[::-1]).astype(int).ravel().tolist()
            boxes.append((left, top, right, bottom))
        return _joined(boxes)

    def _part(self, seen: bool) -> list[Box]:
        """The part of the image that is searched in this frame, if any."""
        height, width = self._size
        if self._cycle < 0:
            return [(0, 0, width, height)]
        idle = 4  # while all that were seen are, every so many frames is searched beside them, and a part
        self._idle = (self._idle + 1) % idle
        if seen and self._idle:
            self._cycle = self._cycle % len(PARTS)
            return []
        self._cycle = (self._cycle + 1) % (len(PARTS) + 1)
        if self._cycle == len(PARTS):
            return []
        x, y = PARTS[self._cycle]
        left, top = int(x * width), int(y * height)
        # their size; what is larger than the overlap is found in the image at half its size, the fifth part
        part = 0.6
        return [(left, top, left + math.ceil(part * width), top + math.ceil(part * height))]


def codes_of(objects: Sequence[ObjectProfile]) -> list[Codes]:
    """What is sought for the tags of objects, by family; raises as `TagFinder`."""
    owner: dict[int, str] = {}
    families: dict[TagFamily, list[int]] = {}
    for profile in objects:
        if profile.tags is None:
            continue
        family = profile.tags.family
        for tag in profile.tags.tags:
            if tag.id in owner:
                raise CalibrationError(
                    f"object {profile.name!r}: tags: {tag.id} is on object {owner[tag.id]!r}, too; messages name tags"
                    " by their numbers alone"
                )
            if tag.id >= GRIDS[family].tags:
                raise CalibrationError(
                    f"object {profile.name!r}: tags: {tag.id}: {family} has 0 to {GRIDS[family].tags - 1}"
                )
            owner[tag.id] = profile.name
            families.setdefault(family, []).append(tag.id)
    return [Codes(family, numbers) for family, numbers in families.items()]


def _known(quad: Float, found: dict[int, tuple[Float, float]]) -> bool:
    middle = quad.mean(axis=0)
    same = 0.35  # of a tag's size: a patch whose middle is nearer to a tag that was found is that tag
    return any(
        np.abs(uv.mean(axis=0) - middle).max() < same * np.ptp(uv, axis=0).max() for uv, _ in found.values()
    )


def _advanced(track: _Track | None, uv: Float, t_ns: int) -> _Track:
    if track is None or not 0 < t_ns - track.t_ns <= 2 * VELOCITY_NS:
        return _Track(uv, np.zeros_like(uv), t_ns)
    return _Track(uv, (uv - track.uv) / ((t_ns - track.t_ns) * 1e-9), t_ns)


def _joined(boxes: list[Box]) -> list[Box]:
    """Boxes that touch as one."""
    whole: list[Box] = []
    for box in boxes:
        left, top, right, bottom = box
        disjoint: list[Box] = []
        for other in whole:
            if left <= other[2] and other[0] <= right and top <= other[3] and other[1] <= bottom:
                left, top = min(left, other[0]), min(top, other[1])
                right, bottom = max(right, other[2]), max(bottom, other[3])
            else:
                disjoint.append(other)
        whole = [*disjoint, (left, top, right, bottom)]
    return whole
