"""Search bands in the image for the seams between the fingers of one hand.

Made once, from what its fingers can do.

The three seams among index ... little have rows of the image as stations, the thumb's has circles about the thumb's
root (CMC). A search band is a middle and a half width at each station, in pixels along the row or in radians along the
circle, from a sweep of the hand model through the ranges of its joints.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from common.arrays import Float, Int
from common.errors import CalibrationError
from common.hand.limits import ABDUCTION
from common.hand.model import CHAINS, METACARPALS
from slave.wrist.view import WristView
from slave.wrist.workspace_samples import (
    NEAREST_M,
    PER_BONE,
    along_bones,
    finger_postures,
    in_image,
    thumb_postures,
)

Float32 = npt.NDArray[np.float32]

STATION_PX = 10.0
_FIRST_RADIUS_PX = 80.0  # nearer to its root the thumb has no seam
LATERAL = (25, 25, 25, 61)  # samples across: index|middle, middle|ring, ring|little, thumb
MARGIN = 12  # samples beyond either edge of a search band: about a finger's breadth
_NO_MAP: Float32 = np.empty((0, 0), dtype=np.float32)
_UNSEEN = "T_camera_palm: the camera does not see the {} of this hand; calibrate the palm's pose"


@dataclass(frozen=True, slots=True, eq=False)
class SearchBands:
    """Search bands of the four seams, in the order of `LATERAL`; S stations.

    Attributes:
        row: First row of the stations of the three finger seams [px].
        radius: Radius of the first station of the thumb's seam [px].
        root: (2,) the thumb's root in the image [px]; angles about it are `angle_of`.
        up: (2,) image direction of angle 0, from the root to the middle finger's knuckle.
        thumb_side: +1.0 where the thumb is to the right in the image, -1.0 to the left.
        middle: (4, S) middle of each search band: u [px], or angle [rad].
        half: (4, S) half width.
        weight: (S, sum of the first three LATERAL + 2 MARGIN each) of what the image shows there: little on the palm,
            whose skin every seam must cross, and one farther aside less of it than one between fingers.
        thumb_crosses: How many of the circles the thumb crosses however it is held.
        map_x, map_y: (S, sum of LATERAL + 2 MARGIN each) where to read the image, float32; the search bands side
            by side, each with its margins.
        palm: (P, 2) columns and rows of the image where the palm is; none where the image does not show it.
    """

    row: float
    radius: float
    root: Float
    up: Float
    thumb_side: float
    middle: Float
    half: Float
    weight: Float32
    thumb_crosses: int
    map_x: Float32
    map_y: Float32
    palm: Int

    def polar(self, uv: Float) -> tuple[Float, Float]:
        """Return the polar coordinates of pixels (N, 2) about the thumb's root.

        Radius [px] and angle [rad], positive towards the thumb's side.
        """
        x, y = uv[:, 0] - self.root[0], uv[:, 1] - self.root[1]
        along = x * self.up[0] + y * self.up[1]
        across = self.thumb_side * (y * self.up[0] - x * self.up[1])
        return np.hypot(x, y), np.arctan2(across, along)

    def lateral(self, seam: int) -> Float:
        """Return the lateral positions of the samples across one search band.

        The positions are (S, LATERAL[seam] + 2 MARGIN), including its margins.
        """
        share = np.arange(-MARGIN, LATERAL[seam] + MARGIN, dtype=np.float64) / (LATERAL[seam] - 1) * 2.0 - 1.0
        return self.middle[seam, :, None] + self.half[seam, :, None] * share

    def across(self, seams: slice, path: Int) -> Float:
        """Return the lateral positions (M, S) of samples of some search bands.

        The samples are (M, S).
        """
        count = np.array(LATERAL[seams])[:, None] - 1
        return self.middle[seams] + self.half[seams] * (2.0 * (path - MARGIN) / count - 1.0)

    def sample(self, seam: int, lateral: Float) -> Float:
        """Return the samples (..., S) of one search band at lateral positions.

        With fractions, of lateral positions (..., S): the inverse of `across`.
        """
        share = (lateral - self.middle[seam]) / self.half[seam]
        return (share + 1.0) * (LATERAL[seam] - 1) / 2.0 + MARGIN

    def pixels(self, seam: int, lateral: Float) -> Float:
        """Pixels (S, ..., 2) of lateral positions (S, ...) of one seam."""
        station = np.arange(len(lateral), dtype=np.float64).reshape(-1, *[1] * (lateral.ndim - 1))
        if seam < 3:
            rows = np.broadcast_to(self.row + STATION_PX * station, lateral.shape)
            return np.stack([lateral, rows], axis=-1)
        r = self.radius + STATION_PX * station
        along, across = r * np.cos(lateral), self.thumb_side * r * np.sin(lateral)
        x, y = self.up
        return self.root + np.stack([along * x - across * y, along * y + across * x], axis=-1)


@lru_cache(maxsize=128)  # one for each way the palm may lie
def search_bands_of(view: WristView) -> SearchBands:
    """Return the search bands of one wrist rig and hand.

    Raises:
        CalibrationError: The palm lies so that no finger can be seen.
    """
    knuckles = in_image(view, view.model.rest_position_m[[7, 12, 22]])[0]
    thumb_side = 1.0 if knuckles[0, 0] > knuckles[2, 0] else -1.0
    root = in_image(view, view.model.rest_position_m[2])[0]
    up = (knuckles[1] - root) / np.linalg.norm(knuckles[1] - root)
    unused_px = 80.0  # rows not used: the fingers end below the upper edge of the image
    stations = int((view.optics.height_px - unused_px) // STATION_PX)
    row = view.optics.height_px - STATION_PX * stations
    empty = np.empty((4, stations))
    still = SearchBands(
        row, _FIRST_RADIUS_PX, root, up, thumb_side, empty, empty, _NO_MAP, 0, _NO_MAP, _NO_MAP, _palm(view)
    )
    *workspace, crossed = _thumb_workspace(view, still, stations)
    rows = row + STATION_PX * np.arange(stations, dtype=np.float64)
    three = _between_fingers(view, rows)
    middle, half = (np.vstack([three[k], np.full(stations, workspace[k])]) for k in (0, 1))
    placed = replace(still, middle=middle, half=half, weight=_weight(view, rows), thumb_crosses=crossed)
    grids = [placed.pixels(seam, placed.lateral(seam)) for seam in range(4)]
    grid = np.concatenate(grids, axis=1)
    return replace(placed, map_x=grid[..., 0].astype(np.float32), map_y=grid[..., 1].astype(np.float32))


def _palm(view: WristView) -> Int:
    """Return pixels along the outer half of the metacarpals of index ... little.

    Columns and rows (P, 2) of the image.
    """
    rest = view.model.rest_position_m
    roots, ends = rest[list(METACARPALS)], rest[CHAINS[1:, 0]]
    uv = in_image(view, np.concatenate([roots + share * (ends - roots) for share in (0.5, 0.75, 1.0)]))[0]
    cells = uv.astype(np.int64)
    inside = (cells >= 0).all(axis=1) & (cells[:, 0] < view.optics.width_px)
    return cells[inside & (cells[:, 1] < view.optics.height_px)]


def _between_fingers(view: WristView, rows: Float) -> tuple[Float, Float]:
    """Return the search bands among index ... little at the given rows.

    Middle and half width (3, S) [px].
    """
    limits = view.model.limits_rad
    points = along_bones(view, finger_postures(view, 1, 8, 8))
    focal = view.optics.matrix[0, 0]
    out = np.empty((2, 3, len(rows)))
    for seam in range(3):
        a, b = points[:, seam + 1], points[:, seam + 2]
        mid = (a + b) / 2.0
        uv, depth = in_image(view, mid)
        scale = focal / np.maximum(depth, NEAREST_M)
        spacing = scale * np.linalg.norm(a[:, :1] - b[:, :1], axis=-1)
        of_spread = 0.75  # share of the abduction range that two neighbours are taken to lean the same way
        lean = np.abs(limits[seam + 1 : seam + 3, ABDUCTION]).max() * of_spread
        free = scale * np.linalg.norm((mid - mid[:, :1])[..., ::2], axis=-1) * np.sin(lean)
        least_of_spacing = 0.25
        most_of_spacing = 0.7  # half width of a search band, in spacings of fingers: beyond lies another seam
        free = np.minimum(np.maximum(free, least_of_spacing * spacing), most_of_spacing * spacing)
        seen = (depth > NEAREST_M) & np.isfinite(uv).all(axis=-1)
        out[:, seam] = _band(uv[..., 1][seen], (uv[..., 0] - free)[seen], (uv[..., 0] + free)[seen], rows)
    return out[0], out[1]


def _weight(view: WristView, rows: Float) -> Float32:
    """`SearchBands.weight` of stations at the given rows (S,)."""
    knuckles, ends = (view.model.rest_position_m[CHAINS[1:, k]] for k in (0, 1))
    along = ends - knuckles
    web = 0.4  # of the proximal phalanx: where the webs between the fingers end, and the palm begins
    web_off_m = 4e-3  # how far the palm may lie from where it is thought to: 3 degrees at the knuckles
    off = web + web_off_m / np.linalg.norm(along, axis=1, keepdims=True)
    webs = in_image(view, knuckles + off * along)[0][:, 1]
    columns = [np.full(n + 2 * MARGIN, 0.5 * (webs[k] + webs[k + 1])) for k, n in enumerate(LATERAL[:3])]
    of_palm = 0.05  # weight of what the palm shows, against fingers
    return np.where(rows[:, None] < np.concatenate(columns), 1.0, of_palm).astype(np.float32)


def _band(at: Float, low: Float, high: Float, stations: Float) -> tuple[Float, Float]:
    """Return the middle and half width (S,) of the intervals near each station.

    The intervals are low ... high (N,).
    """
    near = np.abs(at[None] - stations[:, None]) <= STATION_PX
    known = near.any(axis=1)
    if not known.any():
        raise CalibrationError(_UNSEEN.format("fingers"))
    lows = np.array([np.quantile(low[row], 0.1) for row in near[known]])
    highs = np.array([np.quantile(high[row], 0.9) for row in near[known]])
    ends = [np.interp(stations, stations[known], end) for end in (lows, highs)]
    lows, highs = (np.convolve(np.pad(end, 2, mode="edge"), np.full(5, 0.2), mode="valid") for end in ends)
    return (lows + highs) / 2.0, (highs - lows) / 2.0


def _thumb_workspace(view: WristView, still: SearchBands, stations: int) -> tuple[float, float, int]:
    """Return the thumb's search band and the stations that the thumb crosses.

    Middle and half width [rad] on the finger's side of all that its axis can reach; and how many stations the thumb
    crosses however it is held.

    Raises:
        CalibrationError: No posture of the thumb, or of its tip, is before the camera.
    """
    points = along_bones(view, thumb_postures(view, 7, 7, 3, 3))[:, 0, PER_BONE:]  # beyond the metacarpal
    uv, depth = in_image(view, points)
    radius, angle = still.polar(uv.reshape(-1, 2))
    scale = view.optics.matrix[0, 0] / np.maximum(depth, NEAREST_M).ravel()
    breadth = np.arcsin(np.minimum(scale * view.model.radius_m[4] / np.maximum(radius, 1.0), 0.9))
    seen = (depth > NEAREST_M).ravel()
    ends = depth[:, -1] > NEAREST_M
    if not ends.any():
        raise CalibrationError(_UNSEEN.format("thumb"))
    rare = 0.02  # share of the postures of a sweep rejected at either end
    low, high = np.quantile((angle - breadth)[seen], (rare, 1.0 - rare))
    tips = radius.reshape(len(points), -1)[:, -1]
    crossed = (np.quantile(tips[ends], rare) - _FIRST_RADIUS_PX) / STATION_PX
    return (low + high) / 2.0, (high - low) / 2.0, int(np.clip(crossed, 0, stations))
